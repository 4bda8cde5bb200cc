"""Gmsh's .msh files where meshio (5.3.5) falls short: repairs before it reads, and a 4.1 writer.

- 2.2: data of cells are split wrongly between blocks, so they are read here.
- 4.0: its first lines say 4, which meshio takes for 4.1.
- 4.x: nodes with parametric coordinates are refused, so those are left out; it knows no partitions.
- 4.x: entities without a physical group beside others with one make meshio refuse the file, so
  those get the group 0, which is how meshio says "none".
- 4.1 written by meshio can't be read again when an entity has no nodes of its own, when one has
  cells of two types, or when the source wasn't 4.1; hence the writer here.
- Nodes of two types are left in Gmsh's order; they are put in VTK's here, and back.
"""

from __future__ import annotations

import copy
import io
import re
import struct
from collections.abc import Sequence
from pathlib import Path

import meshio
import numpy as np

from jaxsmooth.convert.regions import GROUPS, recall
from jaxsmooth.files.formats.mshnodes import without_parameters
from jaxsmooth.files.formats.mshraw import Entity, msh_format, read_entities, section_span
from jaxsmooth.files.formats.mshtypes import CODES, in_gmsh_order

__all__ = [
    "keep_groups",
    "read_msh_data",
    "repaired_msh",
    "sniff_msh",
    "split_by_entity",
    "write_data_sections",
    "write_msh41",
]


def sniff_msh(head: bytes) -> str | None:
    """``"gmsh22:ascii"``, ``"gmsh:binary"`` … from the first bytes of a file; None if it isn't Gmsh's."""
    found = re.search(rb"^\s*\$MeshFormat\s+(\d)(?:\.(\d+))?\s+([01])\s", head, re.MULTILINE)
    if found is None:
        return None
    return ("gmsh22" if found[1] == b"2" else "gmsh") + (":binary" if found[3] == b"1" else ":ascii")


def repaired_msh(content: bytes) -> bytes:
    """The file as meshio can read it; the same object when there is nothing to repair."""
    if (found := msh_format(content)) is None:
        return content
    version, binary, size = found
    if version.startswith("2"):
        return re.sub(rb"\$ElementData\r?\n.*?\$EndElementData[^\n]*\n?", b"", content, flags=re.DOTALL)
    if not version.startswith("4"):
        return content
    content = _with_physical_groups(without_parameters(content), binary, size)
    return re.sub(rb"^(\$MeshFormat\s+4)(?=\s)", rb"\1.0", content, count=1)  # 4.1 to meshio


def read_msh_data(content: bytes, mesh: meshio.Mesh) -> dict[str, list[np.ndarray]]:
    """The cell data of a 2.2 file, split over the cell blocks of `mesh`; cells without data get NaN."""
    if re.search(rb"\$MeshFormat\s+2", content[:4096]) is None:
        return {}
    binary = sniff_msh(content[:4096]) == "gmsh22:binary"
    sizes = [len(cells) for cells in mesh.cells]
    found: dict[str, list[np.ndarray]] = {}
    for section in re.finditer(rb"\$ElementData\r?\n(.*?)\$EndElementData", content, flags=re.DOTALL):
        lines, rest = [], section[1]

        def line(lines=lines):
            nonlocal rest
            first, _, rest = rest.partition(b"\n")
            lines.append(first)
            return first.decode().strip()

        names = [line().strip('"') for _ in range(int(line()))]
        for _ in range(int(line())):
            line()
        integers = [int(line()) for _ in range(int(line()))]
        width, rows = integers[1], integers[2]
        if binary:
            table = np.frombuffer(rest, dtype=[("index", "<i4"), ("values", "<f8", (width,))], count=rows)
            index, values = table["index"], table["values"]
        else:
            table = np.array(rest.split(), dtype=float).reshape(rows, 1 + width)
            index, values = table[:, 0].astype(np.int64), table[:, 1:]
        # Cells are counted from 1 in the order of the file, as meshio takes them for all it reads.
        full = np.full((sum(sizes), width), np.nan)
        inside = (index >= 1) & (index <= len(full))
        full[index[inside] - 1] = values[inside]
        full = full[:, 0] if width == 1 else full
        found[names[0]] = np.split(full, np.cumsum(sizes)[:-1])
    return found


