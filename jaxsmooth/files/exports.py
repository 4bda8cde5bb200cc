"""Writing meshes through meshio: what every format can hold, so that nothing is lost in silence."""

from __future__ import annotations

import copy
from collections.abc import Iterable
from pathlib import Path

import meshio
import numpy as np

from jaxsmooth.elements import supported
from jaxsmooth.files.abaqus import write_abaqus
from jaxsmooth.files.formats import (
    EXODUS_BLOCKS,
    EXODUS_ORDER,
    MEDIT_SETS,
    extend_exodus,
    quiet,
    stem_format,
)
from jaxsmooth.files.labels import REGION_NAMES, is_mask, plain
from jaxsmooth.files.msh import split_by_entity, write_data_sections, write_msh41
from jaxsmooth.files.su2 import write_su2
from jaxsmooth.meshfile import MeshFileError

__all__ = ["check_types", "write_source"]

_LINEAR = {"line", "triangle", "quad", "tetra", "wedge", "pyramid", "hexahedron"}
_HOLDS = {
    "abaqus": {"line", "line3", *supported()},
    "avsucd": {"vertex", *_LINEAR},
    "exodus": {"vertex", "line", "line3", *supported()},
    "medit": _LINEAR,
    "nastran": _LINEAR | {"line3", "triangle6", "quad8", "tetra10", "hexahedron20", "wedge15", "pyramid13"},
    "su2": _LINEAR,
    "ugrid": _LINEAR - {"line"},
}
"""Cell types of formats that hold only some of those that this package knows."""

_SURFACES = {"stl", "obj", "off", "ply", "svg", "wkt", "neuroglancer"}
_VTK = {"vtk", "vtk42", "vtu"}
_DATA = {*_VTK, "xdmf", "gmsh", "gmsh22", "npz"}  # hold any point and cell data
_GMSH_TAGS = ("gmsh:physical", "gmsh:geometrical")
_SPECIAL = ("gmsh:bounding_entities",)


def check_types(names: Iterable[str], path: Path, format: str) -> None:
    """Raise `MeshFileError` where a format can't hold elements of these types."""
    stem = stem_format(format)
    if stem in _SURFACES:
        raise MeshFileError(f"{path}: {stem} files hold surfaces only; write .vtu, .msh or .xdmf instead")
    missing = [n for n in names if stem in _HOLDS and n in supported() and n not in _HOLDS[stem]]
    if missing:
        raise MeshFileError(
            f"{path}: {stem} files can't hold {missing[0]} elements; write .vtu, .msh or .xdmf instead"
        )


def write_source(path: Path, mesh: meshio.Mesh, format: str, dim: int) -> list[str]:
    """Write a mesh, and say in notes what the format can't hold.

    Args:
        path: where to; an existing file is replaced.
        mesh: what to write; not modified.
        format: as `formats` names them.
        dim: dimension of the elements; formats without z get x and y of plane meshes.

    Raises:
        MeshFileError: meshio can't write this mesh in this format.
    """
    stem, notes = stem_format(format), []
    mesh = _clean(mesh, stem, dim, notes)
    own_sets = {}
    if stem == "medit" and path.suffix == ".mesh":
        own_sets = {name: mesh.point_sets.pop(name) for name in MEDIT_SETS if name in mesh.point_sets}
    if stem not in ("abaqus", "exodus", "su2") and (mesh.point_sets or mesh.cell_sets or mesh.field_data):
        _sets_to_data(mesh, stem, notes)
    if stem not in _DATA:
        _reduce_data(mesh, stem, dim, notes)
    try:
        with quiet() as said:
            _WRITERS.get(stem, _write_any)(path, mesh, format)
            if own_sets:
                _append_medit_sets(path, own_sets)
    except ModuleNotFoundError as error:
        raise MeshFileError(
            f"{path}: writing {stem} files needs {error.name}; install it with: pip install 'jaxsmooth[io]'"
        ) from error
    except (Exception, SystemExit) as error:  # meshio's writers raise anything
        kind = f"it has no place for {error}" if isinstance(error, KeyError) else " ".join(str(error).split())
        raise MeshFileError(
            f"{path}: this mesh can't be written as {stem}: {kind or type(error).__name__}; "
            "write .vtu, .msh or .xdmf instead"
        ) from error
    if "kipping" in said.getvalue() and "cells" in said.getvalue():
        raise MeshFileError(f"{path}: {stem} files can't hold all cells of this mesh; write .vtu instead")
    return notes


