"""The order of the folders: each imports only what stands before it; files and functions are short."""

import ast
from pathlib import Path

PACKAGE = Path(__file__).parents[1] / "jaxsmooth"
ORDER = (
    *(
        "numerics",
        "cells",
        "mesh",
        "convert",
        "assembly",
        "metrics",
        "motion",
        "guards",
        "targets",
        "methods",
    ),
    *(
        "runs",
        "files",
        "adaptors",
        "report",
        "demo",
        "cache",
        "options",
        "choices",
        "commands",
        "cli",
        "__main__",
    ),
)
LINES, FUNCTION = 400, 60


def modules():
    for path in sorted(PACKAGE.rglob("*.py")):
        yield path.relative_to(PACKAGE), path


def place(parts):
    """Position in the order of the first part of a module's name."""
    return ORDER.index(parts[0].removesuffix(".py"))


def imports(path):
    """Modules of the package that a file imports, also inside functions."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "jaxsmooth":
            inside = node.module.split(".")[1:]
            yield from ([inside] if inside else [[alias.name] for alias in node.names])
        elif isinstance(node, ast.Import):
            yield from (a.name.split(".")[1:] for a in node.names if a.name.startswith("jaxsmooth."))


def test_every_folder_has_its_place():
    found = {name.parts[0].removesuffix(".py") for name, _ in modules()} - {"__init__"}
    assert found == set(ORDER)


def test_folders_import_only_what_stands_before_them():
    wrong = [
        f"{name} imports {'.'.join(other)}"
        for name, path in modules()
        if name.parts != ("__init__.py",)
        for other in imports(path)
        if other[0] in ORDER and place(other) > place(name.parts)
    ]
    assert wrong == []


def test_modules_of_a_folder_do_not_import_each_other_in_circles():
    names = {tuple(name.with_suffix("").parts): path for name, path in modules()}
    graph = {
        n: {tuple(o) for o in imports(p)} | {(*o, "__init__") for o in imports(p)} for n, p in names.items()
    }
    graph = {n: {o for o in others if o in names and o != n} for n, others in graph.items()}
    while leaves := [n for n, others in graph.items() if not others]:
        for leaf in leaves:
            del graph[leaf]
        graph = {n: others - set(leaves) for n, others in graph.items()}
    assert list(graph) in ([], [("__init__",)])


def test_files_are_short():
    assert [str(name) for name, path in modules() if len(path.read_text().splitlines()) > LINES] == []


def test_functions_are_short():
    long = [
        f"{name}: {node.name} has {node.end_lineno - node.lineno + 1} lines"
        for name, path in modules()
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.FunctionDef) and body_lines(node) > FUNCTION
    ]
    assert long == []


def body_lines(node):
    """Lines of a function without its docstring."""
    first = node.body[1] if ast.get_docstring(node) and len(node.body) > 1 else node.body[0]
    return node.end_lineno - first.lineno + 1


def test_the_table_of_elements_needs_numpy_alone():
    for _, path in modules():
        if path.parent.name == "cells":
            lines = path.read_text().splitlines()
            assert "jax" not in [
                line.split()[1].split(".")[0] for line in lines if line.startswith("import ")
            ]
