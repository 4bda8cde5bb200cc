"""Nothing comes back worse: the rule, the driver that heeds it, and meshes that once did."""

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from meshes import grid, mixed_2d

import jaxsmooth as js
from jaxsmooth.guards.acceptance import AcceptanceRule, Status
from jaxsmooth.metrics.summary import Statistics
from jaxsmooth.metrics.validity import inverted

SHARED = Path(__file__).parents[2] / "shared"
needs_shared = pytest.mark.skipif(not SHARED.is_dir(), reason="the shared meshes are not here")

GOOD = Statistics(0.5, 1.0, 0.8, 0.1, below=0, inverted=0, scaled_jacobian_min=0.4)
POOR = Statistics(0.1, 1.0, 0.8, 0.1, below=7, inverted=2, scaled_jacobian_min=-0.3)


@pytest.mark.parametrize(
    ("first", "change", "status"),
    [
        (GOOD, {"q_avg": 0.9}, None),
        (GOOD, {}, Status.NO_GAIN),
        (GOOD, {"inverted": 1, "q_avg": 0.9}, Status.MORE_INVERTED),
        (GOOD, {"below": 1, "q_avg": 0.9}, Status.MORE_POOR),
        (GOOD, {"q_min": 0.49, "q_avg": 0.9}, Status.LOWER_MINIMUM),
        (GOOD, {"scaled_jacobian_min": 0.39, "q_avg": 0.9}, Status.LOWER_CORNER),
        (replace(GOOD, scaled_jacobian_min=0.99), {"scaled_jacobian_min": 0.7, "q_avg": 0.9}, None),
        (GOOD, {"q_avg": 0.79, "q_min": 0.6}, Status.LOWER_AVERAGE),
        (GOOD, {"q_avg": float("nan"), "q_min": 0.6}, Status.LOWER_AVERAGE),
        (POOR, {"inverted": 1}, None),
        (POOR, {"inverted": 0, "q_avg": 0.7}, None),
        (POOR, {"inverted": 1, "q_avg": 0.7}, Status.LOWER_AVERAGE),
        # flat elements before and after, whose sign is but rounding
        (replace(POOR, q_min=-1e-16), {"inverted": 0, "q_min": 1e-16, "q_avg": 0.7}, Status.LOWER_AVERAGE),
        (replace(GOOD, below=9), {"below": 8, "scaled_jacobian_min": 0.3}, None),
        (replace(GOOD, below=9), {"below": 8, "scaled_jacobian_min": 0.29}, Status.LOWER_CORNER),
        (POOR, {"below": 6, "q_avg": 0.7}, Status.LOWER_AVERAGE),
        (POOR, {"inverted": 1, "below": 8}, Status.MORE_POOR),
        (POOR, {"below": 6, "q_min": 0.09}, Status.LOWER_MINIMUM),
        (POOR, {"below": 6, "scaled_jacobian_min": -0.4}, Status.LOWER_CORNER),
    ],
)
def test_the_rule(first, change, status):
    now = replace(first, **change)
    assert AcceptanceRule().objection(first, first, now, 1e-14) == status
    finite = np.isfinite(now.q_avg)
    assert (AcceptanceRule.anything().objection(first, first, now, 1e-14) is None) == finite


def test_fewer_inverted_elements_excuse_a_lower_minimum_above_the_floors():
    before = replace(GOOD, inverted=3, scaled_jacobian_min=0.3)
    now = replace(before, inverted=2, q_min=0.3, scaled_jacobian_min=0.15)
    assert AcceptanceRule().objection(before, before, now, 0) is None
    assert AcceptanceRule().objection(before, before, replace(now, q_min=0.19), 0) == Status.LOWER_MINIMUM


def test_the_rule_can_be_loosened():
    now = replace(GOOD, q_avg=0.75, q_min=0.45)
    assert AcceptanceRule(average=0.1, quality=0.1).objection(GOOD, GOOD, replace(now, q_max=1.1), 0) == (
        Status.NO_GAIN
    )
    better = replace(now, scaled_jacobian_min=0.5)
    assert AcceptanceRule(average=0.1, quality=0.1).objection(GOOD, GOOD, better, 0) is None


# --- The driver --------------------------------------------------------------------------


@pytest.fixture(scope="module")
def square():
    return js.Mesh(*mixed_2d(0.08))


def test_the_last_step_that_counts_is_returned(square):
    """With an average that may not fall at all, the run ends where the history says."""
    strict = AcceptanceRule(average=-0.01)  # every step has to raise it by as much
    result = js.smooth(square, accept=strict, tolerance_avg=0, steps=8)
    q = np.concatenate(js.quality(result.mesh))
    assert result.history[-1].statistics.q_avg == pytest.approx(q.mean(), rel=1e-12)
    rows = [row.statistics for row in result.history]
    for before, now in pairwise(rows):
        assert now.q_min >= before.q_min - 1e-13
        assert now.scaled_jacobian_min >= before.scaled_jacobian_min - 1e-13
        assert now.q_avg >= rows[0].q_avg + 0.01


def test_a_number_of_steps_is_that_number(square):
    result = js.smooth(square, steps=3, tolerance_avg=0)
    assert [row.step for row in result.history] == [0, 1, 2, 3]


def test_a_rule_that_nothing_meets_returns_the_input(square):
    result = js.smooth(square, accept=AcceptanceRule(average=-1.0), tolerance_avg=0)
    assert result.status == Status.LOWER_AVERAGE
    np.testing.assert_array_equal(result.mesh.points, square.points)
    assert len(result.history) == 1


