"""The facets of a mesh whose shape is kept, each once, and their edges, on the host."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from jaxsmooth.cells.table import ElementType
from jaxsmooth.mesh.topology import facet_keys, pair_codes

__all__ = ["Edges", "Segments", "Sides", "segments_of", "unique_sides"]


@dataclass(frozen=True)
class Sides:
    """Facets of one type.

    Attributes:
        type: the facet's element type.
        nodes: ``[m, k]``.
        label: what it belongs to ``[m]``: regions on both sides and tag; different ones do not mix.
        given: number of the given surface it lies on ``[m]``; −1 for none.
    """

    type: ElementType
    nodes: np.ndarray
    label: np.ndarray
    given: np.ndarray


def unique_sides(
    parts: list[tuple[ElementType, np.ndarray, np.ndarray]],
    tags: tuple[np.ndarray, np.ndarray],
    surfaces: list[np.ndarray],
    count: int,
) -> list[Sides]:
    """Facets of several lists, each once: the first of those with the same corners.

    Args:
        parts: type, nodes ``[m, k]`` and the two regions ``[m, 2]`` of each list.
        tags: keys (`facet_keys`) of tagged facets, and their tags.
        surfaces: a mask ``[nodes]`` for each given surface: a facet lies on the one that has all its nodes.
        count: number of nodes of the mesh.
    """
    if not parts:
        return []
    keys = np.concatenate([facet_keys(nodes[:, : kind.corners], count) for kind, nodes, _ in parts])
    number = np.cumsum([0, *(len(nodes) for _, nodes, _ in parts)])
    first = np.zeros(len(keys), bool)
    first[np.unique(keys, return_index=True)[1]] = True
    order = np.argsort(tags[0], kind="stable")
    place = np.clip(np.searchsorted(tags[0][order], keys), 0, max(len(order) - 1, 0))
    tagged = tags[0][order][place] == keys if len(order) else np.zeros(len(keys), bool)
    tag = np.where(tagged, tags[1][order][place] if len(order) else 0, 0)
    regions = np.concatenate([regions for *_, regions in parts])
    label = np.unique(np.c_[regions, tagged, tag], axis=0, return_inverse=True)[1].reshape(-1)
    found = []
    for (kind, nodes, _), low, high in zip(parts, number[:-1], number[1:], strict=True):
        chosen = first[low:high]
        given = np.full(len(nodes), -1)
        for index, mask in enumerate(surfaces):
            given[mask[nodes].all(axis=1)] = index
        found.append(Sides(kind, nodes[chosen], label[low:high][chosen], given[chosen]))
    return [part for part in found if len(part.nodes)]


@dataclass(frozen=True)
class Segments:
    """Edges, or the facets of plane meshes.

    Attributes:
        ends: corner nodes ``[m, 2]``.
        inner: nodes between them ``[m, i]``; −1 where there are fewer.
        bulge: from the middle of the chord to the middle of the segment ``[m, dim]``.
        leave: unit tangents at both ends, into the segment ``[m, 2, dim]``; 0 where there is none.
        bent: whether the segment has a shape of its own, by its inner nodes ``[m]``.
    """

    ends: np.ndarray
    inner: np.ndarray
    bulge: np.ndarray
    leave: np.ndarray
    bent: np.ndarray

    def select(self, chosen: np.ndarray) -> Segments:
        """The segments of a mask or an index array."""
        parts = (self.ends, self.inner, self.bulge, self.leave, self.bent)
        return Segments(*(part[chosen] for part in parts))

    @classmethod
    def join(cls, parts: list[Segments]) -> Segments:
        """All segments of several lists."""
        width = max(part.inner.shape[1] for part in parts)
        inner = [np.pad(p.inner, ((0, 0), (0, width - p.inner.shape[1])), constant_values=-1) for p in parts]
        return cls(
            np.concatenate([p.ends for p in parts]),
            np.concatenate(inner),
            np.concatenate([p.bulge for p in parts]),
            np.concatenate([p.leave for p in parts]),
            np.concatenate([p.bent for p in parts]),
        )

    def once(self, count: int) -> Segments:
        """Each once: the first of those with the same ends, a bent one before straight ones."""
        order = np.argsort(~self.bent, kind="stable")
        first = np.unique(pair_codes(self.ends[order], count), return_index=True)[1]
        return self.select(order[first])


def segments_of(kind: ElementType, nodes: np.ndarray, points: np.ndarray) -> Segments:
    """Segments of line elements ``[m, k]``."""
    places = points[nodes]
    ends = kind.natural[:2]
    middle = np.einsum("k,mkd->md", kind.shape_functions(ends.mean(axis=0)[None])[0], places)
    slopes = np.einsum("ek,mkd->med", kind.slopes_at(ends)[:, :, 0], places)
    leave = slopes * np.sign(ends[::-1, 0] - ends[:, 0])[:, None]
    bulge = middle - places[:, :2].mean(axis=1)
    bent = np.full(len(nodes), not kind.linear)
    return Segments(nodes[:, :2], nodes[:, 2:], bulge if bent.any() else 0 * bulge, _unit(leave), bent)


def _unit(vectors: np.ndarray) -> np.ndarray:
    size = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return vectors / np.where(size > 0, size, 1)


@dataclass(frozen=True)
class Edges:
    """The edges of all facets of a list of `Sides` in 3D, a row for every edge of every facet.

    Facets and their corners are numbered through all sides.

    Attributes:
        segments: the edges.
        facet: facet of each row ``[rows]``.
        corner: numbers of the facet's corners at both ends ``[rows, 2]``.
        normal: unit normal of the facet in the middle of the edge ``[rows, 3]``.
        node: node of every corner ``[corners]``.
        of: facet of every corner ``[corners]``.
        other: the row of the only other facet at the same edge ``[rows]``; −1 where there is none or more.
        same: rows with the same ends have the same number ``[rows]``.
    """

    segments: Segments
    facet: np.ndarray
    corner: np.ndarray
    normal: np.ndarray
    node: np.ndarray
    of: np.ndarray
    other: np.ndarray
    same: np.ndarray

    @classmethod
    def of_sides(cls, sides: list[Sides], points: np.ndarray) -> Edges:
        """Find them."""
        rows, facet, corner, normal, node, of = [], [], [], [], [], []
        facets = corners = 0
        for part in sides:
            kind, m = part.type, len(part.nodes)
            numbers = corners + np.arange(m * kind.corners).reshape(m, -1)
            node.append(part.nodes[:, : kind.corners].reshape(-1))
            of.append(facets + np.repeat(np.arange(m), kind.corners))
            group = kind.edge_nodes
            for pair, local in zip(kind.edges, group.nodes, strict=True):
                rows.append(segments_of(group.type, part.nodes[:, local], points))
                facet.append(facets + np.arange(m))
                corner.append(numbers[:, pair])
                slopes = kind.slopes_at(kind.natural[pair].mean(axis=0)[None])[0]
                tangents = np.einsum("mkd,ke->med", points[part.nodes], slopes)
                normal.append(_unit(np.cross(tangents[:, 0], tangents[:, 1])))
            facets, corners = facets + m, corners + m * kind.corners
        segments = Segments.join(rows)
        other, same = _pair(pair_codes(segments.ends, len(points)))
        facet, corner, normal = (np.concatenate(part) for part in (facet, corner, normal))
        return cls(segments, facet, corner, normal, np.concatenate(node), np.concatenate(of), other, same)

    @property
    def corners(self) -> np.ndarray:
        """Corner nodes of every facet ``[facets, 4]``; −1 where there are fewer."""
        order = np.arange(len(self.of)) - np.searchsorted(self.of, self.of)
        found = np.full((int(self.of.max()) + 1, 4), -1)
        found[self.of, order] = self.node
        return found

    @property
    def angle(self) -> np.ndarray:
        """Angle of the fold at each row ``[rows]``; infinite where the facets do not continue each other."""
        other = np.maximum(self.other, 0)
        cross = np.linalg.norm(np.cross(self.normal, self.normal[other]), axis=1)
        angle = np.arctan2(cross, np.einsum("rd,rd->r", self.normal, self.normal[other]))
        against = (self.segments.ends == self.segments.ends[other][:, ::-1]).all(axis=1)
        return np.where((self.other >= 0) & against, angle, np.inf)


def _pair(codes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    _, same, number = np.unique(codes, return_inverse=True, return_counts=True)
    same = same.reshape(-1)
    order = np.argsort(same, kind="stable")
    other = np.full(len(codes), -1)
    pairs = order[number[same[order]] == 2].reshape(-1, 2)
    other[pairs[:, 0]], other[pairs[:, 1]] = pairs[:, 1], pairs[:, 0]
    return other, same
