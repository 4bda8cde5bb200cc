"""Files in, files out: what stays when only coordinates change, and how long it takes.

    python -m benchmarks.files [--large FILE] [FOLDER …]

makes files with Gmsh, VTK, meshio and netCDF, takes those of the folders too, moves a third of the nodes of
each, writes it in its own format, and compares with the input.  The table goes to ``benchmarks/FILES.md``.
"""

from __future__ import annotations

import argparse
import dataclasses
import platform
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import jax

import jaxsmooth as js
from benchmarks.files.checking import Row, check, moved
from benchmarks.files.making import MAKERS, make
from jaxsmooth.convert.checks import MeshFileError
from jaxsmooth.files.formats.table import FORMATS

SUFFIXES = {suffix for record in FORMATS.values() if record.patch for suffix in record.suffixes}
TABLE = Path(__file__).parents[1] / "FILES.md"

HEAD = """# Files in, files out

Made by `python -m benchmarks.files --large FILE FOLDER …`.  A third of the nodes of each file is moved, but
for held ones, and it is written in its own format.  *Bytes*: whether everything but the coordinates is the
same, byte by byte (array by array where compressed blocks differ in length).  *Error*: the largest difference
between coordinates that were asked for and those read again, relative to the largest coordinate.  *Opened
by*: programs other than jaxsmooth that read the output and find these coordinates.
"""


def main() -> int:
    """Write the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folders", nargs="*", type=Path, help="folders with more files")
    parser.add_argument("--large", type=Path, help="a large file of tetrahedra, to measure times with")
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    with tempfile.TemporaryDirectory() as folder:
        inputs, outputs = Path(folder, "in"), Path(folder, "out")
        inputs.mkdir()
        outputs.mkdir()
        paths = [path for name in MAKERS if (path := make(name, inputs)) is not None]
        for more in options.folders:
            paths += sorted(path for path in more.rglob("*") if path.suffix in SUFFIXES)
        lines = [
            HEAD,
            "| file | format | nodes | bytes | error | opened by | said |",
            "|---|---|---|---|---|---|---|",
        ]
        for path in paths:
            try:
                row = check(path, outputs)
            except MeshFileError as error:
                print(f"{path.name}: left out ({str(error).removeprefix(f'{path}: ')})", flush=True)
                continue
            lines.append(_line(row))
            print(lines[-1], flush=True)
        if options.large is not None:
            lines += ["", *_times(options.large, outputs)]
    TABLE.write_text("\n".join(lines) + "\n")
    return 0


def _line(row: Row) -> str:
    same = "same" if row.same else "**other**"
    shown = (row.name, row.format, str(row.nodes), same, f"{row.error:.1e}", ", ".join(row.readers))
    return f"| {' | '.join(shown)} | {'; '.join(row.notes)} |"


def _times(path: Path, folder: Path) -> list[str]:
    """Seconds to read a mesh, and to write it as a copy and anew, in three formats."""
    file = js.read(path)
    number = sum(len(nodes) for nodes in file.mesh.connectivity)
    lines = [
        f"Seconds for {number:,} elements ({path.name}), on {platform.machine()}, least of three:",
        "",
        "| format | read | written with other coordinates in it | written anew |",
        "|---|---|---|---|",
    ]
    for name, suffix in (("vtu", ".vtu"), ("gmsh:ascii", ".msh"), ("gmsh:binary", ".msh")):
        source = folder / f"large{suffix}"
        js.write(source, file, file_format=name)
        copied = js.read(source)
        anew, points = dataclasses.replace(copied, original=None), moved(copied)
        seconds = [
            _least(lambda source=source: js.read(source)),
            *(
                _least(lambda f=f, p=points, s=suffix: js.write(folder / f"o{s}", f, p))
                for f in (copied, anew)
            ),
        ]
        lines.append(f"| {name} | " + " | ".join(f"{value:.2f}" for value in seconds) + " |")
        print(lines[-1], flush=True)
    return lines


def _least(work: Callable[[], object]) -> float:
    times = []
    for _ in range(3):
        start = time.perf_counter()
        work()
        times.append(time.perf_counter() - start)
    return min(times)


if __name__ == "__main__":
    raise SystemExit(main())
