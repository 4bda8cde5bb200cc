"""I-deas' universal files: nodes (dataset 2411), elements (2412) and groups.

A dataset stands between two lines that hold −1; the line behind the first is its number.  The records are
those of SDRC's "Universal File Datasets"; quadratic elements have their mid-side nodes between the corners.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import meshio
import numpy as np
from jaxtyping import Float

from jaxsmooth.files.formats.record import Format, Holds, Patched, Source, UnpatchableError
from jaxsmooth.files.numbers import Places, put_text, tokens
from jaxsmooth.files.reduction import UNKEPT, data_to_sets, tags_name

__all__ = ["UNV", "patch_unv", "read_unv", "write_unv"]

_CUT = "the file is damaged or cut short"
_NAMES = {
    **dict.fromkeys((11, 21), "line"),
    **dict.fromkeys((22, 23, 24), "line3"),
    **dict.fromkeys((41, 51, 61, 71, 74, 81, 91), "triangle"),
    **dict.fromkeys((42, 52, 62, 72, 82, 92), "triangle6"),
    **dict.fromkeys((44, 54, 64, 84, 94), "quad"),
    **dict.fromkeys((45, 55, 65, 85, 95), "quad8"),
    111: "tetra",
    112: "wedge",
    113: "wedge15",
    115: "hexahedron",
    116: "hexahedron20",
    118: "tetra10",
}
_CODES = {
    "line": 11,
    "line3": 24,
    "triangle": 91,
    "triangle6": 92,
    "quad": 94,
    "quad8": 95,
    "tetra": 111,
    "tetra10": 118,
    "wedge": 112,
    "wedge15": 113,
    "hexahedron": 115,
    "hexahedron20": 116,
}
_BEAMS = range(11, 33)  # have a record of three numbers more
_ORDER = {
    "line3": [0, 2, 1],
    "triangle6": [0, 3, 1, 4, 2, 5],
    "quad8": [0, 4, 1, 5, 2, 6, 3, 7],
    "tetra10": [0, 4, 1, 5, 2, 6, 7, 8, 9, 3],
    "wedge15": [0, 6, 1, 7, 2, 8, 12, 13, 14, 3, 9, 4, 10, 5, 11],
    "hexahedron20": [0, 8, 1, 9, 2, 10, 3, 11, 16, 17, 18, 19, 4, 12, 5, 13, 6, 14, 7, 15],
}
"""Nodes of VTK's element in the order of the file, where the two differ."""

_NODES, _ELEMENTS = (2411, 781), (2412,)
_GROUPS = {2435: 4, 2452: 4, 2467: 4, 2477: 4, 2417: 2, 2429: 2, 2430: 2, 2432: 2}  # numbers for each member


def _datasets(content: bytes) -> Iterator[tuple[int, int, int]]:
    """Number of each dataset, first byte of its records, and the byte behind the last."""
    marks = list(re.finditer(rb"^ {4}-1[ \t\r]*$\n?", content, re.M))
    if len(marks) % 2 or not marks:
        raise ValueError(f"its datasets don't all begin and end with a line of -1; {_CUT}")
    for first, last in zip(marks[::2], marks[1::2], strict=True):
        head = content.find(b"\n", first.end()) + 1
        number = re.match(rb"\s*(\d+)", content[first.end() : head])
        if number is None:
            raise ValueError(f"a dataset of it has no number; {_CUT}")
        yield int(number[1]), head, last.start()


def read_unv(path: Path) -> tuple[meshio.Mesh, list[str]]:
    """Nodes, elements and groups of a universal file.

    Returns the mesh and notes.  Raises `ValueError` in one sentence."""
    content, others = path.read_bytes(), []
    ids, points, elements, groups = None, None, None, {}
    for number, start, end in _datasets(content):
        lines = content[start:end].decode(errors="replace").splitlines()
        if number in _NODES and ids is None:
            ids, points = _nodes(lines)
        elif number in _ELEMENTS and elements is None:
            elements = _elements(lines)
        elif number in _GROUPS:
            groups.update(_groups(lines, _GROUPS[number]))
        else:
            others.append(str(number))
    if ids is None or points is None or elements is None:
        raise ValueError("it has no nodes (dataset 2411) or no elements (dataset 2412)")
    mesh = _mesh(ids, points, elements, groups)
    notes = []
    if others:
        named = ", ".join(dict.fromkeys(others))
        mesh.info = {UNKEPT: [("", f"the other datasets of the universal file ({named})")]}
        notes.append(
            f"datasets of the universal file that are not mesh are kept in .unv files only ({named})"
        )
    return mesh, notes


