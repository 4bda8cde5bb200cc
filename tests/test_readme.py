"""README and the other papers: their code runs, their commands parse, their links lead somewhere."""

import re
import shlex
import tomllib
from pathlib import Path

import jax
import meshes
import meshio
import pytest
from meshio._mesh import topological_dimension
from test_layers import ORDER

import jaxsmooth as js
from jaxsmooth.cells.table import TYPES, supported
from jaxsmooth.files.formats.table import FORMATS
from jaxsmooth.methods import METHODS
from jaxsmooth.options import parser

ROOT = Path(__file__).parents[1]
PAPERS = ("README.md", "CONTRIBUTING.md", "ARCHITECTURE.md", "CHANGELOG.md")


def text(name):
    return (ROOT / name).read_text()


def blocks(name, language):
    """First lines and contents of the code blocks of a language."""
    fenced = re.finditer(rf"^```{language}\n(.*?)^```$", text(name), re.M | re.S)
    return [(text(name)[: found.start(1)].count("\n"), found[1]) for found in fenced]


@pytest.fixture
def tables():
    """What the examples add to tables is gone after them."""
    before = [(table, dict(table)) for table in (TYPES, topological_dimension, FORMATS, METHODS)]
    yield
    for table, rows in before:
        table.clear()
        table.update(rows)


def execute(name, namespace):
    """The Python blocks of a document in order; errors show the line of the document."""
    for line, code in blocks(name, "python"):
        exec(compile("\n" * line + code, str(ROOT / name), "exec"), namespace)


@pytest.fixture
def part(tmp_path, monkeypatch, tables):
    points, cells = meshes.grid("tetra", (3, 3, 3), 0.2)
    meshio.write(tmp_path / "part.msh", meshio.Mesh(points, cells), file_format="gmsh22")
    monkeypatch.chdir(tmp_path)
    return points


def test_the_code_of_the_readme_runs(part):
    names = {}
    execute("README.md", names)
    assert names["result"].history[-1].statistics.q_avg > names["result"].history[0].statistics.q_avg
    written = js.read("part-smooth.vtu").mesh.points
    assert float(abs(written - names["result"].mesh.points).max()) < 1e-12
    assert float(abs(written - part).max()) > 1e-3
    elements = part[names["file"].mesh.connectivity[0]]
    assert float(abs(names["heights"][0] - (elements[..., 2].max(1) - elements[..., 2].min(1))).max()) < 1e-14
    gradient = names["gradient"]
    assert gradient.shape == part.shape
    assert float(abs(gradient).max()) > 0
    assert bool(jax.numpy.isfinite(gradient).all())


def test_the_code_of_contributing_runs(part):
    names = {}
    execute("CONTRIBUTING.md", names)
    elements = part[names["mesh"].connectivity[0]]
    edges = elements[:, [0, 0, 0, 1, 1, 2]] - elements[:, [1, 2, 3, 2, 3, 3]]
    longest = ((edges**2).sum(axis=-1) ** 0.5).max(axis=1)
    assert float(abs(names["lengths"][0] - longest).max()) < 1e-14
    moved = names["result"].mesh.points - names["mesh"].points
    assert float(abs(moved).max()) > 1e-3
    assert js.element_type("triangle7").facets[0].type is js.element_type("line3")


def test_commands_parse():
    """All calls of `jaxsmooth` in shell blocks, with the options that they use."""
    code = "".join(code for name in PAPERS for _, code in blocks(name, "sh"))
    words = [shlex.split(command, comments=True) for command in re.split(r"\n|&&", code)]
    calls = [line[1:] for line in words if line and Path(line[0]).name == "jaxsmooth"]
    assert len(calls) == len(re.findall(r"jaxsmooth (?:smooth|quality|info|compare|demo)", code)) >= 7
    for call in calls:
        options = parser().parse_args(call)
        assert getattr(options, "method", "elastic") in METHODS
        assert set(getattr(options, "metric", [])) <= set(js.METRICS)


def test_there_is_code():
    """So that the tests above look at something."""
    assert len(blocks("README.md", "python")) >= 3
    assert len(blocks("CONTRIBUTING.md", "python")) >= 8


@pytest.mark.parametrize("name", PAPERS)
def test_options_exist(name):
    """Whatever is called ``--option`` in running text is an option of the command line."""
    words = text(name)
    for language in ("sh", "python"):
        for _, code in blocks(name, language):
            words = words.replace(code, "")
    commands = next(a for a in parser()._actions if a.choices).choices.values()
    known = {option for command in commands for option in command._option_string_actions}
    assert set(re.findall(r"(?<![\w-])--[a-z][a-z-]*", words)) <= known


@pytest.mark.parametrize("name", PAPERS)
def test_names_exist(name):
    for found in set(re.findall(r"\bjs\.(\w+)", text(name))):
        assert found in js.__all__


@pytest.mark.parametrize("name", PAPERS)
def test_links_lead_somewhere(name):
    targets = re.findall(r"\]\((?!https?:)([^)#]+)\)", text(name))
    assert [target for target in targets if not (ROOT / target).exists()] == []


def test_tests_that_are_named_exist():
    sources = {path.name: path.read_text() for path in (ROOT / "tests").glob("test_*.py")}
    for name in re.findall(r"`(test_\w+)`", text("CONTRIBUTING.md")):
        assert any(f"def {name}(" in source for source in sources.values())


def test_the_readme_has_all_methods_and_types():
    table = re.findall(r"^\| (`.*?) \|", text("README.md"), re.M)
    assert sorted(re.findall(r"`([\w-]+)`", " ".join(table))) == sorted(METHODS)
    types = re.search(r"\*\*Element types\*\*: (.*?)\. ", text("README.md"), re.S)[1]
    assert re.findall(r"`(\w+)`", types) == supported()


def test_the_architecture_has_the_folders_in_their_order():
    rows = re.findall(r"^\| \[([\w.]+)\]", text("ARCHITECTURE.md"), re.M)
    assert [row.removesuffix(".py") for row in rows] == [name for name in ORDER if name != "__main__"]


def test_versions_agree():
    cited = re.search(r"^version: (.*)$", text("CITATION.cff"), re.M)[1]
    assert cited == js.__version__ == tomllib.loads(text("pyproject.toml"))["project"]["version"]
