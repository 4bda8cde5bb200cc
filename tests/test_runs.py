"""Whole runs as pure functions: values, fixed points, batches, compiles."""

from pathlib import Path

import jax
import numpy as np
import pytest
from derivatives import check
from meshes import grid, mixed_2d

import jaxsmooth as js

SHARED = Path(__file__).parents[2] / "shared" / "meshes"
EXACT = 1e-13  # of the linear systems, where differences are taken


@pytest.fixture(scope="module")
def square():
    points, blocks = grid("triangle", (3, 3), 0.08)
    mesh = js.Mesh(points, blocks)
    rng = np.random.default_rng(3)
    return mesh, js.detect_constraints(mesh), rng.normal(size=points.shape), rng.normal(size=points.shape)


# --- Fixed point -----------------------------------------------------------------------


def test_fixed_point(square):
    mesh, constraints, weights, direction = square
    found = jax.jit(lambda m: js.fixed_point(m, constraints=constraints, tolerance=1e-11))(mesh)
    assert float(found.change) <= 1e-11
    again = js.step(found.mesh, js.Elastic(guard=None, tolerance=EXACT), constraints)
    np.testing.assert_allclose(again.points, found.mesh.points, atol=1e-10)

    def function(p):
        return (
            js.fixed_point(mesh.with_points(p), constraints=constraints, tolerance=1e-12).mesh.points
            * weights
        ).sum()

    gradient = check(function, np.asarray(mesh.points), direction, step=1e-4)
    free = constraints.freedom == 2
    assert free.any()
    np.testing.assert_allclose(gradient[free], 0, atol=1e-8)  # the start of free nodes is forgotten


# --- Runs and batches ------------------------------------------------------------------


def test_run_equals_smooth(square):
    mesh, constraints, *_ = square
    driver = js.smooth(mesh, steps=3, tolerance_avg=0, constraints=constraints)
    pure = jax.jit(lambda m: js.run(m, js.Elastic().loosely(), constraints=constraints, steps=3))(mesh)
    np.testing.assert_allclose(pure.points, driver.mesh.points, atol=1e-14)


def test_no_steps_changes_nothing(square):
    mesh, constraints, *_ = square
    assert (js.run(mesh, constraints=constraints, steps=0).points == mesh.points).all()


def test_one_compile_for_many_geometries_and_vmap(square):
    mesh, constraints, *_ = square
    traces = []

    @jax.jit
    def smooth(points, constraints):
        traces.append(1)
        return js.run(mesh.with_points(points), constraints=constraints, steps=2).points

    rng = np.random.default_rng(7)
    free = (constraints.freedom == 2)[:, None]
    geometries = np.asarray(mesh.points) + 0.03 * rng.uniform(-1, 1, (64, *mesh.points.shape)) * free
    single = np.stack([smooth(g, constraints) for g in geometries])
    assert len(traces) == 1
    batched = jax.jit(
        jax.vmap(lambda p: js.run(mesh.with_points(p), constraints=constraints, steps=2).points)
    )
    np.testing.assert_allclose(batched(geometries), single, atol=1e-12)
    sloped = jax.jit(
        jax.vmap(
            jax.grad(lambda p: js.quality_mean(js.run(mesh.with_points(p), constraints=constraints, steps=2)))
        )
    )
    one = jax.jit(
        jax.grad(lambda p: js.quality_mean(js.run(mesh.with_points(p), constraints=constraints, steps=2)))
    )
    np.testing.assert_allclose(sloped(geometries[:3])[2], one(geometries[2]), atol=1e-9)


def test_meshes_of_different_sizes_in_one_batch():
    meshes = [
        js.Mesh(*grid("triangle", (3, 3), 0.08)),
        js.Mesh(*grid("quad", (2, 3), 0.08)),
        js.Mesh(*mixed_2d(0.08)),
    ]
    batch = js.stack(meshes)
    run = jax.jit(jax.vmap(lambda m, c: js.run(m, js.Elastic(extended=True), constraints=c, steps=2)))
    smooth = run(batch.mesh, batch.constraints)
    quality = jax.vmap(js.quality)(smooth.mesh)
    for mesh, found, mean in zip(meshes, batch.points(smooth.mesh), batch.mean(quality), strict=True):
        alone = js.run(mesh, js.Elastic(extended=True), constraints=js.detect_constraints(mesh), steps=2)
        np.testing.assert_allclose(found, alone.points, atol=1e-12)
        np.testing.assert_allclose(mean, js.quality_mean(alone), atol=1e-12)


def test_batches_want_one_dimension():
    with pytest.raises(ValueError, match="one dimension"):
        js.stack([js.Mesh(*grid("triangle")), js.Mesh(*grid("tetra"))])
    with pytest.raises(ValueError, match="at least one"):
        js.stack([])
