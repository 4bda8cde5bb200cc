"""What is known is not computed again: facets of a topology, the evaluation of a mesh."""

import jax
import meshes
import numpy as np

import jaxsmooth as js
from jaxsmooth.mesh import topology
from jaxsmooth.mesh.memory import Remembered
from jaxsmooth.metrics import summary


def square():
    points, blocks = meshes.grid("triangle", (4, 4), 0.25)
    return js.Mesh(points, blocks)


def test_facets_are_found_once_for_a_topology(monkeypatch):
    calls = []
    find = topology._find_facets
    monkeypatch.setattr(topology, "_find_facets", lambda mesh: calls.append(1) or find(mesh))
    mesh = square()
    topology.find_facets(mesh)
    topology.find_facets(mesh.with_points(mesh.points + 1))
    js.detect_constraints(mesh)
    assert len(calls) == 1
    topology.find_facets(square())
    assert len(calls) == 2


def test_one_smooth_with_report_and_json_evaluates_a_mesh_once_a_step(monkeypatch, tmp_path):
    from jaxsmooth.report import page, report

    evaluations = []
    evaluate = summary._evaluate
    monkeypatch.setattr(summary, "_evaluate", lambda mesh: evaluations.append(1) or evaluate(mesh))
    mesh = square()
    result = js.smooth(mesh, steps=2, tolerance_avg=0)
    page.write_html(tmp_path / "report.html", "square", mesh, result)
    report.as_json("in", "out", "elastic", result, {})
    assert len(evaluations) == 1  # of the input; steps evaluate what they make


def test_a_result_lives_as_long_as_its_arrays():
    known, made = Remembered(), []
    array = np.zeros(3)
    for _ in range(2):
        known.get([array], lambda: made.append(1) or len(made))
    assert made == [1]
    other = np.zeros(3)
    known.get([other], lambda: made.append(1) or len(made))
    assert made == [1, 1]
    del array
    known.get([other], lambda: made.append(1) or len(made))
    assert made == [1, 1]


def test_traced_points_are_no_key():
    mesh = square()
    found = jax.jit(lambda points: js.evaluate(mesh.with_points(points)).quality[0])(mesh.points)
    np.testing.assert_allclose(found, js.quality(mesh)[0], rtol=1e-12)
