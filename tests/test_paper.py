"""The paper's examples: what they start from, and that the command writes what it says."""

import numpy as np
import pytest

pytest.importorskip("scipy")
pytest.importorskip("matplotlib")

from benchmarks.paper import tables
from benchmarks.paper.__main__ import main
from benchmarks.paper.examples import EXAMPLES, quality_values, run, runnable
from benchmarks.paper.printed import ELEMENTS, EVOLUTION, SHAPES
from jaxsmooth.mesh.record import Mesh
from jaxsmooth.motion.detect import detect_constraints

BUILT = {key: Mesh(*EXAMPLES[key].build()) for key in EXAMPLES if not EXAMPLES[key].needs_gmsh}


@pytest.mark.parametrize("key", ["1", "2", "3", "4"])
def test_initial_statistics(key):
    q = quality_values(BUILT[key])
    q_min, _, q_avg, deviation = EVOLUTION[key][0]
    found = (q.min(), q.mean(), q.std(ddof=1))
    np.testing.assert_allclose(found, (q_min, q_avg, deviation), atol=0.03 if key == "4" else 0.02)


def test_initial_extruded():
    q = quality_values(BUILT["3-extruded"])
    np.testing.assert_allclose((q.min(), q.mean()), (0.525, 0.884), atol=0.01)


def test_hexahedra():
    mesh = BUILT["4"]
    assert len(mesh.connectivity[0]) == ELEMENTS["4"]
    freedom = np.bincount(detect_constraints(mesh).freedom, minlength=4)
    assert freedom[0] > 0  # corners of the solid
    assert freedom[1] > 0  # nodes of straight edges and of the arched underside slide along a line
    assert freedom[2] > 0
    assert freedom[3] > 0


def test_quadratic_variant_is_the_same_mesh():
    linear, curved = BUILT["2"], BUILT["2-quadratic"]
    assert curved.types == ("triangle6", "quad8")
    np.testing.assert_allclose(quality_values(curved), quality_values(linear), atol=1e-12)


def test_metric_tables_agree():
    """All thirty rows: 6 + 7 and 6 + 6 + 5, four shapes each."""
    first, second = tables.metrics()
    rows = [*first.rows, *second.rows]
    kinds = [row[0] for row in rows]
    assert [kinds.count(kind) for kind in SHAPES] == [6, 7, 6, 6, 5]
    assert {row[-1] for row in rows} == {"yes"}
    values = [cell for row in rows for cell in row[2:6]]
    assert len(values) == 120
    # the text says the same as the mark
    assert max(abs(float(cell[:5]) - float(cell[7:12])) for cell in values) < 2e-3


@pytest.mark.parametrize("key", ["1", "4"])
def test_printed_evolution_is_reached(key):
    outcome = next(run(EXAMPLES[key], BUILT[key]))
    table = tables.evolution(key, EXAMPLES[key].title, outcome)
    assert [row[-1] for row in table.rows] == ["–"] + ["yes"] * (len(table.rows) - 1)


def test_quick_needs_no_gmsh():
    assert [e.key for e in runnable(quick=True)] == list(BUILT)


def test_command(tmp_path, capsys):
    assert main(["--out", str(tmp_path), "--examples", "2"]) == 0
    written = {path.name for path in tmp_path.iterdir()}
    assert {"RESULTS.md", "table1.csv", "example2.csv", "fig10-example2.png", "timing.csv"} <= written
    text = (tmp_path / "RESULTS.md").read_text(encoding="utf-8")
    assert "### Example 2" in text
    assert "**no**" not in text
    assert "wrote" in capsys.readouterr().out


def test_unknown_example_is_refused(capsys):
    with pytest.raises(SystemExit):
        main(["--examples", "7"])
    assert "numbered 1 to 6" in capsys.readouterr().err
