"""The command line, run as its user runs it; most calls in this process, to share compiles."""

import csv
import json
import os
import subprocess
import sys
import time

import meshio
import numpy as np
import pytest
from meshes import grid, mixed_2d

import jaxsmooth as js
from jaxsmooth.cli import main
from jaxsmooth.metrics.table import METRICS
from jaxsmooth.report import quality as quality_report


@pytest.fixture(scope="module")
def part(tmp_path_factory):
    """A small mesh file with point data, cell data and a named set."""
    path = tmp_path_factory.mktemp("cli") / "part.vtu"
    points, blocks = grid("tetra", (2, 2, 2), amplitude=0.1)
    count = len(blocks["tetra"])
    meshio.Mesh(
        points,
        list(blocks.items()),
        point_data={"temperature": np.arange(len(points), dtype=float)},
        cell_data={"material": [np.ones(count, dtype=np.int64)]},
    ).write(path)
    return path


def run(*arguments):
    return main([str(a) for a in arguments])


def test_smooth_writes_everything_back(part, tmp_path, capsys):
    out, numbers, report = tmp_path / "out.vtu", tmp_path / "out.json", tmp_path / "out.html"
    assert run("smooth", part, out, "--steps", 2, "--json", numbers, "--report", report) == 0
    old, new = meshio.read(part), meshio.read(out)
    assert (old.cells_dict["tetra"] == new.cells_dict["tetra"]).all()
    assert (old.point_data["temperature"] == new.point_data["temperature"]).all()
    assert (old.cell_data["material"][0] == new.cell_data["material"][0]).all()
    assert np.abs(old.points - new.points).max() > 1e-3
    on_side = (old.points == 0) | (old.points == 1)
    assert np.abs(new.points - old.points)[on_side].max() < 1e-12

    text = capsys.readouterr().out
    assert "step  2" in text
    assert "q < 0.2" in text
    content = json.loads(numbers.read_text())
    assert content["method"] == "elastic"
    assert content["precision"] == "float64"
    assert content["elements"] == {"tetra": len(old.cells_dict["tetra"])}
    assert content["status"] in ("converged", "step limit")
    assert {"q_min", "q_avg", "q_below_0.2", "inverted", "scaled_jacobian_min"} <= content["steps"][0].keys()
    assert content["steps"][-1]["q_avg"] > content["steps"][0]["q_avg"]
    assert content["seconds"].keys() == {"read", "constraints", "compile", "smooth", "write"}
    page = report.read_text()
    assert '<script id="scene"' in page
    assert "movable after" in page
    assert sorted(p.name for p in tmp_path.iterdir()) == ["out.html", "out.json", "out.vtu"]


def test_fixed_boundary_and_quiet(part, tmp_path, capsys):
    out = tmp_path / "out.vtu"
    assert run("smooth", part, out, "--steps", 2, "--boundary", "fixed", "-q") == 0
    assert capsys.readouterr().out == ""
    old, new = meshio.read(part).points, meshio.read(out).points
    outer = ((old == 0) | (old == 1)).any(axis=1)
    assert (old[outer] == new[outer]).all()
    assert (old[~outer] != new[~outer]).any()


def test_fix_names_a_set(part, tmp_path, capsys):
    mesh = meshio.read(part)
    mesh.point_sets = {}
    mesh.point_data["CLAMP"] = (mesh.points[:, 0] < 0.6).astype(np.int64)
    source, out = tmp_path / "in.vtu", tmp_path / "out.vtu"
    mesh.write(source)
    assert run("smooth", source, out, "--steps", 1, "--fix", "CLAMP", "-q") == 0
    held = mesh.points[:, 0] < 0.6
    assert (meshio.read(out).points == mesh.points)[held].all()
    assert run("smooth", source, out, "--fix", "CLAMPS") == 2
    assert "did you mean CLAMP?" in capsys.readouterr().err


def test_quality(part, tmp_path, capsys):
    assert run("quality", part, "--metric", "shape", "--json", "-") == 0
    content = json.loads(capsys.readouterr().out)
    q = np.concatenate(js.quality(js.read(part).mesh))
    (row,) = content["quality"]
    np.testing.assert_allclose([row["min"], row["avg"]], [q.min(), q.mean()])
    assert row["metric"] == "shape"
    assert run("quality", part) == 0
    assert "mean_ratio" in capsys.readouterr().out


