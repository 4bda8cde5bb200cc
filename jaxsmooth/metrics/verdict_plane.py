"""Verdict's metrics of triangles and quadrilaterals (Stimpson et al. 2007, The Verdict library).

Functions take the corners of one element in space ``[3, 3]`` or ``[4, 3]``; a plane mesh lies at z = 0.
As in Verdict a triangle has no orientation, and that of a quadrilateral is its own: the normal at its centre.
So the mirror image of an element, which in a plane mesh is inverted, has the same value.
"""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsmooth.cells.table import element_type
from jaxsmooth.metrics.geometry import angle, divide, dot, greatest, sides, unit
from jaxsmooth.numerics.small import contract, determinant, least, norm

__all__ = [
    "quad_angles",
    "quad_aspect_ratio",
    "quad_condition",
    "quad_distortion",
    "quad_equiangle_skew",
    "quad_frobenius",
    "quad_jacobian",
    "quad_max_edge_ratio",
    "quad_oddy",
    "quad_radius_ratio",
    "quad_scaled_jacobian",
    "quad_shape",
    "quad_size",
    "quad_skew",
    "quad_stretch",
    "quad_taper",
    "quad_warpage",
    "triangle_angles",
    "triangle_aspect_ratio",
    "triangle_equiangle_skew",
    "triangle_frobenius",
    "triangle_radius_ratio",
    "triangle_scaled_jacobian",
    "triangle_size",
]

Triangle = Float[Array, "3 3"]
Quad = Float[Array, "4 3"]
Scalar = Float[Array, ""]
_INF = float("inf")


# --- Triangles ----------------------------------------------------------------------------------------


def triangle_size(points: Triangle) -> Scalar:
    """Area."""
    return norm(jnp.cross(points[1] - points[0], points[2] - points[0])) / 2


def triangle_aspect_ratio(points: Triangle) -> Scalar:
    """``l_max Σl / (4√3 A)``: longest side over inradius, 1 for the equilateral triangle."""
    lengths = norm(sides(points))
    return divide(greatest(lengths) * lengths.sum(), 4 * 3**0.5 * triangle_size(points), _INF)


def triangle_radius_ratio(points: Triangle) -> Scalar:
    """Circumradius over twice the inradius."""
    lengths = norm(sides(points))
    return divide(lengths.prod() * lengths.sum(), 16 * triangle_size(points) ** 2, _INF)


def triangle_frobenius(points: Triangle) -> Scalar:
    """``Σl² / (4√3 A)``: Frobenius condition number against the equilateral triangle, over 2."""
    return divide((sides(points) ** 2).sum(), 4 * 3**0.5 * triangle_size(points), _INF)


def triangle_scaled_jacobian(points: Triangle) -> Scalar:
    """``2/√3`` times twice the area over the greatest product of two sides; never negative."""
    lengths = norm(sides(points))
    products = lengths * jnp.roll(lengths, 1)
    return divide(4 / 3**0.5 * triangle_size(points), greatest(products), 0)


def triangle_angles(points: Triangle) -> Float[Array, " 3"]:
    """The three angles in degrees; zero with a side of length zero."""
    along = sides(points)
    solid = (norm(along) > 0).all()
    return jnp.where(solid, angle(along, -jnp.roll(along, 1, axis=0)), 0)


def triangle_equiangle_skew(points: Triangle) -> Scalar:
    """``max((θ_max − 60°)/120°, (60° − θ_min)/60°)``."""
    found = triangle_angles(points)
    return jnp.maximum((greatest(found) - 60) / 120, (60 - least(found)) / 60)


# --- Quadrilaterals -----------------------------------------------------------------------------------


def _normals(points: Quad) -> Quad:
    """Cross products of the sides that meet at the corners."""
    along = sides(points)
    return jnp.cross(jnp.roll(along, 1, axis=0), along)


def _axes(points: Quad) -> tuple[Array, Array]:
    """Principal axes: twice the vectors between the middles of opposite sides."""
    a, b, c, d = points
    return b + c - a - d, c + d - a - b


def _corner_areas(points: Quad) -> Float[Array, " 4"]:
    """Twice the signed areas of the triangles at the corners, along the normal at the centre."""
    return dot(_normals(points), unit(jnp.cross(*_axes(points))))


def _collapsed(points: Quad) -> Array:
    """Whether the last two corners are one: Verdict takes such a quadrilateral for a triangle."""
    return (points[2] == points[3]).all()


def _neighbours_squared(points: Quad) -> Float[Array, " 4"]:
    """Sums of the squared lengths of the two sides at each corner."""
    squares = dot(sides(points), sides(points))
    return squares + jnp.roll(squares, 1)


def _longest_diagonal(points: Quad) -> Scalar:
    return greatest(norm(points[:2] - points[2:]))


def quad_size(points: Quad) -> Scalar:
    """Area, that of the Jacobian at the centre; never negative."""
    return _corner_areas(points).sum() / 4


def quad_aspect_ratio(points: Quad) -> Scalar:
    """``l_max Σl / (4A)`` (Pébay 2004)."""
    lengths = norm(sides(points))
    return divide(greatest(lengths) * lengths.sum(), 4 * quad_size(points), _INF)


def quad_max_edge_ratio(points: Quad) -> Scalar:
    """Longer over shorter principal axis (Robinson 1987)."""
    first, second = (norm(axis) for axis in _axes(points))
    return divide(jnp.maximum(first, second), jnp.minimum(first, second), _INF)


def quad_radius_ratio(points: Quad) -> Scalar:
    """``√(Σl²) h_max / (2√2 · twice the least corner triangle)``, h_max the longest side or diagonal."""
    squares = dot(sides(points), sides(points))
    top = jnp.sqrt(jnp.where(squares.sum() > 0, squares.sum(), 1))
    longest = jnp.maximum(greatest(norm(sides(points))), _longest_diagonal(points))
    return divide(top * longest, 2 * 2**0.5 * least(norm(_normals(points))), _INF)


