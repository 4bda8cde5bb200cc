"""How far an element is from its ideal: e ≥ 1, 1 only on the ideal element, with derivatives.

Every metric here is a convex function of quantities (deformation, surface, measure) of which only
the second derivative of the determinant is not convex.  The Hessian model leaves that one out and
is positive semi-definite (as Garanzha, Kaporin, Kudryavtseva, Protais, Ray and Sokolov 2021,
"Foldover-free maps in 50 lines of code").  Gradients are written out: reverse mode takes several
times as long on CPU.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsmooth.cells.table import ElementType
from jaxsmooth.metrics.record import Metric
from jaxsmooth.metrics.shape import CORNER_WEIGHT, MEAN_RATIO, SHAPE_AND_CORNERS, excess, sample_gradients
from jaxsmooth.numerics.small import cofactors, contract, determinant, power

__all__ = [
    "METRICS",
    "Model",
    "apply_model",
    "hessian_model",
    "inverse_quality",
    "model_diagonal",
    "positive_part",
    "regularisation",
]

METRICS = (SHAPE_AND_CORNERS, MEAN_RATIO)
"""Metrics with a regularised form and a Hessian model of their own."""
_EPS, _EPS_SLOPE = 0.1, 0.2  # ε of a degenerate mesh, and its growth with the worst inversion
_KEEP = 4.0  # size weight per ε of elements below their size
_FLOOR = 1e-6  # least value of a metric of a user's own, over the ideal one

Nodes = Float[Array, "k dim"]
Scalar = Float[Array, ""] | float


def positive_part(det: Array, eps: Array | float) -> Array:
    """χ(det) = (det + √(det² + ε²)) / 2: positive everywhere, det itself for ε = 0 and det > 0.

    With it a barrier is finite on inverted elements and drives them out as ε falls (Escobar,
    Rodríguez, Montenegro, Montero and González-Yuste 2003).
    """
    root = jnp.sqrt(det * det + eps * eps)
    behind = (det < 0) & (root > 0)
    without_cancellation = eps * eps / (2 * jnp.where(behind, root - det, 1))
    return jnp.where(behind, without_cancellation, (det + root) / 2)


def regularisation(worst: Float[Array, "..."]) -> Float[Array, "..."]:
    """ε for a mesh whose least relative determinant is `worst`: none for a valid one.

    Proportional to the worst inversion, so that it falls as the mesh untangles (Garanzha et al.
    2021).  A valid mesh keeps its barrier, however small its determinants: they may be small
    because elements have shrunk to a better shape.
    """
    return jnp.where(worst > 0, 0, _EPS - _EPS_SLOPE * worst)


def _slope(det: Array, eps: Array | float) -> Array:
    root = jnp.sqrt(det * det + eps * eps)
    return jnp.where(root > 0, (1 + det / jnp.where(root > 0, root, 1)) / 2, 0)


def isoperimetric(kind: ElementType, metric: Metric) -> bool:
    """Whether the paper's q serves as the metric: where it is largest on the ideal element."""
    return metric == SHAPE_AND_CORNERS and kind.ideal_is_optimum


def _bounded(kind: ElementType, metric: Metric) -> bool:
    """Whether the paper's q only bounds the metric, which is the mean ratio: where some elements
    have less surface than the ideal one."""
    return metric == SHAPE_AND_CORNERS and not isoperimetric(kind, metric)


def _sampled(kind: ElementType, metric: Metric) -> bool:
    """Whether the metric looks at the Jacobian at sample points: where it varies, or alone counts."""
    return not isoperimetric(kind, metric) or not kind.constant_jacobian


class _Volume(NamedTuple):
    """Regularised measure, and its gradient ``[k, dim]``."""

    value: Float[Array, ""]
    gradient: Nodes


def _volume(kind: ElementType, nodes: Nodes, size: Scalar, eps: Scalar) -> _Volume:
    reference = jnp.asarray(kind.gradients, nodes.dtype)
    weights = jnp.asarray(kind.weights, nodes.dtype)
    frames = contract(nodes, reference)
    raw = (determinant(frames) * weights).sum() / size
    stress = cofactors(frames) * (weights * _slope(raw, eps))[:, None, None]
    return _Volume(size * positive_part(raw, eps), _to_nodes(reference, stress))


class _Surface(NamedTuple):
    """Perimeter or surface area, its gradient, and ``pull``: areas times inverse metrics."""

    value: Float[Array, ""]
    gradient: Nodes
    pull: Float[Array, "s j j"]