def keep_groups(mesh: meshio.Mesh, entities: Sequence[Entity]) -> None:
    """Give a mesh of version 4 what meshio drops: the entities of partitions, and all groups of an entity.

    ``gmsh:physical`` has room for one; the group with the fewest cells says most about them."""
    groups = {(one.dim, one.tag): one.groups for one in entities}
    several = {key: own for key, own in groups.items() if len(own) > 1}
    tags = mesh.cell_data.get("gmsh:geometrical", [])
    keys = [(cells.dim, int(own[0])) for cells, own in zip(mesh.cells, tags, strict=False)]
    if several and "gmsh:physical" in mesh.cell_data:
        sizes: dict[tuple[int, int], int] = {}
        for key, cells in zip(keys, mesh.cells, strict=True):
            for group in groups.get(key, ()):
                sizes[key[0], group] = sizes.get((key[0], group), 0) + len(cells)
        for k, key in enumerate(keys):
            if key in several:
                least = min(several[key], key=lambda group, dim=key[0]: sizes[dim, group])
                mesh.cell_data["gmsh:physical"][k] = np.full(len(mesh.cells[k]), least)
        mesh.info = {GROUPS: several}
    parents = {(one.dim, one.tag): one.parent for one in entities if one.parent is not None}
    for k, key in enumerate(keys):
        if key in parents and parents[key][0] == key[0]:
            tags[k] = np.full(len(mesh.cells[k]), parents[key][1])


def _with_physical_groups(content: bytes, binary: bool, size: int) -> bytes:
    """Entities of partitions among the others, and the group 0 for those without beside others with one."""
    found = read_entities(content)
    several = len({bool(one.groups) for one in found}) > 1
    if not found or not (several or any(one.parent for one in found)):
        return content
    found = sorted({(one.dim, one.tag): one for one in found[::-1]}.values(), key=lambda one: one[:2])
    number = f"<u{size}"
    rows = [[(number, [sum(one.dim == dim for one in found) for dim in range(4)])]]
    for one in found:
        groups = one.groups or [0] * several
        row = [("<i4", one.tag), ("<f8", one.box), (number, len(groups)), ("<i4", groups)]
        rows.append(row + ([(number, len(one.bounds)), ("<i4", one.bounds)] if one.dim else []))
    out = io.BytesIO()
    _section(out, "Entities", rows, binary)
    start, end = section_span(content, "Entities")
    start = content.rindex(b"$Entities", 0, start)
    return content[:start] + out.getvalue().rstrip() + content[end + len(b"$EndEntities") :]


# --- Writing 4.1 -------------------------------------------------------------------------


def split_by_entity(mesh: meshio.Mesh) -> meshio.Mesh:
    """Cell blocks divided so that each has one physical and one geometrical tag, as 4.1 wants.

    Geometrical tags that stand for cells of several physical groups, or are missing, get new numbers."""
    blocks, parts, pairs, taken = [], [], [], {}
    for k, cells in enumerate(mesh.cells):
        zero = np.zeros(len(cells), np.int64)
        physical, geometrical = (
            np.asarray(mesh.cell_data[name][k]).astype(np.int64) if name in mesh.cell_data else zero
            for name in ("gmsh:physical", "gmsh:geometrical")
        )
        keys, inverse = np.unique(np.stack([physical, geometrical], 1), axis=0, return_inverse=True)
        for i, (group, tag) in enumerate(keys):
            blocks.append(np.flatnonzero(inverse.ravel() == i))
            parts.append(k)
            pairs.append((cells.dim, int(group), int(tag)))
    for dim, group, tag in dict.fromkeys(pairs):
        used = {t for (d, _, _), t in taken.items() if d == dim}
        wanted = {t for d, _, t in pairs if d == dim} | used
        free = max([0, *wanted]) + 1
        choice = tag if tag > 0 and tag not in used else free
        taken[dim, group, tag] = choice
    out = copy.copy(mesh)
    out.cells = [
        meshio.CellBlock(mesh.cells[k].type, np.asarray(mesh.cells[k].data)[rows])
        for k, rows in zip(parts, blocks, strict=True)
    ]
    out.cell_data = {
        name: [np.asarray(values[k])[rows] for k, rows in zip(parts, blocks, strict=True)]
        for name, values in mesh.cell_data.items()
    }
    for name, at in (("gmsh:physical", 1), ("gmsh:geometrical", None)):
        out.cell_data[name] = [
            np.full(len(rows), taken[pair] if at is None else pair[at])
            for pair, rows in zip(pairs, blocks, strict=True)
        ]
    if len(blocks) != len(mesh.cells):  # sets that count cells no longer fit; masks stand for them
        out.cell_sets = {}
    return out


