"""Every format into every other: what is lost on the way, and whether it is said.

    python -m benchmarks.files.pairs

makes files with Gmsh, VTK, meshio and netCDF and by hand, writes each in all formats that hold elements,
reads those again and compares nodes, elements, materials, boundary cells and their tags, sets and data.  The
table goes to ``benchmarks/PAIRS.md``.  It fails where something is lost without a word.
"""

from __future__ import annotations

import dataclasses
import tempfile
from collections import defaultdict
from pathlib import Path

import jax

import jaxsmooth as js
from benchmarks.files.facts import KINDS, Missing, items, missing
from benchmarks.files.making import MAKERS, make
from jaxsmooth.convert.checks import MeshFileError
from jaxsmooth.files.formats.record import stem_format
from jaxsmooth.files.formats.table import FORMATS

TABLE = Path(__file__).parents[1] / "PAIRS.md"

HEAD = """# Every format into every other

Made by `python -m benchmarks.files.pairs`: {files} files of {formats} formats, each written anew in every
format that holds elements, and read again; {done} conversions, {refused} refused in a sentence.  Compared are
nodes, elements, materials, boundary cells, boundary tags, named sets (by their nodes), point data and cell
data.  What an output has under another name, or as data of 0 and 1, counts as kept.

Rows are the formats of the inputs, columns those of the outputs.  Letters: what some files of the row lose,
with a note that names it: **m**aterials, boundary **c**ells, boundary **t**ags, **s**ets, **p**oint data,
cell **d**ata.  `·`: nothing.  `×`: all files are refused, or some.  `!`: a loss **without a word**.
"""

_LETTERS = {"materials": "m", "boundary cells": "c", "boundary tags": "t", "sets": "s", "point data": "p"}
_LETTERS |= {"cell data": "d", "nodes": "n", "elements": "e"}

Result = list[Missing] | str
"""What an output lacks, or why there is none."""


def targets() -> list[str]:
    """The formats that hold elements."""
    return [
        name
        for name, record in FORMATS.items()
        if record.write and record.suffixes and not record.refuse(Path("mesh" + record.suffixes[0]))
    ]


def convert(file: js.MeshFile, name: str, folder: Path) -> Result:
    """Write a file in a format, and read it again."""
    path = folder / f"converted{FORMATS[name].suffixes[0]}"
    try:
        notes = js.write(path, dataclasses.replace(file, original=None), file_format=name)
    except MeshFileError as error:
        return str(error).removeprefix(f"{path}: ")
    return list(missing(items(file), items(js.read(path)), notes))


def main() -> int:
    """Write the table."""
    jax.config.update("jax_enable_x64", True)
    results: dict[tuple[str, str], list[Result]] = defaultdict(list)
    silent: list[tuple[str, ...]] = []
    rows: dict[str, int] = {}
    count = 0
    with tempfile.TemporaryDirectory() as folder:
        for path in (make(name, Path(folder)) for name in MAKERS):
            if path is None:
                continue
            file, count = js.read(path), count + 1
            row = rows.setdefault(stem_format(file.format or ""), len(rows))
            for name in targets():
                result = convert(file, name, Path(folder))
                results[stem_format(file.format or ""), name].append(result)
                if not isinstance(result, str):
                    silent += [(path.name, name, lost.kind, lost.name) for lost in result if not lost.said]
            print(f"{path.name}: {row + 1} formats so far", flush=True)
    flat = [result for found in results.values() for result in found]
    refused = sum(isinstance(result, str) for result in flat)
    head = HEAD.format(files=count, formats=len(rows), done=len(flat) - refused, refused=refused)
    TABLE.write_text("\n".join([head, *_matrix(results, list(rows)), "", *_refusals(results)]) + "\n")
    for case in silent:
        print("without a word:", *case)
    return 1 if silent else 0


def _matrix(results: dict[tuple[str, str], list[Result]], rows: list[str]) -> list[str]:
    names = targets()
    lines = [f"| | {' | '.join(names)} |", "|---" * (len(names) + 1) + "|"]
    for row in rows:
        lines.append(f"| {row} | {' | '.join(_cell(results[row, name]) for name in names)} |")
    return lines


def _cell(found: list[Result]) -> str:
    lost = [entry for result in found if not isinstance(result, str) for entry in result]
    letters = "".join(_LETTERS[kind] for kind in KINDS if any(entry.kind == kind for entry in lost))
    marks = ("!" if any(not entry.said for entry in lost) else "") + letters
    refused = sum(isinstance(result, str) for result in found)
    return ("×" if refused == len(found) else marks or "·") + ("×" if 0 < refused < len(found) else "")


def _refusals(results: dict[tuple[str, str], list[Result]]) -> list[str]:
    """Why outputs were refused, one example a format."""
    lines = ["| refused | for example |", "|---|---|"]
    for name in targets():
        told = [r for (_, to), found in results.items() if to == name for r in found if isinstance(r, str)]
        if told:
            lines.append(f"| {name}, {len(told)} files | {min(told, key=len)} |")
    return lines


if __name__ == "__main__":
    raise SystemExit(main())
