"""SU2's meshes, read and written here.

meshio (5.3.5) drops the names of markers, takes files that end early, says a note for every line of a
section that it doesn't know, and corrupts files with CRLF; its writer fails on markers."""

from __future__ import annotations

import re
from pathlib import Path

import meshio
import numpy as np
from jaxtyping import Float

from jaxsmooth.cells.table import element_type
from jaxsmooth.convert.checks import check_last_line, parse_numbers
from jaxsmooth.convert.regions import recall
from jaxsmooth.files.formats.record import Format, Holds, Patched, Source, UnpatchableError
from jaxsmooth.files.numbers import Places, blanked, put_text, tokens
from jaxsmooth.files.reduction import UNKEPT, keep_boundary_tags, material_name, sets_as_masks

__all__ = ["SU2", "read_su2", "write_su2"]

_CODES = {"line": 3, "triangle": 5, "quad": 9, "tetra": 10, "hexahedron": 12, "wedge": 13, "pyramid": 14}
_NAMES = {code: name for name, code in _CODES.items()}

_REST = "su2:rest"  # in `meshio.Mesh.info`: sections that are no mesh, as they stand

_CUT = "the file is damaged or cut short"


def read_su2(path: Path) -> tuple[meshio.Mesh, list[str]]:
    """Nodes, elements, markers as cell sets; other sections as text.

    Returns the mesh and notes.  Raises `ValueError` in one sentence."""
    text = path.read_text(encoding="utf-8", errors="replace")
    check_last_line(text.encode(), b"%")
    lines = [s for line in text.splitlines() if (s := line.partition("%")[0].strip())]
    heads = [k for k, line in enumerate(lines) if "=" in line]
    dim, points, inside, outside = 0, None, [], []
    markers: list[str] = []
    counts, rest, tag = {}, [], None
    for start, end in zip(heads, [*heads[1:], len(lines)], strict=True):
        key, _, value = (word.strip() for word in lines[start].partition("="))
        key, rows = key.upper(), lines[start + 1 : end]
        if key == "NDIME":
            dim = _number(key, value)
            if dim not in (2, 3):
                raise ValueError(f"NDIME is {dim}, not 2 or 3")
        elif key == "NPOIN":
            points = _points(_counted(key, value, rows), dim)
        elif key == "NELEM":
            inside += _cells(key, _counted(key, value, rows))
            counts[key] = True
        elif key == "MARKER_TAG":
            markers, tag = [*markers, value], value
        elif key == "MARKER_ELEMS":
            if tag is None:
                raise ValueError("it has MARKER_ELEMS without a MARKER_TAG")
            outside += [(tag, *cells) for cells in _cells(key, _counted(key, value, rows))]
            counts[tag] = True
        elif key == "NMARK":
            counts[key] = _number(key, value)
        elif key == "NZONE" and _number(key, value) > 1:
            raise ValueError("it has several zones; give each a file of its own")
        elif key != "NZONE":
            rest += lines[start:end]
    if points is None or not dim or not {"NELEM", "NMARK"} <= counts.keys():
        have = {"NDIME": dim, "NPOIN": points is not None, "NELEM": "NELEM" in counts, "NMARK": False}
        missing = next(name for name, there in have.items() if not there)
        raise ValueError(f"it has no section {missing}; {_CUT}")
    if counts["NMARK"] != len(markers) or not all(name in counts for name in markers):
        complete = sum(name in counts for name in markers)
        raise ValueError(f"it has {complete} markers with elements, NMARK says {counts['NMARK']}; {_CUT}")
    mesh = _mesh(points, inside, outside, markers)
    notes = []
    if rest:
        mesh.info = {
            _REST: "\n".join(rest) + "\n",
            UNKEPT: [("su2", "the other sections of the SU2 file")],
        }
        named = ", ".join(dict.fromkeys(line.partition("=")[0].strip() for line in rest if "=" in line))
        notes.append(
            f"sections of the SU2 file that are not mesh are kept in SU2 files as they stand ({named})"
        )
    return mesh, notes


def _number(key: str, value: str) -> int:
    words = value.split()
    if not words or not re.fullmatch(r"[+-]?\d+", words[0]):
        raise ValueError(f"{key} is {value!r}, not a number; {_CUT}")
    return int(words[0])