def _clean(mesh: meshio.Mesh, stem: str, dim: int, notes: list[str]) -> meshio.Mesh:
    """A copy with native arrays that every writer takes, without cells that the format lacks."""
    out = copy.copy(mesh)
    kept = [k for k, cells in enumerate(mesh.cells) if len(cells)]
    lacking = [k for k in kept if mesh.cells[k].type not in _HOLDS.get(stem, {mesh.cells[k].type})]
    if lacking:
        names = ", ".join(sorted({mesh.cells[k].type for k in lacking}))
        notes.append(f"{stem} files can't hold {names} cells; they are not written")
        kept = [k for k in kept if k not in lacking]
    out.cells = [mesh.cells[k] for k in kept]
    out.cells = [
        c if c.type.startswith("polyhedron") else meshio.CellBlock(c.type, plain(c.data)) for c in out.cells
    ]
    out.points = plain(mesh.points)
    if stem == "su2" and dim == 2:  # its dimension is the number of coordinates
        _check_upright(out)
        out.points = out.points[:, :2]
    elif stem in (*_VTK, "xdmf", "gmsh22", "abaqus") and out.points.shape[1] == 2:
        out.points = np.pad(out.points, ((0, 0), (0, 1)))
    # a mixture of types may differ in dtype from block to block
    out.cell_data = {}
    for name, parts in mesh.cell_data.items():
        parts = [_array(parts[k], stem) for k in kept]
        if any(part is None for part in parts) or len({part.shape[1:] for part in parts}) > 1:
            notes.append(f"the cell data {name!r} are not numbers in every cell; they are not written")
        else:
            common = np.result_type(*parts)
            out.cell_data[name] = [part.astype(common) for part in parts]
    out.point_data = {}
    for name, values in mesh.point_data.items():
        if (array := _array(values, stem)) is None:
            notes.append(f"the point data {name!r} are not numbers; they are not written")
        else:
            out.point_data[name] = array
    out.cell_sets = {
        name: [members[k] if k < len(members) else None for k in kept]
        for name, members in mesh.cell_sets.items()
    }
    out.point_sets, out.field_data = dict(mesh.point_sets), dict(mesh.field_data)
    return out


def _array(values, stem: str) -> np.ndarray | None:
    values = plain(values)
    if values.dtype == bool or (stem == "xdmf" and values.dtype.kind in "iu" and values.dtype.itemsize < 4):
        values = values.astype(np.int32)  # meshio's XDMF has no smaller integers
    if values.dtype.kind not in "iuf":
        return None
    if values.dtype.kind == "f" and values.dtype.itemsize not in (4, 8):
        values = values.astype(np.float64)
    if values.ndim > 2 or (values.ndim == 2 and values.shape[1] == 1):
        values = values.reshape(len(values), -1) if values.size != len(values) else values.ravel()
    if stem in _VTK and values.ndim == 2 and values.shape[1] == 2:
        values = np.pad(values, ((0, 0), (0, 1)))  # VTK's vectors have three components
    return values


def _masks(mesh: meshio.Mesh) -> tuple[dict[str, np.ndarray], dict[str, list[np.ndarray]]]:
    """All sets as 0/1 data: of points, and of cells (cell sets and Gmsh's physical names)."""
    of_points, of_cells = {}, {}
    for name, members in mesh.point_sets.items():
        of_points[name] = mask = np.zeros(len(mesh.points), np.int32)
        members = np.asarray(members)
        mask[members if members.dtype == bool else members.astype(np.int64)] = 1
    for name, members in mesh.cell_sets.items():
        if name in _SPECIAL:
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


