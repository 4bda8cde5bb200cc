"""The objective, its Hessian model, the minimisers, and the method."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsmooth as js
from jaxsmooth.mesh.record import Mesh
from jaxsmooth.methods.optimize.goals import GOALS, Goal, Stage, When
from jaxsmooth.methods.optimize.method import Optimize
from jaxsmooth.methods.optimize.minimise import Jaxopt, Newton, Optax, Optimistix
from jaxsmooth.methods.optimize.problem import Aggregation, problem
from jaxsmooth.metrics.evaluation import evaluate
from jaxsmooth.metrics.record import Metric
from jaxsmooth.metrics.shape import mean_ratio
from jaxsmooth.motion.detect import detect_constraints
from jaxsmooth.motion.planar import Constraints
from jaxsmooth.targets import GivenSize, OwnSize

jax.config.update("jax_enable_x64", True)

RNG = np.random.default_rng


def square(n=8, amplitude=0.3, seed=1, triangles=False):
    """A grid of the unit square with its inner nodes displaced, and its boundary mask."""
    x, y = np.meshgrid(np.linspace(0, 1, n + 1), np.linspace(0, 1, n + 1))
    points = np.stack([x.ravel(), y.ravel()], axis=1)
    held = ((points == 0) | (points == 1)).any(axis=1)
    points[~held] += amplitude / n * RNG(seed).uniform(-1, 1, (int((~held).sum()), 2))
    first = np.array([j * (n + 1) + i for j in range(n) for i in range(n)])
    quads = np.stack([first, first + 1, first + n + 2, first + n + 1], axis=1)
    if triangles:
        return Mesh(points, {"triangle": np.r_[quads[:, :3], quads[:, [0, 2, 3]]]}), held
    return Mesh(points, {"quad": quads}), held


@jax.jit
def _step(method, mesh, constraints):
    return method.step(mesh, constraints, evaluate(mesh))


def run(mesh, held, method=None):
    constraints = held if isinstance(held, Constraints) else Constraints.hold(mesh, held)
    method = Optimize() if method is None else method
    return mesh.with_points(_step(method, mesh, constraints).points)


def least(mesh):
    q, det, _ = evaluate(mesh)
    return float(jnp.concatenate(q).min()), float(jnp.concatenate(det).min())


WIDE = Metric("wide", lambda kind, nodes: mean_ratio(kind, nodes * jnp.array([0.5, 1.0])))
"""Best for triangles twice as wide as equilateral ones."""


def test_another_metric_drives_the_optimiser():
    """One free node goes where a search over the plane finds the best mean."""
    angles = np.array([0.1, 1.3, 2.2, 3.7, 5.1])
    points = np.r_[np.stack([2 * np.cos(angles), np.sin(angles)], 1), [[0.4, 0.3]]]
    fan = Mesh(points, {"triangle": [[i, (i + 1) % 5, 5] for i in range(5)]})
    held = np.arange(6) < 5
    goal = Goal((Stage(1, 0, 1),))
    options = {"goal": goal, "start": None, "minimiser": Newton(iterations=40)}

    places = np.stack(np.meshgrid(np.linspace(-1, 1, 81), np.linspace(-0.6, 0.6, 81)), -1).reshape(-1, 2)
    kind, elements = fan.blocks[0]
    around = jnp.asarray(points)[elements].repeat(len(places), axis=0).reshape(5, -1, 3, 2)
    means = jax.vmap(jax.vmap(partial(WIDE, kind)))(around.at[:, :, 2].set(places)).mean(axis=0)
    best = places[int(means.argmax())]
    method = Optimize(metric=WIDE, **options)
    there, usual = (run(fan, held, m).points[5] for m in (method, Optimize(**options)))
    np.testing.assert_allclose(there, best, atol=0.02)  # the search has steps of 0.025 and 0.015
    assert np.abs(usual - best).max() > 0.05
    result = js.smooth(fan, method, constraints=Constraints.hold(fan, held), steps=1)
    assert result.history[-1].statistics.inverted == 0


def test_another_metric_untangles():
    tangled, held = square(amplitude=1.5, triangles=True)
    assert least(tangled)[1] < 0 < least(run(tangled, held, Optimize(metric=WIDE)))[1]


def test_problem_gradient_and_value():
    mesh, held = square()
    sizes = (jnp.full(64, 1 / 64),)
    task = problem(mesh, Constraints.hold(mesh, held), sizes, Aggregation(1.0, 1.0, 4.0))
    value, gradient = task.value_and_grad(mesh.points, jnp.float64(0.0))
    np.testing.assert_allclose(task.value(mesh.points, jnp.float64(0.0))[0], value, rtol=1e-12)
    gradient = task.motion.at(mesh.points).collect(gradient)
    assert not np.asarray(gradient)[held].any()
    direction = jnp.where(jnp.asarray(held)[:, None], 0, jnp.asarray(RNG(5).standard_normal((81, 2))))
    h = 1e-7
    up, down = (task.value(mesh.points + s * h * direction, jnp.float64(0.0))[0] for s in (1, -1))
    np.testing.assert_allclose(jnp.vdot(gradient, direction), (up - down) / (2 * h), rtol=1e-5)


@pytest.mark.parametrize(
    "minimiser", [Newton(), Optimistix(), Jaxopt(), Optax()], ids=lambda m: type(m).__name__
)
@pytest.mark.filterwarnings("ignore")  # jaxopt says that it is not maintained
def test_every_minimiser_reduces_the_objective(minimiser):
    mesh, held = square(triangles=True)
    constraints = Constraints.hold(mesh, held)
    task = problem(mesh, constraints, (jnp.full(128, 1 / 128),), Aggregation(1.0, 1.0, 4.0))
    found = jax.jit(minimiser)(task, mesh.points)
    start = task.value(mesh.points, jnp.float64(0.0))[0]
    best = jax.jit(Newton(iterations=40, tolerance=1e-10))(task, mesh.points).value
    assert found.value < start
    assert start - found.value > 0.9 * (start - best)
    np.testing.assert_array_equal(found.points[held], mesh.points[held])
    assert least(mesh.with_points(found.points))[1] > 0


def test_goals_do_what_they_say():
    mesh, held = square(amplitude=0.4, triangles=True, seed=7)
    points = np.asarray(mesh.points).copy()
    points[held, 0] += 0.1 * np.sin(3 * points[held, 1])  # a boundary that no regular mesh fits
    mesh = mesh.with_points(jnp.asarray(points))
    found = {goal: jnp.concatenate(evaluate(run(mesh, held, Optimize(goal=goal))).quality) for goal in GOALS}
    before = evaluate(mesh).quality[0]
    assert min(q.min() for q in found.values()) > before.min()
    assert min(q.mean() for q in found.values()) > before.mean()
    assert found["worst"].min() >= found["average"].min()
    assert found["average"].mean() >= found["worst"].mean()


def test_balanced_repairs_what_it_made_worse():
    mesh, held = square(amplitude=0, triangles=True)
    x, y = np.asarray(mesh.points).T
    mesh = mesh.with_points(jnp.asarray(np.stack([4 * x + 0.3 * np.sin(12 * x), y], axis=1)))
    before, after = least(mesh)[0], least(run(mesh, held))[0]
    without = least(run(mesh, held, Optimize(goal="average")))[0]
    assert without < 0.9 * before
    assert after > before


def test_elements_that_have_shrunk_keep_their_barrier():
    """Elements far smaller than at the start are no reason to regularise their determinants."""
    mesh, held = square(amplitude=0)
    x, y = np.asarray(mesh.points).T
    mesh = mesh.with_points(jnp.asarray(np.stack([x**3, y + 0.3 * x**2], axis=1)))
    qualities = [least(mesh)[0]]
    for _ in range(3):
        mesh = run(mesh, held)
        qualities.append(least(mesh)[0])
    assert qualities[1] > 5 * qualities[0]
    assert min(qualities[2:]) > 0.99 * qualities[1]


def test_jiggled_grid_becomes_regular():
    assert least(run(*square(amplitude=0.45)))[0] > 0.999


def test_tangled_mesh_untangles():
    mesh, held = square(amplitude=1.6, seed=3)
    assert least(mesh)[1] < 0
    assert least(run(mesh, held))[1] > 0


def test_held_inverted_elements_do_no_harm():
    mesh, _ = square(amplitude=1.6, seed=3)
    everything = np.ones(len(mesh.points), bool)
    np.testing.assert_array_equal(run(mesh, everything).points, mesh.points)


def test_an_element_that_stays_inverted_does_not_stop_the_others():
    mesh, held = square()
    points = np.asarray(mesh.points).copy()
    points[0] = 0.1  # the first quadrilateral is concave there, and its three nodes are held
    mesh = mesh.with_points(jnp.asarray(points))
    constraints = Constraints.hold(mesh, held)
    task = problem(mesh, constraints, (jnp.full(64, 1 / 64),), Aggregation(1.0, 1.0, 4.0))
    np.testing.assert_array_equal(np.flatnonzero(task.hopeless(mesh.points)[0]), [0])
    q, det, _ = (np.asarray(part[0]) for part in evaluate(run(mesh, held)))
    assert (det[1:] > 0).all()
    assert q[1:].mean() > 0.97


def test_given_up_elements_stay_finite_and_leave_the_others_alone():
    mesh, held = square(amplitude=1.6, seed=3)
    task = problem(mesh, Constraints.hold(mesh, held), (jnp.full(64, 1 / 64),), Aggregation(1.0, 1.0, 4.0))
    dets = task.determinants(mesh.points)
    inverted = tuple(det <= 0 for det in dets)
    everything = tuple(jnp.ones_like(part) for part in inverted)
    relieved = task.giving_up(mesh.points, everything)
    value, worst = relieved.value(mesh.points, jnp.float64(0.0))
    assert inverted[0].any()
    assert jnp.isfinite(value)
    np.testing.assert_allclose(worst, dets[0][~inverted[0]].min(), rtol=1e-12)
    np.testing.assert_array_equal(relieved.blocks[0].data.relief > 0, inverted[0])
    assert task.inverted(mesh.points, inverted) == 0
    assert task.inverted(mesh.points, tuple(~part for part in inverted)) == inverted[0].sum()
    found = Newton()(relieved, mesh.points)
    assert found.value < value
    assert (task.determinants(found.points)[0][~inverted[0]] > 0).all()


def test_no_element_is_inverted_that_was_not():
    for seed in range(3):
        mesh, held = square(amplitude=2.5, seed=seed)
        before, after = (np.asarray(evaluate(m).jacobian[0]) for m in (mesh, run(mesh, held)))
        assert not ((before > 0) & (after <= 0)).any()


def test_sliding_nodes_stay_on_their_lines():
    mesh, _ = square()
    points = np.asarray(mesh.points).copy()
    points[3, 0] += 0.03  # on the bottom edge
    mesh = mesh.with_points(jnp.asarray(points))
    smoothed = np.asarray(run(mesh, detect_constraints(mesh)).points)
    np.testing.assert_allclose(smoothed[:9, 1], 0, atol=1e-14)
    assert least(mesh.with_points(jnp.asarray(smoothed)))[0] > 0.999


def test_renumbering_changes_nothing():
    mesh, held = square(triangles=True)
    order = RNG(6).permutation(len(mesh.points))
    place = np.argsort(order)
    other = Mesh(np.asarray(mesh.points)[order], {"triangle": place[np.asarray(mesh.connectivity[0])][::-1]})
    first, second = run(mesh, held), run(other, held[order])
    # iterations stop by tolerances, so that rounding may show at their scale at most
    np.testing.assert_allclose(np.asarray(first.points)[order], second.points, atol=1e-8)


def test_given_size_pulls_measures_together():
    mesh, held = square(n=6, amplitude=0.0, triangles=True)
    points = np.asarray(mesh.points) ** np.array([1.6, 1.0])
    mesh = mesh.with_points(jnp.asarray(points))

    def spread(method):
        areas = np.asarray(evaluate(run(mesh, held, method)).jacobian[0])
        return areas.std() / areas.mean()

    given = Optimize(target=GivenSize(size=1 / 72, weight=10.0), start=None)
    own = Optimize(target=OwnSize(weight=100.0), start=None)
    assert spread(given) < spread(own)


def test_options_are_checked():
    with pytest.raises(ValueError, match="goal must be a Goal, or one of average, worst, bal"):
        Optimize(goal="best")
    with pytest.raises(ValueError, match="for meshes in which nothing is poor"):
        Goal((Stage(1, 1, 2, When.WORSENED),))
    with pytest.raises(ValueError, match="unknown metric 'beauty'"):
        Optimize(metric="beauty")
    with pytest.raises(ValueError, match="'min_jacobian' can't be optimised: it has a unit of measure"):
        Optimize(metric="min_jacobian")
    with pytest.raises(ValueError, match="'taper' can't be optimised: it is not for triangle elements"):
        run(*square(triangles=True), Optimize(metric="taper"))
