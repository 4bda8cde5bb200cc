"""What becomes of materials, sets and data in formats that have no place for them."""

from __future__ import annotations

import meshio
import numpy as np

from jaxsmooth.convert.labels import is_mask
from jaxsmooth.convert.regions import (
    NOT_SETS,
    REGION_NAMES,
    SECTIONS,
    find_regions,
    folded,
    integers,
    recall,
    region_arrays,
)

__all__ = [
    "DATA_FORMATS",
    "GMSH_TAGS",
    "VTK_FORMATS",
    "add_materials",
    "as_tags",
    "material_name",
    "reduce_data",
    "sets_to_data",
]

VTK_FORMATS = {"vtk", "vtk42", "vtu"}
DATA_FORMATS = {*VTK_FORMATS, "xdmf", "gmsh", "gmsh22", "npz"}
"""Formats that hold any point and cell data."""

GMSH_TAGS = ("gmsh:physical", "gmsh:geometrical")
_FOLDED = {folded(name) for name in REGION_NAMES}
_OWN_TAGS = {"medit": "medit:ref", "su2": "su2:tag", "ugrid": "ugrid:ref"}


def material_name(mesh: meshio.Mesh, dim: int) -> str | None:
    """The cell data that tell the materials of the elements apart; else those that have any tags."""
    only = None
    for name, tags in region_arrays(mesh, [k for k, cells in enumerate(mesh.cells) if cells.dim == dim]):
        joined = np.concatenate(list(tags.values()))
        if (joined != joined[0]).any():
            return name
        only = name if only is None and joined.any() else only
    return only


def add_materials(mesh: meshio.Mesh, stem: str, dim: int, notes: list[str]) -> None:
    """Materials that sections or sets give become cell data, for other formats have only those."""
    top = [k for k, cells in enumerate(mesh.cells) if cells.dim == dim]
    cells = [(c.type, c.data) for c in mesh.cells]
    name = material_name(mesh, dim)
    tags = None if name is None else np.concatenate([integers(mesh.cell_data[name][k]) for k in top])
    if recall(mesh, SECTIONS) is None and tags is not None and (tags != tags[0]).any():
        return
    parts = dict(
        zip(
            top,
            find_regions(mesh, cells, [[k] for k in top], [np.arange(len(cells[k][1])) for k in top]),
            strict=True,
        )
    )
    joined = np.concatenate(list(parts.values()))
    if (joined == joined[0]).all():
        return
    name = next(n for n in ("material", "region", "subdomain") if n not in mesh.cell_data)
    first = 1 - min(int(joined.min()), 1)
    zero = [np.zeros(len(c), np.int64) for c in mesh.cells]
    mesh.cell_data[name] = [parts[k] + first if k in parts else zero[k] for k in range(len(cells))]
    if stem in DATA_FORMATS:
        notes.append(f"materials that sections or sets give are written as the cell data {name!r}")


def as_tags(parts) -> list[np.ndarray]:
    """Whole numbers; 0 where cells have none."""
    return [np.nan_to_num(np.asarray(part, float).reshape(-1)).astype(np.int64) for part in parts]


def _masks(mesh: meshio.Mesh) -> tuple[dict[str, np.ndarray], dict[str, list[np.ndarray]]]:
    """All sets as 0/1 data: of points, and of cells (cell sets and Gmsh's physical names)."""
    of_points, of_cells = {}, {}
    for name, members in mesh.point_sets.items():
        of_points[name] = mask = np.zeros(len(mesh.points), np.int32)
        members = np.asarray(members)
        mask[members if members.dtype == bool else members.astype(np.int64)] = 1
    for name, members in mesh.cell_sets.items():
        if name in NOT_SETS:
            continue
        of_cells[name] = [np.zeros(len(cells), np.int32) for cells in mesh.cells]
        for mask, rows in zip(of_cells[name], members, strict=True):
            if rows is not None and len(rows):
                rows = np.asarray(rows)
                mask[rows if rows.dtype == bool else rows.astype(np.int64)] = 1
    physical = mesh.cell_data.get("gmsh:physical")
    for name, entry in mesh.field_data.items():
        if physical is not None and np.shape(entry) == (2,) and name not in of_cells:
            of_cells[name] = [
                ((tags == entry[0]) & (cells.dim == entry[1])).astype(np.int32)
                for cells, tags in zip(mesh.cells, physical, strict=True)
            ]
    return of_points, of_cells


