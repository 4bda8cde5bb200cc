"""Abaqus' and CalculiX' .inp files.

meshio's reader (5.3.5) doesn't know pyramids nor most plane types, takes type names in capitals only,
mixes up sets that span several blocks or name other sets, and hangs on AVS files of the same suffix;
its writer turns C3D8 into C3D8RH and CPS3 into rigid R3D3.  So this format is read and written here.
"""

from __future__ import annotations

import re
from pathlib import Path

import meshio
import numpy as np

from jaxsmooth.elements import element_type

__all__ = ["is_abaqus", "read_abaqus", "write_abaqus"]

_WRITTEN = {
    "line": "T3D2",
    "line3": "T3D3",
    "triangle": "CPS3",
    "triangle6": "CPS6",
    "quad": "CPS4",
    "quad8": "CPS8",
    "tetra": "C3D4",
    "tetra10": "C3D10",
    "pyramid": "C3D5",
    "pyramid13": "C3D13",
    "wedge": "C3D6",
    "wedge15": "C3D15",
    "hexahedron": "C3D8",
    "hexahedron20": "C3D20",
    "hexahedron27": "C3D27",
    "quad9": "S9R5",
}
_SOLID = r"(?:DC|AC|F|EM|Q)?C?3D"
_PLANE = r"(?:CPS|CPE|CPEG|CAX|CGAX|DCAX|DC2D|AC2D|ACAX|DS|M3D|R3D|SFM3D|STRI|F2D|S)"
_FAMILIES = (
    (_SOLID, {4: "tetra", 5: "pyramid", 6: "wedge", 8: "hexahedron", 10: "tetra10", 13: "pyramid13"}),
    (_SOLID, {15: "wedge15", 20: "hexahedron20", 27: "hexahedron27"}),
    (_PLANE, {3: "triangle", 4: "quad", 6: "triangle6", 8: "quad8", 9: "quad9"}),
    (r"(?:T2D|T3D|DC1D)", {2: "line", 3: "line3"}),
    (r"B[23]", {1: "line", 2: "line3", 3: "line"}),
)


def is_abaqus(head: bytes) -> bool:
    """Whether a file begins as Abaqus files do: with a keyword, where AVS files have numbers."""
    lines = [line.strip() for line in head.splitlines()]
    first = next((line for line in lines if line and not line.startswith(b"#")), b"")
    return first.startswith(b"*")


def _meshio_type(name: str) -> str | None:
    """The cell type of an element name; what follows the number of nodes says how it is integrated."""
    name = name.upper().replace("STRI65", "STRI6")
    for prefix, types in _FAMILIES:
        matched = re.fullmatch(rf"{prefix}(\d+)[A-Z]*5?", name)
        if matched and int(matched[1]) in types:
            return types[int(matched[1])]
    return None


def read_abaqus(path: Path) -> tuple[meshio.Mesh, list[str]]:
    """Nodes, elements and sets of an input file; includes are followed.

    Returns the mesh and notes.  Raises `ValueError` in one sentence."""
    points, ids = np.zeros((0, 3)), np.zeros(0, np.int64)
    blocks: list[tuple[str, np.ndarray, np.ndarray]] = []
    node_sets: dict[str, list] = {}
    cell_sets: dict[str, list] = {}
    parts, others = 0, set()
    for key, options, lines in _cards(path):
        if key == "PART":
            parts += 1
            if parts > 1:
                raise ValueError("it has more than one *PART; write each part to a file of its own")
        elif key == "NODE":
            number, coordinates = _nodes(lines)
            points = np.concatenate([points, coordinates])
            ids = np.concatenate([ids, number])
            if "NSET" in options:
                node_sets.setdefault(options["NSET"], []).append(number)
        elif key == "ELEMENT":
            if "TYPE" not in options:
                raise ValueError("an *ELEMENT line has no TYPE")
            name = _meshio_type(options["TYPE"])
            numbers = _integers(lines)
            if name is None:
                raise ValueError(
                    f"element type {options['TYPE']} ({len(lines)} lines of it) is not supported; remove it"
                )
            width = 1 + element_type(name).k
            if len(numbers) % width:
                raise ValueError(f"elements of type {options['TYPE']} don't have {width - 1} nodes each")
            table = numbers.reshape(-1, width)
            blocks.append((name, table[:, 0], table[:, 1:]))
            if "ELSET" in options:
                cell_sets.setdefault(options["ELSET"], []).append(table[:, 0])
        elif key in ("NSET", "ELSET") and options.get(key):
            sets = node_sets if key == "NSET" else cell_sets
            sets.setdefault(options[key], []).extend(_set_members(lines, options))
        elif key not in ("HEADING", "END PART", "PREPRINT"):
            others.add(f"*{key}")
    order = np.argsort(ids, kind="stable")
    sorted_ids = ids[order]
    cells = [(name, _lookup(sorted_ids, order, nodes)) for name, _, nodes in blocks]
    point_sets = {}
    for name in node_sets:
        found = _lookup(sorted_ids, order, _resolve(node_sets, name))
        point_sets[name] = np.unique(found[found >= 0])
    sets = {}
    for name in cell_sets:
        wanted = _resolve(cell_sets, name)
        sets[name] = [np.flatnonzero(np.isin(own, wanted)) for _, own, _ in blocks]
    mesh = meshio.Mesh(points, cells, point_sets=point_sets, cell_sets=sets)
    if not others:
        return mesh, []
    named = ", ".join(sorted(others)[:4]) + (", …" if len(others) > 4 else "")
    return mesh, [f"only nodes, elements and sets of the Abaqus file are kept, not its other cards ({named})"]


