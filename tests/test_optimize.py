"""The objective, its Hessian model, the minimisers, and the method."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsmooth.cells.table import element_type, supported
from jaxsmooth.mesh.record import Mesh
from jaxsmooth.methods.optimize.distortion import (
    METRICS,
    apply_model,
    hessian_model,
    inverse_quality,
    model_diagonal,
    positive_part,
    regularisation,
)
from jaxsmooth.methods.optimize.goals import GOALS, Goal, Stage
from jaxsmooth.methods.optimize.method import Optimize
from jaxsmooth.methods.optimize.minimise import Jaxopt, Newton, Optax, Optimistix
from jaxsmooth.methods.optimize.problem import Aggregation, problem
from jaxsmooth.metrics.evaluation import evaluate
from jaxsmooth.metrics.shape import MEAN_RATIO, SHAPE_AND_CORNERS, measure, shape_quality
from jaxsmooth.motion.detect import detect_constraints
from jaxsmooth.motion.planar import Constraints
from jaxsmooth.targets import GivenSize, OwnSize

jax.config.update("jax_enable_x64", True)

RNG = np.random.default_rng


def jiggled(kind, amplitude=0.05, seed=0):
    return jnp.asarray(kind.ideal + amplitude * RNG(seed).standard_normal(kind.ideal.shape))


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


KINDS = supported()
# types for which "shape_and_corners" is not, or not only, the mean ratio
PAIRS = [(name, METRICS[0]) for name in KINDS] + [
    (name, "mean_ratio") for name in ("triangle", "quad", "tetra", "hexahedron")
]


@pytest.mark.parametrize(("name", "metric"), PAIRS)
def test_gradient_is_that_of_the_value(name, metric):
    kind = element_type(name)
    nodes, size, eps = jiggled(kind), jnp.float64(1.3), jnp.float64(0.1)
    function = jax.jit(partial(inverse_quality, kind, metric, jnp.float64(0.5)))
    direction = jnp.asarray(RNG(2).standard_normal(kind.ideal.shape))
    h = 1e-6
    up, down = (function(nodes + s * h * direction, size, eps)[0] for s in (1, -1))
    # central differences: rounding eps / h and truncation h² are both below 1e-8
    np.testing.assert_allclose(
        jnp.vdot(function(nodes, size, eps)[1], direction), (up - down) / (2 * h), rtol=1e-6, atol=1e-8
    )


@pytest.mark.parametrize(("name", "metric"), PAIRS)
def test_ideal_element_is_the_optimum(name, metric):
    kind = element_type(name)
    function = jax.jit(partial(inverse_quality, kind, metric, jnp.float64(1.0)))
    best, gradient = function(jnp.asarray(kind.ideal), 1.0, 0.0)
    np.testing.assert_allclose(best, 1, rtol=1e-9)
    np.testing.assert_allclose(gradient, 0, atol=1e-9)
    for seed in range(8):
        assert function(jiggled(kind, 0.03, seed), 1.0, 0.0)[0] > 1


@pytest.mark.parametrize("name", KINDS)
def test_metric_is_the_inverse_of_what_is_minimised(name):
    kind = element_type(name)
    nodes = jiggled(kind)
    mirrored = nodes.at[:, 0].multiply(-1)
    for metric in (SHAPE_AND_CORNERS, MEAN_RATIO):
        zero = jnp.float64(0.0)
        e, _ = inverse_quality(kind, metric.name, zero, nodes, measure(kind, nodes), zero)
        np.testing.assert_allclose(metric(kind, nodes), 1 / e, rtol=1e-13)
        assert e > 1.0001
        assert metric(kind, mirrored) == 0


@pytest.mark.parametrize("name", KINDS)
def test_invariance_to_similarity(name):
    kind = element_type(name)
    nodes = jiggled(kind)
    turn, _ = np.linalg.qr(RNG(3).standard_normal((kind.dim, kind.dim)))
    turn[:, 0] *= np.linalg.det(turn)
    moved = 7.0 * nodes @ jnp.asarray(turn).T + 3.0
    values = [inverse_quality(kind, METRICS[0], 0.0, x, 1.0, 0.0)[0] for x in (nodes, moved)]
    np.testing.assert_allclose(values[0], values[1], rtol=1e-10)


@pytest.mark.parametrize("name", ["triangle", "quad", "tetra", "wedge", "hexahedron", "tetra10"])
def test_hessian_model_is_positive_and_its_diagonal_right(name):
    kind = element_type(name)
    aggregation = Aggregation(1.0, 1.0, 6.0, 1.2)
    *_, model = hessian_model(
        kind,
        METRICS[0],
        0.5,
        aggregation.derivatives,
        jiggled(kind),
        jnp.float64(1.0),
        jnp.float64(0.0),
    )
    units = jnp.eye(kind.k * kind.dim).reshape(-1, kind.k, kind.dim)
    matrix = jax.vmap(lambda u: apply_model(kind, u, model).reshape(-1))(units)
    np.testing.assert_allclose(matrix, matrix.T, atol=1e-10 * float(jnp.abs(matrix).max()))
    assert np.linalg.eigvalsh(matrix).min() > -1e-10 * np.abs(matrix).max()
    blocks = matrix.reshape(kind.k, kind.dim, kind.k, kind.dim)
    diagonal = np.stack([blocks[i, :, i] for i in range(kind.k)])
    np.testing.assert_allclose(model_diagonal(kind, model), diagonal, atol=1e-10 * np.abs(diagonal).max())


@pytest.mark.parametrize("name", ["triangle", "tetra"])
def test_hessian_model_of_the_mean_ratio_is_exact_where_nothing_is_left_out(name):
    """Along displacements that leave the determinant's second derivative out: one node's."""
    kind = element_type(name)
    nodes = jiggled(kind, 0.1)
    *_, model = hessian_model(
        kind, "mean_ratio", 0.0, lambda e: (jnp.ones_like(e), jnp.zeros_like(e)), nodes, 1.0, 0.0
    )
    direction = jnp.zeros_like(nodes).at[0].set(jnp.asarray(RNG(4).standard_normal(kind.dim)))
    gradient = lambda t: inverse_quality(kind, "mean_ratio", 0.0, nodes + t * direction, 1.0, 0.0)[1]  # noqa: E731
    exact = jax.jvp(gradient, (0.0,), (1.0,))[1]
    np.testing.assert_allclose(
        jnp.vdot(apply_model(kind, direction, model), direction), jnp.vdot(exact, direction), rtol=1e-10
    )


def test_positive_part():
    det = jnp.asarray([-2.0, -1e-3, 0.0, 1e-3, 2.0])
    assert (positive_part(det, 0.1) > 0).all()
    np.testing.assert_array_equal(positive_part(det, 0.0), jnp.maximum(det, 0))
    slope = jax.vmap(jax.grad(positive_part), in_axes=(0, None))(det, 0.1)
    assert ((slope > 0) & (slope < 1)).all()
    assert regularisation(jnp.float64(1e-9)) == 0  # valid, so the barrier stands
    assert regularisation(jnp.float64(-1.0)) > 0.1


@pytest.mark.parametrize("name", ["triangle", "hexahedron", "wedge", "tetra10"])
def test_vanishing_elements_are_no_way_out(name):
    """With a regularised determinant alone, a metric without size falls to zero with the element."""
    kind = element_type(name)
    for eps in (0.01, 0.1, 0.5):
        scaled = [
            inverse_quality(kind, METRICS[0], 0.0, s * jnp.asarray(kind.ideal), 1.0, eps)[0]
            for s in (1, 1e-3)
        ]
        assert scaled[1] > scaled[0] + 0.5


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
    with pytest.raises(ValueError, match="neither repairs nor untangles"):
        Goal((Stage(1, 1, 2, repairing=True),))
    with pytest.raises(ValueError, match="metric"):
        Optimize(metric="beauty")


@pytest.mark.parametrize("name", ["wedge", "pyramid", "tetra10", "hexahedron20"])
def test_quality_and_shape_are_both_seen(name):
    """Flat ones are worse than by their mean ratio alone; tall ones, of less surface, are not better."""
    kind = element_type(name)
    heights = jnp.array([0.3, 0.5, 0.8, 1.0, 1.4, 2.0])
    stretch = jnp.stack([jnp.ones(6), jnp.ones(6), heights], axis=1)
    nodes = jnp.asarray(kind.ideal) * stretch[:, None]
    both, mean = (
        jax.vmap(lambda x, m=metric: inverse_quality(kind, m, 0.0, x, 1.0, 0.0)[0])(nodes)
        for metric in (METRICS[0], "mean_ratio")
    )
    assert (both >= mean - 1e-12).all()
    assert int(jnp.argmin(both)) == 3
    excess, gap = 1 / shape_quality(kind, nodes[0]) - 1, (both - mean)[0]
    assert excess - 0.02 <= gap <= excess  # the kink is rounded
    assert gap > 0.01
