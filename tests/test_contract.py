"""What every method of the table keeps to, by transformation."""

from functools import cache, partial

import jax
import jax.numpy as jnp
import meshes
import numpy as np
import pytest

import jaxsmooth as js
from jaxsmooth.methods import METHODS

STEPS = 2
GUARDED = [name for name in METHODS if name not in ("laplacian", "weighted-laplacian", "untangle")]
DIFFERENTIABLE = [name for name in METHODS if name not in ("optimize", "untangle")]


@cache
def case(dtype=np.float64):
    """A jiggled square of triangles."""
    points, blocks = meshes.grid("triangle", (4, 4), 0.25)
    mesh = js.Mesh(points.astype(dtype), blocks)
    return mesh, js.detect_constraints(mesh)


@cache
def compiled(name):
    """A run that counts how often it is traced."""
    traces = []

    @jax.jit
    def run(mesh, constraints, state):
        traces.append(1)
        return js.run(mesh, METHODS[name](), constraints=constraints, steps=STEPS, state=state)

    return run, traces


def smoothed(name, mesh, constraints):
    return compiled(name)[0](mesh, constraints, METHODS[name]().init(mesh))


def geometries(count):
    mesh, constraints = case()
    noise = np.random.default_rng(5).normal(size=(count, *mesh.points.shape)) * 0.01
    return mesh.points + np.einsum("nij,gnj->gni", np.asarray(constraints.projectors), noise)


@pytest.mark.parametrize("name", METHODS)
def test_one_compile_for_many_geometries_and_eager_is_compiled(name):
    mesh, constraints = case()
    traces = compiled(name)[1]
    found = [np.asarray(smoothed(name, mesh.with_points(p), constraints).points) for p in geometries(3)]
    assert len(traces) == 1
    with jax.disable_jit(False):
        eager = js.run(
            mesh.with_points(geometries(3)[1]), METHODS[name](), constraints=constraints, steps=STEPS
        )
    np.testing.assert_allclose(eager.points, found[1], atol=1e-12)


@pytest.mark.parametrize("name", METHODS)
def test_vmap_is_a_loop(name):
    mesh, constraints = case()
    state = METHODS[name]().init(mesh)
    many = geometries(3)
    run = partial(js.run, method=METHODS[name](), constraints=constraints, steps=STEPS, state=state)
    batched = jax.jit(jax.vmap(lambda p: run(mesh.with_points(p)).points))(many)
    for points, found in zip(many, batched, strict=True):
        alone = smoothed(name, mesh.with_points(points), constraints).points
        np.testing.assert_allclose(found, alone, atol=1e-10)


@pytest.mark.parametrize("name", METHODS)
def test_single_precision_is_near(name):
    mesh, constraints = case(np.float32)
    assert mesh.points.dtype == np.float32
    found = smoothed(name, mesh, constraints)
    assert found.points.dtype == np.float32
    exact = smoothed(name, *case())
    np.testing.assert_allclose(
        [part.mean() for part in found.evaluation.quality],
        [part.mean() for part in exact.evaluation.quality],
        atol=2e-3,
    )


@pytest.mark.parametrize("name", METHODS)
def test_numbering_does_not_matter(name):
    mesh, constraints = case()
    random = np.random.default_rng(3)
    order = random.permutation(len(mesh.points))  # new number of every old node
    points = np.empty_like(mesh.points)
    points[order] = mesh.points
    nodes = random.permutation(order[np.asarray(mesh.connectivity[0])])
    projectors = jnp.zeros_like(constraints.projectors).at[order].set(constraints.projectors)
    other = js.Mesh(points, {"triangle": nodes})
    theirs = smoothed(name, other, js.Constraints(projectors)).points
    np.testing.assert_allclose(theirs[order], smoothed(name, mesh, constraints).points, atol=1e-9)


@pytest.mark.parametrize("name", METHODS)
def test_motion_is_kept_and_valid_stays_valid(name):
    mesh, constraints = case()
    found = smoothed(name, mesh, constraints)
    move = np.asarray(found.points - mesh.points)
    kept = np.einsum("nij,nj->ni", np.asarray(constraints.projectors), move)
    np.testing.assert_allclose(move, kept, atol=1e-12)
    assert np.abs(move).max() > 1e-3
    if name in GUARDED:
        assert float(found.least) > 0
    assert np.asarray(found.residuals).max() < 1e-9


@pytest.mark.parametrize("name", METHODS)
def test_an_ideal_mesh_stays(name):
    """Equilateral triangles in a hexagon."""
    angles = np.arange(6) * np.pi / 3
    points = np.vstack([[[0.0, 0.0]], np.stack([np.cos(angles), np.sin(angles)], 1)])
    mesh = js.Mesh(points, {"triangle": [[0, 1 + i, 1 + (i + 1) % 6] for i in range(6)]})
    found = js.run(mesh, METHODS[name](), constraints=js.Constraints.hold(mesh, []), steps=1)
    if name in ("elastic", "elastic-extended", "optimize"):
        # a minimum is known to the root of the rounding of its value
        np.testing.assert_allclose(found.points, points, atol=1e-7 if name == "optimize" else 1e-9)
    else:  # the mean of what surrounds a corner lies inside
        np.testing.assert_allclose(found.points[0], 0, atol=1e-12)


@pytest.mark.parametrize("name", DIFFERENTIABLE)
def test_the_value_beside_a_gradient_is_the_plain_value(name):
    mesh, constraints = case()
    state = METHODS[name]().init(mesh)

    def value(points):
        run = js.run(
            mesh.with_points(points), METHODS[name](), constraints=constraints, steps=STEPS, state=state
        )
        return js.quality_mean(run)

    plain = float(jax.jit(value)(mesh.points))
    beside, gradient = jax.jit(jax.value_and_grad(value))(mesh.points)
    # the two programs round in other ways, and the solver goes on from there
    assert plain == pytest.approx(float(beside), abs=1e-12)
    assert np.isfinite(gradient).all()
    assert np.abs(gradient).max() > 0
