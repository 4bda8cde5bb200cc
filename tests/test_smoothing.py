"""The driver: when it stops, what it records, what it refuses."""

import jax
import jax.numpy as jnp
import meshio
import numpy as np
import pytest
from meshes import grid, mixed_2d

import jaxsmooth as js
from jaxsmooth.methods import Method, Proposal


@pytest.fixture(scope="module")
def square():
    points, blocks = mixed_2d(0.08)
    return js.Mesh(points, blocks)


class Mover(Method):
    """A method that proposes what it is told, for the tests of the driver."""

    guard: js.PatchGuard | None
    move: jax.Array

    def propose(self, mesh, motion, before, state=None):
        return Proposal(self.move, jnp.int32(0), jnp.zeros(()))


def test_history_and_statistics(square):
    rows = []
    result = js.smooth(square, steps=3, tolerance_avg=0, callback=rows.append)
    assert tuple(rows) == result.history
    assert [row.step for row in rows] == [0, 1, 2, 3]
    assert result.status == js.Status.STEP_LIMIT
    for mesh, row in ((square, rows[0]), (result.mesh, rows[-1])):
        q = np.concatenate(js.quality(mesh))
        s = row.statistics
        np.testing.assert_allclose([s.q_min, s.q_max, s.q_avg], [q.min(), q.max(), q.mean()], rtol=1e-12)
        np.testing.assert_allclose(s.q_std, np.std(q, ddof=1), rtol=1e-10)
        assert s.below == (q < 0.2).sum()
        assert s.inverted == 0
    np.testing.assert_allclose(
        np.concatenate(result.quality), np.concatenate(js.quality(result.mesh)), rtol=1e-12
    )
    assert rows[-1].as_json().keys() >= {"step", "q_min", "q_below_0.2", "solver_iterations", "seconds"}


def test_stops_when_both_changes_are_small(square):
    result = js.smooth(square, steps=50)
    assert result.status == js.Status.CONVERGED
    last, previous = (row.statistics for row in result.history[:-3:-1])
    assert abs(last.q_avg - previous.q_avg) < 1e-3
    assert abs(last.q_min - previous.q_min) < 2e-2
    for row, before in zip(result.history[1:-1], result.history[:-2], strict=True):
        change = (
            row.statistics.q_avg - before.statistics.q_avg,
            row.statistics.q_min - before.statistics.q_min,
        )
        assert abs(change[0]) >= 1e-3 or abs(change[1]) >= 2e-2


def test_a_perfect_mesh_converges_at_once():
    points, blocks = grid("quad")
    result = js.smooth(js.Mesh(points, blocks))
    assert result.status == js.Status.CONVERGED
    np.testing.assert_allclose(result.mesh.points, points, atol=1e-12)


def test_a_step_that_makes_nothing_better_is_refused(square):
    perfect, blocks = grid("quad")
    mesh = js.Mesh(perfect, blocks)
    inside = js.detect_constraints(mesh).freedom == 2
    move = 0.01 * np.random.default_rng(0).normal(size=perfect.shape) * inside[:, None]
    result = js.smooth(mesh, Mover(js.PatchGuard(gamma=0.1), jnp.asarray(move)), tolerance_avg=0)
    assert result.status == js.Status.LOWER_MINIMUM
    assert (result.mesh.points == mesh.points).all()
    assert len(result.history) == 1


def test_a_step_that_is_not_finite_is_refused(square):
    result = js.smooth(square, Mover(None, jnp.full(square.points.shape, jnp.nan)))
    assert result.status == js.Status.NOT_FINITE
    assert (result.mesh.points == square.points).all()


def test_a_guard_that_refuses_everything_stalls(square):
    move = jnp.where(jnp.asarray(js.detect_constraints(square).freedom == 2)[:, None], jnp.nan, 0.0)
    result = js.smooth(square, Mover(js.PatchGuard(), jnp.broadcast_to(move, square.points.shape)))
    assert result.status == js.Status.STALLED


def test_what_counts_as_a_mesh(square, tmp_path):
    points, blocks = (
        np.asarray(square.points),
        {n: np.asarray(c) for n, c in zip(square.types, square.connectivity, strict=True)},
    )
    expected = js.smooth(square, steps=1).mesh.points
    foreign = meshio.Mesh(np.c_[points, np.zeros(len(points))], list(blocks.items()))
    for same in ((points, blocks), foreign, js.from_meshio(foreign)):
        np.testing.assert_allclose(js.smooth(same, steps=1).mesh.points, expected, atol=1e-14)
    with pytest.raises(ValueError, match="mesh"):
        js.smooth("part.msh")


