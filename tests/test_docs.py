"""The pages in docs: their code runs, they have all public names, and what they link to is there."""

import os
import re
from importlib import import_module
from importlib.util import find_spec, module_from_spec, spec_from_file_location
from pathlib import Path

import jax
import meshes
import meshio
import numpy as np
import pytest
from test_curved import disc
from test_readme import ROOT

import jaxsmooth as js
from jaxsmooth.cli import main

DOCS = ROOT / "docs"
PAGES = sorted(str(path.relative_to(ROOT)) for path in DOCS.rglob("*.md"))


def layered():
    """A channel: three layers of flat cells on its floor, squares above, some of them crooked."""
    x, y = np.linspace(0, 1, 9), np.array([0, 0.004, 0.009, 0.016, 0.12, 0.25, 0.38, 0.5])
    points = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1)
    points[1:-1, 5:-1] += 0.02 * np.random.default_rng(0).normal(size=(7, 2, 2))
    number = np.arange(72).reshape(9, 8)
    corners = number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]
    return meshio.Mesh(points.reshape(-1, 2), {"quad": np.stack([c.ravel() for c in corners], axis=1)})


@pytest.fixture
def files(tmp_path, monkeypatch):
    """What the pages read."""
    points, cells = meshes.grid("tetra", (3, 3, 3), 0.2)
    solid = meshio.Mesh(np.asarray(points), cells)
    meshio.write(tmp_path / "part.msh", solid, file_format="gmsh22")
    solid.point_sets = {"BOLTS": np.flatnonzero(np.linalg.norm(solid.points - 0.5, axis=1) < 0.4)}
    meshio.write(tmp_path / "part.inp", solid)
    js.write(tmp_path / "layers.vtu", layered())
    js.write(tmp_path / "disc.vtu", disc("triangle", 3))
    rng = np.random.default_rng(0)
    points, cells = meshes.grid("tetra", (3, 3, 3), 0.0)
    cell = np.asarray(points).copy()
    cell[((cell > 0) & (cell < 1)).all(axis=1)] += 0.05
    js.write(tmp_path / "cell.vtu", (cell, cells))
    points, cells = meshes.grid("triangle", (5, 5), 0.15)
    js.write(tmp_path / "plate.vtu", (np.asarray(points), cells))
    points, cells = meshes.grid("triangle", (5, 5), 0.0)
    points = np.asarray(points).copy()
    inner = ((points > 0) & (points < 1)).all(axis=1)
    points[inner] += 0.25 * (rng.random((inner.sum(), 2)) - 0.5)
    js.write(tmp_path / "tangled.vtu", js.Mesh(points, cells))
    monkeypatch.chdir(tmp_path)


def follow(page):
    """Do what a page says, Python and commands in their order; returns the names that it made."""
    names, text = {}, (ROOT / page).read_text()
    for kind, code in re.findall(r"^```(python|sh)\n(.*?)^```$", text, re.M | re.S):
        if kind == "python":
            line = text[: text.index(code)].count("\n")
            exec(compile("\n" * line + code, str(ROOT / page), "exec"), names)
        for command in code.splitlines() if kind == "sh" else ():
            if command.startswith("jaxsmooth "):
                assert main(command.split()[1:]) in (0, 3)  # 3: inverted elements are left
    return names


# --- Five tasks, done by what their pages say ----------------------------------------------------------


def test_task_smooth_my_file(files):
    follow("docs/index.md")
    before, after = (meshio.read(name) for name in ("part.msh", "part-smooth.vtu"))
    np.testing.assert_array_equal(before.cells_dict["tetra"], after.cells_dict["tetra"])
    moved = np.linalg.norm(after.points - before.points, axis=1) > 1e-6
    outer = (np.isclose(before.points, 0) | np.isclose(before.points, 1)).sum(axis=1)
    assert moved.any()
    assert not moved[outer == 3].any()
    assert "<html" in Path("report.html").read_text()


def test_task_keep_the_layer(files):
    found = follow("docs/how/layers.md")
    before, after = meshio.read("layers.vtu").points, np.asarray(found["result"].mesh.points)
    low = before[:, 1] < 0.02
    assert low.sum() == 36
    np.testing.assert_array_equal(after[low], before[low, :2])
    assert np.abs(after - before[:, :2]).max() > 1e-3


def test_task_a_periodic_cell(files):
    follow("docs/how/periodic.md")
    before, after = (meshio.read(name).points for name in ("cell.vtu", "cell-smooth.vtu"))
    left, right = (np.flatnonzero(np.isclose(before[:, 0], x)) for x in (0, 1))
    left, right = (part[np.lexsort(before[part][:, 1:].T)] for part in (left, right))
    np.testing.assert_allclose(after[left, 1:], after[right, 1:], atol=1e-6)
    assert np.abs(after - before).max() > 1e-3


def test_task_the_gradient_of_my_objective(files):
    found = follow("docs/how/gradients.md")
    points, objective = found["mesh"].points, jax.jit(found["objective"])
    direction = np.random.default_rng(0).normal(size=points.shape)
    expected = (objective(points + 1e-5 * direction) - objective(points - 1e-5 * direction)) / 2e-5
    np.testing.assert_allclose(np.vdot(found["gradient"], direction), expected, rtol=1e-5)


