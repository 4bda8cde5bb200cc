"""The wheel and the sdist: what is in them, and that the wheel runs away from the checkout."""

import os
import re
import subprocess
import sys
import tarfile
import tomllib
import zipfile

import pytest
from test_readme import ROOT, text

pytest.importorskip("hatchling")

PROJECT = tomllib.loads(text("pyproject.toml"))["project"]
RECIPE = text("conda/recipe.yaml")


def run(*command, cwd, **more):
    done = subprocess.run(command, cwd=cwd, capture_output=True, text=True, env={**os.environ, **more})
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """The sdist and, made from what is in it, the wheel."""
    folder = tmp_path_factory.mktemp("dist")
    run(sys.executable, "-m", "hatchling", "build", "-t", "sdist", "-d", str(folder), cwd=ROOT)
    (sdist,) = folder.glob("*.tar.gz")
    with tarfile.open(sdist) as archive:
        archive.extractall(folder, filter="data")
    source = folder / sdist.name.removesuffix(".tar.gz")
    pip = (sys.executable, "-m", "pip", "wheel", "-q", "--no-build-isolation", "--no-deps", "--no-index")
    run(*pip, "-w", str(folder), str(source), cwd=folder)
    (wheel,) = folder.glob("*.whl")
    return sdist, wheel


def test_the_wheel_has_the_package_and_nothing_else(built):
    with zipfile.ZipFile(built[1]) as archive:
        names = {name for name in archive.namelist() if ".dist-info/" not in name}
        licence = [name for name in archive.namelist() if name.endswith("licenses/LICENSE")]
    kept = [path for path in (ROOT / "jaxsmooth").rglob("*") if path.is_file() and path.suffix != ".pyc"]
    assert names == {str(path.relative_to(ROOT)) for path in kept}
    assert licence


def test_the_sdist_has_what_tests_and_papers_need(built):
    with tarfile.open(built[0]) as archive:
        tops = {name.split("/")[1] for name in archive.getnames() if "/" in name}
    needed = {
        "README.md",
        "CHANGELOG.md",
        "LICENSE",
        "docs",
        "tests",
        "notebooks",
        "benchmarks",
        "mkdocs.yml",
    }
    assert needed <= tops
    assert not tops & {".venv", "site", "shared", "jaxsmooth-demo"}


def test_the_demo_runs_from_the_wheel(built, tmp_path):
    home, away = tmp_path / "home", tmp_path / "away"
    away.mkdir()
    pip = (sys.executable, "-m", "pip", "install", "-q", "--no-deps", "--no-index", "--no-compile")
    run(*pip, "--target", str(home), str(built[1]), cwd=away)
    paths = {"PYTHONPATH": str(home)}
    where = run(sys.executable, "-c", "import jaxsmooth; print(jaxsmooth.__file__)", cwd=away, **paths)
    assert where.startswith(str(home))
    paths |= {"JAX_DISABLE_MOST_OPTIMIZATIONS": "1"}  # as in all tests: it compiles in half of the time
    said = run(str(home / "bin" / "jaxsmooth"), "demo", cwd=away, **paths)
    assert "wrote bracket-smooth.vtu, report.html" in said
    assert (away / "jaxsmooth-demo" / "report.html").stat().st_size > 1e5


def test_the_readme_on_an_index_has_absolute_links():
    """What the build puts into the metadata, from the one place that says where the project lives."""
    from hatchling.metadata.core import ProjectMetadata
    from hatchling.plugin.manager import PluginManager

    metadata = ProjectMetadata(str(ROOT), PluginManager())
    links = re.findall(r"\]\(([^)]+)\)", metadata.core.readme)
    assert len(links) > 5
    assert [link for link in links if not link.startswith(("https://", "#"))] == []
    for link in re.findall(r"\]\(([^)#]+)\)", text("README.md")):
        assert link.startswith("https://") or any(found.endswith(link) for found in links)


def test_the_recipe_agrees_with_the_project():
    asked = re.findall(
        r"^    - ([\w.-]+)(.*)$", RECIPE.partition("\n  run:")[2].partition("\ntests:")[0], re.M
    )
    ours = {re.match(r"[\w.-]+", line)[0]: line for line in PROJECT["dependencies"]}
    found = {name: f"{name}{rest.replace(' ', '')}" for name, rest in asked if name != "python"}
    assert found == ours
    assert f'version: "{PROJECT["version"]}"' in RECIPE


def test_excluded_versions_of_jax_are_the_same_everywhere():
    pins = [
        line.partition("]")[2] or line.removeprefix("jax")
        for lines in (PROJECT["dependencies"], *PROJECT["optional-dependencies"].values())
        for line in lines
        if re.match(r"jax(\[|>)", line)
    ]
    assert len(pins) == 4
    assert len(set(pins)) == 1
