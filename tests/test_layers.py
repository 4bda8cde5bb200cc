"""The order of the modules: each imports only what stands before it."""

import ast
from pathlib import Path

PACKAGE = Path(__file__).parents[1] / "jaxsmooth"
ORDER = [
    ("acceptance", "outputs", "quadrature", "terminal"),
    ("elements",),
    ("bernstein", "mesh", "small", "rounding"),
    ("topology",),
    ("orientation", "cohesive", "hanging", "layers", "files.cards", "files.checks", "files.regions"),
    ("files.labels",),
    ("blocks", "coupling", "planes"),
    ("meshfile",),
    ("metrics", "validity", "constraints", "fitting", "elasticity"),
    ("patches", "solve", "distortion"),
    ("objective", "minimise"),
    ("methods",),
    ("runs", "smoothing", "batch"),
    ("files.abaqus", "files.exodus", "files.medit", "files.msh", "files.mshraw", "files.su2"),
    ("files.reduction", "files.ugrid", "files.vtk", "files.xdmf"),
    ("files.formats",),
    ("files.exports",),
    ("io",),
    ("pictures",),
    ("report", "demo"),
    ("cli",),
]
LEVEL = {name: level for level, names in enumerate(ORDER) for name in names}


def modules():
    for path in sorted(PACKAGE.rglob("*.py")):
        name = ".".join(path.relative_to(PACKAGE).with_suffix("").parts)
        yield name.removesuffix(".__init__"), path


def level_of(name):
    parts = name.split(".")
    for size in range(len(parts), 0, -1):
        if ".".join(parts[:size]) in LEVEL:
            return LEVEL[".".join(parts[:size])]
    return None


def imports(path):
    """Modules of the package that a file imports when it is imported."""
    tree = ast.parse(path.read_text())
    for node in tree.body:
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("jaxsmooth."):
            yield node.module.removeprefix("jaxsmooth.")


def test_every_module_has_its_place():
    assert [n for n, _ in modules() if level_of(n) is None] == ["__init__", "__main__", "files"]


def test_imports_point_backwards():
    wrong = [
        f"{name} imports {other}"
        for name, path in modules()
        if level_of(name) is not None
        for other in imports(path)
        if level_of(other) > level_of(name)
    ]
    assert wrong == []


def test_files_are_short():
    assert [name for name, path in modules() if len(path.read_text().splitlines()) > 400] == []


def test_the_table_of_elements_needs_numpy_alone():
    text = (PACKAGE / "elements.py").read_text()
    assert "jax" not in [
        line.split()[1].split(".")[0] for line in text.splitlines() if line.startswith("import ")
    ]
