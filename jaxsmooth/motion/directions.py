"""Directions at nodes: what rank their vectors have, for the noise in them, and what is normal to all."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from jaxsmooth.cells.table import ElementType
from jaxsmooth.numerics.rounding import coordinate_error, type_error

__all__ = ["Directions", "Noise", "facet_normals", "unit_tangents"]

_FLAT, _ROUGH = 1e-4, 2e-2  # radians: bounds of the flatness tolerance
_SAFETY = 4.0  # noise of a direction, in units of coordinate error over length
_USUAL = 1e-6  # of the size of a mesh: the noise that weighs small facets against large ones
_SNAP = 1e-12  # components of a direction below this are rounding: it lies along axes or planes of them


class Noise(NamedTuple):
    """How far places may be off: by all there is, and by the rounding of their type alone."""

    all: np.ndarray
    type: np.ndarray

    @classmethod
    def of(cls, points: np.ndarray) -> Noise:
        return cls(_SAFETY * coordinate_error(points), _SAFETY * type_error(points))

    def at(self, nodes: np.ndarray) -> Noise:
        """The largest of the nodes of each facet ``[m, k]``."""
        return Noise(self.all[nodes].max(axis=1), self.type[nodes].max(axis=1))


class Directions:
    """Unit vectors gathered at nodes, each with the angle to which it is known.

    A direction v is *normal* to all vectors at a node when the mean square of their cosines
    with v, each over its own tolerance, is at most 1.  Tolerances decide this rank and nothing
    else: which direction it is follows from the vectors, by weights that no rounding enters.
    """

    def __init__(self, count: int, dim: int, size: float):
        self.count, self.dim, self.size = count, dim, size
        self.parts: list[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]] = []
        self.joined: list[np.ndarray] = []

    def add(self, nodes: np.ndarray, found: Vectors) -> None:
        """Add vectors to all nodes ``[m, k]`` of the facets or segments that have them."""
        known = found.known
        # a facet that is hardly more than a point weighs next to nothing
        weight = 1 / np.clip(_USUAL * self.size / found.height[known], _FLAT, 1e8) ** 2
        self.parts.append((nodes[known], found.vectors[known], 1 / found.tolerance[known] ** 2, weight))
        if not known.all():
            self.joined.append(nodes[~known])

    def _groups(self) -> tuple[np.ndarray, np.ndarray]:
        """For each node the one it shares its vectors with, and the nodes of facets without a direction."""
        group, lost = np.arange(self.count), np.zeros(self.count, bool)
        if self.joined:
            ends = np.concatenate(
                [np.stack(np.broadcast_arrays(part[:, :1], part), -1).reshape(-1, 2) for part in self.joined]
            )
            lost[ends] = True
            graph = coo_matrix((np.ones(len(ends), np.int8), ends.T), shape=(self.count, self.count))
            _, group = connected_components(graph, directed=False)
        return group, lost

    def _sum(self, group: np.ndarray, chosen: np.ndarray, weighted: bool) -> np.ndarray:
        """Sums of the squares of the vectors ``[nodes, dim, dim]`` in groups that are chosen."""
        square = np.zeros((self.count, self.dim, self.dim))
        for nodes, vectors, precision, weight in self.parts:
            rows = slice(None) if chosen.all() else chosen[group[nodes]].any(axis=1)
            factor = (precision if weighted else weight)[rows]
            outer = np.einsum("msi,msj,m->mij", vectors[rows], vectors[rows], factor)
            flat = group[nodes[rows]].reshape(-1)
            for i in range(self.dim):
                for j in range(i + 1):
                    part = np.repeat(outer[:, i, j], nodes.shape[1])
                    square[:, i, j] += np.bincount(flat, part, minlength=self.count)
        lower = np.tril(square, -1)
        return square + lower.swapaxes(1, 2)

    def _ranks(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Nodes that have vectors, how many directions these span, and their groups."""
        group, lost = self._groups()
        number = np.zeros(self.count)
        for nodes, vectors, *_ in self.parts:
            number += vectors.shape[1] * np.bincount(group[nodes].reshape(-1), minlength=self.count)
        every = np.ones(self.count, bool)
        touched = np.flatnonzero((number[group] > 0) | lost)
        own = group[touched]
        values = np.linalg.eigvalsh(self._sum(group, every, True)[own])
        rank = (values > number[own, None]).sum(axis=1)
        return touched, np.where(number[own] > 0, rank, self.dim), group

    def _vectors(self, nodes: np.ndarray, group: np.ndarray, which: np.ndarray) -> np.ndarray:
        """Eigenvectors of the vectors' squares at nodes, counted from that of the least value."""
        chosen = np.zeros(self.count, bool)
        chosen[group[nodes]] = True
        vectors = np.linalg.eigh(self._sum(group, chosen, False)[group[nodes]])[1]
        vector = np.take_along_axis(vectors, which[:, None, None], axis=2)[..., 0]
        vector[np.abs(vector) < _SNAP] = 0
        return vector

    def _flattened(self, plane: np.ndarray) -> Directions:
        """With one vector for all facets that lie in one plane, as those around a node in a plane do.

        It is as good as that of the largest of them, and counts as much: a node that is surrounded by tiny
        ones may go far.  Where facets are off it by more than their tolerance the face is curved after all,
        and keeps its own.

        Args:
            plane: nodes in planes ``[nodes]``.
        """
        face, number = self._faces(plane)
        square, best = np.zeros((number, self.dim, self.dim)), np.zeros(number)
        for which, (_, vectors, _, weight) in zip(face, self.parts, strict=True):
            np.add.at(square, which, np.einsum("msi,msj,m->mij", vectors, vectors, weight))
            np.maximum.at(best, which, weight)
        common, agree = np.linalg.eigh(square)[1][..., -1], np.ones(number, bool)
        cosines = [
            np.einsum("msi,mi->ms", vectors, common[which])
            for which, (_, vectors, *_) in zip(face, self.parts, strict=True)
        ]
        for which, cosine, (_, _, precision, _) in zip(face, cosines, self.parts, strict=True):
            agree[which[((1 - cosine**2) * precision[:, None] > 1).any(axis=1)]] = False
        flat = Directions(self.count, self.dim, self.size)
        flat.joined = self.joined
        for which, cosine, (nodes, vectors, precision, weight) in zip(face, cosines, self.parts, strict=True):
            one = np.sign(cosine)[..., None] * common[which][:, None]
            vectors = np.where(agree[which][:, None, None], one, vectors)
            flat.parts.append((nodes, vectors, precision, np.where(agree[which], best[which], weight)))
        return flat

    def _faces(self, plane: np.ndarray) -> tuple[list[np.ndarray], int]:
        """The face of each facet, part by part, and the number of faces: those share nodes in planes."""
        first = self.count
        pairs = [np.zeros((0, 2), int)]
        for nodes, *_ in self.parts:
            own = np.broadcast_to(first + np.arange(len(nodes))[:, None], nodes.shape)
            pairs.append(np.stack([own, nodes], axis=-1)[plane[nodes]])
            first += len(nodes)
        ends = np.concatenate(pairs)
        graph = coo_matrix((np.ones(len(ends), np.int8), ends.T), shape=(first, first))
        found, face = np.unique(
            connected_components(graph, directed=False)[1][self.count :], return_inverse=True
        )
        return np.split(face, np.cumsum([len(nodes) for nodes, *_ in self.parts])[:-1]), len(found)

    def null_space(self) -> tuple[np.ndarray, np.ndarray]:
        """Nodes that have vectors, and the projectors onto what is normal to all of them."""
        touched, rank, group = self._ranks()
        plane = np.zeros(self.count, bool)
        plane[touched[rank == 1]] = True
        return self._flattened(plane)._normal_to_all(touched, rank, group)

    def _normal_to_all(
        self, touched: np.ndarray, rank: np.ndarray, group: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        free = np.zeros((len(touched), self.dim, self.dim))
        free[rank == 0] = np.eye(self.dim)
        open_ = np.flatnonzero((rank > 0) & (rank < self.dim))
        plane = rank[open_] == 1  # one normal; else one free direction
        found = _onto(self._vectors(touched[open_], group, np.where(plane, self.dim - 1, 0)))
        free[open_] = np.where(plane[:, None, None], np.eye(self.dim) - found, found)
        return touched, free

    def common_line(self) -> tuple[np.ndarray, np.ndarray]:
        """Nodes that have vectors, and the projector onto their line, or 0 where they disagree."""
        touched, rank, group = self._ranks()
        line = np.zeros((len(touched), self.dim, self.dim))
        one = np.flatnonzero(rank == 1)
        line[one] = _onto(self._vectors(touched[one], group, np.full(len(one), self.dim - 1)))
        return touched, line

    def fold_angles(self, touched: np.ndarray, free: np.ndarray) -> np.ndarray:
        """Angle of the fold at nodes that are free along one line in 3D; infinite elsewhere."""
        count = self.count
        if self.dim == 2:
            return np.full(len(touched), np.inf)
        line = np.zeros((count, 3))
        line[touched] = np.linalg.eigh(free)[1][..., -1]
        folded = np.zeros(count, dtype=bool)
        folded[touched] = np.rint(np.trace(free, axis1=1, axis2=2)) == 1
        low, high, mean = np.full(count, np.inf), np.full(count, -np.inf), np.zeros((count, 3))
        for nodes, vectors, *_ in self.parts:
            np.add.at(mean, nodes, vectors.mean(axis=1)[:, None])
        side = np.cross(line, mean)
        for nodes, vectors, *_ in self.parts:
            along = np.einsum("msd,mkd->mks", vectors, mean[nodes])
            across = np.einsum("msd,mkd->mks", vectors, side[nodes])
            angle = np.arctan2(across, along)
            np.minimum.at(low, nodes, angle.min(axis=-1))
            np.maximum.at(high, nodes, angle.max(axis=-1))
        return np.where(folded, high - low, np.inf)[touched]


def _onto(vectors: np.ndarray) -> np.ndarray:
    """Projectors onto vectors ``[m, dim]``."""
    square = np.einsum("mi,mj->mij", vectors, vectors)
    return square / np.einsum("mi,mi->m", vectors, vectors)[:, None, None]


class Vectors(NamedTuple):
    """Unit vectors ``[m, s, dim]`` of facets or segments.

    `height` is their least extent, `tolerance` the angle to which they are known; where the height
    is but a rounding there is no direction, and `known` is false."""

    vectors: np.ndarray
    height: np.ndarray
    tolerance: np.ndarray
    known: np.ndarray


def _known(vectors: np.ndarray, size: np.ndarray, height, noise: Noise, flatness: float | None) -> Vectors:
    """Vectors ``[m, s, dim]`` of their sizes ``[m, s]`` made unit ones."""
    known = (height > noise.type) & (size > 0).all(axis=1)
    least = np.maximum(noise.all / _ROUGH, np.finfo(float).tiny)  # below it the angle is as large as it gets
    tolerance = np.clip(noise.all / np.maximum(height, least), _FLAT, _ROUGH)
    if flatness is not None:
        tolerance = np.full(len(height), float(flatness))
    return Vectors(vectors / np.where(size > 0, size, 1)[..., None], height, tolerance, known)


def facet_normals(kind: ElementType, nodes: np.ndarray, noise: Noise, flatness: float | None) -> Vectors:
    """Unit normals at the quadrature points of facets ``[m, k, dim]``."""
    tangents = np.einsum("mkd,qke->mqde", nodes, kind.slopes)
    if kind.dim == 1:
        normals = np.stack([tangents[..., 1, 0], -tangents[..., 0, 0]], axis=-1)
    else:
        normals = np.cross(tangents[..., 0], tangents[..., 1])
    size = np.linalg.norm(normals, axis=-1)
    area = (size @ kind.slope_weights) if kind.dim == 2 else None
    corners = nodes[:, : kind.corners]
    longest = np.linalg.norm(corners[:, kind.edges[:, 0]] - corners[:, kind.edges[:, 1]], axis=-1).max(axis=1)
    height = longest if area is None else area / np.maximum(longest, np.finfo(float).tiny)
    if not kind.linear:  # tangents at the ends magnify what a mid-side node is off by
        height = height / 4
    return _known(normals, size, height, noise, flatness)


def unit_tangents(ends: np.ndarray, noise: Noise, flatness: float | None) -> Vectors:
    vectors = ends[:, 1] - ends[:, 0]
    length = np.linalg.norm(vectors, axis=1)
    return _known(vectors[:, None], length[:, None], length, noise, flatness)
