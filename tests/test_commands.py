"""Commands of the command line: facts of a file, several inputs, nodes named in words."""

from __future__ import annotations

import json
import subprocess
import sys

import meshes
import meshio
import numpy as np
import pytest

import jaxsmooth as js
from jaxsmooth.cli import main
from jaxsmooth.convert.chosen import chosen_nodes


def tags(points, triangles):
    """Material of the elements, 3 on the left and 5, and zone 7 in a corner."""
    x, y = np.asarray(points)[np.asarray(triangles)][..., :2].mean(axis=1).T
    return np.where(x < 0.5, 3, 5), np.where((x < 0.4) & (y < 0.4), 7, 0)


def file_tags(path):
    return meshio.read(path).cell_data["material"][0]


def run(*words):
    return main([str(word) for word in words])


@pytest.fixture(scope="module")
def part(tmp_path_factory):
    """A jiggled plate of 72 triangles, half of them of material 5."""
    path = tmp_path_factory.mktemp("in") / "part.vtu"
    points, blocks = meshes.grid("triangle", (6, 6))
    material, zone = tags(points, blocks["triangle"])
    points = np.c_[meshes.jiggle(points, 0.04, 1), np.zeros(len(points))]
    data = {"material": [material], "zone": [zone.astype(float)]}
    ids = {"id": np.arange(len(points)) * 10}
    meshio.Mesh(points, list(blocks.items()), cell_data=data, point_data=ids).write(path)
    return path


def test_info_says_what_the_file_holds(part, tmp_path, capsys):
    assert run("info", part, "--json", tmp_path / "a.json") == 0
    text, row = capsys.readouterr().out, json.loads((tmp_path / "a.json").read_text())
    mesh = js.read(part).mesh
    q = np.concatenate(js.quality(mesh))
    assert row["nodes"] == len(mesh.points)
    assert row["elements"] == {"triangle": len(mesh.connectivity[0])}
    assert row["bounds"] == [[0, 0, 0], [1, 1, 0]]
    material = file_tags(part)
    assert sorted(row["regions"].values()) == sorted(np.unique(material, return_counts=True)[1].tolist())
    assert row["point_data"] == {"id": "int64"}
    assert row["quality"]["q_min"] == pytest.approx(q.min(), rel=1e-12)
    # four corners; the interface's end is one of a straight side
    assert row["node_freedom"]["held: edge or corner"] >= 4
    assert sum(row["node_freedom"].values()) == len(mesh.points)
    assert "material (int64)" in text
    long = [line for line in text.splitlines() if len(line.rstrip()) > 80]
    assert [line for line in long if not line.startswith(("wrote", str(part)))] == []


def test_several_inputs_and_one_that_fails(part, tmp_path, capsys):
    folder = tmp_path / "in"
    folder.mkdir()
    for name in ("a.vtu", "b.vtu"):
        (folder / name).write_bytes(part.read_bytes())
    (folder / "broken.vtu").write_text("no mesh")
    (folder / "notes.txt").write_text("no mesh either, and no name of one")
    words = ("--steps", 1, "--json", tmp_path / "all.json")
    assert run("smooth", folder, "--out-dir", tmp_path / "out", *words) == 4
    said = capsys.readouterr()
    assert said.err.count("broken.vtu") == 1
    assert "2 of 3 files written" in said.out
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == ["a.vtu", "b.vtu"]
    assert run("smooth", part, tmp_path / "alone.vtu", "--steps", 1) == 0
    assert (tmp_path / "out" / "a.vtu").read_bytes() == (tmp_path / "alone.vtu").read_bytes()
    rows = json.loads((tmp_path / "all.json").read_text())["files"]
    assert [row["output"] is None for row in rows] == [False, False, True]
    assert "error" in rows[2]


