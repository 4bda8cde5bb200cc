"""Verdict's metrics of tetrahedra, pyramids, wedges and hexahedra (Stimpson et al. 2007).

Functions take the corners of one element ``[k, 3]``.  Corner by corner, a metric looks at the edges that
leave the corner, as the columns of a Jacobian.
"""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxsmooth.cells.table import element_type
from jaxsmooth.metrics.geometry import angle, corner_tangents, divide, dot, edge_lengths, greatest, unit
from jaxsmooth.metrics.shape import measure
from jaxsmooth.metrics.verdict_plane import quad_shape, triangle_equiangle_skew
from jaxsmooth.numerics.small import determinant, least, norm, power

__all__ = [
    "IDEAL_DIHEDRAL",
    "hexahedron_axes",
    "hexahedron_condition",
    "hexahedron_diagonal",
    "hexahedron_dimension",
    "hexahedron_distortion",
    "hexahedron_jacobian",
    "hexahedron_max_edge_ratio",
    "hexahedron_nodal_ratio",
    "hexahedron_oddy",
    "hexahedron_scaled_jacobian",
    "hexahedron_shape",
    "hexahedron_shear",
    "hexahedron_size",
    "hexahedron_skew",
    "hexahedron_stretch",
    "hexahedron_taper",
    "pyramid_jacobian",
    "pyramid_scaled_jacobian",
    "pyramid_shape",
    "tetra_aspect_gamma",
    "tetra_aspect_ratio",
    "tetra_collapse_ratio",
    "tetra_condition",
    "tetra_dihedral_angles",
    "tetra_equiangle_skew",
    "tetra_equivolume_skew",
    "tetra_frobenius",
    "tetra_jacobian",
    "tetra_radius_ratio",
    "tetra_scaled_jacobian",
    "tetra_shape",
    "tetra_size",
    "tetra_squish_index",
    "wedge_distortion",
    "wedge_frobenius",
    "wedge_jacobian",
    "wedge_scaled_jacobian",
    "wedge_shape",
]

Tetra = Float[Array, "4 3"]
Pyramid = Float[Array, "5 3"]
Wedge = Float[Array, "6 3"]
Hexahedron = Float[Array, "8 3"]
Scalar = Float[Array, ""]
_INF = float("inf")
IDEAL_DIHEDRAL = float(np.degrees(np.arccos(1 / 3)))
"""Angle between two faces of the regular tetrahedron, in degrees."""
_EDGES = element_type("tetra").edges
_FACES = np.array([(0, 2, 1), (0, 1, 3), (1, 2, 3), (2, 0, 3)])  # outward
_LEAVING = np.array([(0, 2, 3), (0, 1, 4), (1, 2, 5), (3, 4, 5)])  # edges at each corner


# --- Tetrahedra ---------------------------------------------------------------------------------------


def _edges(points: Tetra) -> Float[Array, "6 3"]:
    return points[_EDGES[:, 1]] - points[_EDGES[:, 0]]


def _areas(points: Tetra) -> Float[Array, "4 3"]:
    """Outward normals of the faces, as long as twice their areas."""
    faces = points[_FACES]
    return jnp.cross(faces[:, 1] - faces[:, 0], faces[:, 2] - faces[:, 0])


def tetra_jacobian(points: Tetra) -> Scalar:
    """Determinant of three edges: six times the volume."""
    return determinant(points[1:] - points[0])


def tetra_size(points: Tetra) -> Scalar:
    """Signed volume."""
    return tetra_jacobian(points) / 6


def tetra_aspect_ratio(points: Tetra) -> Scalar:
    """Longest edge over ``2√6`` times the inradius; the orientation does not matter."""
    longest = greatest(norm(_edges(points)))
    return divide(6**0.5 / 12 * longest * norm(_areas(points)).sum(), jnp.abs(tetra_jacobian(points)), _INF)


def _circumvector(points: Tetra) -> Float[Array, " 3"]:
    """The vector from the first corner to the circumcentre, times twice the Jacobian."""
    a, b, c = points[1:] - points[0]
    return dot(c, c) * jnp.cross(a, b) + dot(b, b) * jnp.cross(c, a) + dot(a, a) * jnp.cross(b, c)


def tetra_radius_ratio(points: Tetra) -> Scalar:
    """Circumradius over three times the inradius; the orientation does not matter."""
    size = norm(_areas(points)).sum()
    return divide(norm(_circumvector(points)) * size, 6 * tetra_jacobian(points) ** 2, _INF)


def tetra_aspect_gamma(points: Tetra) -> Scalar:
    """Cube of the root mean square edge over ``6√2`` times the volume (Parthasarathy et al. 1994)."""
    square = (_edges(points) ** 2).sum() / 6
    return divide(power(square, 1.5), 2**0.5 * jnp.abs(tetra_jacobian(points)), _INF)


