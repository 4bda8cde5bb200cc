"""VTK's legacy files: read by meshio (5.3.5), which takes what is there whatever the headers say."""

from __future__ import annotations

import re
from pathlib import Path

import meshio
import numpy as np
from jaxtyping import Float

from jaxsmooth.convert.checks import check_last_line
from jaxsmooth.files.formats.meshios import read_copy
from jaxsmooth.files.formats.record import Format, Holds, Patched, Source, UnpatchableError
from jaxsmooth.files.formats.vtktext import lines_with, with_sizes, without_text
from jaxsmooth.files.numbers import Places, put_binary, put_text, tokens
from jaxsmooth.files.reduction import UNKEPT

__all__ = ["VTK", "VTK42", "check_vtk", "pad_pairs", "patch_vtk", "read_vtk"]

_CUT = "the file is damaged or cut short"


def read_vtk(path: Path) -> tuple[meshio.Mesh, list[str]]:
    """A legacy file of any version; text and bits among its data are left out."""
    content = path.read_bytes()
    version, variant = _sniff(content[:4096])
    repaired, names = without_text(content, variant == "binary")
    repaired = with_sizes(repaired) if version >= 5 else repaired
    same = repaired == content
    mesh = meshio.read(path, file_format="vtk") if same else read_copy(repaired, path, "vtk")
    check_vtk(content, mesh)
    if not names:
        return mesh, []
    mesh.info = {UNKEPT: [("", f"data of text or bits ({', '.join(names)})")]}
    return mesh, [f"data of text or bits are kept in VTK files only ({', '.join(names)})"]


def check_vtk(content: bytes, mesh: meshio.Mesh) -> None:
    """Raise `ValueError` where a legacy file has other counts than `mesh`, which meshio read from it."""
    lines = content[:4096].splitlines()
    if len(lines) > 2 and lines[2].strip().upper() == b"ASCII":
        check_last_line(content)
    cells, capitals = sum(len(block) for block in mesh.cells), content.upper()
    for key, found in (("POINTS", len(mesh.points)), ("CELL_TYPES", cells), ("CELL_DATA", cells)):
        said = _counts(capitals, key)
        if said and said[0] != found:
            raise ValueError(f"its section {key} says {said[0]}, the file has {found}; {_CUT}")
    said = _counts(capitals, "CELLS")
    if len(said) < 2 or any(block.type.startswith("poly") for block in mesh.cells):
        return
    newer = any(lines_with(re.compile(rb"OFFSETS\s"), content, b"OFFSETS"))
    numbers = sum(block.data.size for block in mesh.cells)
    if said[1] != numbers + (0 if newer else cells):
        raise ValueError(f"its section CELLS has other numbers of nodes than its CELL_TYPES want; {_CUT}")


def _counts(content: bytes, key: str) -> list[int]:
    pattern = re.compile(rb"[ \t]*" + key.encode() + rb"[ \t]+(\d+)(?:[ \t]+(\d+))?")
    found = next(lines_with(pattern, content, key.encode()), None)
    return [] if found is None else [int(word) for word in found.groups() if word]


def pad_pairs(mesh: meshio.Mesh) -> None:
    """Give data of two components a third, for VTK's vectors have three."""

    def padded(values: np.ndarray) -> np.ndarray:
        two = values.ndim == 2 and values.shape[1] == 2
        return np.pad(values, ((0, 0), (0, 1))) if two else values

    mesh.point_data = {name: padded(values) for name, values in mesh.point_data.items()}
    mesh.cell_data = {name: [padded(part) for part in parts] for name, parts in mesh.cell_data.items()}


def _write(path: Path, mesh: meshio.Mesh, variant: str, name: str) -> list[str]:
    pad_pairs(mesh)
    mesh.point_data = {name.replace(" ", "_"): v for name, v in mesh.point_data.items()}
    mesh.cell_data = {name.replace(" ", "_"): v for name, v in mesh.cell_data.items()}
    meshio.write(path, mesh, file_format=name, binary=variant == "binary")
    return []


def patch_vtk(
    source: Source, old: Float[np.ndarray, "nodes dim"], new: Float[np.ndarray, "nodes dim"]
) -> Patched:
    """The file with other coordinates, in its own precision."""
    content = source.content
    head = re.search(rb"^[ \t]*POINTS[ \t]+(\d+)[ \t]+(\w+)[ \t]*\r?\n", content, re.M | re.I)
    if head is None:
        raise UnpatchableError("it has no section POINTS")
    count, kind = int(head[1]), head[2].decode().lower()
    index = 3 * np.arange(count)[:, None] + np.arange(3)
    real = {"float": np.dtype(">f4"), "double": np.dtype(">f8")}.get(kind)
    if real is None:
        raise UnpatchableError(f"its coordinates are of the type {kind}")
    if _sniff(content[:4096])[1] == "binary":
        content = put_binary(content, head.end() + real.itemsize * index, real, old, new)
    else:
        last = re.compile(rb"^[ \t]*[A-Za-z]", re.M).search(content, head.end())
        starts, ends = tokens(content, head.end(), last.start() if last else len(content))
        if len(starts) < index.size:
            raise UnpatchableError("its section POINTS ends early")
        content = put_text(content, Places(starts[index], ends[index]), old, new)
    return Patched(content, proven=True)


def _sniff(head: bytes) -> tuple[int, str]:
    """Version and variant."""
    version = re.match(rb"# vtk DataFile Version (\d+)\.", head)
    lines = head.splitlines()
    ascii = len(lines) > 2 and lines[2].strip().upper() == b"ASCII"
    return int(version[1]) if version else 0, "ascii" if ascii else "binary"


VTK = Format(
    "vtk",
    (".vtk",),
    read_vtk,
    lambda path, mesh, dim, variant: _write(path, mesh, variant, "vtk"),
    Holds(lacks=frozenset({"pyramid14"}), any_data=True, space=True),
    sniff=lambda head: _sniff(head)[1] if _sniff(head)[0] >= 5 else None,
    variants=("binary", "ascii"),
    patch=patch_vtk,
)
"""Version 5.1."""

VTK42 = Format(
    "vtk42",
    (".vtk",),
    read_vtk,
    lambda path, mesh, dim, variant: _write(path, mesh, variant, "vtk42"),
    Holds(lacks=frozenset({"pyramid14"}), any_data=True, space=True),
    sniff=lambda head: _sniff(head)[1],
    variants=("binary", "ascii"),
    patch=patch_vtk,
)
"""Versions before 5."""
