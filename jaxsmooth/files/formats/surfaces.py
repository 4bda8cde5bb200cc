"""Formats of surfaces: STL, OBJ, OFF and PLY."""

from __future__ import annotations

import re
from pathlib import Path

import meshio
import numpy as np
from jaxtyping import Float

from jaxsmooth.convert.checks import check_last_line
from jaxsmooth.files.formats.meshios import read_as, write_again
from jaxsmooth.files.formats.record import Format, Holds, Patched, Source, UnpatchableError
from jaxsmooth.files.formats.tables import patch_table
from jaxsmooth.files.numbers import Places, put_text

__all__ = ["SURFACES"]

_TRIANGLES = frozenset({"triangle"})
_POLYGONS = frozenset({"triangle", "quad"})
_VERTEX = re.compile(rb"^[ \t]*v[ \t]+(\S+)[ \t]+(\S+)[ \t]+(\S+)", re.M)


# --- STL: triangles with their normals, and no connectivity --------------------------------------


def _sniff_stl(head: bytes) -> str | None:
    return "ascii" if head.lstrip()[:5].lower() == b"solid" and b"facet" in head else "binary"


def _read_stl(path: Path) -> tuple[meshio.Mesh, list[str]]:
    mesh = meshio.read(path, file_format="stl")
    mesh.cell_data.pop("facet_normals", None)  # they follow from the points
    return mesh, []


def _write_stl(path: Path, mesh: meshio.Mesh, dim: int, variant: str) -> list[str]:
    with np.errstate(invalid="ignore", divide="ignore"):  # triangles without an area
        meshio.write(path, mesh, file_format="stl", binary=variant == "binary")
    return []


# --- OBJ -----------------------------------------------------------------------------------------


def _read_obj(path: Path) -> tuple[meshio.Mesh, list[str]]:
    """Vertices and faces; groups, materials, normals and textures stay in the file."""
    content = path.read_bytes()
    check_last_line(content)
    points: list[list[float]] = []
    cells: list[tuple[str, list[list[int]]]] = []
    names = {3: "triangle", 4: "quad"}
    for number, line in enumerate(content.replace(b"\\\r\n", b" ").replace(b"\\\n", b" ").splitlines(), 1):
        words = line.split()
        if words[:1] == [b"v"]:
            points.append([float(word) for word in words[1:4]])
        elif words[:1] == [b"f"]:
            face = [int(word.partition(b"/")[0]) for word in words[1:]]
            name = names.get(len(face), "polygon")
            if 0 in face or len(face) < 3:
                raise ValueError(
                    f"line {number} is no face; faces are three or more numbers of vertices from 1"
                )
            if not cells or cells[-1][0] != name or len(cells[-1][1][0]) != len(face):
                cells.append((name, []))
            cells[-1][1].append([i - 1 if i > 0 else len(points) + i for i in face])
    places = np.array(points, np.float64).reshape(-1, 3)
    return meshio.Mesh(places, [(name, np.array(rows)) for name, rows in cells]), []


def _write_obj(path: Path, mesh: meshio.Mesh, dim: int, variant: str) -> list[str]:
    lines = ["v {!r} {!r} {!r}".format(*row) for row in np.asarray(mesh.points, np.float64).tolist()]
    for cells in mesh.cells:
        lines += ["f " + " ".join(map(str, row)) for row in (np.asarray(cells.data) + 1).tolist()]
    path.write_text("\n".join([*lines, ""]))
    return []


def _patch_obj(
    source: Source, old: Float[np.ndarray, "nodes dim"], new: Float[np.ndarray, "nodes dim"]
) -> Patched:
    found = list(_VERTEX.finditer(source.content))
    if len(found) != len(old):
        raise UnpatchableError("its vertices do not stand in lines of their own")
    starts, ends = (np.array([[ask(one, i) for i in (1, 2, 3)] for one in found]) for ask in _ENDS)
    normals = re.search(rb"^[ \t]*vn[ \t]", source.content, re.M)
    notes = (
        ("the normals in the file (vn) are those of the input; they are not computed anew",)
        if normals
        else ()
    )
    return Patched(put_text(source.content, Places(starts, ends), old, new), notes)


_ENDS = (re.Match.start, re.Match.end)


# --- OFF and PLY ----------------------------------------------------------------------------------


def _write_anew(path: Path, mesh: meshio.Mesh, dim: int, variant: str) -> list[str]:
    return write_again(path, mesh, dim, _OFF)


def _sniff_ply(head: bytes) -> str | None:
    return "ascii" if b"format ascii" in head[:200] else "binary"


def _write_ply(path: Path, mesh: meshio.Mesh, dim: int, variant: str) -> list[str]:
    stale = [name for name in ("nx", "ny", "nz") if mesh.point_data.pop(name, None) is not None]
    wide = [name for name, values in mesh.point_data.items() if np.ndim(values) > 1]
    lost = [*wide, *mesh.cell_data]
    for name in wide:
        del mesh.point_data[name]
    mesh.cells = [meshio.CellBlock(c.type, np.asarray(c.data).astype(np.int32)) for c in mesh.cells]
    meshio.write(path, mesh, file_format="ply", binary=variant == "binary")
    notes = (
        ["the normals at the vertices (nx, ny, nz) are those of the input; they are left out"]
        if stale
        else []
    )
    return notes + (
        [f"ply files can't hold these data, which are not written: {', '.join(lost)}"] if lost else []
    )


_OFF = Format(
    "off",
    (".off",),
    read_as("off", text=True),
    _write_anew,
    Holds(types=_TRIANGLES, space=True),
    patch=patch_table(rb"\A\s*OFF\s+(\d+)\s+\d+\s+\d+", 0),
)

SURFACES = (
    Format(
        "stl",
        (".stl",),
        _read_stl,
        _write_stl,
        Holds(types=_TRIANGLES, space=True),
        sniff=_sniff_stl,
        variants=("binary", "ascii"),
    ),
    Format("obj", (".obj",), _read_obj, _write_obj, Holds(types=_POLYGONS, space=True), patch=_patch_obj),
    _OFF,
    Format(
        "ply",
        (".ply",),
        read_as("ply"),
        _write_ply,
        Holds(types=_POLYGONS | {"vertex", "line"}, any_data=True, space=True),
        sniff=_sniff_ply,
        variants=("binary", "ascii"),
    ),
)
