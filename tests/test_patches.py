"""Patches and the patch guard against slow loops."""

import jax
import jax.numpy as jnp
import meshes
import numpy as np
import pytest

from jaxsmooth.assembly import over_chosen, patch_mean, patch_min
from jaxsmooth.guards.patch import PatchGuard
from jaxsmooth.mesh.execution import Execution
from jaxsmooth.mesh.record import Mesh
from jaxsmooth.metrics import evaluation as patches
from jaxsmooth.motion.planar import Constraints

GUARD = PatchGuard()
evaluate = jax.jit(patches.evaluate)


@jax.jit
def guarded(guard, mesh, move):
    return guard(mesh, Constraints.hold(mesh, []), move, patches.evaluate(mesh))


MESHES = {
    "2d": lambda amplitude=0.1: meshes.mixed_2d(amplitude),
    "3d": lambda amplitude=0.1: meshes.grid("wedge", None, amplitude),
    "quadratic": lambda amplitude=0.1: meshes.grid("triangle6", (3, 3), amplitude),
}


@pytest.fixture(scope="module", params=MESHES)
def name(request):
    return request.param


def per_node(mesh, values, reduce, empty):
    """A loop over nodes and elements."""
    found = []
    for node in range(len(mesh.points)):
        patch = [
            float(value)
            for connectivity, block in zip(mesh.connectivity, values, strict=True)
            for element, value in zip(np.asarray(connectivity), np.asarray(block), strict=True)
            if node in element
        ]
        found.append(reduce(patch) if patch else empty)
    return np.array(found)


def test_patch_minimum_and_mean(name):
    points, blocks = MESHES[name]()
    mesh = Mesh(np.vstack([points, 0 * points[:1]]), blocks)  # one node without elements
    rng = np.random.default_rng(0)
    values = tuple(jnp.asarray(rng.normal(size=len(nodes))) for nodes in blocks.values())
    np.testing.assert_array_equal(patch_min(mesh, values), per_node(mesh, values, min, np.inf))
    np.testing.assert_allclose(patch_mean(mesh, values), per_node(mesh, values, np.mean, 0), rtol=1e-13)