def test_task_choose_a_method(files, capsys):
    follow("docs/how/methods.md")
    said = capsys.readouterr().out
    assert re.search(r"^Take [a-z-]+: .*q_avg", said, re.M)


TASKS = ("docs/index.md", *(f"docs/how/{name}.md" for name in ("layers", "periodic", "gradients", "methods")))


@pytest.mark.parametrize(
    "page", [page for page in PAGES if "```python" in (ROOT / page).read_text() and page not in TASKS]
)
def test_the_code_of_the_pages_runs(page, files):
    if "libraries" in page:
        for name in ("pyvista", "skfem", "gmsh"):
            pytest.importorskip(name)
    names = follow(page)
    for name in ("gradient", "result"):
        for leaf in jax.tree.leaves(getattr(names.get(name), "points", names.get(name))):
            if isinstance(leaf, jax.Array):
                assert bool(np.isfinite(np.asarray(leaf, float)).all())


def targets():
    return re.findall(r"^::: (\S+)$", (DOCS / "reference.md").read_text(), re.M)


def test_every_public_name_is_in_the_reference():
    found = [target.rpartition(".")[2] for target in targets()]
    assert sorted(found) == sorted(js.__all__)


@pytest.mark.parametrize("name", js.__all__)
def test_every_public_name_is_documented(name):
    target = next(target for target in targets() if target.endswith(f".{name}"))
    if name == "gmsh":
        module = import_module(target)
        assert all(getattr(module, each).__doc__ for each in ("__name__", *module.__all__))
        return
    home, _, own = target.rpartition(".")
    thing = getattr(import_module(home), own)
    assert thing is getattr(js, name)
    if isinstance(thing, dict):
        source = Path(import_module(home).__file__).read_text()
        assert re.search(rf'^{name}\b.*?^"""\w', source, re.M | re.S)
    else:
        assert thing.__doc__
        assert not thing.__doc__.startswith(f"{name}(")  # what a record has without one


@pytest.mark.parametrize("page", PAGES)
def test_links_lead_somewhere(page):
    text, folder = (ROOT / page).read_text(), (ROOT / page).parent
    links = re.findall(r"\]\((?!https?:)([^)]+)\)", text)
    for path, _, anchor in (link.partition("#") for link in links):
        assert (folder / path).exists(), path
        heads = re.findall(r"^#+ (.*)$", (folder / path).read_text(), re.M) if anchor else []
        assert not anchor or anchor in [head.lower().replace(" ", "-") for head in heads]


def test_the_method_names_code_that_is_there():
    named = re.findall(r"`(jaxsmooth\.[\w.]+)`", (DOCS / "method.md").read_text())
    assert len(named) > 15
    for name in named:
        home, _, own = name.rpartition(".")
        assert (
            find_spec(name)
            if own.islower() and hasattr(import_module(home), "__path__")
            else (hasattr(import_module(home), own))
        )


def test_the_comparison_says_what_was_measured():
    """Every quality in it stands in the table of its mesh, and so do the numbers of poor elements."""
    peers = (ROOT / "benchmarks" / "PEERS.md").read_text()
    page = (DOCS / "others.md").read_text()
    tables = {part.split(":")[0]: part for part in peers.split("\n## ")[2:]}
    for mesh in set(re.findall(r"`(\w+_\w+|hexbend24)`", page)):
        assert mesh in tables
    for row in re.findall(r"^\| `(\w+)` \|(.*)$", page, re.M):
        for number in re.findall(r"0\.\d{5}", row[1]):
            assert number in tables[row[0]]
    better = re.findall(r"^\| (\w+) \| .* \| (?!none)[^|]*\|$", peers.split("\n## ")[1], re.M)
    assert sorted(set(better) - {"mesh"}) == sorted(re.findall(r"^\| `(\w+)` \|", page, re.M))
    tangled = [t for t in tables.values() if int(re.search(r"^\| vtk .*", t, re.M)[0].split("|")[7])]
    assert (len(tables), len(tangled)) == (19, 7)


def test_the_site_has_all_pages():
    named = re.findall(r"^ +- (?:[^:\n]+: )?([\w/]+\.md)$", (ROOT / "mkdocs.yml").read_text(), re.M)
    notebooks = [f"docs/notebooks/{path.stem}.md" for path in (ROOT / "notebooks").glob("*.ipynb")]
    made = [*notebooks, "docs/benchmarks.md", "docs/changes.md", "docs/gallery.md"]
    assert sorted(f"docs/{name}" for name in named) == sorted([*PAGES, *made])


def test_the_pages_that_are_made_have_pictures_and_links_that_lead_somewhere():
    pytest.importorskip("mkdocs")
    pytest.importorskip("nbconvert")
    spec = spec_from_file_location("made", DOCS / "made.py")
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    pages = module.made()
    there = {*pages, *(str(Path(page).relative_to("docs")) for page in PAGES)}
    for name, text in pages.items():
        if isinstance(text, bytes):
            assert text.startswith(b"\x89PNG")
            continue
        for link in re.findall(r"\]\((?!https?:|#|data:)([^)#]+)", text):
            assert os.path.normpath(Path(name).parent / link) in there, (name, link)
    for path in (ROOT / "notebooks").glob("*.ipynb"):
        assert f"[![](notebooks/{path.stem}" in pages["gallery.md"]