def test_quality_of_every_element(tmp_path, capsys):
    points, blocks = mixed_2d(0.1)
    cells = [*((name, nodes) for name, nodes in blocks.items())]
    source = tmp_path / "in.vtu"
    meshio.Mesh(np.c_[points, np.full(len(points), 2.0)], cells).write(source)
    table, data = tmp_path / "q.csv", tmp_path / "q.vtu"
    words = ("--metric", "max_angle", "taper,shape", "--csv", table, "--quality-data", data)
    assert run("quality", source, *words) == 0
    out = capsys.readouterr().out
    assert f"wrote {table}, {data}" in out
    assert (
        max(len(line) for line in out.splitlines()[1:] if "wrote" not in line and "note:" not in line) <= 80
    )
    file = js.read(source)
    with table.open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert list(rows[0]) == ["type", "element", "region", "x", "y", "z", "max_angle", "taper", "shape"]
    written = meshio.read(data)
    for name, nodes in blocks.items():
        mine = [row for row in rows if row["type"] == name]
        assert [int(row["element"]) for row in mine] == list(range(len(nodes)))
        centres = [[float(row[axis]) for axis in "xyz"] for row in mine]
        np.testing.assert_allclose(centres, np.c_[points[nodes].mean(axis=1), np.full(len(nodes), 2.0)])
        for metric in ("max_angle", "taper", "shape"):
            expected = np.asarray(js.quality(file.mesh, metric)[file.mesh.types.index(name)])
            found = [float(row[metric] or "nan") for row in mine]
            np.testing.assert_allclose(found, expected)
            np.testing.assert_allclose(written.cell_data_dict[metric][name], expected)
    # the worst by the first metric, the one with the greatest angle
    worst = max(rows, key=lambda row: float(row["max_angle"]))
    line = out.split("worst by max_angle")[1].splitlines()[1].split()
    assert line[:2] == [worst["type"], worst["element"]]
    assert float(line[2]) == pytest.approx(float(worst["max_angle"]), rel=1e-3)
    assert "at (" + ", ".join(f"{float(worst[a]):.6g}" for a in "xyz") + ")" in out


def test_quality_all(part, capsys):
    assert run("quality", "--metric", "all", part) == 0  # the file may come last
    out = capsys.readouterr().out
    assert "min_dihedral_angle" in out or "max_angle" in out
    assert max(len(line) for line in out.splitlines()[1:] if "note:" not in line) <= 80
    assert run("quality", "--metric", "shape") == 2
    assert "needs a mesh file" in capsys.readouterr().err


@pytest.mark.parametrize("option", ["--csv", "--quality-data", "--json"])
def test_quality_does_not_replace_its_input(part, option, capsys):
    before = part.read_bytes()
    assert run("quality", part, "--metric", "shape", option, part) == 2
    assert part.read_bytes() == before


def test_histogram():
    values = np.array([-0.3, 0.0, 0.05, 0.1, 0.11, 1.0, np.nan])
    rows = quality_report.histogram(METRICS["shape"], values)
    assert rows[0] == ("≤ 0", 2)  # closed on the right
    assert [count for _, count in rows[1:]] == [2, 1, 0, 0, 0, 0, 0, 0, 0, 1]
    rows = quality_report.histogram(METRICS["aspect_ratio"], np.array([1.0, 2.0, 11.0, np.inf]))
    assert [count for _, count in rows] == [2, 0, 0, 0, 0, 0, 0, 0, 0, 1, 1]
    assert rows[-1][0] == "> 11"


def test_compare(part, tmp_path, capsys):
    numbers = tmp_path / "c.json"
    assert (
        run("compare", part, "--methods", "elastic,weighted-laplacian", "--steps", 2, "--json", numbers) == 0
    )
    rows = json.loads(numbers.read_text())["methods"]
    assert [row["method"] for row in rows] == ["input", "elastic", "weighted-laplacian"]
    assert rows[1]["all"]["q_avg"] > rows[0]["all"]["q_avg"]
    assert "weighted-laplacian" in capsys.readouterr().out