def _nodes(lines: list[str]) -> tuple[np.ndarray, np.ndarray]:
    if len(lines) % 2:
        raise ValueError(f"its nodes don't have two lines each; {_CUT}")
    ids = np.array([int(line.split()[0]) for line in lines[::2]])
    rows = [line.upper().replace("D", "E").split() for line in lines[1::2]]
    if any(len(row) != 3 for row in rows):
        raise ValueError(f"its nodes don't all have three coordinates; {_CUT}")
    return ids, np.array(rows, dtype=np.float64).reshape(-1, 3)


def _elements(lines: list[str]) -> list[tuple[str, int, int, list[int]]]:
    """Type, number, physical property and nodes of each element."""
    found, at = [], 0
    while at < len(lines):
        head = [int(word) for word in lines[at].split()]
        if len(head) != 6:
            raise ValueError(f"its element records don't have six numbers; {_CUT}")
        if head[1] not in _NAMES:
            raise ValueError(f"elements of type {head[1]} are not supported; remove element {head[0]}")
        at += 2 if head[1] in _BEAMS else 1
        nodes: list[int] = []
        while len(nodes) < head[5]:
            if at >= len(lines):
                raise ValueError(f"its last element has {len(nodes)} nodes and says {head[5]}; {_CUT}")
            nodes += [int(word) for word in lines[at].split()]
            at += 1
        found.append((_NAMES[head[1]], head[0], head[2], nodes))
    return found


