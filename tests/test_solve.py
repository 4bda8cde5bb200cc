"""The projected solve against the Lagrange system of Eq. 33, its residual and its derivative."""

import jax
import jax.numpy as jnp
import meshes
import numpy as np
import pytest
import reference

from jaxsmooth.mesh.record import Mesh
from jaxsmooth.methods.elastic.elasticity import Material
from jaxsmooth.methods.elastic.method import Elastic
from jaxsmooth.metrics.evaluation import evaluate
from jaxsmooth.motion.detect import detect_constraints
from jaxsmooth.motion.planar import Constraints
from jaxsmooth.numerics.admissible import Admissible
from jaxsmooth.numerics.solve import block_inverse, solve_projected


def inclined(kind, seed=0):
    """A jiggled box, sheared and turned: points, blocks and the normals of every node."""
    points, blocks = meshes.grid(kind, amplitude=0.12)
    dim = points.shape[1]
    shear = np.eye(dim)
    shear[0, 1] = 0.3
    change = meshes.rotation_matrix(dim, seed) @ shear
    axes = np.linalg.inv(change)  # its rows are normal to the sides of the image
    return points @ change.T, blocks, [axes[sides] for sides in meshes.box_normals(points)]


proposal = jax.jit(lambda method, mesh, constraints: method.propose(mesh, constraints, evaluate(mesh)))


@pytest.mark.parametrize("kind", meshes.KINDS)
def test_equals_the_lagrange_system(kind):
    points, blocks, normals = inclined(kind)
    mesh = Mesh(points, blocks)
    constraints = detect_constraints(mesh)
    k, force = reference.assemble(points, blocks), reference.forces(points, blocks)
    expected = reference.lagrange(k, force, normals)
    found = proposal(Elastic(tolerance=1e-12), mesh, constraints)
    assert np.abs(np.asarray(found.move) - expected).max() < 1e-9 * np.abs(expected).max()
    assert np.abs(expected).max() > 1e-3
    assert 0 < float(found.residual) <= 1e-12
    for u, vectors in zip(np.asarray(found.move), normals, strict=True):
        np.testing.assert_allclose(vectors @ u, 0, atol=1e-14)
    # a loose solve says honestly how loose it is: the same compiled function, another tolerance
    loose = proposal(Elastic(tolerance=1e-2), mesh, constraints)
    p = np.asarray(constraints.projectors)
    right = np.einsum("nij,nj->ni", p, force)
    inner = np.einsum("nij,nj->ni", p, np.asarray(loose.move))
    left = (
        np.einsum("nij,nj->ni", p, (k @ inner.ravel()).reshape(points.shape)) + np.asarray(loose.move) - inner
    )
    residual = np.linalg.norm(right - left) / np.linalg.norm(right)
    assert float(loose.residual) == pytest.approx(residual, rel=1e-6)
    assert residual <= 1e-2
    assert int(loose.iterations) < int(found.iterations)


@pytest.mark.parametrize("mixed", [lambda: meshes.mixed_2d(0.1), lambda: meshes.mixed_3d(0.1)])
def test_mixed_meshes_and_other_material(mixed):
    points, blocks = mixed()
    axes = np.eye(points.shape[1])
    normals = [axes[sides] for sides in meshes.box_normals(points)]
    k, force = (
        reference.assemble(points, blocks, 3.0, 0.3),
        reference.forces(points, blocks, None, 0.9, 3.0, 0.3),
    )
    expected = reference.lagrange(k, force, normals)
    mesh = Mesh(points, blocks)
    method = Elastic(alpha=0.9, material=Material(3.0, 0.3), tolerance=1e-12)
    found = proposal(method, mesh, detect_constraints(mesh)).move
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9 * np.abs(expected).max())


def dense_problem(seed=0):
    """A positive definite matrix on 6 nodes in 2D with projectors of every rank."""
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(12, 12))
    k = root @ root.T + np.eye(12)
    projectors = np.tile(np.eye(2), (6, 1, 1))
    projectors[0] = 0
    line = np.array([0.6, 0.8])
    projectors[1] = projectors[2] = np.outer(line, line)
    return k, projectors, rng.normal(size=(6, 2))


class Dense:
    """A stored matrix as an operator; JAX sees it as a pytree."""

    def __init__(self, k):
        self.k = k

    def __call__(self, u):
        return (self.k @ u.reshape(-1)).reshape(u.shape)


jax.tree_util.register_pytree_node(Dense, lambda op: ((op.k,), None), lambda _, leaves: Dense(*leaves))


@jax.jit
def dense_solve(k, projectors, force, tolerance=1e-13):
    diagonal = jnp.einsum("ninj->nij", k.reshape(6, 2, 6, 2))
    return solve_projected(Dense(k), diagonal, Admissible(projectors), force, tolerance, 200)


def exact(k, projectors, force):
    p = np.zeros((12, 12))
    for node, block in enumerate(projectors):
        p[2 * node : 2 * node + 2, 2 * node : 2 * node + 2] = block
    return np.linalg.pinv(p @ k @ p, rcond=1e-10, hermitian=True) @ (p @ np.ravel(force))


def test_zero_right_hand_side():
    k, projectors, force = dense_problem()
    found = dense_solve(k, projectors, 0 * force)
    np.testing.assert_array_equal(found.field, 0)
    assert int(found.iterations) == 0
    assert float(found.residual) == 0
    # all of the force on held directions
    found = dense_solve(k, 0 * projectors, force)
    np.testing.assert_array_equal(found.field, 0)


