"""Boundary nodes that meet other parts of the mesh without being part of them.

All is found by place, within the rounding of the coordinates and never within a fraction of an
element: boundaries that merely come close are left alone.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.sparse import csr_matrix
from scipy.spatial import cKDTree  # pyright: ignore[reportAttributeAccessIssue]  # compiled, no stub

from jaxsmooth.cells.table import ElementType
from jaxsmooth.mesh.links import NodeLinks
from jaxsmooth.mesh.topology import Facets, lengths
from jaxsmooth.numerics.rounding import CLOSE, ROUNDINGS, coordinate_error

__all__ = ["find_contacts", "find_hanging"]

_CHORD = 1e-3  # a node on a facet is within this part of its size, and so far from its ends
_ARBITRARY = np.array([0.6354, 0.4873, 0.5990])  # of unit length, near no direction of a usual mesh
_NOTHING = 1e-9  # weights below this are rounding
_ITERATIONS = 8  # of Gauss and Newton, for the nearest point of a facet

Blocks = Sequence[tuple[ElementType, np.ndarray]]


def find_contacts(points: np.ndarray, blocks: Blocks, boundary: Sequence[Facets]) -> np.ndarray:
    """Pairs ``[m, 2]`` of boundary nodes of one place that no element joins.

    Args:
        points: coordinates ``[nodes, dim]``.
        blocks: element types with connectivity.
        boundary: the boundary facets.
    """
    allowed, points = ROUNDINGS * coordinate_error(points), points.astype(np.float64)
    on, longest = np.zeros(len(points), bool), 0.0
    for facets in boundary:
        on[facets.nodes] = True
        longest = max(longest, lengths(points, facets.nodes[:, :2]).max(initial=0.0))
    nodes = np.flatnonzero(on)
    if len(nodes) == 0:
        return np.zeros((0, 2), np.int64)
    reach = min(allowed[nodes].max(), CLOSE * longest)
    pairs = nodes[cKDTree(points[nodes], leafsize=8).query_pairs(reach, output_type="ndarray")]
    allowed = np.minimum(allowed, CLOSE * _shortest(points, boundary, pairs))
    pairs = pairs[lengths(points, pairs) <= allowed[pairs].min(axis=1)]
    return pairs[~_in_one_element(pairs, blocks, len(points))]


def _shortest(points: np.ndarray, boundary: Sequence[Facets], chosen: np.ndarray) -> np.ndarray:
    """Length of the shortest edge of boundary facets at the chosen nodes ``[nodes]``."""
    wanted, shortest = np.zeros(len(points), bool), np.full(len(points), np.inf)
    wanted[chosen] = True
    for facets in boundary:
        rows = facets.nodes[wanted[facets.nodes].any(axis=1)]
        ends = rows[:, facets.type.segments].reshape(-1, 2)
        np.minimum.at(shortest, ends, lengths(points, ends)[:, None])
    return shortest


def _in_one_element(groups: np.ndarray, blocks: Blocks, count: int) -> np.ndarray:
    """Whether some element has all nodes of each group ``[groups, m]``."""
    if len(groups) == 0:
        return np.zeros(0, bool)
    wanted = np.zeros(count, bool)
    wanted[groups] = True
    rows, columns, start = [], [], 0
    for _, nodes in blocks:
        element, local = np.nonzero(wanted[nodes])
        rows.append(nodes[element, local])
        columns.append(start + element)
        start += len(nodes)
    rows, columns = np.concatenate(rows), np.concatenate(columns)
    of_node = csr_matrix((np.ones(len(rows), np.int8), (rows, columns)), shape=(count, start))
    common = of_node[groups[:, 0]]
    for other in groups.T[1:]:
        common = common.multiply(of_node[other]).tocsr()
    return np.diff(common.indptr) > 0


def find_hanging(points: np.ndarray, blocks: Blocks, boundary: Sequence[Facets]) -> NodeLinks | None:
    """Boundary nodes inside an edge or face of an element that they are not part of.

    Args:
        points: coordinates ``[nodes, dim]``.
        blocks: element types with connectivity.
        boundary: the boundary facets.

    Returns:
        The hanging nodes with those of the edges and faces they hang on, weighted by their shape
        functions, or None.
    """
    on, links = np.zeros(len(points), bool), []
    given, points = points, points.astype(np.float64)
    listed = [(part, *_edges_of(part.type, part.nodes)) for part in boundary]
    if not listed:
        return None
    crowded = np.split(
        _doubled(points, [line.segments for _, line, _ in listed], [edges for *_, edges in listed]),
        np.cumsum([len(edges) for *_, edges in listed])[:-1],
    )
    if not any(rows.any() for rows in crowded):
        return None
    for part in boundary:
        on[part.nodes] = True
    search = _Search(points, ROUNDINGS * coordinate_error(given), np.flatnonzero(on))
    for (part, line, edges), rows in zip(listed, crowded, strict=True):
        found = [search.inside(line, edges[rows], blocks)]
        if part.type.dim == 2:
            faces = part.nodes[rows.reshape(-1, len(part.nodes)).any(axis=0)]
            found.append(search.inside(part.type, faces, blocks))
        for facets, nodes, weights in found:
            rows = np.column_stack([nodes, np.sort(facets, axis=1)])
            once = np.unique(rows, axis=0, return_index=True)[1]  # all elements around an edge list it
            links.append(NodeLinks.hanging(nodes[once], facets[once], weights[once], points.shape[1]))
    return NodeLinks.join(links)


def _edges_of(kind: ElementType, facets: np.ndarray) -> tuple[ElementType, np.ndarray]:
    """The edges of facets with all their nodes, those of all facets side by side."""
    line, columns = kind.edge_nodes.type, kind.edge_nodes.nodes
    return line, facets[:, columns].swapaxes(0, 1).reshape(-1, columns.shape[1])


def _doubled(points: np.ndarray, segments: list[np.ndarray], edges: list[np.ndarray]) -> np.ndarray:
    """Edges that leave one of their nodes in the same direction as a shorter one ``[edges]``.

    An edge with a node on it does, as that node's element has an edge to a node of it.  Directions
    are compared, among those of one node, by their component along one arbitrary vector."""
    parts = [part[:, local] for part, local in zip(edges, segments, strict=True)]
    ends = np.concatenate([part.reshape(-1, 2) for part in parts])
    halves = [np.full(len(part), part.shape[1]) for part in parts]
    owner = np.repeat(np.arange(sum(map(len, parts))), np.concatenate(halves))
    if points.shape[1] == 2:  # the faces around a solid have each of their edges in both directions
        ends, owner = np.concatenate([ends, ends[:, ::-1]]), np.concatenate([owner, owner])
    vectors = points[ends[:, 1]] - points[ends[:, 0]]
    size = np.linalg.norm(vectors, axis=1)
    along = (vectors @ _ARBITRARY[: points.shape[1]]) / np.where(size > 0, size, 1)
    order = np.argsort(ends[:, 0] * 4.0 + along)
    found = np.zeros(sum(map(len, edges)), bool)
    for step in (1, 2, 3):  # the two sides of an edge come one after the other
        first, second = order[:-step], order[step:]
        near = np.flatnonzero(
            (ends[first, 0] == ends[second, 0])
            & (np.abs(along[first] - along[second]) < 2 * _CHORD)
            & (ends[first, 1] != ends[second, 1])
        )
        first, second = first[near], second[near]
        product = np.einsum("md,md->m", vectors[first], vectors[second])
        same = product > (1 - 2 * _CHORD**2) * size[first] * size[second]
        longer = np.where(size[first] > size[second], owner[first], owner[second])
        found[longer[same]] = True
    return found


class _Search:
    """Boundary nodes by place."""

    def __init__(self, points: np.ndarray, allowed: np.ndarray, nodes: np.ndarray):
        self.points, self.allowed, self.nodes = points, allowed, nodes
        self.tree = cKDTree(points[nodes], leafsize=8)

    def inside(self, kind: ElementType, facets: np.ndarray, blocks: Blocks) -> tuple[np.ndarray, ...]:
        """Facets and nodes, one for one, where a node hangs inside the facet, and its shape functions."""
        row, node = self._around(kind, facets)
        foot, distance = _foot(kind, self.points[facets[row]], self.points[node])
        size = np.ptp(self.points[facets[row][:, : kind.corners]], axis=1).max(axis=1, initial=0.0)
        allowed = np.maximum(self.allowed[node], self.allowed[facets[row]].max(axis=1, initial=0.0))
        within = (distance <= np.minimum(allowed, _CHORD * size)) & _interior(kind, foot)
        row, node, foot = row[within], node[within], foot[within]
        corners = facets[row][:, : kind.corners]
        groups = np.concatenate([node[:, None], corners], axis=1)
        apart = ~_in_one_element(groups, blocks, len(self.points))
        row, node, foot = row[apart], node[apart], foot[apart]
        hangs = self._joined(row, node, corners[apart], blocks)
        weights = kind.shape_functions(foot[hangs])
        return facets[row[hangs]], node[hangs], np.where(np.abs(weights) < _NOTHING, 0, weights)

    def _joined(self, row: np.ndarray, node: np.ndarray, corners: np.ndarray, blocks: Blocks) -> np.ndarray:
        """Nodes that elements join to a corner of their facet, directly or from one to the next.

        Others are of a part that touches the facet, or cuts through it, without being tied to it."""
        width = corners.shape[1]
        pairs = np.stack([np.repeat(node, width), corners.ravel()], axis=1)
        tied = np.any(_in_one_element(pairs, blocks, len(self.points)).reshape(-1, width), axis=1)
        loose, firm = np.flatnonzero(~tied), np.flatnonzero(tied)
        while len(loose) and len(firm):
            one, other = np.nonzero(row[loose][:, None] == row[firm])
            pairs = np.stack([node[loose[one]], node[firm[other]]], axis=1)
            new = np.unique(loose[one[_in_one_element(pairs, blocks, len(self.points))]])
            tied[new] = True
            loose, firm = np.setdiff1d(loose, new), new
        return tied

    def _around(self, kind: ElementType, facets: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Pairs of a facet and a node that is none of its own, within the sphere about its nodes."""
        if len(facets) == 0:
            return np.zeros(0, int), np.zeros(0, int)
        places = self.points[facets]
        centre = places[:, : kind.corners].mean(axis=1)
        radius = np.linalg.norm(places - centre[:, None], axis=-1).max(axis=1)
        lists = self.tree.query_ball_point(centre, radius)
        row = np.repeat(np.arange(len(facets)), [len(part) for part in lists])
        node = self.nodes[np.concatenate([np.asarray(part, int) for part in lists])]
        foreign = (facets[row] != node[:, None]).all(axis=1)
        return row[foreign], node[foreign]


def _foot(kind: ElementType, facets: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Natural coordinates of the points of facets ``[m, k, dim]`` next to ``[m, dim]``; distances."""
    natural = np.tile(kind.natural[: kind.corners].mean(axis=0), (len(points), 1))
    for _ in range(_ITERATIONS):
        values, slopes = kind.shape_functions(natural), kind.slopes_at(natural)
        missing = points - np.einsum("mk,mkd->md", values, facets)
        tangents = np.einsum("mke,mkd->mde", slopes, facets)
        natural = natural + np.einsum("med,md->me", np.linalg.pinv(tangents), missing)
        natural = np.clip(natural, -2, 2)  # what is outside stays there, and finite
    missing = points - np.einsum("mk,mkd->md", kind.shape_functions(natural), facets)
    return natural, np.linalg.norm(missing, axis=1)


def _interior(kind: ElementType, natural: np.ndarray) -> np.ndarray:
    return kind.family.margin(natural) > _CHORD
