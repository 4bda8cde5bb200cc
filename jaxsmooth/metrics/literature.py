"""The metrics of other authors in the paper's Tables 1 and 2, in its normalisation: 1 on the ideal element.

Inverses are taken where the paper takes them.  Values of inverted elements have the sign of the measure where
the formula has an area or a volume; the tables do not speak of them.  The rows that other metrics of the
package answer are named in `benchmarks.paper`.
"""

from __future__ import annotations

from functools import lru_cache

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxsmooth.cells.table import ElementType, element_type
from jaxsmooth.metrics.geometry import divide, dot, edge_lengths, greatest, in_space, quad_faces, sides
from jaxsmooth.metrics.record import Metric, family
from jaxsmooth.metrics.shape import measure
from jaxsmooth.metrics.verdict_plane import (
    quad_max_edge_ratio,
    quad_stretch,
    triangle_angles,
    triangle_size,
)
from jaxsmooth.metrics.verdict_solid import hexahedron_max_edge_ratio
from jaxsmooth.numerics.small import contract, determinant, least, norm, power

__all__ = ["LITERATURE"]

Points = Float[Array, "k dim"]
Scalar = Float[Array, ""]
_UNIT = {"corners_only": True, "range": (0, 1), "acceptable": (0.2, 1)}
_SIGNED = {"corners_only": True, "range": (-1, 1), "acceptable": (0.2, 1)}


# --- Table 1 ------------------------------------------------------------------------------------------


def _berzins(kind: ElementType, points: Points) -> Scalar:
    lengths, area = edge_lengths(kind, points), measure(kind, points)
    size = jnp.abs(area)
    inverse = (lengths**2).sum() / (16 * 3**0.5) + 3**0.5 / 48 * lengths.sum() ** 2
    return jnp.sign(area) * divide(size, inverse, 0)


def _serrate(kind: ElementType, points: Points) -> Scalar:
    return least(triangle_angles(in_space(points))) / 60


def _longest_times_sum(kind: ElementType, points: Points) -> Scalar:
    """``(l_max Σl / (c A))⁻¹``, 1 on the ideal element."""
    lengths = edge_lengths(kind, points)
    scale = 4 * 3**0.5 if kind.corners == 3 else 4.0
    return divide(scale * measure(kind, points), greatest(lengths) * lengths.sum(), 0)


def _lo_of_quad(points: Float[Array, "4 3"]) -> Scalar:
    """``q₃ q₄ / (q₁ q₂)`` of Lo's qualities of the four triangles of three corners, best first."""
    triangles = points[np.array([(0, 1, 2), (1, 2, 3), (2, 3, 0), (3, 0, 1)])]
    squares = jax.vmap(lambda triangle: (sides(triangle) ** 2).sum())(triangles)
    found = jnp.sort(divide(4 * 3**0.5 * jax.vmap(triangle_size)(triangles), squares, 0))
    return divide(found[0] * found[1], found[2] * found[3], 0)


def _lo(kind: ElementType, points: Points) -> Scalar:
    return _lo_of_quad(in_space(points))


def _inverse(function):
    return lambda kind, points: divide(1, function(in_space(points)), 0)


def _frey_george(kind: ElementType, points: Points) -> Scalar:
    along = sides(points)
    lengths = norm(along)
    longest = jnp.maximum(greatest(lengths), greatest(norm(points[:2] - points[2:])))
    area = least(determinant(jnp.stack([jnp.roll(along, 1, axis=0), along], axis=-2))) / 2
    return divide(8 * area, 2**0.5 * longest * power((lengths**2).sum(), 0.5), 0)


# --- Table 2 ------------------------------------------------------------------------------------------


def _shephard(kind: ElementType, points: Points) -> Scalar:
    faces = points[np.array([(0, 2, 1), (0, 1, 3), (1, 2, 3), (2, 0, 3)])]
    normals = jnp.cross(faces[:, 1] - faces[:, 0], faces[:, 2] - faces[:, 0])
    volume = measure(kind, points)
    return jnp.sign(volume) * divide(2187 * volume**4, ((normals**2).sum() / 4) ** 3, 0)


def _parthasarathy(kind: ElementType, points: Points) -> Scalar:
    square = (edge_lengths(kind, points) ** 2).mean()
    return divide(6 * 2**0.5 * measure(kind, points), power(square, 1.5), 0)


def _weatherill(kind: ElementType, points: Points) -> Scalar:
    return divide(6 * 2**0.5 * measure(kind, points), edge_lengths(kind, points).mean() ** 3, 0)


@lru_cache
def _integration_points(name: str) -> np.ndarray:
    """Gradients ``[q, k, dim]``: at 2×2×2 points of a hexahedron, at 3×3 of a wedge."""
    kind = element_type(name)
    if name == "hexahedron":
        return kind.gradients
    triangle = np.array([(1 / 6, 1 / 6), (2 / 3, 1 / 6), (1 / 6, 2 / 3)])
    heights = np.polynomial.legendre.leggauss(3)[0]
    return kind.gradients_at(np.array([(*spot, height) for spot in triangle for height in heights]))


def _determinants(kind: ElementType, points: Points) -> Float[Array, " q"]:
    return determinant(contract(points, jnp.asarray(_integration_points(kind.name), points.dtype)))


def _warping(face: Float[Array, "4 3"]) -> Scalar:
    """Height of one end of a side over the other, along the normal, over the root of the projected area."""
    normal = jnp.cross(face[2] - face[0], face[3] - face[1])
    area = norm(normal) / 2
    height = jnp.abs(dot(normal, face[1] - face[0]))
    return divide(height, 2 * power(area, 1.5), 0)