@pytest.mark.parametrize("share", [0.0, 0.1, 1.0])
def test_only_the_chosen_are_looked_at(share):
    chosen = np.random.default_rng(0).uniform(size=100) < share

    def look(state, numbers):
        seen, calls = state
        return seen.at[numbers].add(1, mode="drop"), calls + 1

    seen, calls = over_chosen(look, (jnp.zeros(100, int), 0), jnp.asarray(chosen), Execution(64))
    np.testing.assert_array_equal(seen, chosen)
    assert int(calls) == -(-chosen.sum() // 8)  # an eighth of a chunk at a time


def test_portions_do_not_matter(name):
    points, blocks = MESHES[name]()
    move = jnp.asarray(random_move(points, 0.3))
    first, second = (guarded(GUARD, Mesh(points, blocks, execution=Execution(n)), move) for n in (8, 4096))
    np.testing.assert_array_equal(first.points, second.points)
    assert int(first.shortened) == int(second.shortened) > 0


def random_move(points, size, seed=0):
    return size * np.random.default_rng(seed).normal(size=points.shape)


def check_guard(mesh, move, result, gamma=0.8):
    """Eq. 34 at every node that was to move, floors and validity of every element; the nodes that moved."""
    before, after = evaluate(mesh), evaluate(mesh.with_points(result.points))
    moved = (np.asarray(result.points) != np.asarray(mesh.points)).any(axis=1)
    asked = (move != 0).any(axis=1)
    old, new = (per_node(mesh, e.quality, min, np.inf)[asked] for e in (before, after))
    assert (new >= np.where(old > 0, gamma * old, old) - 1e-14).all()
    for was, now in zip(before.jacobian, after.jacobian, strict=True):
        assert (np.asarray(now)[np.asarray(was) > 0] > 0).all()
    for name, floor in (("quality", 0.2), ("corners", 0.1)):
        was, now = (
            np.concatenate([v for v in getattr(e, name) if v is not None] or [[]]) for e in (before, after)
        )
        if len(was) == 0:
            continue
        floor = max(floor, 0.8 * was.min())
        assert (now[was >= floor] >= floor - 1e-13).all()
        assert now.min() >= min(was.min(), floor) - 1e-13
    for found, expected in zip(jax.tree.leaves(result.evaluation), jax.tree.leaves(after), strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-13)
    # every node went along its own move, by the whole of it or by a half, a quarter, …, nothing
    fraction = (np.asarray(result.points) - np.asarray(mesh.points)) / move
    allowed = np.r_[0, 0.5 ** np.arange(GUARD.halvings + 11)]  # longer moves are halved more often
    assert np.abs(fraction[:, 0, None] - allowed).min(axis=1).max() < 1e-9
    np.testing.assert_allclose(fraction, np.tile(fraction[:, :1], fraction.shape[1]), atol=1e-9)
    assert int(result.shortened) == (fraction[:, 0] < 0.99).sum()
    return moved


@pytest.mark.parametrize("size", [0.1, 0.3, 3.0])
@pytest.mark.parametrize("seed", [0, 1])
def test_eq_34_holds_at_every_moved_node(name, size, seed):
    mesh = Mesh(*MESHES[name]())
    move = random_move(mesh.points, size, seed)
    result = guarded(GUARD, mesh, jnp.asarray(move))
    moved = check_guard(mesh, move, result)
    assert int(result.shortened) > 0
    assert moved.any() or size == 3.0
    # the unguarded move breaks the rule, or there would be nothing to test
    assert np.concatenate(evaluate(mesh.with_points(mesh.points + move)).jacobian).min() < 0 or size == 0.1


def test_node_and_element_renumbering(name):
    points, blocks = MESHES[name]()
    move = random_move(points, 0.2)
    rng = np.random.default_rng(5)
    order = rng.permutation(len(points))
    number = np.argsort(order)
    shuffled = {kind: number[rng.permutation(nodes)] for kind, nodes in blocks.items()}
    first = guarded(GUARD, Mesh(points, blocks), jnp.asarray(move))
    second = guarded(GUARD, Mesh(points[order], shuffled), jnp.asarray(move[order]))
    np.testing.assert_array_equal(np.asarray(first.points)[order], second.points)
    assert int(first.shortened) == int(second.shortened) > 0
    assert int(first.sweeps) == int(second.sweeps)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_move_that_is_not_finite_is_taken_back(name, bad):
    mesh = Mesh(*MESHES[name]())
    move = random_move(mesh.points, 1e-4)
    node = 5
    move[node, 0] = bad
    result = guarded(GUARD, mesh, jnp.asarray(move))
    np.testing.assert_array_equal(result.points[node], mesh.points[node])
    assert np.isfinite(result.points).all()
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(result.evaluation))
    near = {n for nodes in mesh.connectivity for e in np.asarray(nodes) if node in e for n in e}
    far = np.setdiff1d(np.arange(len(mesh.points)), list(near))
    np.testing.assert_allclose(result.points[far], np.asarray(mesh.points + move)[far], rtol=0, atol=1e-15)


def test_zero_and_harmless_moves_are_accepted(name):
    mesh = Mesh(*MESHES[name]())
    result = guarded(GUARD, mesh, jnp.zeros_like(mesh.points))
    np.testing.assert_array_equal(result.points, mesh.points)
    assert (int(result.shortened), int(result.sweeps)) == (0, 1)
    turn = meshes.rotation_matrix(mesh.dim)
    move = (
        1.5 * np.asarray(mesh.points) @ turn.T + 7 - np.asarray(mesh.points)
    )  # a similarity: same qualities
    result = guarded(PatchGuard(gamma=0.8), mesh, jnp.asarray(move))
    np.testing.assert_allclose(result.points, mesh.points + move, atol=1e-14)
    assert int(result.shortened) == 0


