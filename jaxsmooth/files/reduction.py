"""What becomes of materials, sets and data in formats that have no place for them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import meshio
import numpy as np

from jaxsmooth.convert.labels import is_mask
from jaxsmooth.convert.regions import (
    NOT_SETS,
    REGION_NAMES,
    SECTIONS,
    find_regions,
    folded,
    recall,
    region_arrays,
)
from jaxsmooth.files.formats.record import Format, Holds

__all__ = [
    "BLOCKWISE",
    "GMSH_TAGS",
    "UNKEPT",
    "add_materials",
    "as_tags",
    "data_to_sets",
    "families_to_sets",
    "keep_boundary_tags",
    "material_name",
    "sets_as_masks",
    "sets_to_data",
    "tags_name",
]

GMSH_TAGS = ("gmsh:physical", "gmsh:geometrical")
_FOLDED = {folded(name) for name in REGION_NAMES}

UNKEPT = "files:unkept"
"""In `meshio.Mesh.info`: what is lost when a file is written anew, pairs of the format whose writer has room
for it (``""``: none) and what it is."""

BLOCKWISE = ("abaqus:types",)
"""In `meshio.Mesh.info`: lists with an entry a cell block, beside `SECTIONS`."""


def material_name(mesh: meshio.Mesh, dim: int) -> str | None:
    """The cell data that tell the materials of the elements apart; else those that have any tags."""
    only = None
    for name, tags in region_arrays(mesh, [k for k, cells in enumerate(mesh.cells) if cells.dim == dim]):
        joined = np.concatenate(list(tags.values()))
        if (joined != joined[0]).any():
            return name
        only = name if only is None and joined.any() else only
    return only


def tags_name(mesh: meshio.Mesh, dim: int) -> str | None:
    """The same; where the elements have no tags, the cell data that the cells of their boundary have."""
    arrays = region_arrays(mesh, range(len(mesh.cells)))
    tagged = (name for name, tags in arrays if any(part.any() for part in tags.values()))
    return material_name(mesh, dim) or next(tagged, None)


def families_to_sets(mesh: meshio.Mesh) -> None:
    """The families of a MED file, which meshio keeps as tags and their names, become sets."""
    mesh.point_sets, mesh.cell_sets = dict(mesh.point_sets), dict(mesh.cell_sets)
    tags, parts = mesh.point_data.get("point_tags"), mesh.cell_data.get("cell_tags")
    of_points = {} if tags is None else _by_name(getattr(mesh, "point_tags", {}))
    of_cells = _by_name(getattr(mesh, "cell_tags", {})) if parts is not None else {}
    for name, own in of_points.items():
        mesh.point_sets.setdefault(name, np.flatnonzero(np.isin(np.asarray(tags), own)))
    for name, own in of_cells.items():
        mesh.cell_sets.setdefault(name, [np.flatnonzero(np.isin(part, own)) for part in parts or ()])
    for name in ("point_tags", "cell_tags"):
        if hasattr(mesh, name):
            delattr(mesh, name)


def _by_name(families: Mapping[Any, list[str]]) -> dict[str, list[Any]]:
    """Numbers of the families that have a name, for each name."""
    names = dict.fromkeys(name for own in families.values() for name in own)
    return {name: [number for number, own in families.items() if name in own] for name in names}


def add_materials(mesh: meshio.Mesh, holds: Holds, dim: int, notes: list[str]) -> None:
    """Materials that sections or sets give become cell data, for other formats have only those."""
    top = [k for k, cells in enumerate(mesh.cells) if cells.dim == dim]
    cells = [(c.type, c.data) for c in mesh.cells]
    name = material_name(mesh, dim)
    tags = None if name is None else np.concatenate(list(dict(region_arrays(mesh, top))[name].values()))
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
    if holds.any_data:
        notes.append(f"materials that sections or sets give are written as the cell data {name!r}")


def as_tags(parts) -> list[np.ndarray]:
    """Whole numbers; 0 where cells have none."""
    return [np.nan_to_num(np.asarray(part, float).reshape(-1)).astype(np.int64) for part in parts]


def sets_as_masks(mesh: meshio.Mesh) -> tuple[dict[str, np.ndarray], dict[str, list[np.ndarray]]]:
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


def sets_to_data(mesh: meshio.Mesh, record: Format, notes: list[str]) -> None:
    """Turn sets that the format has no place for into 0/1 data under their names.

    Those whose names are in `Holds.sets` stay, and named groups where it has them (`Holds.groups`)."""
    own, stem = record.holds.sets, record.name
    if own is True or not (mesh.point_sets or mesh.cell_sets or mesh.field_data):
        return
    kept = {} if own is False else {k: v for k, v in mesh.point_sets.items() if k in own}
    mesh.point_sets = {name: v for name, v in mesh.point_sets.items() if name not in kept}
    of_points, of_cells = sets_as_masks(mesh)
    if record.holds.groups:
        of_cells = {name: masks for name, masks in of_cells.items() if name not in mesh.field_data}
    else:
        mesh.field_data = {}
    mesh.point_sets = kept
    mesh.cell_sets = {k: v for k, v in mesh.cell_sets.items() if k in NOT_SETS or k in mesh.field_data}
    names = [*of_points, *of_cells]
    if not names:
        return
    if not record.holds.any_data:
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


def keep_boundary_tags(
    mesh: meshio.Mesh, dim: int, own: str, of_boundary: int
) -> tuple[list[str], str | None]:
    """Leave the tags of boundary cells (of dimension `of_boundary`) under the name `own`, and no other data.

    Returns the names of data that are lost, and the one whose tags are left."""
    lost, material = [*mesh.point_data, *mesh.cell_data], material_name(mesh, dim)
    blocks = [k for k, cells in enumerate(mesh.cells) if cells.dim == of_boundary]
    tagged = [n for n, tags in region_arrays(mesh, blocks) if any(t.any() for t in tags.values())]
    name = own if own in tagged else next(iter(tagged), None)
    if of_boundary == dim and own not in tagged:  # plane meshes in .ugrid
        name = material
    mesh.cell_data = {own: as_tags(mesh.cell_data[name])} if name else {}
    mesh.point_data = {}
    return [n for n in lost if n not in (name, "medit:ref")], name


def data_to_sets(mesh: meshio.Mesh, dim: int) -> list[str]:
    """Masks and material tags become sets; returns the names of data that can't."""
    lost = []
    _, named = sets_as_masks(mesh)
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
            if (covered and name == GMSH_TAGS[1]) or not tags.any():
                continue
            if name == GMSH_TAGS[0]:
                tags = [tag for tag in tags if not _has_names(mesh, parts, tag)]
            for tag in tags:
                members = [np.flatnonzero(part == tag) for part in parts]
                mesh.cell_sets.setdefault(f"{name.replace(':', '_').replace(' ', '_')}_{tag}", members)
            covered = True
        elif all(is_mask(part) for part in parts):
            mesh.cell_sets.setdefault(name, [np.flatnonzero(part) for part in parts])
        else:
            lost.append(name)
    return lost


def _has_names(mesh: meshio.Mesh, parts: list[np.ndarray], tag: Any) -> bool:
    """Whether Gmsh's groups of this number have names; 0 is no group where there are any."""
    named = {(int(entry[0]), int(entry[1])) for entry in mesh.field_data.values() if np.shape(entry) == (2,)}
    dims = {cells.dim for cells, part in zip(mesh.cells, parts, strict=True) if (part == tag).any()}
    return bool(named) and (tag == 0 or all((int(tag), dim) in named for dim in dims))