def _kwok(kind: ElementType, points: Points) -> Scalar:
    det = _determinants(kind, points)
    warping = greatest(jax.vmap(_warping)(quad_faces(family(kind), points)))
    return (1 - warping) * divide(least(det), greatest(det), 0)


def _menendez(kind: ElementType, points: Points) -> Scalar:
    found = jnp.sort(jax.vmap(_lo_of_quad)(quad_faces("hexahedron", points)))
    return divide(found[:3].prod(), found[3:].prod(), 0)


def _relative_jacobian(kind: ElementType, points: Points) -> Scalar:
    return divide(least(_determinants(kind, points)), measure(kind, points), 0)


def _face_stretch(kind: ElementType, points: Points) -> Scalar:
    return least(jax.vmap(quad_stretch)(quad_faces("wedge", points)))


LITERATURE = (
    Metric(
        "berzins",
        _berzins,
        "mean of Lo's and Weatherill's metrics, harmonic",
        families=("triangle",),
        reference="Berzins 1999: (1/(4 q_b) + sqrt(3) q_w/16)^-1, q_b Lo's, q_w = (sum l)^2/(3 A); "
        "the paper prints sqrt(3)/(16 q_w), which is not 1 on the equilateral triangle",
        **_SIGNED,
    ),
    Metric(
        "serrate",
        _serrate,
        "least angle over 60 degrees",
        families=("triangle",),
        reference="3 min(phi)/pi, Serrate in the paper's Table 1",
        **_UNIT,
    ),
    Metric(
        "pebay_baker",
        _longest_times_sum,
        "area over longest side and perimeter",
        families=("triangle",),
        reference="Pébay and Baker 2003: (l_max sum l/(4 sqrt(3) A))^-1, the inverse of aspect_ratio, signed",
        **_SIGNED,
    ),
    Metric(
        "lo",
        _lo,
        "triangles of three corners, worse over better two",
        families=("quad",),
        reference="Lo 1989: q3 q4/(q1 q2); does not see orientation",
        **_UNIT,
    ),
    Metric(
        "robinson",
        _inverse(quad_max_edge_ratio),
        "shorter over longer principal axis",
        families=("quad",),
        reference="Robinson 1987: the inverse of max(X1/X2, X2/X1), which the paper prints",
        **_UNIT,
    ),
    Metric(
        "frey_george",
        _frey_george,
        "least corner triangle over longest distance",
        families=("quad",),
        reference="Frey and George 2000: (sqrt(2)/8 h_max h_s/A_min)^-1, h_max the longest side or diagonal; "
        "the paper prints max(d1, d2, min l), which agrees on its shapes; signed by the worst corner",
        **_SIGNED,
    ),
    Metric(
        "pebay",
        _longest_times_sum,
        "area over longest side and perimeter",
        families=("quad",),
        reference="Pébay 2004: (l_max sum l/(4 A))^-1, the inverse of aspect_ratio, signed",
        **_SIGNED,
    ),
    Metric(
        "shephard",
        _shephard,
        "volume over the squares of the faces",
        families=("tetra",),
        reference="Shephard and Georges 1991: 2187 V^4/(sum f^2)^3, signed",
        **_SIGNED,
    ),
    Metric(
        "parthasarathy",
        _parthasarathy,
        "volume over cube of root mean square edge",
        families=("tetra",),
        reference="Parthasarathy et al. 1994: (sqrt(2) R^3/(12 V))^-1, R the root mean square of the edges, "
        "which the paper does not explain; the inverse of aspect_gamma, signed",
        **_SIGNED,
    ),
    Metric(
        "weatherill",
        _weatherill,
        "volume over cube of mean edge",
        families=("tetra",),
        reference="Weatherill et al.: ((sum l/6)^3/(6 sqrt(2) V))^-1, signed; the paper has 8.48528",
        **_SIGNED,
    ),
    Metric(
        "taylor",
        _inverse(hexahedron_max_edge_ratio),
        "shortest over longest principal axis",
        families=("hexahedron",),
        reference="Taylor and Flanagan 1989: the inverse of max(A12, A13, A23), the ratios of the principal "
        "axes, longer over shorter; the paper prints the maximum",
        **_UNIT,
    ),
    Metric(
        "kwok",
        _kwok,
        "least over greatest Jacobian, less warping",
        families=("wedge", "hexahedron"),
        corners_only=True,
        acceptable=(0.2, 1),
        range=(-float("inf"), 1),
        reference="Kwok and Chen 2000: (1 - W_max) J_min/J_max at 2x2x2 points of a hexahedron and 3x3 of a "
        "wedge (three in height give the printed values, two do not); W is Ansys's area warping factor of a "
        "face: height of one end of a side over the other along the cross product of the diagonals, over the "
        "root of the projected area; no shape of the paper has a warped face",
    ),
    Metric(
        "menendez",
        _menendez,
        "Lo's metric of the faces, worse over better three",
        families=("hexahedron",),
        reference="Menéndez-Díaz et al. 2005: q4 q5 q6/(q1 q2 q3); does not see orientation",
        **_UNIT,
    ),
    Metric(
        "relative_jacobian",
        _relative_jacobian,
        "least Jacobian over volume",
        families=("wedge", "hexahedron"),
        corners_only=True,
        acceptable=(0.2, 1),
        range=(-float("inf"), 1),
        reference="Knupp et al. in the paper's Table 2: min J/V at the points of kwok, J relative to the "
        "ideal element; zero for elements with negative volume",
    ),
    Metric(
        "face_stretch",
        _face_stretch,
        "least stretch of the quadrilateral faces",
        families=("wedge",),
        reference="Knupp et al. in the paper's Table 2: min sqrt(2) l_min/d_max; Verdict takes the maximum",
        **_UNIT,
    ),
)
"""Those that no other metric of the package is."""