# --- Units -------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
@pytest.mark.parametrize("method", [js.Elastic(extended=True), js.Laplacian(smart=True, weighted=True)])
def test_a_power_of_two_changes_nothing(dtype, method):
    points, blocks = mixed_2d(0.1)
    turn = np.array([[0.8, -0.6], [0.6, 0.8]])
    points = (points @ turn.T).astype(dtype)
    first = np.asarray(js.smooth(js.Mesh(points, blocks), method, steps=2, tolerance_avg=0).mesh.points)
    assert (first != points).any()
    for factor in (2.0**-30 if dtype is np.float64 else 2.0**-10, 2.0**20):
        scaled = js.Mesh((points * factor).astype(dtype), blocks)
        found = np.asarray(js.smooth(scaled, method, steps=2, tolerance_avg=0).mesh.points)
        np.testing.assert_array_equal(found, (first * dtype(factor)))


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_the_unit_of_length_does_not_matter(dtype):
    """Iterations of the solver, and how exactly nodes stay in the sides of a turned box."""
    points, blocks = grid("tetra", None, 0.12)
    inside = points.copy()
    turn = np.linalg.qr(np.random.default_rng(2).normal(size=(3, 3)))[0]
    counts, moved = [], []
    for factor in (1.0, 1e-9, 1e-4, 1e5, 1e9) if dtype is np.float64 else (1.0, 1e-4, 1e5):
        mesh = js.Mesh((factor * (inside @ turn.T)).astype(dtype), blocks)
        result = js.smooth(mesh, js.Elastic(tolerance=1e-3), steps=2, tolerance_avg=0)
        counts.append([row.solver_iterations for row in result.history])
        back = np.asarray(result.mesh.points, np.float64) @ turn / factor
        sides = (points < 1e-9) | (points > 1 - 1e-9)
        drift = np.abs(back - points)[sides].max()
        assert drift < (1e-9 if dtype is np.float64 else 1e-5)
        moved.append(np.abs(back - points).max())
    assert np.ptp(counts, axis=0).max() <= 1
    assert min(moved) > 0.01


@needs_shared
def test_one_mesh_in_three_units():
    runs = []
    for unit in ("1e0", "1e-4", "1e-9"):
        file = js.read(SHARED / "cases" / f"27_ball_{unit}.vtu")
        result = js.smooth(file, steps=2, tolerance_avg=0)
        runs.append((result, (np.asarray(result.mesh.points) - np.asarray(file.mesh.points)) / float(unit)))
    iterations = [[row.solver_iterations for row in result.history] for result, _ in runs]
    assert np.ptp(iterations, axis=0).max() <= 1
    for _, move in runs[1:]:
        np.testing.assert_allclose(move, runs[0][1], atol=1e-6)


# --- Meshes that came back worse -----------------------------------------------------------


def check_not_worse(before, result, average=True):
    """Every promise, by numbers that the driver does not make."""
    first, last = (
        (
            np.concatenate(js.quality(mesh)),
            np.concatenate(js.quality(mesh, "scaled_jacobian")),
            np.concatenate(inverted(mesh)),
        )
        for mesh in (before, result.mesh)
    )
    assert last[2].sum() <= first[2].sum()
    assert (last[0] < 0.2).sum() <= (first[0] < 0.2).sum()
    assert last[0].min() >= min(first[0].min(), 0.2) - 1e-9
    assert last[1].min() >= min(first[1].min(), 0.1) - 1e-9
    assert not average or last[0].mean() >= first[0].mean() - 1e-9


@needs_shared
def test_a_boundary_layer_is_left_alone():
    file = js.read(SHARED / "meshes" / "mixed2d" / "su2_rae2822_hybrid.vtu")
    free = js.detect_constraints(file.mesh, layers="free")
    check_not_worse(file.mesh, js.smooth(file, constraints=free))


@needs_shared
def test_a_tangled_pipe_is_untangled():
    """Second-order elements; once the run ended with one of 144 inverted, called converged."""
    file = js.read(SHARED / "cases" / "10_pipe.msh")
    assert np.concatenate(inverted(file.mesh)).sum() >= 144
    result = js.smooth(file)
    assert np.concatenate(inverted(result.mesh)).sum() == 0
    radius = np.hypot(*np.asarray(file.mesh.points)[:, :2].T)
    held = js.detect_constraints(file.mesh).at(file.mesh.points).freedom == 0
    moved = np.asarray(result.mesh.points) - np.asarray(file.mesh.points)
    assert np.abs(moved[held]).max() == 0
    assert radius[held].max() == pytest.approx(radius.max())


@needs_shared
def test_a_cluster_in_a_far_shell():
    """Proposals of 28 local edges, of which something is left after enough halvings."""
    file = js.read(SHARED / "cases" / "06_cluster.vtu")
    result = js.smooth(file)
    check_not_worse(file.mesh, result)
    rows = [row.statistics for row in result.history]
    assert rows[-1].below < rows[0].below - 5


@needs_shared
def test_poor_elements_still_fall_when_the_mean_has_settled():
    file = js.read(SHARED / "meshes" / "tet" / "rocker_gmsh_13k.vtu")
    held = js.detect_constraints(file.mesh, boundary="fixed")
    result = js.smooth(file, js.Elastic(extended=True), constraints=held, steps=3)
    rows = [row.statistics.below for row in result.history]
    assert len(rows) == 4
    assert rows[-1] < 80 < rows[1]
    assert np.asarray(jnp.concatenate(result.quality)).min() > 0