def _surface(kind: ElementType, nodes: Nodes) -> _Surface:
    reference = jnp.asarray(kind.facet_tangents, nodes.dtype)
    weights = jnp.asarray(kind.facet_weights, nodes.dtype)
    tangents = contract(nodes, reference)
    gram = (tangents[:, :, :, None] * tangents[:, :, None, :]).sum(axis=1)
    square = gram[:, 0, 0] if kind.dim == 2 else determinant(gram)
    root = power(square, 0.5)
    adjugate = jnp.ones_like(gram) if kind.dim == 2 else cofactors(gram)
    solid = root > 0
    pull = adjugate * (jnp.where(solid, 1 / jnp.where(solid, root, 1), 0) * weights)[:, None, None]
    stress = (tangents[:, :, :, None] * pull[:, None, :, :]).sum(axis=2)
    return _Surface((root * weights).sum(), _to_nodes(reference, stress), pull)


class Samples(NamedTuple):
    """Jacobians at the sample points, for value, gradient and Hessian model of the sampled part.

    The model is ``f₁|dA|² + 2f₂ (A:dA)(C:dA) + f₃ (C:dA)²``, C the cofactors of A; A has its
    columns divided by `lengths`.
    """

    frames: Float[Array, "q dim dim"]
    cofactors: Float[Array, "q dim dim"]
    factors: Float[Array, "q 3"]
    inverse_lengths: Float[Array, "q dim"]


def _samples(
    kind: ElementType, metric: Metric, nodes: Nodes, size: Scalar, eps: Scalar
) -> tuple[Float[Array, ""], Nodes, Samples]:
    """Mean over the sample points of ``|A|² / (d det(A)^(2/d))``, its gradient, and the samples."""
    dim = kind.dim
    points = jnp.asarray(sample_gradients(kind), nodes.dtype)
    frames = contract(nodes, points)
    if isoperimetric(kind, metric):
        # the columns' own lengths: by the arithmetic and geometric means the gradient of the
        # normalised form is the one with the lengths held, and the model majorises
        square = (frames * frames).sum(axis=-2)
        inverse = jnp.where(square > 0, 1 / power(jnp.where(square > 0, square, 1), 0.5), 1)
    else:
        inverse = jnp.ones((len(points), dim), nodes.dtype)
    frames = frames * inverse[:, None, :]
    scale = inverse.prod(axis=-1) * size
    raw = determinant(frames) / scale
    slope, det = _slope(raw, eps), scale * positive_part(raw, eps)
    square = (frames * frames).sum(axis=(-1, -2))
    unit = 1 / (len(points) * dim * det ** (2 / dim))
    first = -(2 / dim) * unit * square * slope / det
    mixed = -(4 / dim) * unit * slope / det
    bulk = -(2 / dim + 1) * first * slope / det
    cof = cofactors(frames)
    stress = (2 * unit)[:, None, None] * frames + first[:, None, None] * cof
    gradient = _to_nodes(points, stress * inverse[:, None, :])
    samples = Samples(frames, cof, jnp.stack([2 * unit, mixed, bulk], -1), inverse)
    return (unit * square).sum(), gradient, samples


def _size_weight(size_weight: Scalar, eps: Scalar, stretch: Float[Array, ""]) -> Float[Array, ""]:
    """With ε, metrics without size would be best for elements that vanish."""
    return size_weight + jnp.where(stretch < 1, _KEEP * eps, 0)


def check_metric(metric: Metric, kinds: tuple[ElementType, ...]) -> None:
    """Raises `ValueError` unless a metric can be optimised on elements of these types."""
    lacking = [kind.name for kind in kinds if not metric.applies_to(kind)]
    reason = (
        f"it is not for {lacking[0]} elements"
        if lacking
        else "it compares an element with others"
        if metric.relative
        else f"it has a unit of {metric.units}"
        if metric.units in ("length", "measure")
        else "neither larger nor smaller values are better"
        if metric.larger_is_better is None
        else "it has no derivative"
        if not metric.differentiable
        else None
    )
    if reason is not None:
        raise ValueError(f"the metric {metric.name!r} can't be optimised: {reason}")


def _inverse(kind: ElementType, metric: Metric, nodes: Nodes) -> Float[Array, ""]:
    """Any metric as e: 1 on the ideal element, larger where worse."""
    value, ideal = metric(kind, nodes), metric.ideal_value(kind)
    if metric.larger_is_better:
        return 1 / jnp.maximum(value / ideal, _FLOOR)
    return value / ideal if ideal > 0 else 1 + value - ideal


