"""Derivatives of steps and runs against differences."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from derivatives import check, objective
from meshes import KINDS, grid, ideal, rotation_matrix

import jaxsmooth as js
from jaxsmooth.cells.table import element_type
from jaxsmooth.methods.elastic.elasticity import Material, element_force, linearise
from jaxsmooth.methods.elastic.fitting import target_element
from jaxsmooth.metrics.evaluation import evaluate
from jaxsmooth.metrics.table import measure, shape_quality

SHARED = Path(__file__).parents[2] / "shared" / "meshes"
EXACT = 1e-13  # of the linear systems, where differences are taken


@pytest.fixture(scope="module")
def square():
    points, blocks = grid("triangle", (3, 3), 0.08)
    mesh = js.Mesh(points, blocks)
    rng = np.random.default_rng(3)
    return mesh, js.detect_constraints(mesh), rng.normal(size=points.shape), rng.normal(size=points.shape)


# --- Derivatives -----------------------------------------------------------------------


# A step is the same code for all types.  The parts that differ, the shape functions and the rules, have
# tests of values and gradients over all of KINDS, here and in test_metrics.py and test_distortion.py.
@pytest.mark.parametrize(
    "kind", ["triangle", "quad9", "tetra", "tetra10", "pyramid13", "wedge15", "hexahedron", "hexahedron27"]
)
def test_one_step_of_every_sort_of_type(kind):
    shape = {2: (2, 2), 3: (2, 1, 1)}[element_type(kind).dim]
    points, blocks = grid(kind, shape, amplitude=0.1)
    mesh = js.Mesh(points, blocks)
    rng = np.random.default_rng(5)
    # all but a few nodes free, so that the small meshes have something to solve for
    held = np.zeros(len(points), bool)
    held[np.argsort(points @ rng.normal(size=mesh.dim))[:4]] = True
    constraints = js.Constraints.hold(mesh, held)
    weights, direction = rng.normal(size=(2, *points.shape))
    method = js.Elastic(guard=None, tolerance=EXACT)
    check(lambda p: objective(js.step(mesh.with_points(p), method, constraints), weights), points, direction)


@pytest.mark.parametrize(
    ("method", "steps"),
    [
        (js.Elastic(tolerance=EXACT), 3),
        (js.Elastic(extended=True, tolerance=EXACT), 3),
        (js.Elastic(tolerance=EXACT), 20),
        (js.Laplacian(weighted=True), 1),
        (js.Laplacian(smart=True), 1),
    ],
    ids=["guarded", "extended", "nested", "weighted Laplacian", "smart Laplacian"],
)
def test_runs(square, method, steps):
    mesh, constraints, weights, direction = square

    def function(p):
        return objective(js.run(mesh.with_points(p), method, constraints=constraints, steps=steps), weights)

    check(function, np.asarray(mesh.points), direction)


def test_a_run_whose_guard_is_active():
    """The accepted fractions are constants: the difference of nearby runs agrees where they agree."""
    points, blocks = grid("triangle", (4, 4), amplitude=0.6, seed=4)
    mesh = js.Mesh(points, blocks)
    constraints = js.detect_constraints(mesh)
    method = js.Elastic(tolerance=EXACT, guard=js.PatchGuard(gamma=1.0, keep=1.0))
    shortened = method.step(mesh, constraints, evaluate(mesh)).shortened
    assert int(shortened) > 0
    rng = np.random.default_rng(0)
    weights, direction = rng.normal(size=(2, *points.shape))
    check(
        lambda p: objective(js.run(mesh.with_points(p), method, constraints=constraints, steps=2), weights),
        points,
        direction,
        step=1e-7,
        rtol=1e-5,
    )


def test_parameters_of_the_method(square):
    """α, β, and the elastic constants: E does not matter, ν does."""
    mesh, constraints, weights, _ = square

    def function(values):
        method = js.Elastic(
            extended=True,
            alpha=values["alpha"],
            beta=values["beta"],
            material=Material(values["young"], values["poisson"]),
            guard=None,
            tolerance=EXACT,
        )
        return objective(js.run(mesh, method, constraints=constraints, steps=2), weights)

    at = {
        "alpha": jnp.asarray(0.9),
        "beta": jnp.asarray(1.8),
        "young": jnp.asarray(2.0),
        "poisson": jnp.asarray(0.2),
    }
    gradient = check(function, at, {"alpha": 1.0, "beta": 0.6, "young": 0.5, "poisson": 0.7}, step=1e-5)
    assert abs(float(gradient["young"])) < 1e-9 < abs(float(gradient["poisson"]))


def test_boundary_points_move_the_interior(square):
    """The useful derivative: a boundary as a function of a parameter."""
    mesh, constraints, weights, _ = square
    points = np.asarray(mesh.points)

    def function(bulge):
        bent = points + jnp.stack([jnp.zeros(len(points)), bulge * points[:, 1] * points[:, 0] ** 2], 1)
        smooth = js.run(
            mesh.with_points(bent), js.Elastic(tolerance=EXACT), constraints=constraints, steps=3
        ).mesh
        return objective(smooth, weights)

    check(function, jnp.asarray(0.2), 1.0, step=1e-5)


def test_ideal_patch_has_finite_derivatives():
    """Repeated singular values, the fold of Eq. 5 and zero forces all at once."""
    angles = np.arange(6) * np.pi / 3
    points = np.r_[[[0.0, 0.0]], np.c_[np.cos(angles), np.sin(angles)]]
    triangles = np.array([[0, 1 + i, 1 + (i + 1) % 6] for i in range(6)])
    mesh = js.Mesh(points, {"triangle": triangles})
    constraints = js.Constraints.hold(mesh, np.arange(1, 7))
    weights, direction = np.random.default_rng(1).normal(size=(2, *points.shape))
    method = js.Elastic(guard=None, tolerance=EXACT)
    check(
        lambda p: objective(js.run(mesh.with_points(p), method, constraints=constraints, steps=2), weights),
        points,
        direction,
        step=1e-4,
    )


def test_forward_mode_agrees_with_reverse(square):
    mesh, constraints, weights, direction = square

    def function(p):
        return objective(js.run(mesh.with_points(p), constraints=constraints, steps=2), weights)

    _, forward = jax.jit(lambda p, d: jax.jvp(function, (p,), (d,)))(mesh.points, direction)
    reverse = (jax.jit(jax.grad(function))(mesh.points) * direction).sum()
    np.testing.assert_allclose(forward, reverse, rtol=1e-7)


@pytest.mark.parametrize(("dtype", "rtol"), [(np.float64, 1e-6), (np.float32, 1e-4)])
def test_size_of_the_cotangent_does_not_matter(square, dtype, rtol):
    mesh, constraints, weights, _ = square
    mesh = mesh.with_points(mesh.points.astype(dtype))
    constraints = js.Constraints(constraints.projectors.astype(dtype))
    weights = weights.astype(dtype)
    run = jax.jit(lambda p: js.run(mesh.with_points(p), constraints=constraints, steps=2).points)
    pull = jax.jit(lambda c: jax.vjp(run, mesh.points)[1](c)[0])
    expected = pull(weights)
    assert expected.dtype == dtype
    for scale in (1e-4, 1e-10, 1e-20, 1e-30):
        found = np.asarray(pull(weights * dtype(scale)), np.float64) / scale
        assert np.abs(found - expected).max() <= rtol * np.abs(expected).max()


@pytest.mark.parametrize("kind", KINDS)
def test_no_draw_has_a_gradient_that_is_not_finite(kind):
    """Distorted, flat, inverted, collapsed and ideal elements: quality, target and forces."""
    row, rng = element_type(kind), np.random.default_rng(11)
    count = 720
    nodes = np.stack([ideal(kind) @ rotation_matrix(row.dim, seed).T for seed in range(count)])
    part = np.arange(count) % 6
    nodes[part == 1] += rng.normal(size=nodes.shape)[part == 1]
    nodes[part == 2, :, -1] = 0  # flat
    nodes[part == 3, :, 0] *= -1  # inverted
    nodes[part == 4] = nodes[part == 4] * rng.choice([0, 1, 1e-8], (count, 1, row.dim))[part == 4]
    nodes[part == 5] += 0.3 * rng.normal(size=nodes.shape)[part == 5]

    def energy(x):
        size = jnp.maximum(jnp.abs(measure(row, x)), 0.01)
        target = target_element(jnp.asarray(row.ideal), x, size ** (1 / row.dim))
        pull = element_force(linearise(row, x, size), target - x, Material())
        return shape_quality(row, x) + (pull**2).sum()

    values, slopes = jax.jit(jax.vmap(jax.value_and_grad(energy)))(jnp.asarray(nodes))
    assert np.isfinite(np.asarray(values)).all()
    assert np.isfinite(np.asarray(slopes)).all()


@pytest.mark.skipif(not SHARED.exists(), reason="the mesh collection is not here")
def test_on_a_mesh_of_23_thousand_tetrahedra():
    file = js.read(SHARED / "tet" / "mesquite_flat_tet_sphere.vtu")
    constraints = js.detect_constraints(file.mesh, fixed=file.fixed)
    weights, direction = np.random.default_rng(2).normal(size=(2, *file.mesh.points.shape))
    size = np.ptp(file.source.points, axis=0).max()
    method = js.Elastic(guard=None, tolerance=1e-12)
    check(
        lambda p: objective(js.step(file.mesh.with_points(p), method, constraints), weights),
        np.asarray(file.mesh.points),
        direction * size,
        step=1e-7,
    )
