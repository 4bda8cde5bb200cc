"""What users write themselves: a method, a target, a goal, a guard, a rule, each in a few lines."""

from typing import ClassVar

import jax.numpy as jnp
import meshes
import numpy as np

import jaxsmooth as js
from jaxsmooth.guards.base import Guarded
from jaxsmooth.methods.base import Proposal
from jaxsmooth.numerics.small import Frame


def square(amplitude=0.25):
    points, blocks = meshes.grid("triangle", (6, 6), amplitude)
    return js.Mesh(points, blocks)


class Springs(js.Method):
    """Edges as springs of length zero: a node goes towards the mean of its elements' centres."""

    guard: js.Guard | None = js.PatchGuard()

    def propose(self, mesh, motion, before, state=None):
        total, count = jnp.zeros_like(mesh.points), jnp.zeros(len(mesh.points))
        for nodes in mesh.connectivity:
            centres = mesh.points[nodes].mean(axis=1)
            total = total.at[nodes].add(centres[:, None])
            count = count.at[nodes].add(1)
        move = motion.at(mesh.points).project(total / count[:, None] - mesh.points)
        return Proposal(move, jnp.int32(0), jnp.zeros(()))


def test_a_method():
    result = js.smooth(square(), Springs())
    assert result.history[-1].statistics.q_avg > result.history[0].statistics.q_avg + 0.02
    assert result.history[-1].statistics.inverted == 0


class Halfway(js.Guard):
    """All nodes go half of their way."""

    def __call__(self, mesh, motion, move, before):
        moved = mesh.with_points(motion.retract(mesh.points, move / 2))
        return Guarded(moved.points, js.evaluate(moved), jnp.int32(len(move)), jnp.int32(1))


def test_a_guard():
    mesh = square()
    held = js.detect_constraints(mesh)
    whole = js.step(mesh, js.Elastic(guard=None), held).points - mesh.points
    half = js.step(mesh, js.Elastic(guard=Halfway()), held).points - mesh.points
    np.testing.assert_allclose(half, whole / 2, atol=1e-9)


class Graded(js.Target):
    """Elements grow with x."""

    sized: ClassVar[bool] = True

    def measures(self, mesh, frame):
        centres = [mesh.points[nodes].mean(axis=1)[:, 0] for nodes in mesh.connectivity]
        return tuple(0.002 + 0.06 * x for x in centres)


def areas(mesh):
    return np.asarray(js.quality(mesh, "measure")[0])


def test_a_target_for_both_methods():
    mesh = square(0.0)
    x = np.asarray(mesh.points)[np.asarray(mesh.connectivity[0])].mean(axis=1)[:, 0]
    everything = js.AcceptanceRule.anything()
    for method in (js.Elastic(target=Graded()), js.Optimize(target=Graded(weight=5.0), start=None)):
        graded = js.smooth(mesh, method, steps=4, accept=everything).mesh
        assert areas(mesh)[x > 0.8].mean() / areas(mesh)[x < 0.2].mean() < 1.01
        assert areas(graded)[x > 0.8].mean() / areas(graded)[x < 0.2].mean() > 1.5


def test_free_size_is_that_of_the_nearest_ideal_element():
    """Of diag(a, b) times an equilateral triangle it is the mean of a and b, squared."""
    ideal = js.element_type("triangle").ideal
    points = np.concatenate([3.0 * ideal, ideal * [2.0, 0.5] + 9])
    mesh = js.Mesh(points, {"triangle": [[0, 1, 2], [3, 4, 5]]})
    unit = Frame(jnp.zeros(2), jnp.ones(()))
    np.testing.assert_allclose(js.FreeSize().measures(mesh, unit)[0], [9, 1.25**2], rtol=1e-12)
    np.testing.assert_allclose(js.OwnSize().measures(mesh, unit)[0], [9, 1], rtol=1e-12)


def test_a_goal_and_a_rule():
    goal = js.Goal((js.Stage(1, 0.5, 2), js.Stage(1, 0.5, 6)))
    strict = js.AcceptanceRule(average=-0.5)  # asks for more than can be had
    mesh = square(0.04)
    refused = js.smooth(mesh, js.Optimize(goal=goal), accept=strict, steps=1)
    np.testing.assert_array_equal(refused.mesh.points, mesh.points)
    assert refused.status is js.Status.LOWER_AVERAGE
    reached = js.smooth(mesh, js.Optimize(goal=goal), steps=1)
    assert reached.history[-1].statistics.q_min > reached.history[0].statistics.q_min