def _groups(lines: list[str], width: int) -> Iterator[tuple[str, np.ndarray]]:
    """Name and members ``[members, 2]`` (7: node, 8: element; and its number) of each group."""
    at = 0
    while at < len(lines):
        head = [int(word) for word in lines[at].split()]
        count = head[-1]
        rows = -(-count * width // 8)
        numbers = np.array(" ".join(lines[at + 2 : at + 2 + rows]).split(), dtype=np.int64)
        if len(head) < 7 or len(numbers) != count * width:
            raise ValueError(f"a group of it has {len(numbers)} numbers and says {count} members; {_CUT}")
        yield lines[at + 1].strip(), numbers.reshape(-1, width)[:, :2]
        at += 2 + rows


def _mesh(ids: np.ndarray, points: np.ndarray, elements: list, groups: dict[str, np.ndarray]) -> meshio.Mesh:
    cells, numbers, properties = [], [], []
    for kind in dict.fromkeys(name for name, *_ in elements):
        own = [one for one in elements if one[0] == kind]
        if len({len(nodes) for *_, nodes in own}) > 1:
            raise ValueError(f"its {kind} elements don't have equally many nodes; {_CUT}")
        nodes = _index(ids, np.array([nodes for *_, nodes in own]), "an element refers to node")
        cells.append((kind, nodes[:, np.argsort(_ORDER[kind])] if kind in _ORDER else nodes))
        numbers.append(np.array([number for _, number, _, _ in own]))
        properties.append(np.array([tag for _, _, tag, _ in own]))
    point_sets, cell_sets = {}, {}
    for name, members in groups.items():
        of_nodes, of_cells = members[members[:, 0] == 7, 1], members[members[:, 0] == 8, 1]
        if len(of_nodes):
            point_sets[name] = np.unique(_index(ids, of_nodes, f"the group {name} refers to node"))
        if len(of_cells):
            cell_sets[name] = [np.flatnonzero(np.isin(own, of_cells)) for own in numbers]
    return meshio.Mesh(
        points, cells, cell_data={"unv:property": properties}, point_sets=point_sets, cell_sets=cell_sets
    )


def _index(ids: np.ndarray, wanted: np.ndarray, what: str) -> np.ndarray:
    order = np.argsort(ids, kind="stable")
    at = order[np.minimum(np.searchsorted(ids, wanted, sorter=order), len(ids) - 1)]
    wrong = ids[at] != wanted
    if wrong.any():
        raise ValueError(f"{what} {wanted[wrong][0]}, which is not there; {_CUT}")
    return at


def write_unv(path: Path, mesh: meshio.Mesh, dim: int, variant: str = "") -> list[str]:
    """Nodes, elements with their material as physical property, and sets as groups."""
    tags = mesh.cell_data.get("unv:property") or [np.ones(len(c), np.int64) for c in mesh.cells]
    starts = np.cumsum([0] + [len(cells) for cells in mesh.cells])
    with open(path, "w") as out:
        out.write("    -1\n  2411\n")
        for number, row in enumerate(mesh.points.tolist(), 1):
            words = "".join(f"{value:25.16E}" for value in row).replace("E", "D")
            out.write(f"{number:10d}{1:10d}{1:10d}{11:10d}\n{words}\n")
        out.write("    -1\n    -1\n  2412\n")
        for start, cells, own in zip(starts, mesh.cells, tags, strict=False):
            nodes = cells.data[:, _ORDER[cells.type]] if cells.type in _ORDER else cells.data
            for number, (row, tag) in enumerate(
                zip((nodes + 1).tolist(), own.tolist(), strict=True), int(start) + 1
            ):
                head = (number, _CODES[cells.type], tag, 1, 7, len(row))
                beam = f"{0:10d}{1:10d}{1:10d}\n" if _CODES[cells.type] in _BEAMS else ""
                out.write("".join(f"{n:10d}" for n in head) + "\n" + beam + _eights(row))
        out.write("    -1\n")
        groups = [(name, 7, np.asarray(members)) for name, members in mesh.point_sets.items()]
        for name, members in mesh.cell_sets.items():
            pairs = [(s, r) for s, r in zip(starts, members, strict=False) if r is not None]
            groups.append((name, 8, np.concatenate([s + np.asarray(r, np.int64) for s, r in pairs])))
        if groups:
            out.write("    -1\n  2467\n")
            for number, (name, kind, members) in enumerate(groups, 1):
                rows = [n for member in members.tolist() for n in (kind, member + 1, 0, 0)]
                head = (number, 0, 0, 0, 0, 0, 0, len(members))
                out.write("".join(f"{n:10d}" for n in head) + f"\n{name}\n" + _eights(rows))
            out.write("    -1\n")
    return []


def _eights(numbers: list[int]) -> str:
    """Numbers in lines of eight."""
    lines = [numbers[k : k + 8] for k in range(0, len(numbers), 8)]
    return "".join("".join(f"{n:10d}" for n in line) + "\n" for line in lines)


def _reduce(mesh: meshio.Mesh, dim: int) -> list[str]:
    name = tags_name(mesh, dim)
    tags = mesh.cell_data.pop(name) if name else None
    lost = data_to_sets(mesh, dim)
    mesh.point_data = {}
    mesh.cell_data = {} if tags is None else {"unv:property": [np.asarray(t).astype(np.int64) for t in tags]}
    return lost


def patch_unv(
    source: Source, old: Float[np.ndarray, "nodes dim"], new: Float[np.ndarray, "nodes dim"]
) -> Patched:
    """The file with other coordinates."""
    found = [span for number, *span in _datasets(source.content) if number in _NODES]
    if len(found) < 1:
        raise UnpatchableError("it has no nodes")
    starts, ends = tokens(source.content, *found[0])
    if len(starts) != 7 * len(old):
        raise UnpatchableError("its nodes don't have four numbers and three coordinates each")
    columns = slice(4, 7)
    places = Places(starts.reshape(-1, 7)[:, columns], ends.reshape(-1, 7)[:, columns])
    return Patched(put_text(source.content, places, old, new))  # in columns, so it is read again


UNV = Format(
    "unv",
    (".unv",),
    read_unv,
    write_unv,
    Holds(types=frozenset(_CODES), sets=True, space=True, reduce=_reduce),
    patch=patch_unv,
)
