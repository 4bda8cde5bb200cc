"""Whether the cells of a file make a mesh; messages name what its user finds in the file."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np
from meshio._mesh import topological_dimension

from jaxsmooth.cells.table import TYPES, element_type, supported
from jaxsmooth.mesh.record import check_size

__all__ = [
    "SYNONYMS",
    "MeshFileError",
    "check_cells",
    "check_last_line",
    "check_points",
    "check_references",
    "dimension",
    "element_dim",
    "parse_numbers",
    "tell_meshio",
]

# meshio refuses to build cells of a type whose dimension it doesn't list.  These gaps of its
# table (5.3.5; named in its `__all__` but not exported) are filled once, where nothing is listed.
for _name, _dim in {
    "wedge15": 3,
    "pyramid13": 3,
    "tetra4": 3,
    "tetra8": 3,
    "tetra14": 3,
    "hexahedron9": 3,
    "hexahedron24": 3,
    "hexahedron1331": 3,
    "triangle7": 2,
    "quad5": 2,
    "quad6": 2,
}.items():
    topological_dimension.setdefault(_name, _dim)

SYNONYMS = {"tetra4": "tetra"}  # some of meshio's readers use another name


class MeshFileError(ValueError):
    """A mesh that can't be read, used or written; the message is one sentence for its user."""


def tell_meshio(name: str) -> None:
    """Let meshio build cells of a type of the table that it doesn't list.

    Raises `ValueError` for a type that the table lacks."""
    topological_dimension.setdefault(name, element_type(name).dim)


def dimension(name: str) -> int:
    """Dimension of the cells of a type that meshio knows."""
    if name in TYPES:
        return TYPES[name].dim
    return 3 if name.startswith("polyhedron") else topological_dimension.get(name, 3)


def check_points(points: np.ndarray) -> None:
    """Raise `MeshFileError` where coordinates are missing, not finite, or of no size to compute with."""
    if points.ndim != 2 or points.shape[1] not in (2, 3) or points.dtype.kind not in "fiu":
        raise MeshFileError(
            f"the mesh has points of shape {list(points.shape)} ({points.dtype}); "
            "each needs 2 or 3 real coordinates"
        )
    finite = np.isfinite(points).all(axis=1)
    if not finite.all():
        node = int(np.argmin(finite))
        raise MeshFileError(
            f"node {node} (counted from 0) has a coordinate that is not finite ({points[node].tolist()}), "
            f"{int((~finite).sum())} such nodes in all; repair or remove them"
        )
    try:
        check_size(points, np.finfo(points.dtype if points.dtype.kind == "f" else float))
    except ValueError as error:
        raise MeshFileError(str(error)) from error


def element_dim(cells: Sequence[tuple[str, Any]]) -> int:
    """The highest dimension among the cells; raises `MeshFileError` below 2."""
    dim = max((dimension(name) for name, data in cells if len(data)), default=0)
    if dim < 2:
        found = {name: 0 for name, data in cells if len(data)}
        for name, data in cells:
            if len(data):
                found[name] += len(data)
        held = ", ".join(f"{n} {name}" for name, n in found.items()) or "no cells"
        raise MeshFileError(
            f"the mesh has no volume elements and no plane ones (it has {held}), nothing to smooth"
        )
    return dim


def check_cells(cells: Sequence[tuple[str, Any]], chosen: Sequence[int], count: int) -> None:
    """Raise `MeshFileError` where the chosen blocks aren't sound elements of `count` nodes."""
    strange: dict[str, int] = {}
    for k in chosen:
        name, data = cells[k]
        if name not in supported():
            strange[name] = strange.get(name, 0) + len(data)
    if strange:
        raise MeshFileError(
            f"cell type not supported: {', '.join(f'{name} ({n} cells)' for name, n in strange.items())}; "
            f"convert these cells to {', '.join(supported(dimension(next(iter(strange)))))}"
        )
    first = np.cumsum([0] + [len(data) for _, data in cells])
    for k in chosen:
        name, nodes = cells[k][0], np.asarray(cells[k][1])
        if nodes.ndim != 2 or nodes.shape[1] != element_type(name).k:
            raise MeshFileError(f"cell block {k} ({name}) doesn't have {element_type(name).k} nodes a cell")
        outside = (nodes < 0) | (nodes >= count)
        if outside.any():
            row, column = np.argwhere(outside)[0]
            raise MeshFileError(
                f"{_cell(first, k, int(row), name)} refers to node {nodes[row, column]}, which is out of "
                f"range (the file has {count} nodes, counted from 0); repair the connectivity"
            )
        ordered = np.sort(nodes, axis=1)
        twice = ordered[:, 1:] == ordered[:, :-1]
        if twice.any():
            row, column = np.argwhere(twice)[0]
            raise MeshFileError(
                f"{_cell(first, k, int(row), name)} has node {ordered[row, column]} twice, "
                f"{int(twice.any(axis=1).sum())} such cells in this block; "
                "split the degenerate elements or use the type that fits them"
            )


def check_references(mesh: Any) -> None:
    """Raise `ValueError` where cells below the highest dimension refer to nodes that aren't there.

    `check_cells` does it for the highest, which are checked for more than that."""
    top = max((dimension(cells.type) for cells in mesh.cells if len(cells)), default=0)
    for k, cells in enumerate(mesh.cells):
        if not len(cells) or dimension(cells.type) == top or cells.type not in (*TYPES, "vertex"):
            continue
        nodes = np.ma.filled(cells.data, -1)
        outside = (nodes < 0) | (nodes >= len(mesh.points))
        if outside.any():
            row = int(np.argwhere(outside)[0, 0])
            raise ValueError(
                f"{cells.type} {row} of cell block {k} (counted from 0) refers to a node that is out of "
                f"range (the file has {len(mesh.points)} nodes); repair the connectivity"
            )


def _cell(first: np.ndarray, block: int, row: int, name: str) -> str:
    return f"cell {first[block] + row} of the file ({name} {row} of cell block {block}, counted from 0)"


def check_last_line(content: bytes, comment: bytes = b"#") -> None:
    """Raise `ValueError` where a text file ends within a line, so that its last number may be cut."""
    last = content.replace(b"\r", b"\n").rpartition(b"\n")[2].strip()
    if last and not last.startswith(comment):
        raise ValueError(
            "its last line has no end, so the file may be cut short; complete it or end the line"
        )


def parse_numbers(text: str | bytes, place: str, dtype: Any = np.float64) -> np.ndarray:
    """Numbers with blanks between them; raises `ValueError` that names the place for anything else."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", DeprecationWarning)  # how NumPy says it before 2.3
            return np.fromstring(text, dtype=dtype, sep=" ")
    except (DeprecationWarning, ValueError) as error:
        raise ValueError(f"{place} has something that is not a number") from error