def test_labels_survive_and_interfaces_are_kept():
    points, blocks = grid("quad", (4, 4), amplitude=0.08)
    right = points[blocks["quad"]].mean(axis=1)[:, 0] > 0.5
    middle = np.abs(np.asarray(grid("quad", (4, 4))[0])[:, 0] - 0.5) < 1e-9
    points[middle, 0] = 0.5
    mesh = js.Mesh(points, blocks, js.Labels((right.astype(int),)))
    result = js.smooth(mesh, steps=2, tolerance_avg=0)
    assert (result.mesh.labels.regions[0] == mesh.labels.regions[0]).all()
    np.testing.assert_allclose(np.asarray(result.mesh.points)[middle, 0], 0.5, atol=1e-14)
    assert np.abs(np.asarray(result.mesh.points)[middle, 1] - points[middle, 1]).max() > 1e-4


def test_fixed_nodes_of_a_file_are_held(square):
    points = np.asarray(square.points)
    cells = [(n, np.asarray(c)) for n, c in zip(square.types, square.connectivity, strict=True)]
    mask = (points[:, 0] < 0.5).astype(np.int64)
    file = js.from_meshio(meshio.Mesh(points, cells, point_data={"fixed": mask}))
    moved = np.abs(np.asarray(js.smooth(file, steps=1).mesh.points) - points).max(axis=1)
    assert moved[mask == 1].max() == 0 < moved[mask == 0].max()


def test_constraints_of_another_mesh(square):
    other = js.Mesh(*grid("quad"))
    with pytest.raises(ValueError, match="constraints are for 16 nodes in 2D"):
        js.smooth(square.with_points(jnp.zeros((20, 2))), constraints=js.detect_constraints(other))
    with pytest.raises(ValueError, match="steps"):
        js.smooth(square, steps=-1)


def test_input_is_not_changed(square):
    before = np.array(square.points)
    js.smooth(square, steps=1)
    assert (np.asarray(square.points) == before).all()


def test_smooth_refuses_traced_points(square):
    with pytest.raises(TypeError, match=r"use run\(mesh, method, constraints=constraints, steps=3\)"):
        jax.grad(lambda p: js.quality_mean(js.smooth(square.with_points(p), steps=2).mesh))(square.points)


@pytest.mark.parametrize(
    ("points", "blocks", "sentence"),
    [
        ([[0, 0], [1, 0], [0, 1]], {"triangle": np.zeros((0, 3), int)}, "block 0 .triangle. has no elements"),
        ([[0, 0], [1e200, 0], [0, 1e200]], {"triangle": [[0, 1, 2]]}, "size of 1e[+]200"),
        ([[0, 0], [1e-200, 0], [0, 1e-200]], {"triangle": [[0, 1, 2]]}, "size of 1e-200"),
        ([[0, 0], [1, 0], [0, 1]], {"triangle": [[0, 1, 3]]}, "element 0: node index 3 is out of range"),
        ([[0, 0], [1, 0], [0, 1]], {"triangle": [[0, 1, 1]]}, "element 0: node 1 appears twice"),
        (
            [[0, 0], [np.nan, 0], [0, 1]],
            {"triangle": [[0, 1, 2]]},
            "node 1 has a coordinate that is not finite",
        ),
        ([[0, 0], [1, 0], [0, 1], [1, 1]], {"tetra": [[0, 1, 2, 3]]}, "3D elements in 2D space"),
        ([[0, 0], [1, 0], [0, 1]], {"polygon": [[0, 1, 2]]}, "'polygon' is not supported"),
        ([[0, 0], [1, 0], [0, 1]], {}, "no element blocks"),
    ],
)
def test_meshes_that_are_refused(points, blocks, sentence):
    with pytest.raises(ValueError, match=sentence):
        js.Mesh(np.array(points, float), blocks)


@pytest.mark.parametrize("factor", [0.0, 1.0])
def test_flat_and_collapsed_meshes_do_not_give_nan(factor):
    points = np.array([[0, 0], [1, 0], [0, 1], [1, 1]]) * [factor, 0]
    result = js.smooth((points, {"triangle": [[0, 1, 2], [1, 3, 2]]}), steps=2)
    assert np.isfinite(np.asarray(result.mesh.points)).all()
    assert result.history[-1].statistics.inverted == 2