def tetra_frobenius(points: Tetra) -> Scalar:
    """``|A|² / (3 |det A|^(2/3))`` against the regular tetrahedron: the inverse mean ratio."""
    det = jnp.abs(tetra_jacobian(points))
    return divide((_edges(points) ** 2).sum() / 2, 3 * power(2 * det**2, 1 / 3), _INF)


def tetra_condition(points: Tetra) -> Scalar:
    """Frobenius condition number against the regular tetrahedron, over 3; negative if inverted."""
    a, b, c = points[1:] - points[0]
    frame = jnp.stack([a, (2 * b - a) / 3**0.5, (3 * c - b - a) / 6**0.5])
    normals = jnp.cross(frame, jnp.roll(frame, -1, axis=0))
    det = 2**0.5 * tetra_jacobian(points)  # of the frame
    size = norm(frame.reshape(-1)) * norm(normals.reshape(-1))
    return jnp.sign(det) * divide(size, 3 * jnp.abs(det), 0) + jnp.where(det == 0, _INF, 0)


def tetra_shape(points: Tetra) -> Scalar:
    """Inverse of `tetra_frobenius`, which is the mean ratio; zero if inverted."""
    det = tetra_jacobian(points)
    top = 3 * power(2 * jnp.maximum(det, 0) ** 2, 1 / 3)
    return divide(top, (_edges(points) ** 2).sum() / 2, 0)


def tetra_scaled_jacobian(points: Tetra) -> Scalar:
    """``√2`` times the Jacobian over the greatest product of the three edges at a corner."""
    lengths = norm(_edges(points))
    products = lengths[_LEAVING].prod(axis=1)
    return divide(2**0.5 * tetra_jacobian(points), greatest(products), _INF)


def tetra_dihedral_angles(points: Tetra) -> Float[Array, " 6"]:
    """Angles between the faces in degrees."""
    normals = _areas(points)
    first, second = np.triu_indices(4, 1)
    return angle(normals[first], -normals[second])


def tetra_equiangle_skew(points: Tetra) -> Scalar:
    """The worst of the angles of the faces and those between them, over its distance from ideal."""
    dihedral = tetra_dihedral_angles(points)
    wide, narrow = greatest(dihedral) - IDEAL_DIHEDRAL, IDEAL_DIHEDRAL - least(dihedral)
    own = jnp.maximum(wide / (180 - IDEAL_DIHEDRAL), narrow / IDEAL_DIHEDRAL)
    return jnp.maximum(own, greatest(jax.vmap(triangle_equiangle_skew)(points[_FACES])))


def tetra_collapse_ratio(points: Tetra) -> Scalar:
    """Least over the faces of the signed height above it over its longest edge."""
    faces = points[_FACES]
    longest = jax.vmap(greatest)(norm(faces - jnp.roll(faces, 1, axis=1)))
    heights = divide(tetra_jacobian(points), norm(_areas(points)), 0)
    return least(divide(heights, longest, 0))


def tetra_equivolume_skew(points: Tetra) -> Scalar:
    """1 − V / V of the regular tetrahedron in the circumsphere."""
    det = tetra_jacobian(points)
    top = norm(_circumvector(points)) ** 3
    # R = |v| / (2 det); the regular tetrahedron in it has volume 8√3/27 R³
    ideal = 3**0.5 / 27 * top
    return jnp.where(det != 0, 1 - divide(det * det**3 / 6, ideal, 0), 1)


def tetra_squish_index(points: Tetra) -> Scalar:
    """Greatest over the faces of 1 − cos between its normal and the vector from centroid to its centre."""
    centres = points[_FACES].mean(axis=1) - points.mean(axis=0)
    return greatest(1 - dot(unit(_areas(points)), unit(centres)))


# --- Corners of pyramids, wedges and hexahedra --------------------------------------------------------


def _at_corners(name: str, points: Float[Array, "k 3"]) -> tuple[Array, Array]:
    """Jacobians at the corners, and the lengths of the three edges there ``[c, 3]``."""
    tangents = corner_tangents(element_type(name), points)
    return determinant(tangents), norm(tangents)


def _condition(tangents: Float[Array, "c 3 3"]) -> Float[Array, " c"]:
    normals = jnp.cross(tangents, jnp.roll(tangents, -1, axis=1))
    sizes = norm(tangents.reshape(-1, 9)) * norm(normals.reshape(-1, 9))
    return divide(sizes, determinant(tangents), _INF)


def _worst_shape(det: Float[Array, " c"], lengths: Float[Array, "c 3"], scale: float) -> Scalar:
    """Least ``3 (scale · det)^(2/3) / Σl²``, at most 1; zero where a corner is flat or inverted."""
    shapes = divide(3 * power(scale * jnp.maximum(det, 0), 2 / 3), (lengths**2).sum(axis=1), 0)
    return jnp.minimum(jnp.where((det > 0).all(), least(shapes), 0), 1)