def _sets_to_data(mesh: meshio.Mesh, stem: str, notes: list[str]) -> None:
    """Turn sets into 0/1 data under their names; Gmsh keeps its physical names as they are."""
    of_points, of_cells = _masks(mesh)
    if stem in ("gmsh", "gmsh22"):
        of_cells = {name: masks for name, masks in of_cells.items() if name not in mesh.field_data}
    else:
        mesh.field_data = {}
    mesh.point_sets = {}
    mesh.cell_sets = {k: v for k, v in mesh.cell_sets.items() if k in _SPECIAL or k in mesh.field_data}
    names = [*of_points, *of_cells]
    if not names:
        return
    if stem not in _DATA:
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


def _check_upright(mesh: meshio.Mesh) -> None:
    """Raise `MeshFileError` where x and y alone would not say where plane elements are."""
    nodes = np.unique(np.concatenate([cells.data.ravel() for cells in mesh.cells if cells.dim == 2]))
    extent = np.ptp(mesh.points[nodes], axis=0)
    if len(extent) == 3 and extent[2] > 1e-5 * extent[:2].max():
        raise MeshFileError(
            "su2 files hold x and y of plane meshes and nothing else, but this one lies in another plane; "
            "choose another format"
        )


def _reduce_data(mesh: meshio.Mesh, stem: str, dim: int, notes: list[str]) -> None:
    """Keep what formats without free data can hold: material tags, and sets where there are some."""
    lost = [*mesh.point_data, *mesh.cell_data]
    if stem == "abaqus":
        lost = _data_to_sets(mesh)
    elif stem == "exodus":
        lost = [name for name in mesh.cell_data if name != EXODUS_BLOCKS]
        mesh.cell_data = {}
        if mesh.cell_sets or mesh.field_data:
            lost += [name for name in (*mesh.cell_sets, *mesh.field_data) if name not in _SPECIAL]
    elif stem in ("medit", "su2"):
        named = _masks(mesh)[1]  # before the tags that they come from go
        own = f"{stem}:{'ref' if stem == 'medit' else 'tag'}"
        name = next((n for n in (own, *REGION_NAMES) if _is_tag(mesh.cell_data.get(n))), None)
        mesh.cell_data = {own: mesh.cell_data[name]} if name else {}
        values = mesh.point_data.get("medit:ref")
        mesh.point_data = {"medit:ref": values} if stem == "medit" and _is_tag([values]) else {}
        lost = [n for n in lost if n not in (name, "medit:ref")]
        if stem == "su2":  # markers are cell sets of the boundary
            mesh.cell_sets = {n: [np.flatnonzero(m) for m in ms] for n, ms in named.items()}
            top = [k for k, cells in enumerate(mesh.cells) if cells.dim == dim]
            lost += [n for n, ms in mesh.cell_sets.items() if any(len(ms[k]) for k in top)]
            lost += list(mesh.point_sets)
    else:
        return  # meshio knows best; what it leaves out differs from format to format
    lost = [n for n in lost if n != "gmsh:dim_tags"]
    if lost:
        notes.append(f"{stem} files can't hold these data, which are not written: {', '.join(lost)}")


def _is_tag(parts) -> bool:
    return parts is not None and all(p is not None and p.dtype.kind in "iu" and p.ndim == 1 for p in parts)


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
        if name in REGION_NAMES and _is_tag(parts):
            tags = np.unique(np.concatenate(parts))
            if (covered and name in _GMSH_TAGS) or not tags.any():
                continue
            for tag in tags:
                members = [np.flatnonzero(part == tag) for part in parts]
                mesh.cell_sets.setdefault(f"{name.replace(':', '_')}_{tag}", members)
            covered = True
        elif all(is_mask(part) for part in parts):
            mesh.cell_sets.setdefault(name, [np.flatnonzero(part) for part in parts])
        else:
            lost.append(name)
    return lost


# --- Writers -----------------------------------------------------------------------------


def _write_any(path: Path, mesh: meshio.Mesh, format: str) -> None:
    meshio.write(path, mesh, file_format=stem_format(format))


