"""Nastran's bulk data: read and written by meshio (5.3.5), patched here.

A node is a card GRID of fields of 8 columns (its number, a coordinate system, three coordinates, …), GRID* of
two lines with fields of 16 columns, or GRID with commas."""

from __future__ import annotations

import re
import tempfile
from pathlib import Path

import meshio
import numpy as np
from jaxtyping import Float

from jaxsmooth.files.formats.meshios import read_as, reduce_rare, write_again
from jaxsmooth.files.formats.record import Format, Holds, Patched, Source, UnpatchableError
from jaxsmooth.files.numbers import check_columns, check_old
from jaxsmooth.files.reduction import UNKEPT

__all__ = ["NASTRAN", "patch_nastran", "read_nastran"]

_TYPES = (
    "line triangle quad tetra wedge pyramid hexahedron line3 triangle6 quad8 tetra10 hexahedron20 wedge15 "
    "pyramid13"
)


_CELLS = (
    "CBAR CBEAM CBUSH CBUSH1D CGAP CROD CTRIAR CTRIA3 CTRIA6 CTRAX6 CTRIAX6 CQUADR CSHEAR CQUAD4 CQUAD8 "
    "CQUAD9 CTETRA CPYRA CPYRAM CPENTA CHEXA"
)
_MESH = frozenset((*_CELLS.split(), "GRID", "ENDDATA"))


def read_nastran(path: Path) -> tuple[meshio.Mesh, list[str]]:
    """A file of bulk data, whether or not other sections come first."""
    content = path.read_bytes()
    begin = re.search(rb"^[ \t]*BEGIN BULK", content, re.M)
    if begin:
        mesh, notes = _READ(path)
    else:
        with tempfile.TemporaryDirectory() as folder:
            copy = Path(folder) / "mesh.bdf"
            copy.write_bytes(b"BEGIN BULK\n" + content)
            mesh, notes = _READ(copy)
    words = re.compile(rb"^([A-Z][A-Z0-9]*)", re.M).findall(content, begin.end() if begin else 0)
    cards = sorted({word.decode() for word in words} - _MESH)
    if cards:
        named = ", ".join(cards[:4]) + (", …" if len(cards) > 4 else "")
        mesh.info = {UNKEPT: [("", f"the other cards of the Nastran file ({named})")]}
        notes.append(f"cards of the Nastran file that are not mesh are kept in Nastran files only ({named})")
    return mesh, notes


_READ = read_as("nastran", text=True, end="ENDDATA")


def _write(path: Path, mesh: meshio.Mesh, dim: int, variant: str) -> list[str]:
    """Meshio writes negative numbers of many digits into no field, so coordinates are put in afterwards."""
    points = np.zeros((len(mesh.points), 3))
    points[:, : mesh.points.shape[1]] = mesh.points
    mesh.points = np.zeros_like(points)
    notes = write_again(path, mesh, dim, NASTRAN)
    patched = patch_nastran(Source(path.read_bytes(), path, path), mesh.points, points)
    path.write_bytes(patched.content)
    return [*notes, *patched.notes]


# --- Other coordinates ---------------------------------------------------------------------

_Field = tuple[
    int, int, int
]  # first byte, the byte behind the last, and how many there may be (0: any number)


def patch_nastran(
    source: Source, old: Float[np.ndarray, "nodes dim"], new: Float[np.ndarray, "nodes dim"]
) -> Patched:
    """The file with other coordinates; fields of 8 or 16 columns get as many digits as they have room for."""
    content = source.content
    fields = _grid_fields(content)
    found = np.array([[_number(content[start:end]) for start, end, _ in row] for row in fields])
    check_old(found.reshape(-1, 3), old)
    check_columns(3, old, new)
    parts, at, lost, narrow = [], 0, 0.0, set()
    for node, axis in np.argwhere(old != new).tolist():
        start, end, width = fields[node][axis]
        value = float(new[node, axis])
        word = _fitted(value, width) if width else repr(value).encode()
        before = content[start:end]
        if width:
            lost = max(lost, abs(_number(word) - value))
            narrow.add(width)
            left = before[:1].strip() and before.endswith(b" ")
            word = word.ljust(len(before)) if left else word.rjust(len(before))
        parts += [content[at:start], word]
        at = end
    size = float(np.abs(new).max(initial=0))
    notes = ()
    if lost > 1e-12 * size:
        notes = (
            f"fields of {min(narrow)} columns round coordinates by at most {lost:.1e}, where the largest "
            f"coordinate is {size:.6g}",
        )
    return Patched(b"".join([*parts, content[at:]]), notes, proven=True)


