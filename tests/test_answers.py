"""What the command line answers: mistakes, tags, what is held and by what, losses, within 80 columns."""

import json
import subprocess
import sys

import meshio
import numpy as np
import pytest
from meshes import grid

import jaxsmooth as js
from jaxsmooth.cli import main
from jaxsmooth.convert.chosen import chosen_nodes
from jaxsmooth.report.advice import advice
from jaxsmooth.report.holding import REASONS, Holding

WIDTH = 80


def run(*arguments):
    return main([str(a) for a in arguments])


@pytest.fixture(scope="module")
def part(tmp_path_factory):
    """A small mesh of triangles, with the tags of its left and its right half, and lines on its foot."""
    path = tmp_path_factory.mktemp("in") / "part.msh"
    points, blocks = grid("triangle", (3, 3), amplitude=0.15)
    triangles = blocks["triangle"]
    tags = np.where(points[triangles].mean(axis=1)[:, 0] < 0.5, 1, 2)
    foot = np.flatnonzero(points[:, 1] == 0)
    foot = foot[np.argsort(points[foot, 0])]
    lines = np.c_[foot[:-1], foot[1:]]
    marks = [tags, np.full(len(lines), 7)]
    mesh = meshio.Mesh(
        np.c_[points, 0 * points[:, 0]],
        [("triangle", triangles), ("line", lines)],
        cell_data={"gmsh:physical": marks, "gmsh:geometrical": marks},
    )
    mesh.field_data = {"LEFT": np.array([1, 2]), "RIGHT": np.array([2, 2]), "FOOT": np.array([7, 1])}
    meshio.write(path, mesh, file_format="gmsh22", binary=False)
    return path


WITHOUT_JAX = [
    (["smooth", "nowhere.msh", "out.msh"], "nowhere.msh: there is no such file"),
    (["quality", "--metric", "skew", "nowhere.msh"], "nowhere.msh: there is no such file"),
    (["smooth", "a.msh", "--boundry", "slide", "b.msh"], "unknown option --boundry; did you mean --boundary"),
    (["quality", "a.msh", "--quality-date", "b"], "did you mean --quality-data"),
    (["compare", "nowhere.msh", "--methods", "elastic,laplaciun"], "did you mean laplacian"),
    (["smooth", "a.msh"], "smooth needs IN and OUT, got 1 names; for several meshes add --out-dir DIR"),
    (["smooth", "/", "b.msh"], "this is a folder; to smooth all meshes in it add --out-dir"),
    (["info", "a.msh", "b.msh"], "one word too many, b.msh"),
]


def test_what_is_wrong_is_said_without_loading_jax():
    code = (
        "import sys, jaxsmooth.cli as c\n"
        f"for words in {[words for words, _ in WITHOUT_JAX]!r}:\n"
        "    try: code = c.main(words)\n"
        "    except SystemExit as end: code = end.code\n"
        "    assert code == 2, words\n"
        "assert 'jax' not in sys.modules and 'meshio' not in sys.modules"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    for _, text in WITHOUT_JAX:
        assert text in done.stderr


def test_names_may_stand_behind_options(part, tmp_path):
    assert run("smooth", part, "--steps", 0, tmp_path / "a.msh", "-q") == 0
    assert (tmp_path / "a.msh").read_bytes() == part.read_bytes()


def test_info_says_tags_and_orientation(part, tmp_path, capsys):
    points, blocks = grid("tetra", (1, 1, 1))
    nodes = blocks["tetra"].copy()
    nodes[:2, [0, 1]] = nodes[:2, [1, 0]]
    np.savez(tmp_path / "a.npz", points=points, tetra=nodes)
    assert run("info", tmp_path / "a.npz", "--json", "-") == 0
    content = json.loads(capsys.readouterr().out)
    assert content["reversed"] == {"tetra": 2}
    assert content["advice"]  # all eight nodes are corners
    assert run("info", part, "--json", tmp_path / "a.json") == 0
    content = json.loads((tmp_path / "a.json").read_text())
    assert content["reversed"] == {}
    tags = {(row["dimension"], row["tag"]): row["nodes"] for row in content["tags"]}
    assert tags.keys() == {(2, 1), (2, 2), (1, 7)}
    assert tags[1, 7] == 4
    assert "1:7 (4 nodes)" in capsys.readouterr().out


def test_nodes_by_dimension_and_tag(part):
    file = js.read(part)
    assert (chosen_nodes(file, "1:7") == (np.asarray(file.mesh.points)[:, 1] == 0)).all()
    assert (chosen_nodes(file, "2:1") == file.named_sets["LEFT"]).all()
    with pytest.raises(ValueError, match="the file has 2:1, 2:2, 1:7"):
        chosen_nodes(file, "2:7")


def test_every_reason_to_be_held_has_a_remedy():
    held = [k for k, name in enumerate(REASONS) if name.startswith("held")]
    assert len(advice(Holding(np.array(held, np.uint8)))) == len(held)
    free = np.zeros(100, np.uint8)
    free[: len(held)] = held
    assert advice(Holding(free)) == []


def test_worst_elements_with_their_place_and_what_holds_them(part, capsys):
    assert run("quality", part, "--metric", "shape", "--json", "-") == 0
    row = json.loads(capsys.readouterr().out)["worst"][0]
    file = js.read(part)
    nodes = np.asarray(file.mesh.connectivity[0])[row["element"]]
    np.testing.assert_allclose(row["place"], np.asarray(file.source.points)[nodes].mean(axis=0))
    assert row["value"] == pytest.approx(float(js.quality(file.mesh)[0].min()))
    assert sum(int(word.split()[0]) for word in row["nodes"].split(", ")) == 3


def test_losses_are_in_the_json_and_said_in_silence(part, tmp_path, capsys):
    for name, words in (("a.vtu", ()), ("a.msh", ("--quality-data",))):
        out, numbers = tmp_path / name, tmp_path / "a.json"
        assert run("smooth", part, out, "--steps", 1, "-q", "--json", numbers, *words) == 0
        losses = json.loads(numbers.read_text())["losses"]
        assert losses
        assert capsys.readouterr().err.splitlines() == [f"jaxsmooth: {out}: {note}" for note in losses]
    assert "because data are added" in losses[-1]


def test_the_format_of_the_input_is_copied_when_it_is_asked_for(part, tmp_path):
    for name, start in (("gmsh22", part.read_bytes()), ("gmsh:binary", b"$MeshFormat\n4.1 1")):
        assert run("smooth", part, tmp_path / "a.msh", "--format", name, "--steps", 0, "-q") == 0
        assert (tmp_path / "a.msh").read_bytes().startswith(start)


def test_tables_fit_80_columns(part, tmp_path, capsys):
    assert run("smooth", part, tmp_path / "a.msh", "--steps", 1, "--fix", "0-15") == 0
    assert run("compare", part, "--steps", 1, "--methods", "elastic,smart-weighted-laplacian") == 0
    assert run("quality", part) == 0
    assert run("info", part) == 0
    lines = [line for line in capsys.readouterr().out.splitlines() if str(tmp_path.parent) not in line]
    lines = [line.rstrip() for line in lines if "note:" not in line and not line.startswith("nodes:")]
    assert len(lines) > 40
    assert [line for line in lines if len(line) > WIDTH] == []
