"""The package's own metrics: measure, the paper's quality (Eqs. 1–5), and what guards and the optimiser use.

Element functions take the nodes of one element ``[k, dim]``, curved ones included.  All are signed or zero
for inverted elements, and differentiable with finite gradients.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxsmooth.cells.table import ElementType
from jaxsmooth.metrics.geometry import divide, edge_lengths, greatest
from jaxsmooth.metrics.record import Metric
from jaxsmooth.numerics.small import contract, determinant, least, norm, signed_power

__all__ = [
    "CORNER_WEIGHT",
    "EDGE_RATIO",
    "MEAN_RATIO",
    "MEASURE",
    "MIN_JACOBIAN",
    "SCALED_JACOBIAN",
    "SHAPE",
    "SHAPE_AND_CORNERS",
    "edge_ratio",
    "excess",
    "mean_ratio",
    "measure",
    "min_jacobian",
    "sample_gradients",
    "scaled_jacobian",
    "shape_and_corners",
    "shape_quality",
    "surface",
]

Nodes = Float[Array, "k dim"]
Scalar = Float[Array, ""]

CORNER_WEIGHT = 0.5
"""Weight of the corner term of `shape_and_corners` beside the isoperimetric one."""
_ROUND = 0.02  # radius of the rounded kink of `excess`


def measure(kind: ElementType, nodes: Nodes) -> Scalar:
    """Signed area or volume of one element, by its quadrature rule."""
    frames = contract(nodes, jnp.asarray(kind.gradients, nodes.dtype))
    return determinant(frames) @ jnp.asarray(kind.weights, nodes.dtype)


def surface(kind: ElementType, nodes: Nodes) -> Scalar:
    """Perimeter or surface area of one element; curved sides are integrated."""
    tangents = contract(nodes, jnp.asarray(kind.facet_tangents, nodes.dtype))
    normals = tangents[..., 0] if kind.dim == 2 else jnp.cross(tangents[..., 0], tangents[..., 1])
    return norm(normals) @ jnp.asarray(kind.facet_weights, nodes.dtype)


def shape_quality(kind: ElementType, nodes: Nodes, beta: Scalar | float = 2.0) -> Scalar:
    """The paper's metric, Eqs. 1–5, times the sign of the measure.

    ``q = 1 − |1 − (m_r / m)^β|`` with m the perimeter or surface area and m_r that of the
    ideal element of the same measure.  For flat elements its gradient is finite when
    ``β ≥ dim / (dim − 1)``, which holds for the default, and not zero in 2D; for a smaller β it is 0 there.
    """
    volume, side = measure(kind, nodes), surface(kind, nodes)
    dim = kind.dim
    # (m_r / m)^β with the roots of the measure collected into one power, and its sign
    top = kind.ideal_surface**beta * signed_power(volume, beta * (dim - 1) / dim)
    solid = side > 0
    ratio = jnp.where(solid, top / jnp.where(solid, side, 1) ** beta, 0)
    return jnp.where(jnp.abs(ratio) > 1, 2 * jnp.sign(ratio) - ratio, ratio)


def min_jacobian(kind: ElementType, nodes: Nodes) -> Scalar:
    """Least Jacobian determinant over nodes and quadrature points.

    Relative to the ideal element of unit measure: the ideal element of measure V has V.
    An element is *inverted* where this is not positive.
    """
    return least(determinant(contract(nodes, jnp.asarray(kind.validity_gradients, nodes.dtype))))


def scaled_jacobian(kind: ElementType, nodes: Nodes) -> Scalar:
    """Least over the corners of ``det(t₁, …) / ∏|tᵢ|``, over the ideal element's value there.

    The tᵢ are the tangents of the edges that leave the corner; the apex of a pyramid has no
    such frame and is left out.  The ideal value is 1 for quadrilaterals and hexahedra, √3/2
    for triangles and wedges, √2/2 for tetrahedra and pyramids.  Where a tangent vanishes (a mid-side node at
    the quarter of its edge) it has no direction, and the corner counts as closed: 0.
    """
    best = np.einsum("kd,qkj->qdj", kind.ideal, kind.corner_frames)
    best = np.linalg.det(best) / np.linalg.norm(best, axis=1).prod(axis=-1)
    slopes = jnp.asarray(kind.corner_frames, nodes.dtype)
    # from the corner, so that a distance from the origin costs no digits
    rays = nodes[None] - nodes[np.asarray(kind.framed_corners)][:, None]
    frames = (rays[..., None] * slopes[:, :, None]).sum(axis=1)
    lengths = norm(jnp.swapaxes(frames, -1, -2))
    reach = (jnp.abs(rays).sum(axis=-1)[..., None] * jnp.abs(slopes)).sum(axis=1)
    lengths = jnp.where(lengths > jnp.finfo(nodes.dtype).eps ** 0.5 * reach, lengths, 0)
    return least(divide(determinant(frames), lengths.prod(axis=-1), 0) / jnp.asarray(best, nodes.dtype))


def sample_gradients(kind: ElementType) -> np.ndarray:
    """Gradients ``[s, k, dim]`` where `mean_ratio` looks: at the nodes of linear elements, at nodes and
    quadrature points of quadratic ones, once where the Jacobian is constant."""
    every = kind.validity_gradients
    nodal = len(every) - len(kind.gradients)
    return every[:nodal] if kind.linear and nodal else every


def _inverse_mean_ratio(kind: ElementType, frames: Float[Array, "s dim dim"]) -> tuple[Scalar, Array]:
    """Mean of ``|A|² / (dim · det(A)^(2/dim))`` over samples A, and whether all det A are positive."""
    det, size = determinant(frames), (frames**2).sum(axis=(-1, -2))
    valid = (det > 0).all()
    det = jnp.where(valid, det, 1)
    return (jnp.where(valid, size, 1) / (kind.dim * det ** (2 / kind.dim))).mean(), valid


def mean_ratio(kind: ElementType, nodes: Nodes) -> Scalar:
    """Harmonic mean over the samples of ``dim · det(A)^(2/dim) / |A|²``; zero if any det ≤ 0.

    A is the deformation gradient from the ideal element (Knupp 2003) at the points of
    `sample_gradients`; 1 only on the ideal element, for every type.  For triangles it is Lo's
    ``4√3 A / Σl²``, for tetrahedra Liu and Joe's ``12 (3V)^(2/3) / Σl²``.
    """
    frames = contract(nodes, jnp.asarray(sample_gradients(kind), nodes.dtype))
    inverse, valid = _inverse_mean_ratio(kind, frames)
    return jnp.where(valid, 1 / inverse, 0)


def excess(ratio: Scalar) -> tuple[Scalar, Scalar, Scalar]:
    """About ``max(ratio − 1, 0)``, rounded to be smooth and convex, with two derivatives."""
    x = jnp.maximum(ratio - 1, 0)
    total = x + _ROUND
    return x * x / total, x * (x + 2 * _ROUND) / total**2, jnp.where(x > 0, 2 * _ROUND**2 / total**3, 0)


def shape_and_corners(kind: ElementType, nodes: Nodes) -> Scalar:
    """1/e of what the optimiser minimises by this name; zero if a sampled determinant is not positive.

    The inverse of q, ``(S/S_ideal)² / V^(2(d−1)/d)``, is blunt about corners.  For quadrilaterals and
    hexahedra e adds half the excess over 1 of the mean of ``|B|² / (d det(B)^(2/d))`` over the nodes, B the
    Jacobian with its columns normalised: the scaled Jacobian to the power −2/d.  Wedges, pyramids and
    quadratic elements, for which q is not largest on the ideal element, take the inverse `mean_ratio` and the
    `excess` of the inverse q over 1.
    """
    dim = kind.dim
    volume = measure(kind, nodes)
    frames = contract(nodes, jnp.asarray(sample_gradients(kind), nodes.dtype))
    if kind.ideal_is_optimum:
        lengths = norm(jnp.swapaxes(frames, -1, -2))
        frames = frames / jnp.where(lengths > 0, lengths, 1)[:, None, :]
    mean, valid = _inverse_mean_ratio(kind, frames)
    valid = valid & (volume > 0)
    size = jnp.where(valid, volume, 1) ** (2 * (dim - 1) / dim)
    ratio = jnp.where(valid, surface(kind, nodes) / kind.ideal_surface, 1) ** 2 / size
    if not kind.ideal_is_optimum:
        e = mean + excess(ratio)[0]
    else:
        e = ratio if kind.constant_jacobian else ratio + CORNER_WEIGHT * (mean - 1)
    return jnp.where(valid, 1 / e, 0)


def edge_ratio(kind: ElementType, nodes: Nodes) -> Scalar:
    """Shortest over longest edge, between corner nodes."""
    lengths = edge_lengths(kind, nodes)
    return divide(least(lengths), greatest(lengths), 0)


_INF = float("inf")
SHAPE = Metric(
    "shape",
    shape_quality,
    "the paper's q: isoperimetric ratio, signed",
    range=(-1, 1),
    acceptable=(0.2, 1),
    reference="the paper, Eqs. 1-5 with beta = 2",
)
SCALED_JACOBIAN = Metric(
    "scaled_jacobian",
    scaled_jacobian,
    "worst corner over the ideal corner, signed",
    range=(-(2**0.5), 2**0.5),
    acceptable=(0.2, 2**0.5),
    reference="Knupp 2000, Finite element mesh quality via optimization of the Jacobian matrix norm",
)
MEAN_RATIO = Metric(
    "mean_ratio",
    mean_ratio,
    "Knupp's shape metric against the ideal element",
    range=(0, 1),
    acceptable=(0.2, 1),
    reference="Knupp 2003, Algebraic mesh quality metrics; Lo 1985 and Liu and Joe 1994 for simplices",
)
SHAPE_AND_CORNERS = Metric(
    "shape_and_corners",
    shape_and_corners,
    "what the optimiser maximises by default",
    range=(0, 1),
    acceptable=(0.2, 1),
    reference="jaxsmooth.metrics.shape.shape_and_corners",
)
EDGE_RATIO = Metric(
    "edge_ratio",
    edge_ratio,
    "shortest over longest edge",
    corners_only=True,
    range=(0, 1),
    acceptable=(0.2, 1),
    reference="Baker 1989; Knupp et al. 2007",
)
MIN_JACOBIAN = Metric(
    "min_jacobian",
    min_jacobian,
    "least Jacobian determinant",
    acceptable=(0, _INF),
    units="measure",
    reference="the determinant at nodes and quadrature points, relative to the ideal element of unit measure",
)
MEASURE = Metric(
    "measure",
    measure,
    "signed area or volume",
    acceptable=(0, _INF),
    units="measure",
    larger_is_better=None,
    reference="the area or volume of Verdict, which gives triangles and quadrilaterals no sign",
)