# --- Pyramids -----------------------------------------------------------------------------------------

_PARTS = np.array([(0, 1, 2, 4), (0, 2, 3, 4), (0, 1, 3, 4), (1, 2, 3, 4)])  # the two ways to cut it in two


def pyramid_jacobian(points: Pyramid) -> Scalar:
    """Least Jacobian of the four tetrahedra on three base corners and the apex."""
    return least(jax.vmap(tetra_jacobian)(points[_PARTS]))


def pyramid_scaled_jacobian(points: Pyramid) -> Scalar:
    """√2 times the least scaled Jacobian of the four tetrahedra, folded at 1; zero if one is inverted."""
    worst = 2**0.5 * least(jax.vmap(tetra_scaled_jacobian)(points[_PARTS]))
    return jnp.where(worst <= 0, 0, jnp.where(worst < 1, worst, 2 - worst))


def pyramid_shape(points: Pyramid) -> Scalar:
    """Shape of the base, times the cosine of the axis to its normal, times height over ideal or inverse.

    The ideal height is √2/2 of the longest edge; the normal is the cross product of the diagonals.
    """
    base, apex = points[:4], points[4]
    normal = unit(jnp.cross(base[2] - base[0], base[3] - base[1]))
    axis = apex - base.mean(axis=0)
    height = dot(axis, normal)
    cosine = divide(height, norm(axis), 0)
    longest = greatest(edge_lengths(element_type("pyramid"), points)) * 0.5**0.5
    ratio = jnp.where(height < longest, divide(height, longest, 0), divide(longest, height, 0))
    return jnp.where(height > 0, quad_shape(base) * cosine * ratio, 0)


# --- Wedges -------------------------------------------------------------------------------------------

_TETRAS = np.array([(0, 1, 2, 3), (1, 2, 0, 4), (2, 0, 1, 5), (3, 5, 4, 0), (4, 3, 5, 1), (5, 4, 3, 2)])
_NORMAL = 1.16477  # Verdict's digits of the Frobenius aspect at the corners of the unit wedge
_MASTER = 0.433013 / 0.866025  # its digits of volume over corner Jacobian of the unit wedge


def wedge_frobenius(points: Wedge) -> Float[Array, " 6"]:
    """Frobenius aspects of the six tetrahedra at the corners, 1 on the unit wedge; they have no sign."""
    return jax.vmap(tetra_frobenius)(points[_TETRAS]) / _NORMAL


def wedge_jacobian(points: Wedge) -> Scalar:
    """Least corner Jacobian."""
    return least(_at_corners("wedge", points)[0])


def wedge_scaled_jacobian(points: Wedge) -> Scalar:
    """``2/√3`` times the least corner Jacobian over the lengths of its edges."""
    det, lengths = _at_corners("wedge", points)
    return 2 / 3**0.5 * least(divide(det, lengths.prod(axis=1), 0))


def wedge_shape(points: Wedge) -> Scalar:
    """Least over the corners of ``3 (2 det / √3)^(2/3) / Σl²``; zero where one is flat or inverted."""
    return _worst_shape(*_at_corners("wedge", points), 2 / 3**0.5)


def wedge_distortion(points: Wedge) -> Scalar:
    """Least corner Jacobian over the volume, 1 on the unit wedge; infinite for volume zero."""
    volume = measure(element_type("wedge"), points)
    solid = volume != 0
    return jnp.where(solid, wedge_jacobian(points) * _MASTER / jnp.where(solid, volume, 1), _INF)


# --- Hexahedra ----------------------------------------------------------------------------------------

_SIGNS = element_type("hexahedron").natural  # −1 and 1


def hexahedron_axes(points: Hexahedron) -> Float[Array, "3 3"]:
    """Principal axes: four times the vectors between the centres of opposite faces."""
    return jnp.asarray(_SIGNS.T, points.dtype) @ points


def _diagonals(points: Hexahedron) -> Float[Array, " 4"]:
    return norm(points[np.array([6, 7, 4, 5])] - points[:4])


def hexahedron_size(points: Hexahedron) -> Scalar:
    """Mean of the corner Jacobians, which `relative_size_squared` takes for the volume."""
    return _at_corners("hexahedron", points)[0].mean()


def hexahedron_max_edge_ratio(points: Hexahedron) -> Scalar:
    """Longest over shortest principal axis (Taylor and Flanagan 1989)."""
    lengths = norm(hexahedron_axes(points))
    return divide(greatest(lengths), least(lengths), _INF)


