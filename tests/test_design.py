"""Meshes as functions of a design."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from derivatives import check
from meshes import grid

import jaxsmooth as js
from jaxsmooth.cells.table import element_type
from jaxsmooth.methods.elastic.elasticity import Material, linearise, stiffness


@pytest.fixture(scope="module")
def square():
    points, blocks = grid("triangle", (3, 3), 0.08)
    mesh = js.Mesh(points, blocks)
    return mesh, js.detect_constraints(mesh)


def matrices(mesh):
    """Dense stiffness and masses, element by element."""
    points, kind = np.asarray(mesh.points), element_type("triangle")
    k, m = np.zeros((2 * len(points), 2 * len(points))), np.zeros(len(points))
    for nodes in np.asarray(mesh.connectivity[0]):
        x = jnp.asarray(points[nodes])
        where = (2 * nodes[:, None] + [0, 1]).reshape(-1)
        k[np.ix_(where, where)] += stiffness(linearise(kind, x, jnp.asarray(1e-9)), Material())
        m[nodes] += abs(np.linalg.det(points[nodes[1:]] - points[nodes[0]])) / 6
    return k, np.repeat(m, 2)


def test_a_bulging_side(square):
    mesh, constraints = square
    points = np.asarray(mesh.points)
    side = np.abs(points[:, 1] - 1) < 1e-9
    shaped = js.design(mesh, side, motion=constraints, steps=2)
    weights = np.random.default_rng(0).normal(size=points.shape)
    x = shaped.places[:, 0]

    def function(height):
        done = shaped(shaped.places.at[:, 1].add(height * x * (1 - x)))
        return js.if_valid((done.points * weights).sum() + js.quality_least(done), done)

    check(function, jnp.asarray(0.7), 1.0, step=1e-4, rtol=1e-7)
    # without steps it is the elastic extension
    bare = js.design(mesh, side, motion=constraints, steps=0)
    moved = (
        jax.jit(lambda design, places: design(places).points)(bare, shaped.places + jnp.asarray([0.0, 0.3]))
        - points
    )
    np.testing.assert_allclose(moved[side], np.broadcast_to([0.0, 0.3], (side.sum(), 2)), atol=1e-15)
    k, _ = matrices(mesh)
    free = (constraints.freedom == 2) & ~side
    force = (k @ np.asarray(moved).reshape(-1)).reshape(-1, 2)
    np.testing.assert_allclose(force[free], 0, atol=1e-9)


def test_filtered_gradients(square):
    mesh, constraints = square
    gradient = np.random.default_rng(1).normal(size=mesh.points.shape)
    k, m = matrices(mesh)
    basis = np.linalg.svd(np.asarray(jax.scipy.linalg.block_diag(*constraints.projectors)))
    basis = basis[0][:, basis[1] > 0.5]
    for radius, unit in ((0.0, 1.0), (0.3, 1.0), (0.3, 1000.0)):
        a = basis.T @ (np.diag(m) + radius**2 * k) @ basis
        expected = (basis @ np.linalg.solve(a, basis.T @ gradient.reshape(-1))).reshape(-1, 2) / unit**2
        found = js.filter_gradient(
            mesh.with_points(unit * mesh.points), gradient, motion=constraints, radius=unit * radius
        )
        np.testing.assert_allclose(found, expected, atol=1e-8 * np.abs(expected).max())


def test_least_quality_is_a_bound(square):
    mesh, _ = square
    least = min(float(q.min()) for q in js.quality(mesh))
    for sharpness in (20.0, 1000.0):
        found = js.quality_least(mesh, sharpness=sharpness)
        assert least - np.log(18) / sharpness <= found <= least