def write_data_sections(path: Path, mesh: meshio.Mesh, binary: bool) -> None:
    """Append the point and cell data of a mesh to a .msh file (meshio's ascii ones are not numbers)."""
    with open(path, "ab") as out:
        for name, values in mesh.point_data.items():
            if name != "gmsh:dim_tags":
                _write_data(out, "NodeData", name, values, binary)
        for name, parts in mesh.cell_data.items():
            if name not in ("gmsh:physical", "gmsh:geometrical"):
                _write_data(out, "ElementData", name, np.concatenate(parts), binary)


def write_msh41(path: Path, mesh: meshio.Mesh, binary: bool) -> None:
    """Write a Gmsh 4.1 file.  Every cell block has one value of ``gmsh:physical`` and one of
    ``gmsh:geometrical``, see `split_by_entity`."""
    points = np.zeros((len(mesh.points), 3))
    points[:, : mesh.points.shape[1]] = mesh.points
    entities = _all_entities(mesh, points)
    with open(path, "wb") as out:
        out.write(f"$MeshFormat\n4.1 {int(binary)} 8\n".encode())
        if binary:
            out.write(struct.pack("<i", 1) + b"\n")
        out.write(b"$EndMeshFormat\n")
        groups = sorted(
            (int(v[1]), int(v[0]), name) for name, v in mesh.field_data.items() if np.shape(v) == (2,)
        )
        if groups:
            rows = "".join(f'{dim} {tag} "{name}"\n' for dim, tag, name in groups)
            out.write(f"$PhysicalNames\n{len(groups)}\n{rows}$EndPhysicalNames\n".encode())
        _section(out, "Entities", _entity_rows(entities), binary)
        _section(out, "Nodes", _node_rows(mesh, points, entities), binary)
        _section(out, "Elements", _element_rows(mesh), binary)
        if mesh.gmsh_periodic:
            _section(out, "Periodic", _periodic_rows(mesh.gmsh_periodic), binary)
    write_data_sections(path, mesh, binary)


def _section(out, name: str, rows, binary: bool) -> None:
    """One section; a row is a list of (dtype, values), a line of its own in ascii."""
    out.write(f"${name}\n".encode())
    for row in rows:
        if binary:
            for dtype, values in row:
                out.write(np.ascontiguousarray(values, dtype=dtype).tobytes())
        elif len(row) == 1 and np.ndim(row[0][1]) == 2:
            np.savetxt(out, row[0][1], fmt="%.16e" if row[0][0] == "<f8" else "%d")
        else:
            text = [("%.16e" if dtype == "<f8" else "%d") % v for dtype, vs in row for v in np.atleast_1d(vs)]
            out.write(" ".join(text).encode() + b"\n")
    out.write(b"\n" * binary + f"$End{name}\n".encode())


def _all_entities(mesh: meshio.Mesh, points: np.ndarray) -> dict[tuple[int, int], dict]:
    """All entities {(dim, tag): box, groups, bounds}: those of cells and those of nodes."""
    found: dict[tuple[int, int], dict] = {}
    tags = mesh.point_data.get("gmsh:dim_tags")
    if tags is not None:
        unique, inverse = np.unique(np.asarray(tags), axis=0, return_inverse=True)
        for k, (dim, tag) in enumerate(unique):
            own = points[inverse.ravel() == k]
            box = own.min(axis=0), own.max(axis=0)
            found[int(dim), int(tag)] = {"box": box, "groups": [], "bounds": []}
    bounding = mesh.cell_sets.get("gmsh:bounding_entities", [])
    for k, cells in enumerate(mesh.cells):
        key = cells.dim, int(mesh.cell_data["gmsh:geometrical"][k][0])
        own = points[np.unique(cells.data)]
        entity = found.setdefault(key, {"groups": [], "bounds": []})
        low, high = entity.get("box", (own[0], own[0]))
        entity["box"] = (np.minimum(low, own.min(axis=0)), np.maximum(high, own.max(axis=0)))
        groups = [int(mesh.cell_data["gmsh:physical"][k][0])]
        several = (recall(mesh, GROUPS) or {}).get(key, [])
        groups = list(several) if groups[0] in several else groups
        for name, value in mesh.field_data.items():  # an entity may be in several groups
            members = mesh.cell_sets.get(name)
            if np.shape(value) == (2,) and value[1] == cells.dim and members is not None and k < len(members):
                groups += [int(value[0])] if members[k] is not None and len(members[k]) else []
        entity["groups"] += [g for g in dict.fromkeys(groups) if g and g not in entity["groups"]]
        if k < len(bounding) and bounding[k] is not None and not entity["bounds"]:
            entity["bounds"] = [int(b) for b in bounding[k]]
    return dict(sorted(found.items()))