class _Metric(NamedTuple):
    """e, its gradient, and what the Hessian model needs."""

    value: Float[Array, ""]
    gradient: Nodes
    volume: _Volume
    surface: _Surface | None
    samples: Samples | None


def _metric(kind: ElementType, metric: Metric, size_weight, nodes: Nodes, size, eps) -> _Metric:
    dim = kind.dim
    volume = _volume(kind, nodes, size, eps)
    stretch = volume.value / size
    size_weight = _size_weight(size_weight, eps, stretch)
    value = size_weight * ((stretch + 1 / stretch) / 2 - 1)
    gradient = size_weight * (1 - 1 / stretch**2) / (2 * size) * volume.gradient
    surface = samples = None
    if metric == SHAPE_AND_CORNERS:
        surface = _surface(kind, nodes)
        ratio = (surface.value / kind.ideal_surface) ** 2 / volume.value ** (2 * (dim - 1) / dim)
        slope = (
            2 * ratio * (surface.gradient / surface.value - (dim - 1) / dim * volume.gradient / volume.value)
        )
        if _bounded(kind, metric):
            ratio, rise, _ = excess(ratio)
            slope = rise * slope
        value, gradient = value + ratio, gradient + slope
    if _sampled(kind, metric):
        mean, slope, samples = _samples(kind, metric, nodes, size, eps)
        if metric not in METRICS:  # the mean ratio lends its barrier and its Hessian model
            plain = jnp.asarray(eps) <= 0
            own = jax.value_and_grad(lambda nodes: _inverse(kind, metric, nodes))(nodes)
            mean, slope = (jnp.where(plain, a, b) for a, b in zip(own, (mean, slope), strict=True))
        weight = CORNER_WEIGHT if isoperimetric(kind, metric) else 1.0
        value = value + (weight * (mean - 1) if isoperimetric(kind, metric) else mean)
        gradient = gradient + weight * slope
    return _Metric(value, gradient, volume, surface, samples)


def inverse_quality(
    kind: ElementType, metric: Metric, size_weight: Scalar, nodes: Nodes, size: Scalar, eps: Scalar
) -> tuple[Float[Array, ""], Nodes]:
    """e ≥ 1 of one element, and its gradient ``[k, dim]``.

    For ε = 0 and no size weight 1/e is the metric of `jaxsmooth.metrics.shape` of the same name, which
    defines it.
    ``shape_and_corners``: the inverse of the paper's q (Eqs. 1–5, β = 2), ``(S/S_ideal)² / V^(2(d−1)/d)``.
    q is blunt about corners, so elements whose Jacobian varies add the excess of the mean over
    the sample points of ``|A|² / (d det(A)^(2/d))``; for quadrilaterals and hexahedra with the
    columns of A normalised, which leaves aspect ratios to q: it is the scaled Jacobian to the
    power −2/d.  Wedges, pyramids and quadratic elements take the mean ratio and the excess of the
    inverse q over 1.
    ``mean_ratio``: the mean over the sample points of ``|A|² / (d det(A)^(2/d))``,
    A the deformation gradient from the ideal element (Knupp 2001).

    Args:
        kind: the element type.
        metric: one of `METRICS`, or any that passes `check_metric`: e is then its ideal value over it, or
            where small is best it over its ideal (above an ideal of 0); the mean ratio while ε is positive.
        size_weight: of ``(τ + 1/τ)/2 − 1``, τ the measure over the target's; 0 leaves it free, but
            with ε elements below their size are kept from vanishing.
        nodes: ``[k, dim]``.
        size: measure of the target element.
        eps: ε of the regularised determinant, relative to `size`.
    """
    found = _metric(kind, metric, size_weight, nodes, size, eps)
    return found.value, found.gradient


class Model(NamedTuple):
    """Hessian model of one element: a sum of squares.

    Attributes:
        surface: ``[k, k]``, the same for each direction in space: ``Σ Gᵀ M G`` over the sample points of all
            facets, with their metric tensors M times what they weigh, and their natural derivatives G.
        samples: see `Samples`.
        vectors: nodal fields ``[m, k, dim]`` whose products with a displacement are squared:
            the gradients of e, of the size, and of the isoperimetric ratio.
    """

    surface: Float[Array, "k k"] | None
    samples: Samples | None
    vectors: Float[Array, "m k dim"]


