"""What follows from connectivity, found once on the host with NumPy."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import jax
import numpy as np

from jaxsmooth.cells.table import ElementType
from jaxsmooth.mesh.hanging import covered
from jaxsmooth.mesh.links import NodeLinks
from jaxsmooth.mesh.memory import Remembered
from jaxsmooth.mesh.record import Mesh

__all__ = [
    "Facets",
    "at_nodes",
    "deformations",
    "determinants",
    "facet_keys",
    "find_facets",
    "kept_facets",
    "lengths",
    "node_pairs",
    "pair_codes",
    "signed_measures",
]


@dataclass(frozen=True)
class Facets:
    """The facets of one facet type, one row for every side of an element.

    Attributes:
        type: the facet's element type (`line`, `triangle`, …).
        nodes: ``[facets, kf]``, outward from the element they belong to.
        region: region of that element ``[facets]`` (0 where the mesh has no labels).
        partner: region on the other side ``[facets]``; −1 on the boundary.
    """

    type: ElementType
    nodes: np.ndarray
    region: np.ndarray
    partner: np.ndarray

    def select(self, chosen: np.ndarray) -> Facets:
        """The facets of a mask ``[facets]``."""
        return Facets(self.type, self.nodes[chosen], self.region[chosen], self.partner[chosen])


def kept_facets(mesh: Mesh) -> list[Facets]:
    """The facets whose shape is kept: those of a solid or a plane mesh, and the elements of a surface.

    A surface is a boundary with nothing behind it: its elements have ``partner == -1``.
    """
    if not mesh.surface:
        return find_facets(mesh)
    parts = zip(mesh.blocks, _regions(mesh), strict=True)
    return [
        Facets(kind, np.asarray(nodes), region, np.full(len(nodes), -1)) for (kind, nodes), region in parts
    ]


_FACETS: Remembered[list[Facets]] = Remembered()


def find_facets(mesh: Mesh) -> list[Facets]:
    """All facets of a mesh, with the region on either side; found once for meshes of one topology.

    Two elements share a facet when they share its corner nodes, or when nodes that hang on it
    (`Labels.links`) divide it on one side.  Boundary facets have ``partner == -1``.
    """
    arrays = jax.tree.leaves((mesh.connectivity, mesh.labels))
    return _FACETS.get(arrays, partial(_find_facets, mesh))


def _find_facets(mesh: Mesh) -> list[Facets]:
    owners: dict[ElementType, list[tuple[np.ndarray, np.ndarray]]] = {}
    for (kind, nodes), region in zip(mesh.blocks, _regions(mesh), strict=True):
        nodes = np.asarray(nodes)
        for group in kind.facets:
            sides = nodes[:, group.nodes].reshape(-1, group.nodes.shape[1])
            owners.setdefault(group.type, []).append((sides, np.repeat(region, len(group.nodes))))
    found = []
    for kind, parts in owners.items():
        nodes = np.concatenate([p[0] for p in parts])
        region = np.concatenate([p[1] for p in parts])
        found.append([kind, nodes, region])
    # A quadratic element may meet a linear one: corners decide, whatever the facet type.
    corners = [_three_corners(nodes[:, : kind.corners]) for kind, nodes, _ in found]
    keys = facet_keys(np.concatenate(corners), len(mesh.points))
    regions = np.concatenate([region for _, _, region in found])
    partner = _pair(keys, regions)
    if mesh.labels is not None and mesh.labels.links is not None:
        _pair_hanging(mesh, mesh.labels.links, found, regions, partner)
    ends = np.cumsum([len(nodes) for _, nodes, _ in found])
    return [
        Facets(kind, nodes, region, other)
        for (kind, nodes, region), other in zip(found, np.split(partner, ends[:-1]), strict=True)
    ]


def facet_keys(corners: np.ndarray, count: int) -> np.ndarray:
    """One integer for every set of corner nodes ``[facets, c]`` of a mesh of `count` nodes."""
    ordered = _three_corners(corners).astype(np.int64)
    if count < 2**21:
        key = ordered[:, 0]
        for column in ordered.T[1:]:
            key = key * count + column
        return key
    return np.unique(ordered, axis=0, return_inverse=True)[1].reshape(-1)


def _three_corners(corners: np.ndarray) -> np.ndarray:
    """The lowest three, sorted: enough to tell the faces of a solid apart."""
    if corners.shape[1] != 3:
        return np.sort(corners, axis=1)[:, :3]
    a, b, c = corners.T
    low, high = np.minimum(a, b), np.maximum(a, b)
    return np.stack([np.minimum(low, c), np.maximum(low, np.minimum(high, c)), np.maximum(high, c)], axis=1)


def _pair(keys: np.ndarray, regions: np.ndarray) -> np.ndarray:
    """For every facet the region of the facet with the same key, or −1."""
    order = np.argsort(keys, kind="stable")
    same = keys[order][1:] == keys[order][:-1]
    partner = np.full(len(keys), -1, dtype=regions.dtype)
    first, second = order[:-1][same], order[1:][same]
    partner[first], partner[second] = regions[second], regions[first]
    return partner


def _pair_hanging(
    mesh: Mesh, links: NodeLinks, facets: list, regions: np.ndarray, partner: np.ndarray
) -> None:
    """Fill in the regions on the other side of facets that are divided there, and of their parts."""
    outer = np.flatnonzero(partner < 0)
    ends = np.searchsorted(outer, np.cumsum([len(nodes) for _, nodes, _ in facets])[:-1])
    rows = np.split(outer, ends)
    start = np.cumsum([0, *(len(nodes) for _, nodes, _ in facets)])
    chosen = [(kind, nodes[r - s]) for (kind, nodes, _), r, s in zip(facets, rows, start, strict=False)]
    pairs = outer[covered(np.asarray(mesh.points, np.float64), chosen, links)]
    partner[pairs[:, 0]] = regions[pairs[:, 1]]
    partner[pairs[:, 1]] = regions[pairs[:, 0]]


def _regions(mesh: Mesh) -> list[np.ndarray]:
    """Regions of the elements of each block, numbered from 0; one region without labels."""
    sizes = [len(nodes) for nodes in mesh.connectivity]
    if mesh.labels is None or not mesh.labels.regions:
        return [np.zeros(size, dtype=np.int64) for size in sizes]
    tags = np.concatenate([np.asarray(part) for part in mesh.labels.regions])
    numbers = np.unique(tags, return_inverse=True)[1].reshape(-1)
    return np.split(numbers, np.cumsum(sizes)[:-1])


def lengths(points: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    """Distances between the two nodes of pairs ``[…, 2]``."""
    return np.linalg.norm(points[pairs[..., 1]] - points[pairs[..., 0]], axis=-1)


def pair_codes(pairs: np.ndarray, count: int) -> np.ndarray:
    """One integer for every pair of nodes ``[…, 2]`` of a mesh of `count`, whichever comes first."""
    return pairs.min(axis=-1).astype(np.int64) * count + pairs.max(axis=-1)


def node_pairs(mesh: Mesh) -> np.ndarray:
    """Pairs of nodes that share an edge, each once ``[pairs, 2]``."""
    parts = [np.asarray(nodes)[:, kind.segments].reshape(-1, 2) for kind, nodes in mesh.blocks]
    pairs = np.sort(np.concatenate(parts), axis=1).astype(np.int64)
    codes = np.unique(pairs[:, 0] * len(mesh.points) + pairs[:, 1])
    return np.stack([codes // len(mesh.points), codes % len(mesh.points)], axis=1)


def at_nodes(points: np.ndarray, nodes: np.ndarray) -> np.ndarray:
    """Coordinates ``[dim, k, elements]`` of the nodes ``[elements, k]``: NumPy is fast on long rows."""
    return np.ascontiguousarray(np.asarray(points).T)[:, np.asarray(nodes).T]


def deformations(corners: np.ndarray, gradients: np.ndarray) -> np.ndarray:
    """Deformation gradients ``[q, dim, dim, elements]`` of elements ``[dim, k, elements]``, on the host.

    Those of natural derivatives ``[q, k, dim]``, of which most are zero for linear elements.
    """
    found = np.zeros((len(gradients), *corners.shape[:1], gradients.shape[2], corners.shape[2]))
    for sample, node, column in np.argwhere(gradients):
        found[sample, :, column] += gradients[sample, node, column] * corners[:, node]
    return found


def determinants(frames: np.ndarray) -> np.ndarray:
    """Of matrices ``[…, dim, dim, elements]``; of ``[…, 3, 2, elements]`` the area, which has no sign."""
    a = np.moveaxis(frames, (-3, -2), (0, 1))
    if a.shape[:2] == (3, 2):
        return np.linalg.norm(np.cross(a[:, 0], a[:, 1], axis=0), axis=0)
    if len(a) == 2:
        return a[0, 0] * a[1, 1] - a[0, 1] * a[1, 0]
    minors = (a[1, 1] * a[2, 2] - a[1, 2] * a[2, 1], a[1, 2] * a[2, 0] - a[1, 0] * a[2, 2])
    return a[0, 0] * minors[0] + a[0, 1] * minors[1] + a[0, 2] * (a[1, 0] * a[2, 1] - a[1, 1] * a[2, 0])


def signed_measures(kind: ElementType, points: np.ndarray, nodes: np.ndarray) -> np.ndarray:
    """Signed area or volume of the elements ``[elements]``, on the host; areas in space have no sign."""
    if not len(nodes):
        return np.zeros(0)
    corners = at_nodes(np.asarray(points, np.float64), nodes)
    return kind.weights @ determinants(deformations(corners, kind.gradients))