def _counted(key: str, value: str, rows: list[str]) -> list[str]:
    count = _number(key, value)
    if len(rows) != count:
        raise ValueError(f"its section {key} has {len(rows)} lines and says {count}; {_CUT}")
    return rows


def _table(rows: list[str], dtype) -> np.ndarray:
    """The numbers of lines that have equally many ``[lines, m]``."""
    numbers = parse_numbers(" ".join(rows), "one of its sections", dtype)
    width = len(rows[0].split())
    if len(numbers) != len(rows) * width or any(len(row.split()) != width for row in rows):
        raise ValueError(f"its lines like {rows[0]!r} don't all have {width} numbers; {_CUT}")
    return numbers.reshape(len(rows), width)


def _points(rows: list[str], dim: int) -> np.ndarray:
    if not dim:
        raise ValueError("NDIME does not stand before NPOIN")
    table = _table(rows, np.float64) if rows else np.zeros((0, dim))
    if table.shape[1] not in (dim, dim + 1, dim + 2):  # an index, or two, may follow
        raise ValueError(f"its nodes have {table.shape[1]} numbers in {dim}D; {_CUT}")
    return table[:, :dim]


def _cells(key: str, rows: list[str]) -> list[tuple[str, np.ndarray]]:
    """Cells by type; the lines of each in their order."""
    codes = [row.split(None, 1)[0] for row in rows]
    found = []
    for code in sorted(set(codes), key=lambda c: (len(c), c)):
        name = _NAMES.get(int(code)) if code.isdigit() else None
        if name is None:
            raise ValueError(f"its section {key} has cells of type {code}, which SU2 does not have")
        table = _table([row for row, c in zip(rows, codes, strict=True) if c == code], np.int64)
        k = element_type(name).k
        if table.shape[1] not in (k + 1, k + 2):  # an index may follow
            raise ValueError(f"its {name} cells have {table.shape[1] - 1} numbers, not {k} nodes; {_CUT}")
        found.append((name, table[:, 1 : k + 1]))
    return found


def _mesh(points, inside, outside, markers: list[str]) -> meshio.Mesh:
    """Elements by type, then boundary cells by type, with the markers' numbers and names."""
    numbers: dict[str, int] = {}
    for name in markers:
        taken = set(numbers.values()) | {int(m) for m in markers if m.lstrip("+-").isdigit()}
        free = next(n for n in range(1, len(taken) + 2) if n not in taken)
        numbers.setdefault(name, int(name) if name.lstrip("+-").isdigit() else free)
    cells = list(inside)
    tags = [np.zeros(len(nodes), np.int32) for _, nodes in inside]
    for kind in dict.fromkeys(kind for _, kind, _ in outside):
        own = [(name, nodes) for name, other, nodes in outside if other == kind]
        cells.append((kind, np.concatenate([nodes for _, nodes in own])))
        tags.append(np.concatenate([np.full(len(nodes), numbers[name], np.int32) for name, nodes in own]))
    sets = {
        name: [
            np.flatnonzero(values == number) if k >= len(inside) else np.zeros(0, np.int64)
            for k, values in enumerate(tags)
        ]
        for name, number in numbers.items()
    }
    return meshio.Mesh(points, cells, cell_data={"su2:tag": tags}, cell_sets=sets)


def _reduce(mesh: meshio.Mesh, dim: int) -> list[str]:
    named, material = sets_as_masks(mesh)[1], material_name(mesh, dim)
    lost, name = keep_boundary_tags(mesh, dim, "su2:tag", dim - 1)
    if name and name == material:
        lost.append(f"{name} of the elements")
    # markers are cell sets of the boundary
    mesh.cell_sets = {n: [np.flatnonzero(m) for m in ms] for n, ms in named.items()}
    top = [k for k, cells in enumerate(mesh.cells) if cells.dim == dim]
    lost += [n for n, ms in mesh.cell_sets.items() if any(len(ms[k]) for k in top)]
    return lost + list(mesh.point_sets)


def _upright(mesh: meshio.Mesh) -> np.ndarray:
    """x and y of a plane mesh; raises `ValueError` where they alone would not say where its elements are."""
    nodes = np.unique(np.concatenate([cells.data.ravel() for cells in mesh.cells if cells.dim == 2]))
    extent = np.ptp(mesh.points[nodes], axis=0)
    if len(extent) == 3 and extent[2] > 1e-5 * extent[:2].max():
        raise ValueError(
            "its files hold x and y of plane meshes and nothing else, but this one lies in another plane"
        )
    return mesh.points[:, :2]


