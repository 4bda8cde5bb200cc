"""Which way each node may move: one projector ``[dim, dim]`` a node.

A facet keeps its shape if its nodes move within its plane.  A node may therefore move in the
null space of the normals of all facets around it that have to be kept: in a plane, along a
straight edge, or not at all.  That rule needs no search for planes and edges and does not
depend on numbering.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from jaxsmooth.elements import ElementType, element_type
from jaxsmooth.layers import layer_nodes, nodes_of, stretched
from jaxsmooth.mesh import Labels, Mesh
from jaxsmooth.meshfile import as_mesh
from jaxsmooth.rounding import coordinate_error, type_error
from jaxsmooth.topology import facet_keys, find_facets

__all__ = ["Constraints", "coordinate_error", "detect_constraints"]

_FLAT, _ROUGH = 1e-4, 2e-2  # radians: bounds of the flatness tolerance
_SAFETY = 4.0  # noise of a direction, in units of coordinate error over length
_USUAL = 1e-6  # of the size of a mesh: the noise that weighs small facets against large ones
_SNAP = 1e-12  # components of a direction below this are rounding: it lies along axes or planes of them


class Constraints(eqx.Module):
    """Attributes: orthogonal projectors ``[nodes, dim, dim]`` onto the free directions."""

    projectors: Float[Array, "*batch nodes dim dim"]

    @property
    def freedom(self) -> np.ndarray:
        """Free directions of every node ``[nodes]``: 0 held, 1 on a line, 2 in a plane, 3 free."""
        return np.rint(np.trace(np.asarray(self.projectors), axis1=1, axis2=2)).astype(int)

    @classmethod
    def hold(cls, mesh: Mesh, nodes: Any) -> Constraints:
        """Hold the nodes of a mask ``[nodes]`` or an index array, leave all others free."""
        projectors = np.tile(np.eye(mesh.dim), (len(mesh.points), 1, 1))
        projectors[_mask(nodes, len(mesh.points))] = 0
        return cls(jnp.asarray(projectors, mesh.points.dtype))


def detect_constraints(
    mesh: Any,
    *,
    boundary: str = "slide",
    interfaces: str = "slide",
    feature_angle: float = 0.0,
    flatness: float | None = None,
    fixed: Any = None,
    layers: str = "hold",
    freeze_aspect: float | None = None,
) -> Constraints:
    """Find how every node may move so that the shape of the domain is kept.

    Boundary nodes slide within flat faces and along straight edges and are held elsewhere.
    So do nodes of interfaces between regions (`Mesh.labels`), of embedded surfaces and lines
    that the mesh names, and of the borders between boundary cells of different tags.

    Args:
        mesh: a `Mesh`, or whatever else `as_mesh` takes.
        boundary: ``"slide"``, or ``"fixed"`` to hold every boundary node.
        interfaces: the same choice for interfaces between regions.
        feature_angle: degrees.  A straight fold shallower than this belongs to a curved face,
            whose nodes are held; by default every straight fold is an edge to slide along.
        flatness: angle in radians below which facets lie in one plane.  By default it follows
            from the precision of the coordinates and the size of each facet (1e-4 at least).
        fixed: nodes to hold besides those of `Labels.held`: a mask ``[nodes]`` or indices.
        layers: ``"hold"`` to hold the nodes of boundary layers (`layer_nodes`), whose elements are
            stretched on purpose, or ``"free"``.
        freeze_aspect: hold the nodes of all elements of a greater aspect ratio (`aspect_ratios`).

    Returns:
        The constraints.

    Raises:
        ValueError: for an unknown choice, a mask of another length, or an aspect ratio below 1.
    """
    for name, choice in (("boundary", boundary), ("interfaces", interfaces)):
        if choice not in ("slide", "fixed"):
            raise ValueError(f"{name} must be 'slide' or 'fixed', got {choice!r}")
    if layers not in ("hold", "free"):
        raise ValueError(f"layers must be 'hold' or 'free', got {layers!r}")
    if freeze_aspect is not None and not freeze_aspect >= 1:
        raise ValueError(f"freeze_aspect must be 1 or more, got {freeze_aspect}")
    mesh = as_mesh(mesh)
    points = np.asarray(mesh.points, np.float64)
    count, dim = points.shape
    noise = _Noise.of(np.asarray(mesh.points))
    held = _mask(fixed, count)
    size = float(np.ptp(points, axis=0).max())
    normals, tangents = _Directions(count, dim, size), _Directions(count, dim, size)

    all_facets = find_facets(mesh)
    if layers == "hold":
        held |= layer_nodes(mesh, all_facets)
    if freeze_aspect is not None:
        held |= nodes_of(mesh, stretched(mesh, freeze_aspect))
    for facets in all_facets:
        outer = facets.partner < 0
        between = ~outer & (facets.partner != facets.region)
        for chosen, choice in ((outer, boundary), (between, interfaces)):
            nodes = facets.nodes[chosen]
            if choice == "fixed":
                held[nodes] = True
            else:
                normals.add(nodes, _facet_normals(facets.type, points[nodes], noise.at(nodes), flatness))
    if mesh.labels is not None:
        if mesh.labels.held is not None:
            held |= _mask(mesh.labels.held, count)
        _add_features(mesh.labels, points, noise, flatness, normals, tangents, held)

    projectors = np.tile(np.eye(dim), (count, 1, 1))
    on_facets, free = normals.null_space()
    if feature_angle > 0:
        free[normals.fold_angles(on_facets, free) < np.deg2rad(feature_angle)] = 0
    projectors[on_facets] = free
    on_lines, line = tangents.common_line()
    stays = np.einsum("nij,njk,nki->n", projectors[on_lines], line, line) > 1 - 1e-6
    projectors[on_lines] = line * stays[:, None, None]
    projectors[held] = 0
    return Constraints(jnp.asarray(projectors, mesh.points.dtype))


class _Noise(NamedTuple):
    """How far places may be off: by all there is, and by the rounding of their type alone."""

    all: np.ndarray
    type: np.ndarray

    @classmethod
    def of(cls, points: np.ndarray) -> _Noise:
        return cls(_SAFETY * coordinate_error(points), _SAFETY * type_error(points))

    def at(self, nodes: np.ndarray) -> _Noise:
        """The largest of the nodes of each facet ``[m, k]``."""
        return _Noise(self.all[nodes].max(axis=1), self.type[nodes].max(axis=1))


def _mask(nodes: Any, count: int) -> np.ndarray:
    mask = np.zeros(count, dtype=bool)
    if nodes is None:
        return mask
    nodes = np.asarray(nodes)
    if nodes.dtype == bool and nodes.shape != (count,):
        raise ValueError(f"the mask of fixed nodes has shape {list(nodes.shape)}; the mesh has {count} nodes")
    if nodes.dtype != bool and nodes.size and not (nodes.min() >= 0 and nodes.max() < count):
        raise ValueError(f"a fixed node is out of range; the mesh has {count} nodes")
    mask[nodes if nodes.dtype == bool else nodes.astype(int)] = True
    return mask


class _Directions:
    """Unit vectors gathered at nodes, each with the angle to which it is known.

    A direction v is *normal* to all vectors at a node when the mean square of their cosines
    with v, each over its own tolerance, is at most 1.  Tolerances decide this rank and nothing
    else: which direction it is follows from the vectors, by weights that no rounding enters.
    """

    def __init__(self, count: int, dim: int, size: float):
        self.count, self.dim, self.size = count, dim, size
        self.parts: list[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]] = []
        self.joined: list[np.ndarray] = []

    def add(self, nodes: np.ndarray, found: _Vectors) -> None:
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

    def null_space(self) -> tuple[np.ndarray, np.ndarray]:
        """Nodes that have vectors, and the projectors onto what is normal to all of them."""
        touched, rank, group = self._ranks()
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


class _Vectors(NamedTuple):
    """Unit vectors ``[m, s, dim]`` of facets or segments.

    `height` is their least extent, `tolerance` the angle to which they are known; where the height
    is but a rounding there is no direction, and `known` is false."""

    vectors: np.ndarray
    height: np.ndarray
    tolerance: np.ndarray
    known: np.ndarray


def _known(vectors: np.ndarray, size: np.ndarray, height, noise: _Noise, flatness: float | None) -> _Vectors:
    """Vectors ``[m, s, dim]`` of their sizes ``[m, s]`` made unit ones."""
    known = (height > noise.type) & (size > 0).all(axis=1)
    tolerance = np.clip(noise.all / np.maximum(height, np.finfo(float).tiny), _FLAT, _ROUGH)
    if flatness is not None:
        tolerance = np.full(len(height), float(flatness))
    return _Vectors(vectors / np.where(size > 0, size, 1)[..., None], height, tolerance, known)


def _facet_normals(kind: ElementType, nodes: np.ndarray, noise: _Noise, flatness: float | None) -> _Vectors:
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
    if kind.order == 2:  # tangents at the ends magnify what a mid-side node is off by
        height = height / 4
    return _known(normals, size, height, noise, flatness)


def _add_features(
    labels: Labels,
    points: np.ndarray,
    noise: _Noise,
    flatness: float | None,
    normals: _Directions,
    tangents: _Directions,
    held: np.ndarray,
) -> None:
    """Tagged cells of lower dimension: keep their surfaces, lines, borders and vertices."""
    count, dim = points.shape
    edges, edge_tags, ends, end_tags = [], [], [], []
    for name, nodes, tags in zip(labels.feature_types, labels.features, labels.feature_tags, strict=True):
        if name == "vertex":
            held[nodes[:, 0]] = True
            continue
        kind = element_type(name)
        if kind.dim == 2 and dim == 3:
            normals.add(nodes, _facet_normals(kind, points[nodes], noise.at(nodes), flatness))
            sides = nodes[:, kind.segments]
            edges.append(sides.reshape(-1, 2))
            edge_tags.append(np.repeat(tags, sides.shape[1]))
        elif kind.dim == 1:
            segments = nodes[:, kind.segments].reshape(-1, 2)
            tangents.add(segments, _unit_tangents(points[segments], noise.at(segments), flatness))
            ends.append(nodes[:, :2].reshape(-1))
            end_tags.append(np.repeat(tags, 2))
    if edges:
        pairs, tags = np.concatenate(edges), np.concatenate(edge_tags)
        border = pairs[_on_border(facet_keys(pairs, count), tags)]
        tangents.add(border, _unit_tangents(points[border], noise.at(border), flatness))
    if ends:
        nodes, tags = np.concatenate(ends), np.concatenate(end_tags)
        held[nodes[_on_border(nodes, tags)]] = True


def _on_border(keys: np.ndarray, tags: np.ndarray) -> np.ndarray:
    """True where a key occurs once, or with more than one tag."""
    _, group, number = np.unique(keys, return_inverse=True, return_counts=True)
    total = np.bincount(group, tags)
    square = np.bincount(group, tags.astype(float) ** 2)
    mixed = square * number - total**2 > 0.5
    return (mixed | (number == 1))[group]


def _unit_tangents(ends: np.ndarray, noise: _Noise, flatness: float | None) -> _Vectors:
    vectors = ends[:, 1] - ends[:, 0]
    length = np.linalg.norm(vectors, axis=1)
    return _known(vectors[:, None], length[:, None], length, noise, flatness)