def test_full_strictness_lets_no_patch_get_worse(name):
    mesh = Mesh(*MESHES[name]())
    move = random_move(mesh.points, 0.05)
    result = guarded(PatchGuard(gamma=1.0), mesh, jnp.asarray(move))
    check_guard(mesh, move, result, gamma=1.0)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_inverted_patches_do_not_get_worse(name, seed):
    """A tangled mesh: where a patch is inverted Eq. 34 asks for nothing, the guard does."""
    points, blocks = MESHES[name](0.0)
    tangled = points + random_move(points, 0.4, seed=10)
    mesh = Mesh(tangled, blocks)
    before = evaluate(mesh)
    assert (np.concatenate(before.jacobian) <= 0).any()
    assert (np.concatenate(before.quality) < 0).any()
    move = random_move(points, 0.1, seed)
    result = guarded(GUARD, mesh, jnp.asarray(move))
    check_guard(mesh, move, result)
    after = evaluate(mesh.with_points(result.points))
    assert (np.concatenate(after.jacobian) <= 0).sum() <= (np.concatenate(before.jacobian) <= 0).sum()


def test_fractions_are_constants_for_differentiation():
    mesh = Mesh(*MESHES["2d"]())
    move, weight = random_move(mesh.points, 0.2), random_move(mesh.points, 1.0, seed=3)

    @jax.jit
    def total(points, move):
        return (guarded(GUARD, mesh.with_points(points), move).points * weight).sum()

    by_points, by_move = jax.grad(total, argnums=(0, 1))(mesh.points, jnp.asarray(move))
    fraction = (np.asarray(guarded(GUARD, mesh, jnp.asarray(move)).points) - np.asarray(mesh.points)) / move
    np.testing.assert_allclose(by_points, weight, rtol=1e-13)
    np.testing.assert_allclose(by_move, weight * fraction, rtol=1e-9, atol=1e-12)
    assert 0 < fraction.min(initial=1, where=fraction > 0) < 1


def test_an_element_is_not_spoilt_by_the_other_nodes_of_a_node_that_stays():
    """Each of two triangles has a node that may not move further; the other ones may not go on."""
    points = np.array([[0, 0], [1, 0], [0.5, 0.8], [0.5, -0.8]])
    mesh = Mesh(points, {"triangle": np.array([[0, 1, 2], [1, 0, 3]])})
    move = np.array([[0, 0], [0, 0], [0.1, -0.79], [0.0, 0.1]])
    result = guarded(PatchGuard(gamma=0.8), mesh, jnp.asarray(move))
    q = np.concatenate(evaluate(mesh.with_points(result.points)).quality)
    assert q.min() >= 0.8 * np.concatenate(evaluate(mesh).quality).min()
    assert int(result.shortened) == 1  # held nodes are not counted


def test_a_move_of_many_elements_is_halved_until_it_fits():
    """28 times the local edge: five halvings would take it back."""
    mesh = Mesh(*meshes.grid("triangle", (10, 10)))
    node = int(np.argmin(np.abs(np.asarray(mesh.points) - 0.5).sum(axis=1)))
    move = np.zeros(mesh.points.shape)
    move[node] = [2.8, 0.3]
    result = guarded(PatchGuard(gamma=0.5), mesh, jnp.asarray(move))
    length = np.linalg.norm(np.asarray(result.points)[node] - np.asarray(mesh.points)[node])
    assert 0.005 < length < 0.1


def test_eq_34_alone():
    """Without floors a corner may close, where its element is large and q does not see it."""
    points = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], float)
    mesh = Mesh(points, {"quad": np.array([[0, 1, 2, 3]])})
    move = np.zeros_like(points)
    move[2] = [-0.49, -0.49]
    free = guarded(PatchGuard(gamma=0.5, poor=0.0, corner=0.0), mesh, jnp.asarray(move))
    np.testing.assert_allclose(free.points[2], [0.51, 0.51])
    kept = guarded(PatchGuard(gamma=0.5, poor=0.0, corner=0.3, keep=1.0), mesh, jnp.asarray(move))
    assert 0.7 <= evaluate(mesh.with_points(kept.points)).corners[0][0] < 1  # up to where they are open