def write_su2(path: Path, mesh: meshio.Mesh, dim: int, variant: str = "") -> list[str]:
    """Nodes, elements, and boundary cells by marker: by cell set, else by ``su2:tag``.

    Plane meshes are written without their third coordinate."""
    points = _upright(mesh) if dim == 2 else mesh.points
    inside = [k for k, cells in enumerate(mesh.cells) if cells.dim == dim]
    outside = [k for k, cells in enumerate(mesh.cells) if cells.dim == dim - 1]
    with open(path, "w") as out:
        out.write(f"NDIME= {dim}\nNPOIN= {len(points)}\n")
        np.savetxt(out, points, fmt="%.16e")
        out.write(f"NELEM= {sum(len(mesh.cells[k]) for k in inside)}\n")
        for k in inside:
            _write_rows(out, mesh.cells[k], slice(None))
        markers = _markers(mesh, outside)
        out.write(f"NMARK= {len(markers)}\n")
        for name, rows in markers.items():
            count = sum(len(rows[k]) for k in outside)
            out.write(f"MARKER_TAG= {name}\nMARKER_ELEMS= {count}\n")
            for k in outside:
                _write_rows(out, mesh.cells[k], rows[k])
        out.write(recall(mesh, _REST) or "")
    return []


def _write_rows(out, cells: meshio.CellBlock, rows) -> None:
    nodes = np.asarray(cells.data)[rows].astype(np.int64)
    np.savetxt(out, np.column_stack([np.full(len(nodes), _CODES[cells.type]), nodes]), fmt="%d")


def _markers(mesh: meshio.Mesh, outside: list[int]) -> dict[str, dict[int, np.ndarray]]:
    """Which boundary cells every marker has; a cell belongs to one marker only."""
    left = {k: np.ones(len(mesh.cells[k]), bool) for k in outside}
    found: dict[str, dict[int, np.ndarray]] = {}
    for name, members in mesh.cell_sets.items():
        rows = {k: np.zeros(0, np.int64) for k in outside}
        for k in outside:
            if k < len(members) and members[k] is not None and len(members[k]):
                rows[k] = np.asarray(members[k], dtype=np.int64)
        if any(len(r) for r in rows.values()) and all(left[k][rows[k]].all() for k in outside):
            found["_".join(name.split())] = rows
            for k in outside:
                left[k][rows[k]] = False
    tags = mesh.cell_data.get("su2:tag")
    tags = [np.zeros(len(cells), np.int64) for cells in mesh.cells] if tags is None else tags
    rest = {k: np.flatnonzero(left[k]) for k in outside}
    values = [tags[k][rest[k]] for k in outside]
    for tag in np.unique(np.concatenate(values)) if values else ():
        found[str(tag)] = {k: rest[k][tags[k][rest[k]] == tag] for k in outside}
    return found


def patch_su2(
    source: Source, old: Float[np.ndarray, "nodes dim"], new: Float[np.ndarray, "nodes dim"]
) -> Patched:
    """The file with other coordinates."""
    content = source.content.replace(b"\r\n", b" \n").replace(b"\r", b"\n")  # of the same length
    content = blanked(content, b"%")
    head = re.search(rb"^[ \t]*NPOIN[ \t]*=[ \t]*(\d+)[^\n]*\n", content, re.M | re.I)
    if head is None:
        raise UnpatchableError("it has no section NPOIN")
    following = re.compile(rb"^[^\n=]*=", re.M).search(content, head.end())
    starts, ends = tokens(content, head.end(), following.start() if following else len(content))
    count = int(head[1])
    if not count or len(starts) % count:
        raise UnpatchableError("the lines of its nodes don't have equally many numbers")
    columns = slice(0, old.shape[1])
    places = Places(starts.reshape(count, -1)[:, columns], ends.reshape(count, -1)[:, columns])
    return Patched(put_text(source.content, places, old, new), proven=True)


SU2 = Format(
    "su2",
    (".su2",),
    read_su2,
    write_su2,
    Holds(types=frozenset(_CODES), sets=True, reduce=_reduce),
    patch=patch_su2,
)
