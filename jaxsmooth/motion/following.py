"""Sliding within flat faces and along straight edges that turn with the points."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxsmooth.cells.table import ElementType, element_type
from jaxsmooth.convert.meshfile import as_mesh
from jaxsmooth.mesh.record import Mesh
from jaxsmooth.mesh.topology import kept_facets, node_pairs
from jaxsmooth.motion.base import Motion
from jaxsmooth.motion.planar import Constraints
from jaxsmooth.numerics.admissible import Admissible
from jaxsmooth.numerics.small import cofactors, norm

__all__ = ["Following", "follow"]

Field = Float[Array, "nodes dim"]
Blocks = Float[Array, "nodes dim dim"]

_SAME = 1e-2  # entries of projectors that differ by less are those of one direction
_ALONG = 1 - 1e-6  # square of the cosine between a line and an edge on it
_CONSTANT, _PLANE, _EDGE, _LINE = range(4)


class Following(Motion):
    """What nodes may do, by the facets and lines that hold them: which is known, where they point is not.

    `follow` makes one.  Normals, tangents and projectors are those of the present points, and differentiable.
    With ``M = Σ n nᵀ`` of the unit normals around a node the projector is ``I − M / tr M`` in a plane and
    ``adj M / tr adj M`` on an edge; on a line it is ``T / tr T``, ``T = Σ t tᵀ``.

    Attributes:
        projectors: of the nodes that are free or held, and of what no facet or line explains.
        role: of every node: whether it is one of these, in a plane, on an edge between facets, or on a line.
        facets: nodes ``[m, k]`` of the facets around the nodes in planes and on edges.
        pairs: connected nodes on lines ``[l, 2]``.
        types: element types of the facets (static).
    """

    projectors: Blocks
    role: Int[Array, " nodes"]
    facets: tuple[Int[Array, "_ _"], ...]
    pairs: Int[Array, "l 2"]
    types: tuple[str, ...] = eqx.field(static=True)

    def at(self, points: Field) -> Admissible:
        """The tangents of the present facets and lines."""
        kinds = tuple(element_type(name) for name in self.types)
        eye = jnp.eye(points.shape[1], dtype=points.dtype)
        role = self.role[:, None, None]
        faces = jnp.where((role == _PLANE) | (role == _EDGE), _normals(kinds, self.facets, points), eye)
        lines = jnp.where(role == _LINE, _tangents(self.pairs, points), eye)
        found = jnp.where(role == _PLANE, eye - _leading(faces), self.projectors.astype(points.dtype))
        if len(eye) == 3:
            edges = jnp.where(role == _EDGE, faces, eye)
            found = jnp.where(role == _EDGE, _leading(cofactors(edges)), found)
        return Admissible(jnp.where(role == _LINE, _leading(lines), found))


def _normals(kinds: tuple[ElementType, ...], facets: tuple[Array, ...], points: Field) -> Blocks:
    """Σ n nᵀ over the quadrature points of all facets around each node."""
    total = jnp.zeros((*points.shape, points.shape[1]), points.dtype)
    for kind, nodes in zip(kinds, facets, strict=True):
        tangents = jnp.einsum("mkd,qke->mqde", points[nodes], jnp.asarray(kind.slopes, points.dtype))
        if kind.dim == 1:
            normals = jnp.stack([tangents[..., 1, 0], -tangents[..., 0, 0]], axis=-1)
        else:
            normals = jnp.cross(tangents[..., 0], tangents[..., 1])
        square = _unit_squares(normals).sum(axis=1)
        total = total.at[nodes].add(square[:, None])
    return total


def _tangents(pairs: Int[Array, "l 2"], points: Field) -> Blocks:
    """Σ t tᵀ over the edges on lines at each node."""
    total = jnp.zeros((*points.shape, points.shape[1]), points.dtype)
    return total.at[pairs].add(_unit_squares(points[pairs[:, 1]] - points[pairs[:, 0]])[:, None])


def _unit_squares(vectors: Float[Array, "... dim"]) -> Float[Array, "... dim dim"]:
    length = norm(vectors)[..., None]
    unit = vectors / jnp.where(length > 0, length, 1)
    return unit[..., :, None] * unit[..., None, :]


def _leading(square: Blocks) -> Blocks:
    """Projectors onto the leading direction of matrices that have one: their eighth power over its trace."""

    def scaled(square):
        trace = jnp.trace(square, axis1=-2, axis2=-1)[:, None, None]
        return square / jnp.where(trace > 0, trace, 1)

    for _ in range(3):
        square = scaled(square)
        square = square @ square
    return scaled(square)


def follow(mesh: Any, constraints: Motion) -> Following:
    """Constraints that turn with the points, for boundaries that depend on a design.

    `Constraints` are directions that were found in one mesh.  Here is found, once, which facets and lines
    each direction comes from; the motion takes their normals and tangents at the points that it is given.
    It is right for all designs that keep faces flat, edges straight and corners corners.  Directions that
    come from no facet, interface, tagged cell or line stay as they are.

    Args:
        mesh: the mesh that the constraints were found in.
        constraints: of flat faces and straight edges, as `detect_constraints` finds them by default.

    Raises:
        TypeError: for other motions.
    """
    if not isinstance(constraints, Constraints):
        raise TypeError(
            f"follow takes Constraints, got {type(constraints).__name__}; detect them with boundary='planar' "
            "in a mesh whose nodes are not linked"
        )
    mesh = as_mesh(mesh)
    dim, freedom = mesh.dim, constraints.freedom
    points, projectors = mesh.points, jnp.asarray(constraints.projectors)
    kinds, facets = _facets(mesh)
    partly = (freedom > 0) & (freedom < dim)
    square = _normals(kinds, facets, points)
    role = np.full(len(points), _CONSTANT)
    plane = jnp.eye(dim, dtype=points.dtype) - _leading(square)
    role[partly & (freedom == dim - 1) & _close(plane, projectors)] = _PLANE
    if dim == 3:
        edge = _leading(cofactors(square))
        role[(freedom == 1) & _close(edge, projectors)] = _EDGE
    pairs = _on_lines(mesh, np.asarray(projectors), (freedom == 1) & (role == _CONSTANT))
    role[pairs[:, 0]] = _LINE
    bound = (role == _PLANE) | (role == _EDGE)
    chosen = [part[bound[np.asarray(part)].any(axis=1)] for part in facets]
    return Following(
        projectors,
        jnp.asarray(role, jnp.int32),
        tuple(chosen),
        jnp.asarray(pairs, jnp.int32),
        tuple(kind.name for kind in kinds),
    )


def _facets(mesh: Mesh) -> tuple[tuple[ElementType, ...], tuple[Array, ...]]:
    """Facets on the boundary, between regions, and of tagged surfaces."""
    kinds, found = [], []
    for part in kept_facets(mesh):
        kept = (part.partner < 0) | (part.partner > part.region)
        kinds.append(part.type)
        found.append(jnp.asarray(part.nodes[kept], jnp.int32))
    if mesh.labels is not None:
        for name, nodes in zip(mesh.labels.feature_types, mesh.labels.features, strict=True):
            if name != "vertex" and element_type(name).dim == mesh.dim - 1:
                kinds.append(element_type(name))
                found.append(jnp.asarray(nodes, jnp.int32))
    return tuple(kinds), tuple(found)


def _on_lines(mesh: Mesh, projectors: np.ndarray, nodes: np.ndarray) -> np.ndarray:
    """Connected nodes ``[l, 2]`` whose edge goes along the line of the first; once from each end."""
    pairs = np.asarray(node_pairs(mesh))
    pairs = np.concatenate([pairs, pairs[:, ::-1]])
    pairs = pairs[nodes[pairs[:, 0]]]
    points = np.asarray(mesh.points)
    ways = points[pairs[:, 1]] - points[pairs[:, 0]]
    along = np.einsum("li,lij,lj->l", ways, projectors[pairs[:, 0]], ways)
    return pairs[along > _ALONG * (ways**2).sum(axis=1)]


def _close(one: Blocks, other: Blocks) -> np.ndarray:
    return np.asarray(jax.device_get(jnp.abs(one - other).max(axis=(1, 2)))) < _SAME