def _entity_rows(entities):
    yield [("<u8", [sum(dim == d for dim, _ in entities) for d in range(4)])]
    for (dim, tag), entity in entities.items():
        box = entity["box"][0] if dim == 0 else np.concatenate(entity["box"])
        row = [("<i4", tag), ("<f8", box), ("<u8", len(entity["groups"])), ("<i4", entity["groups"])]
        yield row + ([("<u8", len(entity["bounds"])), ("<i4", entity["bounds"])] if dim else [])


def _node_rows(mesh, points, entities):
    """Nodes by entity, where the source says which; else all of them in the first of the highest."""
    tags = mesh.point_data.get("gmsh:dim_tags")
    top = max(dim for dim, _ in entities)
    home = next(key for key in entities if key[0] == top)
    if tags is None:
        tags = np.tile(home, (len(points), 1))
    unique, inverse = np.unique(np.asarray(tags), axis=0, return_inverse=True)
    order = np.argsort(inverse.ravel(), kind="stable")
    parts = np.split(order, np.cumsum(np.bincount(inverse.ravel()))[:-1])
    yield [("<u8", [len(unique), len(points), 1, len(points)])]
    for (dim, tag), own in zip(unique, parts, strict=True):
        yield [("<i4", [dim, tag, 0]), ("<u8", len(own))]
        yield [("<u8", own[:, None] + 1)]
        yield [("<f8", points[own])]


def _element_rows(mesh):
    total = sum(len(cells) for cells in mesh.cells)
    yield [("<u8", [len(mesh.cells), total, 1, total])]
    first = 1
    for k, cells in enumerate(mesh.cells):
        nodes = in_gmsh_order(cells.type, cells.data)
        tag = int(mesh.cell_data["gmsh:geometrical"][k][0])
        yield [("<i4", [cells.dim, tag, CODES[cells.type]]), ("<u8", len(nodes))]
        yield [("<u8", np.column_stack([np.arange(first, first + len(nodes)), nodes.astype(np.int64) + 1]))]
        first += len(nodes)


def _periodic_rows(links):
    yield [("<u8", len(links))]
    for dim, (tag, source), affine, pairs in links:
        affine = [] if affine is None else np.ravel(affine)
        yield [("<i4", [dim, tag, source])]
        yield [("<u8", len(affine)), ("<f8", affine)]
        pairs = np.asarray(pairs).astype(np.int64).reshape(-1, 2) + 1
        yield [("<u8", len(pairs))]
        if len(pairs):
            yield [("<u8", pairs)]


def _write_data(out, section: str, name: str, values: np.ndarray, binary: bool) -> None:
    values = np.asarray(values, float).reshape(len(values), -1)
    width = values.shape[1]
    if width not in (1, 3, 9):
        if width > 9:  # no room in a tensor
            for k in range(width):
                _write_data(out, section, f"{name}_{k}", values[:, k], binary)
            return
        wider = 3 if width == 2 else 9
        values = np.pad(values, ((0, 0), (0, wider - width)))
        width = wider
    out.write(f'${section}\n1\n"{name}"\n1\n0.0\n3\n0\n{width}\n{len(values)}\n'.encode())
    if binary:
        table = np.empty(len(values), dtype=[("index", "<i4"), ("values", "<f8", (width,))])
        table["index"], table["values"] = np.arange(1, len(values) + 1), values
        out.write(table.tobytes() + b"\n")
    else:
        rows = np.column_stack([np.arange(1, len(values) + 1), values])
        np.savetxt(out, rows, fmt=["%d"] + ["%.16e"] * width)
    out.write(f"$End{section}\n".encode())
