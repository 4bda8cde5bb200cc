"""The energy as a function, and its optimum: values, derivatives of first and second order."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from meshes import grid, hexahedra_and_pyramids

import jaxsmooth as js

STEP = 2e-4


def first_and_second(function):
    """Value, gradient, and the product of the Hessian with a direction: one program."""

    def both(at, direction):
        (value, gradient), (_, product) = jax.jvp(jax.value_and_grad(function), (at,), (direction,))
        return value, gradient, product

    return jax.jit(both)


def check(function, at, directions, rtol):
    """Gradient and Hessian product against differences of order four, and symmetry."""
    both = first_and_second(function)

    def dot(a, b):
        return sum(float((x * y).sum()) for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True))

    one, two = directions
    near = [both(jax.tree.map(lambda a, d, k=k: a + k * STEP * d, at, one), one) for k in (-2, -1, 1, 2)]
    slope, bend = jax.tree.map(
        lambda a, b, c, d: (a - 8 * b + 8 * c - d) / (12 * STEP), *[n[:2] for n in near]
    )
    (value, gradient, first), second = both(at, one), both(at, two)[2]
    np.testing.assert_allclose(dot(gradient, one), slope, rtol=rtol, atol=1e-11 * abs(value) / STEP)
    for found, expected in zip(jax.tree.leaves(first), jax.tree.leaves(bend), strict=True):
        np.testing.assert_allclose(found, expected, atol=10 * rtol * np.abs(expected).max())
    np.testing.assert_allclose(dot(first, two), dot(second, one), rtol=1e-7)
    return value, gradient


@pytest.fixture(scope="module")
def square():
    points, blocks = grid("triangle", (3, 3), 0.08)
    mesh = js.Mesh(points, blocks)
    fields = jnp.asarray(np.random.default_rng(3).normal(size=(3, *points.shape)))
    return mesh, js.detect_constraints(mesh), fields


@pytest.mark.parametrize("make", [partial(grid, "quad8", (1, 2), 0.1), partial(hexahedra_and_pyramids, 0.1)])
def test_derivatives_of_the_energy(make):
    points, blocks = make()
    mesh, rng = js.Mesh(points, blocks), np.random.default_rng(0)
    at = {"points": mesh.points, "size": jnp.asarray(0.1), "worst": jnp.asarray(0.5)}
    directions = [jax.tree.map(lambda x: jnp.asarray(0.1 * rng.normal(size=x.shape)), at) for _ in range(2)]

    def function(at):
        aggregation = js.Aggregation(1.0, at["worst"], 4.0)
        target = js.GivenSize(size=at["size"], weight=0.3)
        return js.energy(mesh.with_points(at["points"]), target=target, aggregation=aggregation)

    check(function, at, directions, 1e-7)


def test_energy_is_what_the_metric_says_and_infinite_where_inverted(square):
    mesh, constraints, (direction, *_) = square
    q = np.concatenate(js.quality(mesh, metric="shape_and_corners"))
    expected = np.mean(1 - q + 0.1 / 4 * q**-4.0)
    np.testing.assert_allclose(js.energy(mesh), expected, rtol=1e-12)
    mirrored = mesh.with_points(mesh.points * jnp.asarray([-1.0, 1.0]))
    flat = mesh.with_points(mesh.points * jnp.asarray([1.0, 0.0]))
    both = jax.jit(jax.value_and_grad(lambda p: js.Energy()(mesh.with_points(p), constraints)))
    for bad in (mirrored, flat):
        value, gradient = both(bad.points)
        assert value == np.inf
        assert np.isfinite(gradient).all()
        assert np.isfinite(js.energy(bad, regularisation=0.1))
        assert js.if_valid(jnp.asarray(1.0), bad) == np.inf
    assert js.if_valid(jnp.asarray(1.0), mesh) == 1
    # the preconditioned gradient descends, within the constraints, in any unit of length
    for unit in (1.0, 1000.0):
        scaled = mesh.with_points(unit * mesh.points)
        slope = js.Energy().preconditioner(scaled, constraints)(both(mesh.points)[1] / unit)
        np.testing.assert_allclose(constraints.at(mesh.points).project(slope), slope, atol=1e-12 * unit)
        moved = scaled.with_points(scaled.points - 0.5 * slope)
        assert js.energy(moved, motion=constraints) < 0.9 * js.energy(scaled, motion=constraints)
    product = js.Energy().hessian_product(mesh, direction, constraints)
    ahead, behind = (both(mesh.points + sign * 1e-5 * direction)[1] for sign in (1, -1))
    np.testing.assert_allclose(product, (ahead - behind) / 2e-5, atol=1e-6 * np.abs(product).max())


def test_optimum_and_its_derivatives(square):
    mesh, constraints, (weights, *directions) = square
    at = {"points": mesh.points, "worst": jnp.asarray(0.3)}
    directions = [{"points": 0.1 * d, "worst": jnp.asarray(0.5)} for d in directions]

    def function(at):
        energy = js.Energy(aggregation=js.Aggregation(1.0, at["worst"], 4.0))
        found = js.optimum(mesh.with_points(at["points"]), energy, motion=constraints)
        return jnp.where(found.converged, (jnp.sin(3 * found.points) * weights).sum(), jnp.nan)

    _, gradient = check(function, at, directions, 1e-7)
    assert abs(gradient["worst"]) > 1e-4
    free = constraints.freedom == 2
    np.testing.assert_allclose(gradient["points"][free], 0, atol=1e-8)  # the start is forgotten
    held = constraints.freedom == 0
    assert np.abs(gradient["points"][held]).max() > 0.1


def test_optimum_is_one(square):
    mesh, constraints, _ = square
    optimum = jax.jit(lambda m, most: js.optimum(m, motion=constraints, max_steps=most))
    energy = jax.jit(jax.value_and_grad(lambda p: js.Energy()(mesh.with_points(p), constraints)))
    found = optimum(mesh, 50)
    assert found.converged
    value, slope = energy(found.points)
    np.testing.assert_allclose(found.energy, value, rtol=1e-14)
    assert value < energy(mesh.points)[0]
    np.testing.assert_allclose(constraints.at(mesh.points).collect(slope), 0, atol=1e-9)
    held = constraints.freedom == 0
    assert (found.points[held] == mesh.points[held]).all()
    assert not optimum(mesh, 0).converged