def hessian_model(
    kind: ElementType,
    metric: Metric,
    size_weight: Scalar,
    aggregate: Callable[[Array], tuple[Array, Array]],
    nodes: Nodes,
    size: Scalar,
    eps: Scalar,
) -> tuple[Float[Array, ""], Nodes, Model]:
    """Positive semi-definite model of the Hessian of φ(e) of one element.

    Left out: the second derivative of the determinant, and φ″ where negative.  Surfaces enter by
    their Dirichlet energy over the present surface, which majorises the area.
    """
    dim = kind.dim
    found = _metric(kind, metric, size_weight, nodes, size, eps)
    first, second = aggregate(found.value)
    volume, surface, samples = found.volume, found.surface, found.samples
    vectors = [
        jnp.sqrt(jnp.maximum(second, 0)) * found.gradient,
        jnp.sqrt(first * _size_weight(size_weight, eps, volume.value / size) * size / volume.value**3)
        * volume.gradient,
    ]
    pull = None
    if surface is not None:
        # S^d / V^(d−1) has second differential ∝ (dS − S/V dV)² where S and V are linear
        ratio = (surface.value / kind.ideal_surface) ** 2 / volume.value ** (2 * (dim - 1) / dim)
        change = surface.gradient / surface.value - volume.gradient / volume.value
        weight = first
        if _bounded(kind, metric):
            _, rise, bend = excess(ratio)
            weight = first * rise
            slope = surface.gradient / surface.value - (dim - 1) / dim * volume.gradient / volume.value
            vectors.append(jnp.sqrt(first * bend) * 2 * ratio * slope)
        vectors.append(jnp.sqrt(weight * 2 * (dim - 1) * ratio) * change)
        tangents = jnp.asarray(kind.facet_tangents, nodes.dtype)
        turned = (tangents[:, :, :, None] * surface.pull[:, None]).sum(axis=2)
        pull = (turned[:, :, None] * tangents[:, None]).sum(axis=(0, -1))
        pull = weight * 2 * ratio / surface.value * pull
    if samples is not None:
        weight = first * (CORNER_WEIGHT if isoperimetric(kind, metric) else 1)
        samples = samples._replace(factors=weight * samples.factors)
    return found.value, found.gradient, Model(pull, samples, jnp.stack(vectors))


def _to_nodes(gradients: Float[Array, "q k j"], stress: Float[Array, "q dim j"]) -> Nodes:
    return (gradients[:, :, None, :] * stress[:, None]).sum(axis=(0, -1))


def apply_model(kind: ElementType, move: Nodes, model: Model) -> Nodes:
    """The model times a displacement ``[k, dim]``."""
    force = ((model.vectors * move).sum(axis=(-1, -2))[:, None, None] * model.vectors).sum(axis=0)
    if model.surface is not None:
        force = force + (model.surface[:, :, None] * move).sum(axis=1)
    if model.samples is not None:
        frames, cof, factors, inverse = model.samples
        points = jnp.asarray(sample_gradients(kind), move.dtype)
        change = contract(move, points) * inverse[:, None, :]
        a, c = (frames * change).sum(axis=(-1, -2)), (cof * change).sum(axis=(-1, -2))
        plain, mixed, bulk = factors[:, 0], factors[:, 1], factors[:, 2]
        along, across = mixed * c, mixed * a + bulk * c
        stress = plain[:, None, None] * change + along[:, None, None] * frames + across[:, None, None] * cof
        force = force + _to_nodes(points, stress * inverse[:, None, :])
    return force


def model_diagonal(kind: ElementType, model: Model) -> Float[Array, "k dim dim"]:
    """Diagonal node blocks of the model."""
    eye = jnp.eye(kind.dim, dtype=model.vectors.dtype)
    blocks = _outer(model.vectors, model.vectors).sum(axis=0)
    if model.surface is not None:
        blocks = blocks + jnp.diagonal(model.surface)[:, None, None] * eye
    if model.samples is not None:
        frames, cof, factors, inverse = model.samples
        points = jnp.asarray(sample_gradients(kind), eye.dtype) * inverse[:, None, :]
        a = (frames[:, None] * points[:, :, None, :]).sum(axis=-1)
        c = (cof[:, None] * points[:, :, None, :]).sum(axis=-1)
        plain, mixed, bulk = (factors[:, i, None, None, None] for i in range(3))
        square = (points * points).sum(axis=-1)[..., None, None] * eye
        cross = _outer(a, c)
        part = plain * square + mixed * (cross + jnp.swapaxes(cross, -1, -2)) + bulk * _outer(c, c)
        blocks = blocks + part.sum(axis=0)
    return blocks


def _outer(a: Array, b: Array) -> Array:
    return a[..., :, None] * b[..., None, :]