def _grid_fields(content: bytes) -> list[list[_Field]]:
    """Where the coordinates of every GRID card stand, in the order of the file."""
    begin = re.search(rb"^[ \t]*BEGIN BULK[^\n]*\n", content, re.M)
    end = re.search(rb"^ENDDATA", content, re.M)
    lines = re.compile(rb"^(GRID\*?|[*+])([^\r\n]*)", re.M)
    fields: list[list[_Field]] = []
    waiting = False  # for the second line of a GRID*
    for line in lines.finditer(content, begin.end() if begin else 0, end.start() if end else len(content)):
        start, stop, key = line.start(), line.end(), line[1]
        if key in (b"*", b"+"):
            if waiting:
                fields[-1].append(_columns(start + 8, stop, 16))
            waiting = False
        elif key == b"GRID" and b"," in line[2]:
            ends = [start + found.start() for found in re.finditer(b",", line[0])] + [stop]
            if len(ends) < 6:
                raise UnpatchableError("a GRID card with commas has no three coordinates")
            fields.append([_stripped(content, ends[k] + 1, ends[k + 1]) for k in (2, 3, 4)])
        elif key == b"GRID" and line[2][:1] in (b" ", b""):
            fields.append([_columns(start + 8 * k, stop, 8) for k in (3, 4, 5)])
        elif key == b"GRID*" and b"," not in line[2]:
            fields.append([_columns(start + 8 + 16 * k, stop, 16) for k in (2, 3)])
            waiting = True
        else:
            raise UnpatchableError(f"it has a card {line[0][:16].decode(errors='replace')!r}")
    if any(len(row) != 3 for row in fields):
        raise UnpatchableError("a GRID* card has no second line")
    return fields


def _columns(start: int, stop: int, width: int) -> _Field:
    if start >= stop:
        raise UnpatchableError("a GRID card leaves out a coordinate")
    return start, min(start + width, stop), width


def _stripped(content: bytes, start: int, end: int) -> _Field:
    text = content[start:end]
    return start + len(text) - len(text.lstrip()), end - (len(text) - len(text.rstrip())), 0


def _number(text: bytes) -> float:
    """A number as Nastran writes it: 1.5-3 is 0.0015."""
    text = text.strip().upper().replace(b"D", b"E")
    return float(re.sub(rb"(?<=[\d.])([+-])", rb"E\1", text) if b"E" not in text else text)


def _fitted(value: float, width: int) -> bytes:
    """The text of at most so many columns that is nearest to a number."""
    exact = repr(value)
    if len(exact) <= width and "." in exact and "e" not in exact:
        return exact.encode()
    words = []
    for digits in range(width):
        words.append(re.sub(r"^(-?)0(?=\.\d)", r"\1", f"{value:#.{digits}f}"))
        mantissa, _, power = f"{value:#.{digits}e}".partition("e")
        words.append(f"{mantissa}{int(power):+d}")
    fitting = [word.encode() for word in words if len(word) <= width]
    return min(fitting, key=lambda word: abs(_number(word) - value))


NASTRAN = Format(
    "nastran",
    (".bdf", ".fem", ".nas"),
    read_nastran,
    _write,
    Holds(
        types=frozenset(_TYPES.split()),
        reduce=lambda mesh, dim: reduce_rare(mesh, dim, own="nastran:ref"),
    ),
    patch=patch_nastran,
)
