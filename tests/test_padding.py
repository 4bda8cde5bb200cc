"""Meshes of about one size share what is compiled; their ghosts make no difference."""

from __future__ import annotations

from collections import Counter

import jax
import meshes
import numpy as np
import pytest

import jaxsmooth as js
from jaxsmooth.mesh.padding import Padded, padded
from jaxsmooth.metrics.evaluation import evaluate
from jaxsmooth.runs import driver

_COMPILED: Counter[str] = Counter()


def _listen(event, seconds, **more):
    if event == "/jax/core/compile/backend_compile_duration":
        _COMPILED[more.get("fun_name", "")] += 1


jax.monitoring.register_event_duration_secs_listener(_listen)


def grid(kind, shape, seed=1):
    points, blocks = meshes.grid(kind, shape)
    return js.Mesh(meshes.jiggle(points, 0.05, seed), blocks)


@pytest.mark.parametrize("kind", ["triangle", "hexahedron", "tetra10"])
def test_sizes_are_few_and_at_most_a_quarter_larger(kind):
    for mesh in (grid(kind, (3, 2, 2)[: 2 if kind == "triangle" else 3]), js.Mesh(*meshes.mixed_3d())):
        whole = padded(mesh)
        for count, nodes in zip(whole.elements, whole.mesh.connectivity, strict=True):
            assert count <= len(nodes) <= max(1.25 * count, 32)
        extra = sum(kind.k for kind, _ in mesh.blocks)
        assert whole.nodes + extra <= len(whole.mesh.points) <= max(1.25 * (whole.nodes + extra), 32)
        # what counts is where it was
        np.testing.assert_array_equal(whole.mesh.points[: whole.nodes], mesh.points)
        for old, new in zip(mesh.connectivity, whole.mesh.connectivity, strict=True):
            np.testing.assert_array_equal(new[: len(old)], old)
            assert (np.asarray(new[len(old) :]) >= whole.nodes).all()
        # ghosts are ideal, and in the box of the mesh
        for q, count in zip(evaluate(whole.mesh).quality, whole.elements, strict=True):
            np.testing.assert_allclose(q[count:], 1, rtol=1e-12) if kind == "tetra10" else None
        points = np.asarray(whole.mesh.points)
        assert (points >= points[: whole.nodes].min(axis=0)).all()
        assert (points <= points[: whole.nodes].max(axis=0)).all()


@pytest.mark.parametrize("method", [js.Elastic(), js.Optimize()], ids=["elastic", "optimize"])
def test_ghosts_make_no_difference(method, monkeypatch):
    mesh = js.Mesh(*meshes.mixed_2d())
    mesh = mesh.with_points(meshes.jiggle(np.asarray(mesh.points), 0.05, 2))
    result = js.smooth(mesh, method, steps=2)
    monkeypatch.setattr(driver, "with_ghosts", lambda mesh, _, motion: (Padded.as_it_is(mesh), motion))
    alone = js.smooth(mesh, method, steps=2)
    np.testing.assert_allclose(result.mesh.points, alone.mesh.points, atol=1e-9)
    assert len(result.history) == len(alone.history)
    for one, other in zip(result.history, alone.history, strict=True):
        assert one.statistics.below == other.statistics.below
        assert one.statistics.q_avg == pytest.approx(other.statistics.q_avg, abs=1e-9)
        assert one.statistics.q_std == pytest.approx(other.statistics.q_std, abs=1e-9)
    for q, nodes in zip(result.quality, mesh.connectivity, strict=True):
        assert len(q) == len(nodes)


def test_statistics_are_those_of_the_elements_alone():
    mesh = grid("tetra", (2, 2, 2))
    q = np.concatenate(js.quality(mesh))
    corner = np.concatenate(js.quality(mesh, metric="scaled_jacobian"))
    found = js.statistics(mesh)
    expected = q.min(), q.max(), q.mean(), q.std(ddof=1), corner.min()
    given = found.q_min, found.q_max, found.q_avg, found.q_std, found.scaled_jacobian_min
    np.testing.assert_allclose(given, expected, rtol=1e-12)
    assert (found.below, found.inverted) == (int((q < 0.2).sum()), 0)


def test_a_second_mesh_of_about_the_size_compiles_nothing():
    js.smooth(grid("triangle", (7, 6)), steps=1)
    _COMPILED.clear()
    mesh = grid("triangle", (9, 5), seed=3)
    assert padded(mesh).elements != padded(grid("triangle", (7, 6))).elements
    result = js.smooth(mesh, steps=1)
    assert result.history[-1].statistics.q_avg > result.history[0].statistics.q_avg
    # JAX compiles a copy for every new shape that comes from the host, in milliseconds
    assert set(_COMPILED) <= {"jit(stage)"}
