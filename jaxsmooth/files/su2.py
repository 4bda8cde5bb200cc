"""SU2's meshes: names of markers, which meshio (5.3.5) drops, and a writer that works with markers."""

from __future__ import annotations

import re
from pathlib import Path

import meshio
import numpy as np

__all__ = ["name_markers", "write_su2"]

_CODES = {"line": 3, "triangle": 5, "quad": 9, "tetra": 10, "hexahedron": 12, "wedge": 13, "pyramid": 14}


def name_markers(mesh: meshio.Mesh, content: bytes) -> None:
    """Give a mesh that meshio read cell sets with the names of its markers."""
    number, tags = 0, {}
    for word in re.findall(rb"^\s*MARKER_TAG\s*=\s*(.*?)\s*$", content, re.MULTILINE):
        name = word.decode(errors="replace")
        number = int(name) if name.lstrip("+-").isdigit() else number + 1  # as meshio numbers them
        tags[name] = number
    top = max((cells.dim for cells in mesh.cells), default=0)
    for name, tag in tags.items():
        mesh.cell_sets[name] = [
            np.flatnonzero(values == tag) if cells.dim < top else np.zeros(0, np.int64)
            for cells, values in zip(mesh.cells, mesh.cell_data["su2:tag"], strict=True)
        ]


def write_su2(path: Path, mesh: meshio.Mesh) -> None:
    """Nodes, elements, and boundary cells by marker: by cell set, else by ``su2:tag``."""
    dim = mesh.points.shape[1]
    inside = [k for k, cells in enumerate(mesh.cells) if cells.dim == dim]
    outside = [k for k, cells in enumerate(mesh.cells) if cells.dim == dim - 1]
    with open(path, "w") as out:
        out.write(f"NDIME= {dim}\nNPOIN= {len(mesh.points)}\n")
        np.savetxt(out, mesh.points, fmt="%.16e")
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
