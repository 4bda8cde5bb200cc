"""Edges, corners, faces and angles of one straight element, with finite derivatives everywhere.

Points are those of the corners ``[k, dim]``.  What is written for faces takes points in space ``[k, 3]``.
"""

from __future__ import annotations

from functools import lru_cache

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxsmooth.cells.table import ElementType
from jaxsmooth.numerics.small import least, norm

__all__ = [
    "QUADS",
    "angle",
    "corner_tangents",
    "divide",
    "dot",
    "edge_lengths",
    "greatest",
    "in_space",
    "quad_faces",
    "sides",
    "triangle_faces",
    "unit",
]

Points = Float[Array, "k dim"]
Scalar = Float[Array, ""]

QUADS = {
    "hexahedron": ((0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7), (3, 2, 1, 0), (4, 5, 6, 7)),
    "wedge": ((0, 1, 4, 3), (1, 2, 5, 4), (2, 0, 3, 5)),
    "pyramid": ((0, 1, 2, 3),),
}
_TRIANGLES = {
    "wedge": ((0, 1, 2), (3, 4, 5)),
    "pyramid": ((0, 1, 4), (1, 2, 4), (2, 3, 4), (3, 0, 4)),
}


def divide(top: Array | float, bottom: Array, otherwise: Array | float) -> Array:
    """``top / bottom`` where the bottom is positive, else `otherwise`."""
    solid = bottom > 0
    return jnp.where(solid, top / jnp.where(solid, bottom, 1), otherwise)


def greatest(values: Float[Array, " n"]) -> Scalar:
    """The maximum; its derivative is that of one of the greatest values."""
    return -least(-values)


def dot(a: Array, b: Array) -> Array:
    """Scalar product over the last axis."""
    return (a * b).sum(axis=-1)


def unit(vectors: Float[Array, "... dim"]) -> Float[Array, "... dim"]:
    """Vectors of length 1; zero stays zero."""
    return divide(vectors, norm(vectors)[..., None], 0)


def angle(a: Float[Array, "... 3"], b: Float[Array, "... 3"]) -> Float[Array, "..."]:
    """Angle in degrees, 0 to 180; zero with a vector of length zero."""
    across, along = norm(jnp.cross(a, b)), dot(a, b)
    solid = (across > 0) | (along != 0)
    return jnp.degrees(jnp.where(solid, jnp.arctan2(across, jnp.where(solid, along, 1)), 0))


def in_space(points: Points) -> Float[Array, "k 3"]:
    """Points of the plane as points in space."""
    return jnp.pad(points, ((0, 0), (0, 3 - points.shape[1])))


def sides(points: Points) -> Points:
    """Sides of a polygon: from each corner to the next."""
    return jnp.roll(points, -1, axis=0) - points


def edge_lengths(kind: ElementType, points: Points) -> Float[Array, " edges"]:
    """Lengths of the edges, between corners."""
    return norm(points[kind.edges[:, 0]] - points[kind.edges[:, 1]])


@lru_cache
def _neighbours(kind: ElementType) -> np.ndarray:
    """Ends ``[c, dim]`` of the edges that leave each corner, right-handed; not of the apex of a pyramid."""
    count = kind.corners - (kind.dim == 3 and kind.corners == 5)
    rows = []
    for corner in range(count):
        ends = [a + b - corner for a, b in kind.edges if corner in (a, b)]
        if np.linalg.det(kind.natural[ends] - kind.natural[corner]) < 0:
            ends = [ends[1], ends[0], *ends[2:]]
        rows.append(ends)
    return np.array(rows)


def corner_tangents(kind: ElementType, points: Points) -> Float[Array, "c dim dim"]:
    """The edges that leave each corner, as rows, right-handed; not of the apex of a pyramid."""
    ends = _neighbours(kind)
    return points[ends] - points[: len(ends), None]


def quad_faces(name: str, points: Float[Array, "k 3"]) -> Float[Array, "faces 4 3"]:
    """Corners of the quadrilateral faces of a family."""
    return points[np.array(QUADS[name])]


def triangle_faces(name: str, points: Float[Array, "k 3"]) -> Float[Array, "faces 3 3"]:
    """Corners of the triangular faces of a family."""
    return points[np.array(_TRIANGLES[name])]
