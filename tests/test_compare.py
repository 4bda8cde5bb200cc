"""Methods side by side: rows as they come, and which method is advised."""

import json

import meshes
import meshio
import pytest
from test_answers import WIDTH

from jaxsmooth import choices
from jaxsmooth.cli import main
from jaxsmooth.report.compared import recommend


def row(name, inverted, poor, average, seconds):
    numbers = {"q_min": 0.1, "q_avg": average, "q_below_0.2": poor, "inverted": inverted}
    return {"method": name, "all": numbers, "seconds": seconds, "compile_seconds": 12.0}


INPUT = row("input", 0, 10, 0.70, 0.0)


@pytest.mark.parametrize(
    ("rows", "best", "hurry"),
    [
        ([row("a", 0, 5, 0.80, 1.0), row("b", 0, 4, 0.75, 1.5)], "b", None),  # poor ones before the average
        ([row("a", 1, 0, 0.90, 1.0), row("b", 0, 9, 0.71, 1.5)], "b", None),  # validity before all
        ([row("a", 0, 5, 0.8002, 3.0), row("b", 0, 5, 0.8, 2.0)], "b", None),  # close: the quicker one
        ([row("a", 0, 5, 0.802, 3.0), row("b", 0, 5, 0.8, 2.0)], "a", None),
        ([row("a", 0, 4, 0.80, 3.0), row("b", 0, 5, 0.80, 1.0), row("c", 0, 6, 0.80, 0.1)], "a", "b"),
        ([row("a", 0, 4, 0.80, 3.0), row("b", 2, 0, 0.99, 0.1)], "a", None),  # in no hurry to spoil the mesh
        ([row("a", 0, 10, 0.70, 1.0), row("b", 0, 11, 0.9, 1.0), row("c", 3, 0, None, 1.0)], "input", None),
        ([row("a", 0, 10, 0.7005, 2.0), row("b", 0, 10, 0.6999, 1.0)], "a", None),  # close, but b harms
        ([], "input", None),
    ],
)
def test_which_method_is_advised(rows, best, hurry):
    name, words = recommend([INPUT, *rows])
    assert name == best
    assert words[0].startswith("Take none" if best == "input" else f"Take {best}: ")
    assert len(words) == 1 + (hurry is not None)
    if hurry:
        assert words[1].startswith(f"In a hurry: {hurry} takes 1.00 s and leaves 5 below")


def test_the_advice_has_reasons_and_costs():
    tangled = row("input", 3, 10, 0.70, 0.0)
    _, (words,) = recommend([tangled, row("optimize", 0, 4, 0.81234, 3.0)])
    assert words == (
        "Take optimize: 0 inverted elements (3 before), 4 below q = 0.2 (10 before), q_avg 0.8123 (0.7); "
        "it takes 3.00 s, once compiled in 12.0 s."
    )


def test_rows_are_printed_as_they_come(tmp_path, capsys, monkeypatch):
    part, numbers, seen, ran = tmp_path / "part.vtu", tmp_path / "c.json", [], choices.run_method
    meshio.write(part, meshio.Mesh(*meshes.grid("tetra", (3, 3, 3), 0.2)))

    def run(*given):
        seen.append(capsys.readouterr().out)
        return ran(*given)

    monkeypatch.setattr(choices, "run_method", run)
    names = "elastic,laplacian"
    assert main(["compare", str(part), "--methods", names, "--steps", "1", "--json", str(numbers)]) == 0
    lines = [text.splitlines() for text in (*seen, capsys.readouterr().out)]
    assert lines[0][-1].startswith("input  ")
    assert [line.split()[0] for line in lines[1]] == ["elastic"]
    assert lines[2][0].startswith("laplacian  ")
    assert all(len(line) <= WIDTH for part in lines[1:] for line in part if "wrote" not in line)
    content = json.loads(numbers.read_text())
    assert content["best"] in ("elastic", "laplacian")
    assert content["advice"][0].startswith(f"Take {content['best']}: ")
    assert lines[2][-2].endswith(content["advice"][-1][-20:])