def test_inverted_elements_give_exit_code_3(tmp_path, capsys):
    points = np.array([[0, 0], [2, 0], [1, 1.0], [1, -1]])
    meshio.Mesh(np.c_[points, np.zeros(4)], [("triangle", [[0, 1, 2], [0, 1, 3], [1, 2, 3]])]).write(
        tmp_path / "in.vtk"
    )
    assert run("quality", tmp_path / "in.vtk") == 3
    capsys.readouterr()
    assert run("smooth", tmp_path / "in.vtk", tmp_path / "out.vtk", "--steps", 0) == 3
    assert "inverted elements remain; wrote" in capsys.readouterr().out
    assert run("smooth", tmp_path / "in.vtk", tmp_path / "out.vtk", "--steps", 0, "-q") == 3
    assert "inverted elements remain" in capsys.readouterr().err
    assert (tmp_path / "out.vtk").exists()


def history(part, out, *options):
    numbers = out.with_suffix(".json")
    assert run("smooth", part, out, "-q", "--json", numbers, "--method", "laplacian", *options) == 0
    return json.loads(numbers.read_text())["steps"]


def test_steps_are_exact(part, tmp_path):
    steps = len(history(part, tmp_path / "a.vtu")) - 1
    assert 2 < steps < 9  # it converges
    rows = history(part, tmp_path / "b.vtu", "--steps", 9)
    assert len(rows) - 1 == 9
    assert rows[9]["q_avg"] != rows[8]["q_avg"]
    assert len(history(part, tmp_path / "c.vtu", "--steps", 0)) == 1


class Enough(Exception):
    """Ends a run when the test has seen what it wants."""


def arguments_of(monkeypatch, name, *command):
    """What a function of the library is called with; it does nothing."""
    seen = []

    def record(*args, **kwargs):
        seen.append((args, kwargs))
        raise Enough

    with monkeypatch.context() as patch:
        patch.setattr(name, record)
        with pytest.raises(Enough):
            run(*command)
    return seen[0]


def test_the_goal_reaches_the_method(part, tmp_path, monkeypatch):
    smooth = ("smooth", part, tmp_path / "out.vtu", "--method", "optimize")
    for command, goal in [
        ((*smooth, "--goal", "worst"), "worst"),
        ((*smooth, "--goal", "average"), "average"),
        (smooth, "balanced"),
        (("compare", part, "--methods", "optimize, elastic", "--goal", "worst"), "worst"),
    ]:
        (_, method), _ = arguments_of(monkeypatch, "jaxsmooth.runs.driver.smooth", *command)
        assert method == js.Optimize(goal=goal)
    with pytest.raises(SystemExit) as end:
        run(*smooth, "--goal", "best")
    assert end.value.code == 2


def test_freezing_reaches_the_constraints(part, tmp_path, monkeypatch):
    detect = "jaxsmooth.motion.detect.detect_constraints"
    smooth = ("smooth", part, tmp_path / "out.vtu")
    assert "freeze_aspect" not in arguments_of(monkeypatch, detect, *smooth)[1]
    for command in (smooth, ("compare", part)):
        assert arguments_of(monkeypatch, detect, *command, "--freeze-aspect", 20)[1]["freeze_aspect"] == 20


BAD = [
    (("smooth", "nowhere.vtu", "OUT"), "nowhere.vtu"),
    (("smooth", "PART", "nofolder/out.vtu"), "nofolder"),
    (("smooth", "PART", "PART"), "--force"),
    (("smooth", "PART", "out.what"), ".what"),
    (("smooth", "PART", "OUT", "--method", "elastc"), "did you mean elastic"),
    (("smooth", "PART", "OUT", "--fix", "nothing"), "nothing"),
    (("smooth", "PART", "OUT", "--fix", "fixed"), "unknown set 'fixed'"),
    (("smooth", "PART", "OUT", "--steps", "-1"), "steps"),
    (("smooth", "PART", "OUT", "--json", "nofolder/x.json"), "nofolder"),
    (("smooth", "PART", "OUT", "--goal", "worst"), "--goal is for the method optimize, not for elastic"),
    (("compare", "PART", "--methods", "elastic", "--goal", "worst"), "add it to --methods"),
    (("smooth", "PART", "OUT", "--freeze-aspect", "1"), "above 1"),
    (("compare", "PART", "--freeze-aspect", "nan"), "above 1"),
    (("smooth", "PART", "OUT", "--feature-angle", "nan"), "--feature-angle"),
    (("quality", "PART", "--metric", "mean_ration"), "did you mean mean_ratio"),
    (("compare", "PART", "--methods", "elastic,laplaciun"), "did you mean laplacian"),
]


