"""AFLR's .ugrid files as text: meshio (5.3.5) reads them in single precision and writes them broken."""

from __future__ import annotations

from pathlib import Path

import meshio
import numpy as np

from jaxsmooth.convert.checks import check_last_line
from jaxsmooth.files.formats.meshios import read_as
from jaxsmooth.files.formats.record import Format, Holds
from jaxsmooth.files.formats.tables import patch_table
from jaxsmooth.files.reduction import keep_boundary_tags, material_name

__all__ = ["UGRID", "is_text", "read_ugrid", "write_ugrid"]

_SURFACE = {"triangle": 3, "quad": 4}
_VOLUME = {"tetra": 4, "pyramid": 5, "wedge": 6, "hexahedron": 8}
_PYRAMID = [1, 0, 3, 4, 2]  # this package's nodes in the file's order
_BINARY = {"b8l", "b8", "b4", "lb8l", "lb8", "lb4", "r8", "r4", "lr8", "lr4"}


def is_text(path: Path) -> bool:
    """Whether the name is that of a text file; ``mesh.lb8.ugrid`` and others are binary."""
    return not _BINARY.intersection(part.lstrip(".").lower() for part in path.suffixes[-2:-1])


def read_ugrid(path: Path) -> tuple[meshio.Mesh, list[str]]:
    """A file as text or binary: the mesh, and notes."""
    return (_read_text(path), []) if is_text(path) else read_as("ugrid")(path)


def _read_text(path: Path) -> meshio.Mesh:
    """Nodes, boundary faces with their tags, and elements.  Raises `ValueError` in one sentence."""
    text = path.read_text()
    check_last_line(text.encode())
    numbers = np.array(text.split(), dtype=np.float64)
    if len(numbers) < 7 or (numbers[:7] < 0).any():
        raise ValueError("its first line does not have seven counts")
    count, *sizes = numbers[:7].astype(np.int64)
    kinds = dict(zip((*_SURFACE, *_VOLUME), sizes, strict=True))
    widths = {**_SURFACE, **_VOLUME}
    needed = 7 + 3 * count + sum(n * (widths[k] + (k in _SURFACE)) for k, n in kinds.items())
    if len(numbers) < needed:
        raise ValueError(
            f"it has {len(numbers)} numbers and its counts need {needed}; the file is damaged or cut short"
        )
    parts, at = [], 7
    for size in (
        3 * count,
        *(kinds[k] * _SURFACE[k] for k in _SURFACE),
        *(kinds[k] for k in _SURFACE),
        *(kinds[k] * _VOLUME[k] for k in _VOLUME),
    ):
        parts.append(numbers[at : at + size])
        at += size
    cells, tags = [], []
    for k, name in enumerate(kinds):
        nodes = parts[1 + k if name in _SURFACE else 3 + k].astype(np.int64).reshape(-1, widths[name]) - 1
        if len(nodes):
            cells.append((name, nodes[:, _PYRAMID] if name == "pyramid" else nodes))
            tags.append(parts[3 + k].astype(np.int64) if name in _SURFACE else np.zeros(len(nodes), np.int64))
    return meshio.Mesh(parts[0].reshape(-1, 3), cells, cell_data={"ugrid:ref": tags})


def write_ugrid(path: Path, mesh: meshio.Mesh, dim: int, variant: str = "") -> list[str]:
    """Nodes, boundary faces with ``ugrid:ref`` (else 1), and elements."""
    tags = mesh.cell_data.get("ugrid:ref", [np.ones(len(cells), np.int64) for cells in mesh.cells])
    found = {name: [k for k, c in enumerate(mesh.cells) if c.type == name] for name in (*_SURFACE, *_VOLUME)}
    points = np.zeros((len(mesh.points), 3))
    points[:, : mesh.points.shape[1]] = mesh.points
    with open(path, "w") as out:
        sizes = [sum(len(mesh.cells[k]) for k in own) for own in found.values()]
        out.write(" ".join(map(str, [len(points), *sizes])) + "\n")
        np.savetxt(out, points, fmt="%.16e")
        for name in _SURFACE:
            for k in found[name]:
                np.savetxt(out, mesh.cells[k].data.astype(np.int64) + 1, fmt="%d")
        for name in _SURFACE:
            for k in found[name]:
                np.savetxt(out, tags[k].astype(np.int64), fmt="%d")
        for name in _VOLUME:
            for k in found[name]:
                nodes = mesh.cells[k].data.astype(np.int64) + 1
                nodes = nodes[:, np.argsort(_PYRAMID)] if name == "pyramid" else nodes
                np.savetxt(out, nodes, fmt="%d")
    return []


def _reduce(mesh: meshio.Mesh, dim: int) -> list[str]:
    material = material_name(mesh, dim)
    lost, name = keep_boundary_tags(mesh, dim, "ugrid:ref", 2)
    return [*lost, f"{name} of the elements"] if dim == 3 and name and name == material else lost


def _refuse(path: Path) -> str | None:
    if is_text(path):
        return None
    return "ugrid files are written as text, and this name says binary; name it .ugrid"


UGRID = Format(
    "ugrid",
    (".ugrid",),
    read_ugrid,
    write_ugrid,
    Holds(
        types=frozenset({*_SURFACE, *_VOLUME}),
        reduce=_reduce,
    ),
    refuse=_refuse,
    patch=patch_table(rb"\A\s*(\d+)(?:\s+\d+){6}\s", 0),
)
