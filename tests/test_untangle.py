"""Untangling: all that can be valid becomes valid, the rest is named."""

import json

import jax
import jax.numpy as jnp
import meshio
import numpy as np
import pytest

import jaxsmooth as js
from jaxsmooth.cli import main
from jaxsmooth.guards.acceptance import AcceptanceRule
from jaxsmooth.methods import Optimize, Untangle
from jaxsmooth.metrics.validity import inverted
from jaxsmooth.runs.driver import smooth


def grid(n: int, dim: int, kind: str, amplitude: float, seed: int):
    """A unit square or cube whose nodes inside are moved at random by so many element sizes."""
    axes = np.meshgrid(*[np.linspace(0, 1, n + 1)] * dim, indexing="ij")
    points = np.stack(axes, -1).reshape(-1, dim)
    inside = ((points > 0) & (points < 1)).all(axis=1)
    moves = np.random.default_rng(seed).uniform(-amplitude, amplitude, points.shape) / n
    index = np.arange(len(points)).reshape((n + 1,) * dim)
    if dim == 2:
        corners = [index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]]
        quads = np.stack([c.ravel() for c in corners], axis=1)
        cells = quads if kind == "quad" else np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    else:
        a, b, c, d, e, f, g, h = (
            index[i : n + i, j : n + j, k : n + k].ravel()
            for k in (0, 1)
            for i, j in ((0, 0), (1, 0), (1, 1), (0, 1))
        )
        paths = ((b, c), (c, d), (d, h), (h, e), (e, f), (f, b))
        cells = np.stack([a, b, c, d, e, f, g, h], axis=1)
        if kind == "tetra":
            cells = np.concatenate([np.stack([a, p, q, g], axis=1) for p, q in paths])
    return js.as_mesh((np.where(inside[:, None], points + moves, points), {kind: cells}))


def count(mesh) -> int:
    return sum(int(part.sum()) for part in inverted(mesh))


CASES = [("triangle", 2, 8), ("quad", 2, 8), ("tetra", 3, 4), ("hexahedron", 3, 4)]


@pytest.mark.parametrize(("kind", "dim", "n"), CASES)
def test_whatever_can_be_valid_becomes_valid(kind, dim, n):
    mesh = grid(n, dim, kind, 1.2, seed=1)
    done = smooth(mesh, Untangle(), steps=1)
    assert count(mesh) > 20
    assert count(done.mesh) == 0
    edge = np.isclose(np.asarray(mesh.points), 0) | np.isclose(np.asarray(mesh.points), 1)
    np.testing.assert_allclose(np.asarray(done.mesh.points)[edge], np.asarray(mesh.points)[edge], atol=1e-12)


def test_size_and_place_do_not_matter():
    mesh = grid(8, 2, "triangle", 1.2, seed=1)
    constraints = js.detect_constraints(mesh)
    found = js.step(mesh, Untangle(), constraints=constraints).points
    larger = mesh.with_points(mesh.points * 2.0**20)
    scaled = js.step(larger, Untangle(), constraints=js.detect_constraints(larger)).points
    np.testing.assert_array_equal(np.asarray(scaled) / 2.0**20, found)


def test_a_valid_mesh_stays_as_it_is():
    mesh = grid(8, 2, "triangle", 0.2, seed=1)
    found = js.step(mesh, Untangle(), constraints=js.detect_constraints(mesh))
    np.testing.assert_array_equal(found.points, mesh.points)


def test_single_precision():
    mesh = grid(8, 2, "triangle", 1.2, seed=1)
    mesh = mesh.with_points(mesh.points.astype(jnp.float32))
    done = smooth(mesh, Untangle(), steps=1)
    assert done.mesh.points.dtype == jnp.float32
    assert count(done.mesh) == 0


def bent():
    """A grid with a corner pushed inside: that triangle is inverted, and all its nodes are held."""
    mesh = grid(8, 2, "triangle", 1.2, seed=1)
    points = np.asarray(mesh.points).copy()
    corner = int(np.argmax(points[:, 0] - points[:, 1]))
    held = np.flatnonzero(((points == 0) | (points == 1)).any(axis=1))
    points[corner] = [0.92, 0.08]
    return mesh.with_points(jnp.asarray(points)), held


def test_what_is_held_does_not_stop_the_rest():
    mesh, held = bent()
    rule = AcceptanceRule.anything()
    done = smooth(mesh, Untangle(), steps=1, constraints=js.Constraints.hold(mesh, held), accept=rule)
    stay = np.flatnonzero(np.asarray(inverted(done.mesh)[0]))
    assert len(stay) == 1
    assert np.isin(np.asarray(mesh.connectivity[0])[stay[0]], held).all()


def star():
    """A ring that no point sees whole: three arms, so that some triangle at the middle is always inverted."""
    angles = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    radii = np.where(np.arange(12) % 4 == 0, 1.0, 0.3)
    twist = np.where(np.arange(12) % 4 == 1, 1.5, 0.0)  # arms wind around the middle
    ring = radii[:, None] * np.stack([np.cos(angles + twist), np.sin(angles + twist)], axis=1)
    points = np.concatenate([ring, [[0.0, 0.0]]])
    cells = np.stack([np.arange(12), (np.arange(12) + 1) % 12, np.full(12, 12)], axis=1)
    return js.as_mesh(meshio.Mesh(points, [("triangle", cells)]))


def test_it_ends_where_nothing_can_be_done():
    mesh = star()
    hold = js.Constraints.hold(mesh, np.arange(12))
    done = smooth(mesh, Untangle(), steps=1, constraints=hold, accept=AcceptanceRule.anything())
    assert np.isfinite(np.asarray(done.mesh.points)).all()
    assert count(mesh) >= count(done.mesh) > 0
    assert 0 < done.history[1].solver_iterations < Untangle().iterations


def test_optimize_untangles_first():
    mesh = grid(8, 2, "triangle", 1.2, seed=1)
    rows = smooth(mesh, Optimize(), steps=2).history
    assert [row.statistics.inverted for row in rows[1:]] == [0, 0]
    assert rows[2].statistics.q_avg > rows[1].statistics.q_avg


def test_it_has_no_derivative():
    mesh = grid(8, 2, "triangle", 1.2, seed=1)
    constraints = js.detect_constraints(mesh)

    def moved(points):
        return js.step(mesh.with_points(points), Untangle(), constraints=constraints).points.sum()

    with pytest.raises(TypeError, match=r"js\.optimum"):
        jax.grad(moved)(mesh.points)


def test_the_command_names_what_stays_inverted(tmp_path, capsys):
    mesh, held = bent()
    fixed = np.zeros(len(mesh.points))
    fixed[held] = 1
    meshio.write(
        tmp_path / "in.vtu",
        meshio.Mesh(
            np.asarray(mesh.points),
            [("triangle", np.asarray(mesh.connectivity[0]))],
            point_data={"fixed": fixed},
        ),
    )
    paths = [str(tmp_path / name) for name in ("in.vtu", "out.vtu", "out.json")]
    assert main(["smooth", *paths[:2], "--method", "untangle", "--json", paths[2]]) == 3
    rows = json.loads((tmp_path / "out.json").read_text())["still_inverted"]
    hopeless = [row for row in rows if not row["repairable"]]
    assert hopeless
    assert all(row["type"] == "triangle" for row in rows)
    assert f"{len(hopeless)} inverted elements can't be repaired" in capsys.readouterr().out
