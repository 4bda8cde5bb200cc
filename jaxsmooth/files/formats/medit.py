"""Medit's meshes: a reader for text, the sets that meshio (5.3.5) drops, and what they hold.

meshio wants every count on a line of its own, knows few keywords, and takes files that end early."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import meshio
import numpy as np
from jaxtyping import Float

from jaxsmooth.convert.labels import HELD
from jaxsmooth.convert.regions import integers
from jaxsmooth.files.formats.record import Format, Holds, Patched, Source, UnpatchableError
from jaxsmooth.files.numbers import Places, blanked, put_binary, put_text, tokens
from jaxsmooth.files.reduction import UNKEPT, as_tags, tags_name

__all__ = ["MEDIT", "read_medit", "write_medit"]

_CELLS = {
    "Edges": "line",
    "Triangles": "triangle",
    "Quadrilaterals": "quad",
    "Tetrahedra": "tetra",
    "Prisms": "wedge",
    "Pyramids": "pyramid",
    "Hexahedra": "hexahedron",
    "Hexaedra": "hexahedron",
}
_NODES = {"line": 2, "triangle": 3, "quad": 4, "tetra": 4, "wedge": 6, "pyramid": 5, "hexahedron": 8}
_REQUIRED = {
    "RequiredEdges": "line",
    "RequiredTriangles": "triangle",
    "RequiredQuadrilaterals": "quad",
}
_SETS = ("Corners", "RequiredVertices")
_BINARY_VERTICES = 4
_BINARY_SETS = {13: "Corners", 15: "RequiredVertices"}


def read_medit(path: Path) -> tuple[meshio.Mesh, list[str]]:
    """A Medit file, as text or binary.

    Returns the mesh and notes.  Raises `ValueError` in one sentence."""
    if path.suffix.lower() == ".meshb":
        mesh = meshio.read(path, file_format="medit")
        mesh.point_sets = _binary_sets(path.read_bytes())
        return mesh, []
    text = re.sub(r"#.*", "", path.read_text(encoding="utf-8", errors="replace"))
    found = re.split(r"(?<![\w.])(?!nan\b|inf)([A-Za-z]\w+)", text)
    sections = list(zip(found[1::2], found[2::2], strict=True))
    if not sections:
        raise ValueError("it has no section that Medit files have")
    if sections[-1][0].lower() != "end":
        raise ValueError("it does not end with the keyword End; the file is damaged or cut short")
    return _mesh(sections)


def _mesh(sections: list[tuple[str, str]]) -> tuple[meshio.Mesh, list[str]]:
    dtype, dim, points, references = np.float64, 0, None, None
    cells, tags, notes, unkept, sets, required = [], [], [], [], {}, {}
    for key, body in sections:
        if key == "MeshVersionFormatted":
            dtype = np.float32 if body.strip() == "1" else np.float64
        elif key == "Dimension":
            dim = int(body)
        elif key == "Vertices":
            table = _rows(key, body, dim + 1, np.float64)
            points, references = table[:, :dim].astype(dtype), table[:, dim].astype(np.int64)
        elif key in _CELLS:
            table = _rows(key, body, _NODES[_CELLS[key]] + 1, np.int64)
            if len(table):
                cells.append((_CELLS[key], table[:, :-1] - 1))
                tags.append(table[:, -1])
        elif key in _SETS:
            sets[key] = _rows(key, body, 1, np.int64)[:, 0] - 1
        elif key in _REQUIRED:
            required[key] = _rows(key, body, 1, np.int64)[:, 0] - 1
        elif key.lower() != "end" and body.split() not in ([], ["0"]):
            unkept.append(key)
            notes.append(f"the section {key} of the Medit file is kept in Medit files only")
    if points is None or dim not in (2, 3):
        raise ValueError("it has no Dimension of 2 or 3 before its Vertices")
    for key, members in sets.items():
        wrong = (members < 0) | (members >= len(points))
        if wrong.any():
            raise ValueError(f"its section {key} names node {members[wrong][0] + 1}, of {len(points)} nodes")
    mesh = meshio.Mesh(
        points, cells, point_data={"medit:ref": references}, cell_data={"medit:ref": tags}, point_sets=sets
    )
    held = [np.zeros(0, np.int64)]
    for key, chosen in required.items():
        held.append(_nodes(_REQUIRED[key], chosen, cells))
        kept = f"{len(np.unique(held[-1]))} nodes are held, and it is kept in Medit files only"
        notes.append(f"the section {key} of the Medit file: its {kept}")
    unkept += required
    if unkept:
        mesh.info = {UNKEPT: [("", f"sections of the Medit file ({', '.join(unkept)})")]}
    if required:
        mesh.info[HELD] = np.unique(np.concatenate(held))
    return mesh, notes


def _rows(key: str, body: str, width: int, dtype) -> np.ndarray:
    try:
        numbers = np.array(body.split(), dtype=np.float64)
    except ValueError as error:
        raise ValueError(f"its section {key} has something that is not a number") from error
    if not len(numbers) or len(numbers) != 1 + numbers[0] * width:
        said = int(numbers[0]) if len(numbers) else "(missing)"
        raise ValueError(
            f"its section {key} has {max(len(numbers) - 1, 0)} numbers, not {width} for each of the {said} "
            "rows that it says; the file is damaged or cut short"
        )
    return numbers[1:].reshape(-1, width).astype(dtype)


def _nodes(name: str, chosen: np.ndarray, cells) -> np.ndarray:
    """Nodes of the chosen cells of one type, counted over all sections of that type."""
    own = [nodes for kind, nodes in cells if kind == name]
    table = np.concatenate(own) if own else np.zeros((0, _NODES[name]), np.int64)
    return table[chosen[(chosen >= 0) & (chosen < len(table))]].ravel()


def _binary_sections(content: bytes) -> Iterator[tuple[int, int]]:
    """Number of the keyword, and where its content begins: every section says where the next begins."""
    order, version, _ = _binary_types(content)
    place, at = f"{order}i{8 if version >= 3 else 4}", 8
    size = 4 + np.dtype(place).itemsize
    while 0 < at <= len(content) - size:
        yield int(np.frombuffer(content, f"{order}i4", 1, at)[0]), at + size
        following = int(np.frombuffer(content, place, 1, at + 4)[0])
        if following <= at:
            break
        at = following


def _binary_types(content: bytes) -> tuple[str, int, np.dtype]:
    """Byte order, version, and how whole numbers are stored."""
    order = "<" if content[:4] == b"\x01\0\0\0" else ">"
    version = int(np.frombuffer(content, f"{order}i4", 1, 4)[0])
    return order, version, np.dtype(f"{order}i{8 if version >= 4 else 4}")


def _binary_sets(content: bytes) -> dict[str, np.ndarray]:
    """Corners and required vertices of a binary file."""
    number, sets = _binary_types(content)[2], {}
    for key, start in _binary_sections(content):
        if key in _BINARY_SETS:
            count = int(np.frombuffer(content, number, 1, start)[0])
            members = np.frombuffer(content, number, count, start + number.itemsize)
            sets[_BINARY_SETS[key]] = members.astype(np.int64) - 1
    return sets


def _reduce(mesh: meshio.Mesh, dim: int) -> list[str]:
    lost, name = [*mesh.point_data, *mesh.cell_data], tags_name(mesh, dim)
    mesh.cell_data = {"medit:ref": as_tags(mesh.cell_data[name])} if name else {}
    values = integers(mesh.point_data["medit:ref"]) if "medit:ref" in mesh.point_data else None
    mesh.point_data = {"medit:ref": values} if values is not None else {}
    return [n for n in lost if n not in (name, "medit:ref")]


def write_medit(path: Path, mesh: meshio.Mesh, dim: int, variant: str = "") -> list[str]:
    """Write a mesh as text or, where the name ends in ``.meshb``, binary; only text has room for sets."""
    sets, mesh.point_sets = mesh.point_sets, {}
    meshio.write(path, mesh, file_format="medit")
    if path.suffix.lower() == ".meshb":
        return [f"binary medit files are written without sets: {', '.join(sets)}"] if sets else []
    if sets:
        text = path.read_text().rstrip().removesuffix("End")
        for name, members in sets.items():
            numbers = "\n".join(map(str, (np.asarray(members, dtype=np.int64) + 1).tolist()))
            text += f"{name}\n{len(members)}\n{numbers}\n"
        path.write_text(text + "\nEnd\n")
    return []


def patch_medit(
    source: Source, old: Float[np.ndarray, "nodes dim"], new: Float[np.ndarray, "nodes dim"]
) -> Patched:
    """The file with other coordinates."""
    content, width = source.content, old.shape[1]
    if source.path.suffix.lower() != source.output.suffix.lower():
        raise UnpatchableError(f"{source.path.suffix} and {source.output.suffix} are text and binary")
    if source.path.suffix.lower() == ".meshb":
        order, version, number = _binary_types(content)
        real = np.dtype(f"{order}f{4 if version == 1 else 8}")
        start = next(start for key, start in _binary_sections(content) if key == _BINARY_VERTICES)
        row = width * real.itemsize + number.itemsize
        first = start + number.itemsize + row * np.arange(len(old))[:, None]
        return Patched(
            put_binary(content, first + real.itemsize * np.arange(width), real, old, new), proven=True
        )
    plain = blanked(content, b"#")
    head = re.search(rb"(?<![\w.])Vertices\s+(\d+)", plain)
    if head is None:
        raise UnpatchableError("it has no section Vertices")
    starts, ends = tokens(plain, head.end(), _next_word(plain, head.end()))
    row = (width + 1) * np.arange(int(head[1]))[:, None] + np.arange(width)
    return Patched(put_text(content, Places(starts[row], ends[row]), old, new), proven=True)


def _next_word(content: bytes, start: int) -> int:
    """Where the next keyword begins: a letter behind a blank."""
    found = re.compile(rb"(?<=\s)[A-Za-z]").search(content, start)
    return found.start() if found else len(content)


MEDIT = Format(
    "medit",
    (".mesh", ".meshb"),
    read_medit,
    write_medit,
    Holds(types=frozenset(_NODES), sets=frozenset(_SETS), reduce=_reduce),
    patch=patch_medit,
)
