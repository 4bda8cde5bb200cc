"""Derivatives where they were silently wrong, or are refused."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from meshes import KINDS_2D, grid, ideal

import jaxsmooth as js
from jaxsmooth.cells.table import element_type
from jaxsmooth.metrics.table import shape_quality
from jaxsmooth.numerics.implicit import conjugate_residuals

EXACT = 1e-13


@pytest.fixture(scope="module")
def square():
    points, blocks = grid("triangle", (3, 3), 0.08)
    mesh = js.Mesh(points, blocks)
    return (
        mesh,
        js.detect_constraints(mesh),
        jnp.asarray(np.random.default_rng(3).normal(size=(3, *points.shape))),
    )


def hessian_products(function, points, directions, step):
    """Products with two directions, and that with the first by a difference of order four."""
    product = jax.jit(lambda p, d: jax.jvp(jax.grad(function), (p,), (d,)))
    first, second = (product(points, d)[1] for d in directions)
    g = [product(points + k * step * directions[0], directions[0])[0] for k in (-2, -1, 1, 2)]
    return first, second, (g[0] - 8 * g[1] + 8 * g[2] - g[3]) / (12 * step)


def test_second_derivatives_of_a_fixed_point(square):
    mesh, constraints, (weights, *directions) = square
    method = js.Elastic(tolerance=EXACT)

    def function(p):
        found = js.fixed_point(mesh.with_points(p), method, constraints=constraints, tolerance=1e-12)
        return (jnp.sin(3 * found.points) * weights).sum()

    first, second, expected = hessian_products(function, mesh.points, directions, 2e-4)
    np.testing.assert_allclose(first, expected, atol=1e-8 * np.abs(expected).max())
    np.testing.assert_allclose((first * directions[1]).sum(), (second * directions[0]).sum(), rtol=1e-9)


def test_a_derivative_that_is_not_found_is_nan(square):
    mesh, constraints, (weights, *_) = square

    @jax.jit
    @jax.value_and_grad
    def function(p):
        few = js.fixed_point(mesh.with_points(p), constraints=constraints, max_iterations=2)
        return jnp.where(few.converged, (few.points * weights).sum(), jnp.nan)

    value, gradient = function(mesh.points)
    assert np.isfinite(value)
    assert np.isnan(gradient).all()


def test_conjugate_residuals_solve_what_is_not_symmetric():
    rng = np.random.default_rng(0)
    a = 5 * np.eye(40) + rng.normal(size=(40, 40)) / 2
    b = rng.normal(size=(20, 2))
    found = jax.jit(
        lambda b: conjugate_residuals(lambda v: (a @ v.reshape(-1)).reshape(20, 2), b, 1e-13, 100)
    )
    np.testing.assert_allclose(found(b).reshape(-1), np.linalg.solve(a, b.reshape(-1)), rtol=1e-10)
    np.testing.assert_allclose(found(1e-30 * b) * 1e30, found(b), rtol=1e-12)
    assert (found(0 * b) == 0).all()


def test_what_has_no_derivative_says_so(square):
    mesh, constraints, _ = square

    def optimised(p):
        return js.quality_mean(js.run(mesh.with_points(p), js.Optimize(), constraints=constraints, steps=1))

    with pytest.raises(TypeError, match=r"js\.optimum"):
        jax.grad(optimised)(mesh.points)
    with pytest.raises(TypeError, match="quality_mean"):
        jax.grad(lambda p: js.statistics(mesh.with_points(p)).q_avg)(mesh.points)
    with pytest.raises(TypeError, match="run"):
        jax.jit(lambda m: js.smooth(m).points)(mesh)


@pytest.mark.parametrize("kind", KINDS_2D)
def test_quality_has_a_slope_at_a_flat_element(kind):
    row = element_type(kind)
    nodes = jnp.asarray(ideal(kind) @ [[1, 0], [0.4, 0]])  # sheared, so that no edge has length 0
    direction = jnp.asarray(ideal(kind) @ [[0, 0], [0, 1]])
    found = jax.jit(jax.grad(lambda x: shape_quality(row, x)))(nodes)
    q = [shape_quality(row, nodes + k * 1e-4 * direction) for k in (-2, -1, 1, 2)]
    expected = (q[0] - 8 * q[1] + 8 * q[2] - q[3]) / 12e-4
    assert expected > 1
    np.testing.assert_allclose((found * direction).sum(), expected, rtol=1e-9)


def test_precision_follows_the_points(square):
    """Constraints and parameters in another precision are taken in that of the mesh."""
    mesh, constraints, _ = square
    single = mesh.with_points(np.asarray(mesh.points, np.float32))
    method = js.Elastic(alpha=jnp.asarray(0.9))
    gradient = jax.jit(jax.grad(lambda p: js.quality_mean(js.step(mesh.with_points(p), method, constraints))))
    found, expected = gradient(single.points), gradient(mesh.points)
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, expected, atol=1e-3 * np.abs(expected).max())


@pytest.mark.parametrize("method", [js.Laplacian(), js.Laplacian(smart=True), js.Elastic()], ids=repr)
def test_batches_of_every_method(square, method):
    mesh, _, _ = square
    meshes = [mesh, js.Mesh(*grid("triangle", (2, 3), 0.05))]
    batch = js.stack(meshes)
    state = method.init(batch.mesh)
    done = jax.jit(lambda b, state: b.run(method, steps=2, state=state))(batch, state)
    means = batch.quality_mean(done.mesh)
    for one, points, mean in zip(meshes, batch.points(done.mesh), means, strict=True):
        alone = js.run(one, method, constraints=js.detect_constraints(one), steps=2)
        np.testing.assert_allclose(points, alone.points, atol=1e-14)
        np.testing.assert_allclose(mean, js.quality_mean(alone), rtol=1e-12)


def test_one_compile_for_all_calls_outside_of_jit(square):
    mesh, constraints, _ = square
    run = jax.jit(lambda m: js.run(m, js.Laplacian(weighted=True), constraints=constraints, steps=1).points)
    expected = run(mesh)
    compiled = []
    jax.monitoring.register_event_duration_secs_listener(lambda name, *_, **__: compiled.append(name))
    for call in range(20):
        moved = mesh.with_points(mesh.points + 0.001 * call)
        for constraint in (constraints, js.Constraints(constraints.projectors + 0.0)):
            done = js.run(moved, js.Laplacian(weighted=True), constraints=constraint, steps=1)
            stepped = js.step(moved, js.Laplacian(weighted=True), constraint)
        np.testing.assert_allclose(done.points, expected + 0.001 * call, atol=1e-14)
        np.testing.assert_allclose(stepped.points, done.points, atol=1e-15)
        if call == 0:
            compiled.clear()
    assert not [name for name in compiled if "backend_compile" in name]
