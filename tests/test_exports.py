"""What the package exports is one list: as types, as ``__all__``, and as what is imported when asked for."""

import ast
from pathlib import Path

import jaxsmooth as js

TREE = ast.parse(Path(js.__file__).read_text(encoding="utf-8"))


def test_all_names_what_can_be_imported():
    assert sorted(js.__all__) == sorted(js._HOME)
    assert len(set(js.__all__)) == len(js.__all__)


def test_type_checkers_see_every_name_where_it_is_imported_from():
    (typed,) = [
        node
        for node in TREE.body
        if isinstance(node, ast.If) and isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING"
    ]
    seen = {
        alias.name: node.module
        for node in ast.walk(typed)
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }
    assert seen == {name: f"jaxsmooth.{home}" for name, home in js._HOME.items()}


def test_types_are_shipped():
    assert Path(js.__file__).with_name("py.typed").is_file()