def hexahedron_skew(points: Hexahedron) -> Scalar:
    """Greatest ``|cos|`` between two principal axes."""
    axes = hexahedron_axes(points)
    cosines = jnp.abs(dot(unit(axes), unit(jnp.roll(axes, 1, axis=0))))
    return jnp.where((norm(axes) > 0).all(), greatest(cosines), _INF)


def hexahedron_taper(points: Hexahedron) -> Scalar:
    """Greatest over two axes of the length of their cross derivative over the shorter one."""
    lengths = norm(hexahedron_axes(points))
    first, second = np.array([0, 0, 1]), np.array([1, 2, 2])
    cross = norm(jnp.asarray((_SIGNS[:, first] * _SIGNS[:, second]).T, points.dtype) @ points)
    return greatest(divide(cross, jnp.minimum(lengths[first], lengths[second]), _INF))


def hexahedron_stretch(points: Hexahedron) -> Scalar:
    """``√3 l_min / d_max``."""
    shortest = least(edge_lengths(element_type("hexahedron"), points))
    return divide(3**0.5 * shortest, greatest(_diagonals(points)), _INF)


def hexahedron_diagonal(points: Hexahedron) -> Scalar:
    """Shortest over longest diagonal."""
    return divide(least(_diagonals(points)), greatest(_diagonals(points)), _INF)


def hexahedron_dimension(points: Hexahedron) -> Scalar:
    """``V / √(2 Σ |∂V/∂xᵢ|²)``: the length of a stable time step (Taylor and Flanagan 1989)."""
    volume, slopes = jax.value_and_grad(partial(measure, element_type("hexahedron")))(points)
    return divide(jnp.abs(volume), 2**0.5 * norm(slopes.reshape(-1)), 0)


def hexahedron_oddy(points: Hexahedron) -> Scalar:
    """Greatest over corners and centre of ``(|g|² − (tr g)²/3) / det(J)^(4/3)``, g = JᵀJ (Oddy 1988)."""
    corners = corner_tangents(element_type("hexahedron"), points)
    frames = jnp.concatenate([hexahedron_axes(points)[None], corners])
    metric = frames @ jnp.swapaxes(frames, 1, 2)
    top = (metric**2).sum(axis=(1, 2)) - jnp.trace(metric, axis1=1, axis2=2) ** 2 / 3
    det = determinant(frames)
    values = jnp.where(det > 0, divide(top, power(jnp.maximum(det, 0), 4 / 3), _INF), _INF)
    return jnp.maximum(greatest(values), 0)


def hexahedron_condition(points: Hexahedron) -> Float[Array, " 8"]:
    """Frobenius condition numbers at the corners, over 3; infinite where one is flat or inverted."""
    return _condition(corner_tangents(element_type("hexahedron"), points)) / 3


def hexahedron_jacobian(points: Hexahedron) -> Scalar:
    """Least Jacobian of corners and centre."""
    centre = determinant(hexahedron_axes(points)) / 64
    return least(jnp.append(_at_corners("hexahedron", points)[0], centre))


def hexahedron_scaled_jacobian(points: Hexahedron) -> Scalar:
    """Least Jacobian of corners and centre over the lengths of its columns; infinite if one is zero."""
    axes = hexahedron_axes(points)
    det, lengths = _at_corners("hexahedron", points)
    det, lengths = jnp.append(det, determinant(axes)), jnp.append(lengths, norm(axes)[None], axis=0)
    return jnp.where((lengths > 0).all(), least(divide(det, lengths.prod(axis=1), 0)), _INF)


def hexahedron_nodal_ratio(points: Hexahedron) -> Scalar:
    """Least over greatest corner Jacobian; −∞ where none is positive."""
    det, _ = _at_corners("hexahedron", points)
    return divide(least(det), greatest(det), -_INF)


def hexahedron_shear(points: Hexahedron) -> Scalar:
    """Least scaled Jacobian of the corners; zero where one is flat or inverted."""
    det, lengths = _at_corners("hexahedron", points)
    return jnp.where((det > 0).all(), least(divide(det, lengths.prod(axis=1), 0)), 0)


def hexahedron_shape(points: Hexahedron) -> Scalar:
    """Least over the corners of ``3 det^(2/3) / Σl²``; zero where one is flat or inverted."""
    return _worst_shape(*_at_corners("hexahedron", points), 1.0)


def hexahedron_distortion(points: Hexahedron) -> Scalar:
    """Least Jacobian of nodes and quadrature points over the volume, 1 on the cube."""
    kind = element_type("hexahedron")
    det = determinant(jnp.einsum("kd,qkj->qdj", points, jnp.asarray(kind.validity_gradients, points.dtype)))
    volume = measure(kind, points)
    solid = volume != 0
    return jnp.where(solid, least(det) / jnp.where(solid, volume, 1), _INF)