def _cards(path: Path, depth: int = 0):
    """Keyword, options and data lines of every card."""
    text = path.read_text(encoding="utf-8", errors="replace")
    for card in re.split(r"^(?=\*[^*])", text, flags=re.MULTILINE):
        if not card.startswith("*") or card.startswith("**"):
            continue
        lines = [s for line in card.splitlines() if (s := line.strip()) and not s.startswith("**")]
        head = lines.pop(0)
        while head.endswith(",") and lines:
            head += lines.pop(0)
        words = [word.strip() for word in head[1:].split(",")]
        options = {}
        for word in words[1:]:
            name, _, value = word.partition("=")
            options[name.strip().upper()] = value.strip().strip('"')
        key = " ".join(words[0].upper().split())
        if key == "INCLUDE":
            other = path.parent / options.get("INPUT", "")
            if depth > 8 or not other.is_file():
                raise ValueError(f"its *INCLUDE file {options.get('INPUT', '')!r} isn't there")
            yield from _cards(other, depth + 1)
        else:
            yield key, options, lines


def _integers(lines: list[str]) -> np.ndarray:
    return np.array([word for word in ",".join(lines).split(",") if word.strip()], dtype=np.int64)


def _nodes(lines: list[str]) -> tuple[np.ndarray, np.ndarray]:
    if not lines:
        return np.zeros(0, np.int64), np.zeros((0, 3))
    rows = [line.rstrip(",").split(",")[:4] for line in lines]
    rows = [[word if word.strip() else "0" for word in row] + ["0"] * (4 - len(row)) for row in rows]
    table = np.char.replace(np.char.upper(np.array(rows)), "D", "E")  # Fortran's exponent
    return table[:, 0].astype(np.int64), table[:, 1:].astype(np.float64)


def _set_members(lines: list[str], options: dict[str, str]) -> list:
    words = [[word.strip() for word in line.split(",") if word.strip()] for line in lines]
    if "GENERATE" in options:
        ranges = [[int(word) for word in row] for row in words]
        return [np.arange(r[0], r[1] + 1, r[2] if len(r) > 2 else 1) for r in ranges]
    flat = [word for row in words for word in row]
    numbers = [word for word in flat if word.lstrip("+-").isdigit()]
    names = [word.strip('"') for word in flat if not word.lstrip("+-").isdigit()]
    return [np.array(numbers, dtype=np.int64), *names]


def _resolve(sets: dict[str, list], name: str, seen: tuple[str, ...] = ()) -> np.ndarray:
    """Numbers in a set, also those of the sets that it names."""
    folded = {key.upper(): key for key in sets}
    found = [np.zeros(0, np.int64)]
    for member in sets[name]:
        if isinstance(member, str):
            key = folded.get(member.upper())
            if key is None:
                raise ValueError(f"set {name!r} names the set {member!r}, which isn't there")
            found += [] if key in seen else [_resolve(sets, key, (*seen, name))]
        else:
            found.append(member)
    return np.unique(np.concatenate(found))


def _lookup(sorted_ids: np.ndarray, order: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Index of the nodes with these numbers; −1 where there is none."""
    if not len(sorted_ids):
        return np.full(wanted.shape, -1)
    at = np.minimum(np.searchsorted(sorted_ids, wanted), len(sorted_ids) - 1)
    return np.where(sorted_ids[at] == wanted, order[at], -1)


def write_abaqus(path: Path, mesh: meshio.Mesh) -> None:
    """Nodes, elements and sets; types that Abaqus doesn't have raise `ValueError`."""
    missing = [cells.type for cells in mesh.cells if cells.type not in _WRITTEN]
    if missing:
        raise ValueError(f"Abaqus files have no {missing[0]} elements")
    starts = np.cumsum([0] + [len(cells) for cells in mesh.cells])
    with open(path, "w") as out:
        out.write("*HEADING\nwritten by jaxsmooth\n*NODE\n")
        numbers = np.arange(1, len(mesh.points) + 1)
        width = mesh.points.shape[1]
        rows = np.column_stack([numbers, mesh.points])
        np.savetxt(out, rows, fmt=["%d"] + ["%.16e"] * width, delimiter=", ")
        for start, cells in zip(starts, mesh.cells, strict=False):
            out.write(f"*ELEMENT, TYPE={_WRITTEN[cells.type]}\n")
            numbers = np.arange(start + 1, start + len(cells) + 1)
            rows = np.column_stack([numbers, np.asarray(cells.data).astype(np.int64) + 1])
            lines = [["%d"] * len(part) for part in np.array_split(rows[0], -(-rows.shape[1] // 15))]
            np.savetxt(out, rows, fmt=",\n".join(map(",".join, lines)))  # a line has at most 16 numbers
        for name, members in mesh.cell_sets.items():
            pairs = zip(starts, members, strict=False)
            chosen = [start + np.asarray(rows) for start, rows in pairs if rows is not None]
            _write_set(out, "ELSET", name, np.concatenate(chosen or [np.zeros(0, int)]))
        for name, members in mesh.point_sets.items():
            members = np.asarray(members)
            _write_set(out, "NSET", name, np.flatnonzero(members) if members.dtype == bool else members)


def _write_set(out, key: str, name: str, members: np.ndarray) -> None:
    out.write(f"*{key}, {key}={name}\n")
    words = (members.astype(np.int64) + 1).astype(str)
    for k in range(0, len(words), 12):
        out.write(",".join(words[k : k + 12]) + ",\n")