def _write_vtk(path: Path, mesh: meshio.Mesh, format: str) -> None:
    mesh.point_data = {name.replace(" ", "_"): v for name, v in mesh.point_data.items()}
    mesh.cell_data = {name.replace(" ", "_"): v for name, v in mesh.cell_data.items()}
    meshio.write(path, mesh, file_format=stem_format(format), binary=not format.endswith(":ascii"))


def _write_xdmf(path: Path, mesh: meshio.Mesh, format: str) -> None:
    # one file: a companion .h5 could not be renamed together with it
    meshio.write(path, mesh, file_format="xdmf", data_format="XML")


def _write_gmsh(path: Path, mesh: meshio.Mesh, format: str) -> None:
    binary = not format.endswith(":ascii")
    _tag(mesh)
    if stem_format(format) == "gmsh":
        write_msh41(path, split_by_entity(mesh), binary)
        return
    bare = copy.copy(mesh)
    bare.points = mesh.points.astype(np.float64)
    bare.point_data, bare.cell_data = {}, {name: mesh.cell_data[name] for name in _GMSH_TAGS}
    meshio.write(path, bare, file_format="gmsh22", binary=binary)
    write_data_sections(path, mesh, binary)


def _tag(mesh: meshio.Mesh) -> None:
    """Both of Gmsh's tags for all cells; other material tags are physical groups to it."""
    if "gmsh:physical" not in mesh.cell_data:
        name = next((n for n in REGION_NAMES if _is_tag(mesh.cell_data.get(n))), None)
        zero = [np.zeros(len(cells), np.int32) for cells in mesh.cells]
        mesh.cell_data["gmsh:physical"] = zero if name in (None, *_GMSH_TAGS) else mesh.cell_data[name]
    if "gmsh:geometrical" not in mesh.cell_data:
        mesh.cell_data["gmsh:geometrical"] = mesh.cell_data["gmsh:physical"]
    for name in _GMSH_TAGS:
        mesh.cell_data[name] = [part.astype(np.int32) for part in mesh.cell_data[name]]


def _write_abaqus(path: Path, mesh: meshio.Mesh, format: str) -> None:
    write_abaqus(path, mesh)


def _write_su2(path: Path, mesh: meshio.Mesh, format: str) -> None:
    write_su2(path, mesh)


def _write_exodus(path: Path, mesh: meshio.Mesh, format: str) -> None:
    extend_exodus()
    mesh.cells = [
        meshio.CellBlock(c.type, c.data[:, EXODUS_ORDER[c.type]]) if c.type in EXODUS_ORDER else c
        for c in mesh.cells
    ]
    meshio.write(path, mesh, file_format="exodus")


def _append_medit_sets(path: Path, sets: dict[str, np.ndarray]) -> None:
    text = path.read_text().rstrip().removesuffix("End")
    for name, members in sets.items():
        numbers = "\n".join(map(str, (np.asarray(members, dtype=np.int64) + 1).tolist()))
        text += f"{name}\n{len(members)}\n{numbers}\n"
    path.write_text(text + "\nEnd\n")


def _write_npz(path: Path, mesh: meshio.Mesh, format: str) -> None:
    arrays = {"points": mesh.points, **mesh.point_data}
    for name in dict.fromkeys(cells.type for cells in mesh.cells):
        own = [k for k, cells in enumerate(mesh.cells) if cells.type == name]
        arrays[name] = np.concatenate([mesh.cells[k].data for k in own])
        for key, parts in mesh.cell_data.items():
            arrays[f"{name}/{key}"] = np.concatenate([parts[k] for k in own])
    with open(path, "wb") as out:
        np.savez_compressed(out, **arrays)


_WRITERS = {
    "vtk": _write_vtk,
    "vtk42": _write_vtk,
    "xdmf": _write_xdmf,
    "gmsh": _write_gmsh,
    "gmsh22": _write_gmsh,
    "abaqus": _write_abaqus,
    "exodus": _write_exodus,
    "su2": _write_su2,
    "npz": _write_npz,
}