def sets_to_data(mesh: meshio.Mesh, stem: str, notes: list[str]) -> None:
    """Turn sets into 0/1 data under their names; Gmsh keeps its physical names as they are."""
    of_points, of_cells = _masks(mesh)
    if stem in ("gmsh", "gmsh22"):
        of_cells = {name: masks for name, masks in of_cells.items() if name not in mesh.field_data}
    else:
        mesh.field_data = {}
    mesh.point_sets = {}
    mesh.cell_sets = {k: v for k, v in mesh.cell_sets.items() if k in NOT_SETS or k in mesh.field_data}
    names = [*of_points, *of_cells]
    if not names:
        return
    if stem not in DATA_FORMATS:
        notes.append(f"{stem} files hold no named sets; not written: {', '.join(names)}")
        return
    for name, mask in of_points.items():
        mesh.point_data[_free(name, mesh.point_data)] = mask
    for name, masks in of_cells.items():
        mesh.cell_data[_free(name, mesh.cell_data)] = masks
    notes.append(f"{stem} files hold no named sets; written as data of 0 and 1: {', '.join(names)}")


def _free(name: str, taken) -> str:
    while name in taken:
        name += "_set"
    return name


def reduce_data(mesh: meshio.Mesh, stem: str, dim: int, notes: list[str]) -> None:
    """Keep what formats without free data can hold: material tags, and sets where there are some."""
    lost = [*mesh.point_data, *mesh.cell_data]
    if stem == "abaqus":
        lost = _data_to_sets(mesh)
    elif stem == "exodus":
        name = material_name(mesh, dim)
        lost = [other for other in mesh.cell_data if other != name]
        mesh.cell_data = {name: as_tags(mesh.cell_data[name])} if name else {}
        lost += [name for name in (*mesh.cell_sets, *mesh.field_data) if name not in NOT_SETS]
    elif stem in _OWN_TAGS:
        lost = _keep_tags(mesh, stem, dim)
    else:  # meshio knows best; what it leaves out differs from format to format
        if name := material_name(mesh, dim):  # it takes the first whole numbers, or those of its own name
            tags = as_tags(mesh.cell_data.pop(name))
            mesh.cell_data = {"nastran:ref" if stem == "nastran" else name: tags, **mesh.cell_data}
        return
    lost = [n for n in lost if n != "gmsh:dim_tags"]
    if lost:
        notes.append(f"{stem} files can't hold these data, which are not written: {', '.join(lost)}")


def _keep_tags(mesh: meshio.Mesh, stem: str, dim: int) -> list[str]:
    """Leave the tags that a format has for its cells; returns the names of data that it can't hold."""
    lost, named, own = [*mesh.point_data, *mesh.cell_data], _masks(mesh)[1], _OWN_TAGS[stem]
    material = material_name(mesh, dim)
    name = material
    if stem != "medit":  # tags of boundary cells only
        of_boundary = dim - 1 if stem == "su2" else 2
        blocks = [k for k, cells in enumerate(mesh.cells) if cells.dim == of_boundary]
        tagged = [n for n, tags in region_arrays(mesh, blocks) if any(t.any() for t in tags.values())]
        name = own if own in tagged else next(iter(tagged), None)
        if of_boundary == dim and own not in tagged:  # plane meshes in .ugrid
            name = material
    lost = [n for n in lost if n not in (name, "medit:ref")]
    if name and name == material and stem == "su2":
        lost.append(f"{name} of the elements")
    mesh.cell_data = {own: as_tags(mesh.cell_data[name])} if name else {}
    values = integers(mesh.point_data["medit:ref"]) if "medit:ref" in mesh.point_data else None
    mesh.point_data = {"medit:ref": values} if stem == "medit" and values is not None else {}
    if stem == "su2":  # markers are cell sets of the boundary
        mesh.cell_sets = {n: [np.flatnonzero(m) for m in ms] for n, ms in named.items()}
        top = [k for k, cells in enumerate(mesh.cells) if cells.dim == dim]
        lost += [n for n, ms in mesh.cell_sets.items() if any(len(ms[k]) for k in top)]
        lost += list(mesh.point_sets)
    return lost


def _data_to_sets(mesh: meshio.Mesh) -> list[str]:
    """Masks and material tags become sets; returns the names of data that can't."""
    lost = []
    _, named = _masks(mesh)
    mesh.cell_sets = {name: [np.flatnonzero(mask) for mask in masks] for name, masks in named.items()}
    for name, values in mesh.point_data.items():
        if is_mask(values):
            mesh.point_sets.setdefault(name, np.flatnonzero(values))
        else:
            lost.append(name)
    covered = bool(named)
    for name, parts in mesh.cell_data.items():
        if folded(name) in _FOLDED and all(np.ndim(part) == 1 for part in parts):
            parts = as_tags(parts)
            tags = np.unique(np.concatenate(parts))
            if (covered and name in GMSH_TAGS) or not tags.any():
                continue
            for tag in tags:
                members = [np.flatnonzero(part == tag) for part in parts]
                mesh.cell_sets.setdefault(f"{name.replace(':', '_').replace(' ', '_')}_{tag}", members)
            covered = True
        elif all(is_mask(part) for part in parts):
            mesh.cell_sets.setdefault(name, [np.flatnonzero(part) for part in parts])
        else:
            lost.append(name)
    return lost