@pytest.mark.parametrize(
    ("arguments", "expected"), BAD, ids=lambda x: None if isinstance(x, str) else " ".join(x)
)
def test_bad_input_is_one_sentence(arguments, expected, part, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    before = part.read_bytes()
    names = {"PART": str(part), "OUT": str(tmp_path / "out.vtu")}
    assert run(*(names.get(a, a) for a in arguments)) == 2
    error = capsys.readouterr().err
    assert error.startswith("jaxsmooth: ")
    assert error.count("\n") == 1
    assert expected in error
    assert list(tmp_path.iterdir()) == []
    assert part.read_bytes() == before


BROKEN = {
    "nan": (lambda p, c: (np.where(np.arange(len(p))[:, None] == 3, np.nan, p), c), "node 3"),
    "range": (lambda p, c: (p, np.where(c == 5, 99, c)), "99"),
    "twice": (lambda p, c: (p, np.c_[c[:, :3], c[:, 2]]), "twice"),
}


@pytest.mark.parametrize("fault", BROKEN)
def test_broken_meshes(fault, tmp_path, capsys):
    points, blocks = grid("tetra", (1, 1, 1))
    change, expected = BROKEN[fault]
    points, nodes = change(points, blocks["tetra"])
    np.savez(tmp_path / "in.npz", points=points, tetra=nodes)
    assert run("smooth", tmp_path / "in.npz", tmp_path / "out.npz") == 2
    assert expected in capsys.readouterr().err
    assert not (tmp_path / "out.npz").exists()


def test_help_does_not_load_jax():
    code = "import sys, jaxsmooth.cli as c\ntry: c.main(['smooth', '--help'])\nexcept SystemExit: pass\n"
    code += "assert 'jax' not in sys.modules and 'numpy' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True, stdout=subprocess.DEVNULL)
    times = []
    for _ in range(3):
        start = time.perf_counter()
        subprocess.run([sys.executable, "-m", "jaxsmooth", "--help"], check=True, stdout=subprocess.DEVNULL)
        times.append(time.perf_counter() - start)
    assert min(times) < 3.0  # 0.06 s on an idle machine; the bound only catches an import of JAX


def test_the_help_names_every_method():
    from jaxsmooth.methods import METHODS
    from jaxsmooth.options import METHODS as NAMES

    assert NAMES.split(", ") == list(METHODS)


def test_the_help_says_the_defaults():
    from jaxsmooth.methods.optimize.goals import GOALS
    from jaxsmooth.options import GOALS as NAMES
    from jaxsmooth.options import parser

    assert list(GOALS) == list(NAMES)
    (commands,) = (a.choices for a in parser()._actions if a.choices)
    for command in commands.values():
        options = [a for a in command._actions if (a.option_strings or a.nargs == "?") and a.dest != "help"]
        assert [a.dest for a in options if "(default: " not in (a.help or "")] == []
        for action in options:
            if isinstance(action.default, str):
                assert f"(default: {action.default})" in action.help


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_a_folder_that_is_read_only(part, tmp_path, capsys):
    tmp_path.chmod(0o500)
    assert run("smooth", part, tmp_path / "out.vtu") == 2
    assert "out.vtu" in capsys.readouterr().err


def test_demo(tmp_path, capsys):
    assert run("demo", tmp_path / "demo") == 0
    names = {p.name for p in (tmp_path / "demo").iterdir()}
    assert names == {"bracket-smooth.vtu", "before-after.png", "report.html"}
    q = np.concatenate(js.quality(js.read(tmp_path / "demo" / "bracket-smooth.vtu").mesh))
    assert (q < 0.2).sum() < 30  # 309 before
    assert "scaled Jacobian" in capsys.readouterr().out
