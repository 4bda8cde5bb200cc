"""Results as PyVista grids.  The way in is `jaxsmooth.convert.foreign`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxsmooth.convert.checks import MeshFileError
from jaxsmooth.convert.foreign import FOREIGN
from jaxsmooth.convert.meshfile import as_file, as_mesh, to_meshio
from jaxsmooth.convert.regions import recall
from jaxsmooth.mesh.record import Mesh
from jaxsmooth.metrics.table import named, quality
from jaxsmooth.metrics.validity import inverted

if TYPE_CHECKING:
    from pyvista import PolyData, UnstructuredGrid

__all__ = ["Accessor", "to_pyvista"]


def to_pyvista(
    anything: Any, metrics: Sequence[str] = ("shape", "scaled_jacobian")
) -> UnstructuredGrid | PolyData:
    """A PyVista grid with all data, and with the quality of the elements.

    What came as a grid goes back as a copy of it, of the same class and with all its arrays (an image or a
    structured grid as an `UnstructuredGrid`); of anything else the grid has points, cells, and data.

    Args:
        anything: what `smooth` returned, or whatever else `as_mesh` takes.
        metrics: names in `METRICS`, each of which becomes cell data, NaN in cells that it is not for.

    Returns:
        The grid; cell data ``inverted`` are 1 where an element is, and point data ``displacement``
        ``[nodes, 3]`` say how far the nodes went.

    Raises:
        ValueError: for an unknown metric.
        MeshFileError: VTK has no such cells (``pyramid14``).
        ImportError: PyVista is not installed.
    """
    try:
        import pyvista
    except ImportError as missing:
        raise ImportError("grids need PyVista; install it with: pip install pyvista") from missing
    mesh, file = as_mesh(anything), as_file(anything)
    fields = _fields(mesh, metrics)
    moved = to_meshio(file, mesh.points, cell_data=fields)
    known = recall(file.source, FOREIGN)
    if isinstance(known, pyvista.DataSet):
        grid = _alike(known)
        for name in fields:
            grid.cell_data[name] = np.concatenate(moved.cell_data[name])
    else:
        grid = _grid(moved)
    old, new = (np.zeros((len(moved.points), 3)) for _ in range(2))
    old[:, : file.source.points.shape[1]] = file.source.points
    new[:, : moved.points.shape[1]] = moved.points
    grid.points = new if known is None else new.astype(grid.points.dtype)
    grid.point_data["displacement"] = new - old
    return grid


def _fields(mesh: Mesh, metrics: Sequence[str]) -> dict[str, list[np.ndarray]]:
    """Cell data by block; whether a cell is inverted is 0 or 1, for NaN stands where it is no element."""
    found = {named(name).name: [np.asarray(part) for part in quality(mesh, named(name))] for name in metrics}
    return {**found, "inverted": [part.astype(float) for part in inverted(mesh)]}


def _alike(data: Any) -> Any:
    """A copy whose points may be anywhere."""
    import pyvista

    if isinstance(data, (pyvista.UnstructuredGrid, pyvista.PolyData)):
        out = data.copy()
        squares = np.isin(getattr(out, "celltypes", 0), (8, 11))
        if not squares.any():
            return out
        data = out
    from jaxsmooth.convert.foreign import as_source

    out = _grid(as_source(data))
    for name, values in data.field_data.items():
        out.field_data[name] = values
    return out


def _grid(mesh: Any) -> UnstructuredGrid:
    import pyvista
    from meshio._vtk_common import meshio_to_vtk_order, meshio_to_vtk_type

    cells, types = [], []
    for block in mesh.cells:
        if block.type not in meshio_to_vtk_type:
            raise MeshFileError(f"VTK has no cells of type {block.type}; take them out")
        order = meshio_to_vtk_order(block.type)
        nodes = np.asarray(block.data) if order is None else np.asarray(block.data)[:, order]
        cells.append(np.insert(nodes, 0, nodes.shape[1], axis=1).ravel())
        types.append(np.full(len(nodes), meshio_to_vtk_type[block.type], np.uint8))
    points = np.zeros((len(mesh.points), 3), mesh.points.dtype)
    points[:, : mesh.points.shape[1]] = mesh.points
    grid = pyvista.UnstructuredGrid(np.concatenate(cells), np.concatenate(types), points)
    for name, values in mesh.point_data.items():
        grid.point_data[name] = values
    for name, parts in mesh.cell_data.items():
        grid.cell_data[name] = np.concatenate(parts)
    return grid


class Accessor:
    """``grid.jaxsmooth`` of every PyVista grid, once this package is installed."""

    def __init__(self, grid: Any) -> None:
        self._grid = grid

    def smooth(self, method: Any = None, **options: Any) -> Any:
        """The smoothed grid: `to_pyvista` of `smooth`, which has the options."""
        from jaxsmooth.runs.driver import smooth

        return to_pyvista(smooth(self._grid, method, **options))

    def quality(self, *metrics: str) -> Any:
        """The grid with metrics as cell data; see `to_pyvista`."""
        return to_pyvista(self._grid, metrics or ("shape", "scaled_jacobian"))