def test_several_inputs_are_checked_before_the_work(part, tmp_path, capsys):
    twin = tmp_path / "part.vtu"
    twin.write_bytes(part.read_bytes())
    assert run("smooth", part, twin, "--out-dir", tmp_path / "out") == 2
    assert "several inputs would be written there" in capsys.readouterr().err
    assert run("smooth", part, twin, tmp_path / "x.vtu") == 2
    assert "--out-dir" in capsys.readouterr().err
    (tmp_path / "empty").mkdir()
    assert run("smooth", tmp_path / "empty", "--out-dir", tmp_path / "out") == 2
    assert "no file in this folder" in capsys.readouterr().err
    assert run("smooth", twin, "--out-dir", tmp_path) == 2
    assert "--force" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_nodes_named_in_words(part):
    file = js.read(part)
    triangles = np.asarray(file.mesh.connectivity[0])
    chosen = np.zeros(len(file.mesh.points), bool)
    chosen[triangles[file_tags(part) == 3]] = True
    assert (chosen_nodes(file, "material=3") == chosen).all()
    assert chosen_nodes(file, "material=3,5").all()
    assert np.flatnonzero(chosen_nodes(file, "id=20")).tolist() == [2]
    assert np.flatnonzero(chosen_nodes(file, "1-3,5")).tolist() == [1, 2, 3, 5]
    for word, said in {
        "materia=3": "did you mean material",
        "material=9": "nothing in the file has this tag",
        "material=x": "a tag is a number",
        "3-900": "the file has nodes 0 to",
        "walls": "unknown set 'walls'",
    }.items():
        with pytest.raises(ValueError, match=said):
            chosen_nodes(file, word)


def test_held_nodes_stay_and_the_format_is_the_one_asked_for(part, tmp_path, capsys):
    words = ("smooth", part, tmp_path / "out.vtk", "--fix", "zone=7", "--steps", 2)
    assert run(*words, "--format", "vtk:ascii", "--quality-data", "--json", tmp_path / "a.json") == 0
    assert "by an option" in capsys.readouterr().out
    before, after = js.read(part), js.read(tmp_path / "out.vtk")
    held = chosen_nodes(before, "zone=7")
    move = np.abs(np.asarray(after.mesh.points - before.mesh.points)).max(axis=1)
    assert move[held].max() == 0 < move.max()
    assert b"\nASCII\n" in (tmp_path / "out.vtk").read_bytes()
    q = np.concatenate(js.quality(after.mesh))
    np.testing.assert_allclose(np.concatenate(after.source.cell_data["shape"]), q, rtol=1e-12)
    assert run(*words, "--format", "vtx") == 2
    assert "did you mean" in capsys.readouterr().err


def test_poor_elements_are_named_with_what_holds_them(tmp_path, capsys):
    points = [[0, 0, 0], [1, 0, 0], [0.5, 0.02, 0], [0.5, 1, 0]]
    meshio.Mesh(np.array(points, float), [("triangle", [[0, 1, 2], [1, 3, 2], [3, 0, 2]])]).write(
        tmp_path / "in.vtu"
    )
    words = ("smooth", tmp_path / "in.vtu", tmp_path / "out.vtu", "--fix", "0-3")
    assert run(*words, "--json", tmp_path / "a.json") == 0
    text, row = capsys.readouterr().out, json.loads((tmp_path / "a.json").read_text())
    (worst,) = row["worst"]
    assert (worst["type"], worst["element"]) == ("triangle", 0)
    np.testing.assert_allclose(worst["place"], np.mean(points[:3], axis=0), atol=1e-12)
    assert "most nodes are held" in text
    assert "leave out --fix" in text or "--feature-angle" in text


@pytest.mark.parametrize("words", [("smooth", "--stepz", "3", "a", "b"), ("info", "nowhere.vtu")])
def test_mistakes_are_answered_without_jax(words):
    code = (
        "import sys, jaxsmooth.cli as c\n"
        f"try: c.main({list(words)!r})\nexcept SystemExit: pass\n"
        "sys.exit('jax' in sys.modules or 'meshio' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], capture_output=True).returncode == 0