@pytest.mark.parametrize("scale", [1e-200, 1e-30, 1.0, 1e100])
def test_any_size_of_right_hand_side(scale):
    k, projectors, force = dense_problem()
    force[3] = 0  # exact zeros among the entries
    expected = exact(k, projectors, force)
    found = dense_solve(k, projectors, force * scale)
    assert float(found.residual) <= 1e-13
    np.testing.assert_allclose(np.ravel(found.field) / scale, expected, rtol=1e-10, atol=1e-12)


def test_running_out_of_iterations_is_reported():
    k, projectors, force = dense_problem()
    diagonal = jnp.einsum("ninj->nij", jnp.asarray(k).reshape(6, 2, 6, 2))
    found = solve_projected(
        Dense(jnp.asarray(k)), diagonal, Admissible(jnp.asarray(projectors)), jnp.asarray(force), 1e-13, 3
    )
    assert int(found.iterations) == 3
    assert float(found.residual) > 1e-3


def test_a_singular_system_ends():
    """Nothing holds this mesh: the force is consistent, a cotangent is not."""
    points, blocks = meshes.grid("triangle", amplitude=0.2)
    mesh = Mesh(points, blocks)
    free = Constraints.hold(mesh, np.zeros(len(points), bool))
    stiffness = reference.assemble(points, blocks).toarray()
    found = proposal(Elastic(tolerance=1e-10), mesh, free)
    assert float(found.residual) <= 1e-10

    @jax.jit
    def pulled(force, cotangent):
        k = jnp.asarray(stiffness)
        diagonal = jnp.einsum("ninj->nij", k.reshape(len(points), 2, len(points), 2))
        solve = lambda f: solve_projected(Dense(k), diagonal, Admissible(free.projectors), f, 1e-2, 1000)  # noqa: E731
        found = solve(cotangent)
        return found.iterations, jax.vjp(lambda f: solve(f).field, force)[1](cotangent)[0]

    force = reference.forces(points, blocks)
    iterations, slope = pulled(force, np.random.default_rng(0).normal(size=points.shape))
    assert int(iterations) <= 4 * points.size
    assert np.isfinite(np.asarray(slope)).all()


def test_block_inverse():
    rng = np.random.default_rng(0)
    root = rng.normal(size=(5, 3, 3))
    blocks = np.einsum("nij,nkj->nik", root, root) * np.array([1, 1e-30, 1e30, 1, 1])[:, None, None]
    blocks[3] = 0
    projectors = np.tile(np.eye(3), (5, 1, 1))
    projectors[4] = np.diag([1, 1, 0])
    found = np.asarray(block_inverse(jnp.asarray(blocks), Admissible(jnp.asarray(projectors))))
    for n in (0, 1, 2):
        np.testing.assert_allclose(found[n] @ blocks[n], np.eye(3), atol=1e-9)
    np.testing.assert_array_equal(found[3], np.eye(3))
    np.testing.assert_allclose(found[4][:2, :2] @ blocks[4][:2, :2], np.eye(2), atol=1e-12)
    # the size of a block, not that of 1, decides what is singular: in nanometres nothing changes
    small = np.asarray(
        block_inverse(jnp.asarray(blocks[4:] * 2.0**-90), Admissible(jnp.asarray(projectors[4:])))
    )
    np.testing.assert_allclose(small[0] * 2.0**-90, found[4], rtol=1e-13)


@jax.jit
def backward(k, projectors, force, cotangent):
    _, pull = jax.vjp(lambda k, f: dense_solve(k, projectors, f).field, k, force)
    return pull(cotangent)


@pytest.mark.parametrize("scale", [1.0, 1e-8, 1e-20, 1e-30])
def test_derivative(scale):
    k, projectors, force = dense_problem()
    cotangent = np.random.default_rng(1).normal(size=(6, 2))
    slope_k, slope_force = (np.asarray(s) / scale for s in backward(k, projectors, force, scale * cotangent))
    # the adjoint in closed form: u = A⁺ f, so ∂(c·u)/∂f = A⁺ c and ∂(c·u)/∂K = −(A⁺ c) uᵀ
    adjoint, u = exact(k, projectors, cotangent), exact(k, projectors, force)
    np.testing.assert_allclose(slope_force.ravel(), adjoint, rtol=1e-7, atol=1e-8)
    np.testing.assert_allclose(slope_k, -np.outer(adjoint, u), rtol=1e-7, atol=1e-8)
    # and by differences
    h, change = 1e-6, np.random.default_rng(2).normal(size=k.shape)
    change = change + change.T
    up, down = (exact(k + s * change, projectors, force) @ cotangent.ravel() for s in (h, -h))
    assert (slope_k * change).sum() == pytest.approx((up - down) / (2 * h), rel=1e-6)


def test_gradient_through_a_whole_step():
    """d(loss of the new points)/d(points), with every part of the step in it, by differences."""
    points, blocks, _ = inclined("quad")
    mesh = Mesh(points, blocks)
    constraints = detect_constraints(mesh)
    weight = np.random.default_rng(3).normal(size=points.shape)

    @jax.jit
    def loss(p):
        changed = mesh.with_points(p)
        return (Elastic(tolerance=1e-13).propose(changed, constraints, evaluate(changed)).move * weight).sum()

    slope = np.asarray(jax.jit(jax.grad(loss))(mesh.points))
    h = 1e-6
    for seed in range(3):
        along = np.random.default_rng(seed).normal(size=points.shape)
        up, down = float(loss(points + h * along)), float(loss(points - h * along))
        assert (slope * along).sum() == pytest.approx((up - down) / (2 * h), rel=1e-6, abs=1e-8)