def quad_frobenius(points: Quad) -> Float[Array, " 4"]:
    """Frobenius condition numbers at the corners against the square, over 2; they have no sign."""
    return divide(_neighbours_squared(points), 2 * norm(_normals(points)), _INF)


def quad_condition(points: Quad) -> Scalar:
    """The greatest of the condition numbers; infinite where a corner is flat or inverted."""
    corners = greatest(divide(_neighbours_squared(points), 2 * _corner_areas(points), _INF))
    return jnp.where(_collapsed(points), triangle_frobenius(points[:3]), corners)


def quad_shape(points: Quad) -> Scalar:
    """1 over the condition; zero where a corner is flat or inverted."""
    shapes = divide(2 * _corner_areas(points), _neighbours_squared(points), 0)
    solid = (norm(sides(points)) > 0).all()
    return jnp.where(solid, jnp.maximum(least(shapes), 0), 0)


def quad_jacobian(points: Quad) -> Scalar:
    """Least corner Jacobian."""
    return jnp.where(_collapsed(points), 2 * triangle_size(points[:3]), least(_corner_areas(points)))


def quad_scaled_jacobian(points: Quad) -> Scalar:
    """Least corner Jacobian over the lengths of its two sides."""
    lengths = norm(sides(points))
    corners = least(divide(_corner_areas(points), lengths * jnp.roll(lengths, 1), 0))
    corners = jnp.where((lengths > 0).all(), corners, 0)
    return jnp.where(_collapsed(points), triangle_scaled_jacobian(points[:3]), corners)


def quad_skew(points: Quad) -> Scalar:
    """``|cos|`` of the angle between the principal axes (Robinson 1987)."""
    first, second = _axes(points)
    return jnp.abs(dot(unit(first), unit(second)))


def quad_taper(points: Quad) -> Scalar:
    """``|P₀ + P₂ − P₁ − P₃|`` over the shorter principal axis (Robinson 1987)."""
    first, second = (norm(axis) for axis in _axes(points))
    cross = norm(points[0] + points[2] - points[1] - points[3])
    return divide(cross, jnp.minimum(first, second), _INF)


def quad_warpage(points: Quad) -> Scalar:
    """Cube of the least cosine between the normals at opposite corners: 1 where it is flat and convex."""
    normals = _normals(points)
    solid = (norm(normals) > 0).all()
    return jnp.where(solid, least(dot(unit(normals[:2]), unit(normals[2:]))) ** 3, 0)


def quad_stretch(points: Quad) -> Scalar:
    """``√2 l_min / d_max``."""
    return divide(2**0.5 * least(norm(sides(points))), _longest_diagonal(points), _INF)


def quad_oddy(points: Quad) -> Scalar:
    """Greatest over the corners of ``((g₁₁ − g₂₂)² + 4 g₁₂²) / (2 det g)``, g the metric (Oddy 1988)."""
    along = sides(points)
    before = -jnp.roll(along, 1, axis=0)
    first, second, mixed = dot(along, along), dot(before, before), dot(along, before)
    det = dot(_normals(points), _normals(points))
    return greatest(divide((first - second) ** 2 + 4 * mixed**2, 2 * det, _INF))


def quad_angles(points: Quad) -> Float[Array, " 2"]:
    """Least and greatest angle in degrees; the latter is reflex where a corner is inverted.

    With a side of length zero they are 360 and 0, as in Verdict.
    """
    along = sides(points)
    found = angle(along, -jnp.roll(along, 1, axis=0))
    greater = greatest(found)
    greater = jnp.where((_corner_areas(points) < 0).any(), 360 - greater, greater)
    solid = (norm(along) > 0).all()
    corners = jnp.where(solid, jnp.stack([least(found), greater]), jnp.array([360.0, 0.0], points.dtype))
    folded = triangle_angles(points[:3])
    return jnp.where(_collapsed(points), jnp.stack([least(folded), greatest(folded)]), corners)


def quad_equiangle_skew(points: Quad) -> Scalar:
    """``max(θ_max − 90°, 90° − θ_min) / 90°``."""
    lesser, greater = quad_angles(points)
    return jnp.maximum(greater - 90, 90 - lesser) / 90


def quad_distortion(points: Quad) -> Scalar:
    """Least Jacobian determinant of nodes and quadrature points over the area, 1 on the square; where z = 0.

    As in Verdict the area is the integral of the absolute determinant, determinants at quadrature points
    count along the interpolated normals of the nodes, and those at nodes along a normal of two corners that
    agree; a collapsed quadrilateral is a triangle, with 2 for 1.
    """
    kind, flat = element_type("quad"), points[:, :2]
    inner = determinant(contract(flat, jnp.asarray(kind.gradients, points.dtype)))
    nodal = determinant(contract(flat, jnp.asarray(kind.gradients_at(kind.natural), points.dtype)))
    normals = jnp.sign(nodal)
    # of corner 0 if 2 or 1 agree with it, else of the other two
    agrees = jnp.maximum(normals[0] * normals[2], normals[0] * normals[1]) > 0
    face = jnp.where(agrees, normals[0], normals[1] + normals[2])
    inner_along = inner * (jnp.asarray(kind.values, points.dtype) @ normals)
    nodal_along = jnp.where(face * normals > 0, 1.0, -1.0) * jnp.abs(nodal)
    worst, size = least(jnp.concatenate([inner_along, nodal_along])), jnp.abs(inner).mean()
    solid = size > 0
    return jnp.where(_collapsed(points), 2.0, jnp.where(solid, worst / jnp.where(solid, size, 1), 0))
