"""Meshes of other libraries as `meshio.Mesh`; a library that is not loaded can't have made one."""

from __future__ import annotations

import sys
from typing import Any

import meshio
import numpy as np
from meshio._vtk_common import vtk_to_meshio_order, vtk_to_meshio_type

from jaxsmooth.convert.checks import MeshFileError

__all__ = ["FOREIGN", "as_source"]

FOREIGN = "jaxsmooth:foreign"
"""In `meshio.Mesh.info`: the mesh of another library that was converted."""

_SQUARE = {8: ("quad", (0, 1, 3, 2)), 11: ("hexahedron", (0, 1, 3, 2, 4, 5, 7, 6))}  # pixels, voxels
_POLYGON = {3: "triangle", 4: "quad"}


def as_source(anything: Any) -> meshio.Mesh | None:
    """A mesh of PyVista, VTK or scikit-fem, or of meshio itself; None for anything else.

    Cells stay in their order; runs of one type become blocks.

    Raises:
        MeshFileError: a grid has polyhedra, polygons of more than four corners, or other cells
            without a type here.
    """
    if isinstance(anything, meshio.Mesh):
        return anything
    if (pyvista := sys.modules.get("pyvista")) is not None and isinstance(anything, pyvista.DataSet):
        return _from_grid(anything)
    vtk = sys.modules.get("vtkmodules.vtkCommonDataModel")
    if vtk is not None and isinstance(anything, vtk.vtkDataSet):
        import pyvista

        return _from_grid(pyvista.wrap(anything))
    if (skfem := sys.modules.get("skfem")) is not None and isinstance(anything, skfem.Mesh):
        return _from_skfem(anything)
    return None


def _from_grid(data: Any) -> meshio.Mesh:
    grid = data if hasattr(data, "celltypes") else data.cast_to_unstructured_grid()
    types = np.asarray(grid.celltypes)
    offsets = np.asarray(grid.cell_offsets if hasattr(grid, "cell_offsets") else grid.offset)
    connectivity = np.asarray(grid.cell_connectivity)
    sizes = np.diff(offsets)
    starts = np.flatnonzero(np.diff(types, prepend=-1) | np.diff(sizes, prepend=-1))
    ends = np.append(starts[1:], len(types))
    cells = []
    for start, end in zip(starts, ends, strict=True):
        kind, size = int(types[start]), int(sizes[start])
        nodes = connectivity[offsets[start] : offsets[end]].reshape(-1, size)
        name, order = _SQUARE.get(kind) or (_name(kind, size), vtk_to_meshio_order(kind))
        cells.append((name, nodes if order is None else nodes[:, list(order)]))
    cuts = starts[1:]
    out = meshio.Mesh(
        np.asarray(grid.points),
        cells,
        point_data=_numbers(grid.point_data),
        cell_data={k: np.split(v, cuts) for k, v in _numbers(grid.cell_data).items()},
    )
    out.info = {FOREIGN: data}
    return out


def _name(kind: int, size: int) -> str:
    """meshio's name of VTK's type; two-noded poly-lines and polygons of 3 or 4 corners are plain cells."""
    if kind == 4 and size == 2:
        return "line"
    if kind == 2 and size == 1:
        return "vertex"
    name = _POLYGON.get(size) if kind == 7 else vtk_to_meshio_type.get(kind)
    if name is None or name == "polyhedron" or name.startswith("VTK_"):
        raise MeshFileError(
            f"the grid has cells of VTK's type {kind} with {size} nodes, which can't be smoothed; "
            "take them out (grid.extract_cells) or split them (grid.triangulate)"
        )
    return name


def _numbers(data: Any) -> dict[str, np.ndarray]:
    """Arrays of numbers; text stays in the grid."""
    return {k: np.asarray(v) for k, v in data.items() if np.asarray(v).dtype.kind in "biuf"}


def _from_skfem(mesh: Any) -> meshio.Mesh:
    from skfem.io.meshio import TYPE_MESH_MAPPING, to_meshio

    if type(mesh) not in TYPE_MESH_MAPPING:
        raise MeshFileError(
            f"scikit-fem's {type(mesh).__name__} can't be smoothed; give one of "
            f"{', '.join(kind.__name__ for kind in TYPE_MESH_MAPPING)}"
        )
    out = to_meshio(mesh, encode_cell_data=False)
    cells, points = out.cells[0], np.asarray(out.points)
    subdomains = mesh.subdomains or {}
    sets = {name: [np.asarray(rows, np.int64)] for name, rows in subdomains.items()}
    regions = np.zeros(len(cells.data), np.int64)
    for number, rows in enumerate(subdomains.values(), 1):  # what lies in several is a region of its own
        regions[rows] = regions[rows] * (len(subdomains) + 1) + number
    point_sets = {name: np.unique(mesh.facets[:, rows]) for name, rows in (mesh.boundaries or {}).items()}
    out = meshio.Mesh(points, [cells], cell_sets=sets, point_sets=point_sets)
    if len(np.unique(regions)) > 1:
        out.cell_data["region"] = [np.unique(regions, return_inverse=True)[1]]
    out.info = {FOREIGN: mesh}
    return out
