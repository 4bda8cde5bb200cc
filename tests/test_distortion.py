"""What one element adds to the objective: e, its gradient, its Hessian model."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsmooth.cells.table import element_type, supported
from jaxsmooth.methods.optimize.distortion import (
    METRICS,
    apply_model,
    hessian_model,
    inverse_quality,
    model_diagonal,
    positive_part,
    regularisation,
)
from jaxsmooth.methods.optimize.problem import Aggregation
from jaxsmooth.metrics.record import Metric
from jaxsmooth.metrics.shape import MEAN_RATIO, SHAPE_AND_CORNERS, mean_ratio, measure, shape_quality
from jaxsmooth.metrics.table import named

jax.config.update("jax_enable_x64", True)

RNG = np.random.default_rng


def jiggled(kind, amplitude=0.05, seed=0):
    return jnp.asarray(np.asarray(kind.ideal) + amplitude * RNG(seed).standard_normal(kind.ideal.shape))


KINDS = supported()
# types for which "shape_and_corners" is not, or not only, the mean ratio
PAIRS = [(name, METRICS[0]) for name in KINDS] + [
    (name, MEAN_RATIO) for name in ("triangle", "quad", "tetra", "hexahedron")
]
# others: the first is best where large, the second where small
OWN = Metric("roundness", lambda kind, nodes: 3 * mean_ratio(kind, nodes) ** 2, ideal=3.0)
OTHERS = [("triangle", OWN), ("tetra", named("condition")), ("quad", named("max_angle"))]


@pytest.mark.parametrize(("name", "metric"), PAIRS)
def test_gradient_is_that_of_the_value(name, metric):
    kind = element_type(name)
    nodes, size, eps = jiggled(kind), jnp.float64(1.3), jnp.float64(0.1)
    function = jax.jit(partial(inverse_quality, kind, metric, jnp.float64(0.5)))
    direction = jnp.asarray(RNG(2).standard_normal(kind.ideal.shape))
    h = 1e-6
    up, down = (function(nodes + s * h * direction, size, eps)[0] for s in (1, -1))
    # central differences: rounding eps / h and truncation h² are both below 1e-8
    np.testing.assert_allclose(
        jnp.vdot(function(nodes, size, eps)[1], direction), (up - down) / (2 * h), rtol=1e-6, atol=1e-8
    )


@pytest.mark.parametrize(("name", "metric"), OTHERS)
def test_another_metric_is_differentiated_and_has_the_barrier_of_the_mean_ratio(name, metric):
    kind = element_type(name)
    nodes, zero = jiggled(kind), jnp.float64(0.0)
    function = jax.jit(lambda nodes, eps: inverse_quality(kind, metric, zero, nodes, 1.3, eps))
    e, gradient = function(nodes, zero)
    ratio = jax.jit(lambda x: metric(kind, x) / metric.ideal_value(kind))(nodes)
    np.testing.assert_allclose(e, 1 / ratio if metric.larger_is_better else ratio, rtol=1e-13)
    direction = jnp.asarray(RNG(2).standard_normal(kind.ideal.shape))
    up, down = (function(nodes + s * 1e-6 * direction, zero)[0] for s in (1, -1))
    np.testing.assert_allclose(jnp.vdot(gradient, direction), (up - down) / 2e-6, rtol=1e-6, atol=1e-8)
    mirrored, eps = nodes.at[:, 0].multiply(-1), jnp.float64(0.1)
    usual = jax.jit(lambda x: inverse_quality(kind, MEAN_RATIO, zero, x, 1.3, eps))(mirrored)
    for value, other in zip(function(mirrored, eps), usual, strict=True):
        np.testing.assert_allclose(value, other, rtol=1e-12)


@pytest.mark.parametrize(("name", "metric"), PAIRS)
def test_ideal_element_is_the_optimum(name, metric):
    kind = element_type(name)
    function = jax.jit(partial(inverse_quality, kind, metric, jnp.float64(1.0)))
    best, gradient = function(jnp.asarray(kind.ideal), 1.0, 0.0)
    np.testing.assert_allclose(best, 1, rtol=1e-9)
    np.testing.assert_allclose(gradient, 0, atol=1e-9)
    for seed in range(8):
        assert function(jiggled(kind, 0.03, seed), 1.0, 0.0)[0] > 1


@pytest.mark.parametrize("name", KINDS)
def test_metric_is_the_inverse_of_what_is_minimised(name):
    kind = element_type(name)
    nodes = jiggled(kind)
    mirrored = nodes.at[:, 0].multiply(-1)
    for metric in (SHAPE_AND_CORNERS, MEAN_RATIO):
        zero = jnp.float64(0.0)

        @jax.jit
        def both(x, metric=metric, zero=zero):
            return metric(kind, x), inverse_quality(kind, metric, zero, x, measure(kind, x), zero)[0]

        q, e = both(nodes)
        np.testing.assert_allclose(q, 1 / e, rtol=1e-13)
        assert e > 1.0001
        assert both(mirrored)[0] == 0


@pytest.mark.parametrize("name", KINDS)
def test_invariance_to_similarity(name):
    kind = element_type(name)
    nodes = jiggled(kind)
    turn, _ = np.linalg.qr(RNG(3).standard_normal((kind.dim, kind.dim)))
    turn[:, 0] *= np.linalg.det(turn)
    moved = 7.0 * nodes @ jnp.asarray(turn).T + 3.0
    value = jax.jit(lambda x: inverse_quality(kind, METRICS[0], 0.0, x, 1.0, 0.0)[0])
    values = [value(x) for x in (nodes, moved)]
    np.testing.assert_allclose(values[0], values[1], rtol=1e-10)


@pytest.mark.parametrize("name", ["triangle", "quad", "tetra", "wedge", "hexahedron", "tetra10"])
def test_hessian_model_is_positive_and_its_diagonal_right(name):
    kind = element_type(name)
    aggregation = Aggregation(1.0, 1.0, 6.0, 1.2)
    units = jnp.eye(kind.k * kind.dim).reshape(-1, kind.k, kind.dim)

    @jax.jit
    def both(nodes):
        *_, model = hessian_model(kind, METRICS[0], 0.5, aggregation.derivatives, nodes, 1.0, 0.0)
        matrix = jax.vmap(lambda u: apply_model(kind, u, model).reshape(-1))(units)
        return matrix, model_diagonal(kind, model)

    matrix, found = (np.asarray(part) for part in both(jiggled(kind)))
    np.testing.assert_allclose(matrix, matrix.T, atol=1e-10 * np.abs(matrix).max())
    assert np.linalg.eigvalsh(matrix).min() > -1e-10 * np.abs(matrix).max()
    blocks = matrix.reshape(kind.k, kind.dim, kind.k, kind.dim)
    diagonal = np.stack([blocks[i, :, i] for i in range(kind.k)])
    np.testing.assert_allclose(found, diagonal, atol=1e-10 * np.abs(diagonal).max())


@pytest.mark.parametrize("name", ["triangle", "tetra"])
def test_hessian_model_of_the_mean_ratio_is_exact_where_nothing_is_left_out(name):
    """Along displacements that leave the determinant's second derivative out: one node's."""
    kind = element_type(name)
    nodes = jiggled(kind, 0.1)
    direction = np.zeros(nodes.shape)
    direction[0] = RNG(4).standard_normal(kind.dim)

    @jax.jit
    def both(nodes, direction):
        *_, model = hessian_model(
            kind, MEAN_RATIO, 0.0, lambda e: (jnp.ones_like(e), jnp.zeros_like(e)), nodes, 1.0, 0.0
        )
        gradient = lambda x: inverse_quality(kind, MEAN_RATIO, 0.0, x, 1.0, 0.0)[1]  # noqa: E731
        return apply_model(kind, direction, model), jax.jvp(gradient, (nodes,), (direction,))[1]

    found, exact = both(nodes, direction)
    np.testing.assert_allclose(np.vdot(found, direction), np.vdot(exact, direction), rtol=1e-10)


def test_positive_part():
    det = jnp.asarray([-2.0, -1e-3, 0.0, 1e-3, 2.0])
    assert (positive_part(det, 0.1) > 0).all()
    np.testing.assert_array_equal(positive_part(det, 0.0), jnp.maximum(det, 0))
    slope = jax.vmap(jax.grad(positive_part), in_axes=(0, None))(det, 0.1)
    assert ((slope > 0) & (slope < 1)).all()
    assert regularisation(jnp.float64(1e-9)) == 0  # valid, so the barrier stands
    assert regularisation(jnp.float64(-1.0)) > 0.1


@pytest.mark.parametrize("name", ["triangle", "hexahedron", "wedge", "tetra10"])
def test_vanishing_elements_are_no_way_out(name):
    """With a regularised determinant alone, a metric without size falls to zero with the element."""
    kind = element_type(name)
    function = jax.jit(lambda x, eps: inverse_quality(kind, METRICS[0], 0.0, x, 1.0, eps)[0])
    for eps in (0.01, 0.1, 0.5):
        scaled = [function(s * np.asarray(kind.ideal), eps) for s in (1.0, 1e-3)]
        assert scaled[1] > scaled[0] + 0.5


@pytest.mark.parametrize("name", ["wedge", "pyramid", "tetra10", "hexahedron20"])
def test_quality_and_shape_are_both_seen(name):
    """Flat ones are worse than by their mean ratio alone; tall ones, of less surface, are not better."""
    kind = element_type(name)
    heights = np.array([0.3, 0.5, 0.8, 1.0, 1.4, 2.0])
    stretch = np.stack([np.ones(6), np.ones(6), heights], axis=1)
    nodes = np.asarray(kind.ideal) * stretch[:, None]

    @jax.jit
    @jax.vmap
    def values(x):
        found = (inverse_quality(kind, metric, 0.0, x, 1.0, 0.0)[0] for metric in (METRICS[0], MEAN_RATIO))
        return *found, shape_quality(kind, x)

    both, mean, q = (np.asarray(part) for part in values(nodes))
    assert (both >= mean - 1e-12).all()
    assert both.argmin() == 3
    excess, gap = 1 / q[0] - 1, (both - mean)[0]
    assert excess - 0.02 <= gap <= excess  # the kink is rounded
    assert gap > 0.01
