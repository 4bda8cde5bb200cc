"""Writing meshes through meshio: what every format can hold, so that nothing is lost in silence."""

from __future__ import annotations

import copy
import importlib.util
from collections.abc import Iterable
from pathlib import Path

import meshio
import numpy as np
from meshio._helpers import _writer_map, reader_map
from meshio._vtk_common import vtk_to_meshio_type
from meshio.gmsh.common import _meshio_to_gmsh_type
from meshio.xdmf.common import meshio_to_xdmf_type

from jaxsmooth.cells.table import TYPES, supported
from jaxsmooth.convert.checks import SYNONYMS, MeshFileError
from jaxsmooth.convert.regions import NOT_SETS, SECTIONS, plain, recall
from jaxsmooth.files.formats.abaqus import ABAQUS_TYPES, write_abaqus
from jaxsmooth.files.formats.exodus import write_exodus
from jaxsmooth.files.formats.medit import MEDIT_SETS, append_medit_sets
from jaxsmooth.files.formats.msh import in_gmsh_order, split_by_entity, write_data_sections, write_msh41
from jaxsmooth.files.formats.su2 import SU2_REST, write_su2
from jaxsmooth.files.formats.ugrid import is_text, write_ugrid
from jaxsmooth.files.reading import quiet, read_format, stem_format
from jaxsmooth.files.reduction import (
    DATA_FORMATS,
    GMSH_TAGS,
    VTK_FORMATS,
    add_materials,
    as_tags,
    material_name,
    reduce_data,
    sets_to_data,
)

__all__ = ["check_types", "check_writable", "write_source"]

_LINEAR = {"line", "triangle", "quad", "tetra", "wedge", "pyramid", "hexahedron"}
_QUADRATIC = {"line3", "triangle6", "quad8", "tetra10", "pyramid13", "wedge15", "hexahedron20"}
_CENTRED = {"quad9", "hexahedron27"}
_HOLDS = {
    "abaqus": _LINEAR | _QUADRATIC | _CENTRED,
    "avsucd": {"vertex", *_LINEAR},
    "exodus": {"vertex", "pyramid14", "wedge18"} | _LINEAR | _QUADRATIC | _CENTRED,
    "medit": _LINEAR,
    "nastran": _LINEAR | _QUADRATIC,
    "su2": _LINEAR,
    "ugrid": _LINEAR - {"line"},
}
"""Cell types of formats that hold only some of those that this package knows."""

_MESHIO = {
    **{stem: set(vtk_to_meshio_type.values()) for stem in VTK_FORMATS},
    **{stem: set(_meshio_to_gmsh_type) for stem in ("gmsh", "gmsh22")},
    "xdmf": set(meshio_to_xdmf_type),
}
"""The same as meshio's tables say, which have other cells than this package's, too."""

_SURFACES = {"stl", "obj", "off", "ply", "svg", "wkt", "neuroglancer"}
_ONE_BLOCK = {"med", "hmf", "h5m"}  # of a type
_NEEDS = {"exodus": "netCDF4", "med": "h5py", "h5m": "h5py", "hmf": "h5py", "cgns": "h5py", "xdmf": "h5py"}


def check_writable(format: str) -> None:
    """Raise `MeshFileError` where nothing here writes a format, or a package for it is missing."""
    stem = stem_format(format)
    if stem not in _writer_map and stem not in _WRITERS:
        raise MeshFileError(f"nothing writes {stem} files; write .vtu, .msh or .xdmf instead")
    if stem == "dolfin-xml":
        raise MeshFileError("dolfin-xml files have no room for data, tags and sets; write .xdmf instead")
    if (package := _NEEDS.get(stem)) and importlib.util.find_spec(package) is None:
        raise MeshFileError(
            f"writing {stem} files needs {package}; install it with: pip install 'jaxsmooth[io]'"
        )


def check_types(names: Iterable[str], path: Path, format: str) -> None:
    """Raise `MeshFileError` where a format can't be written, or can't hold elements of these types."""
    stem = stem_format(format)
    try:
        check_writable(format)
    except MeshFileError as error:
        raise MeshFileError(f"{path}: {error}") from None
    if stem == "ugrid" and not is_text(Path(path)):
        raise MeshFileError(
            f"{path}: ugrid files are written as text, and this name says binary; name it .ugrid"
        )
    if stem in _SURFACES:
        raise MeshFileError(f"{path}: {stem} files hold surfaces only; write .vtu, .msh or .xdmf instead")
    missing = [n for n in names if n in supported() and not _holds(stem, n)]
    if missing:
        raise MeshFileError(
            f"{path}: {stem} files can't hold {missing[0]} elements; write {_instead(missing)} instead"
        )


def _holds(stem: str, name: str) -> bool:
    """Whether a format has cells of a type, as far as is known before it is written."""
    if name in TYPES and stem in _MESHIO:
        return name in _MESHIO[stem]
    return name in _HOLDS.get(stem, {name})


def _instead(names: Iterable[str]) -> str:
    """The formats to recommend for elements of these types."""
    suffixes = {"vtu": ".vtu", "gmsh22": ".msh", "xdmf": ".xdmf"}
    able = [suffix for stem, suffix in suffixes.items() if all(_holds(stem, name) for name in names)]
    return " or ".join(filter(None, (", ".join(able[:-1]), *able[-1:]))) or ".npz"


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
    if stem != "abaqus":
        add_materials(mesh, stem, dim, notes)
    own_sets = {}
    if stem == "medit" and path.suffix == ".mesh":
        own_sets = {name: mesh.point_sets.pop(name) for name in MEDIT_SETS if name in mesh.point_sets}
    if stem not in ("abaqus", "exodus", "su2") and (mesh.point_sets or mesh.cell_sets or mesh.field_data):
        sets_to_data(mesh, stem, notes)
    if stem not in DATA_FORMATS:
        reduce_data(mesh, stem, dim, notes)
    try:
        with quiet() as said:
            notes += _WRITERS.get(stem, _write_rare)(path, mesh, format, dim) or []
            if own_sets:
                append_medit_sets(path, own_sets)
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
    lacking = [k for k in kept if not _holds(stem, mesh.cells[k].type)]
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
    elif stem in (*VTK_FORMATS, "xdmf", "gmsh22", "abaqus") and out.points.shape[1] == 2:
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
    if stem != "gmsh":  # Gmsh's own, of 4.1
        out.cell_sets = {name: members for name, members in out.cell_sets.items() if name not in NOT_SETS}
    out.point_sets, out.field_data = dict(mesh.point_sets), dict(mesh.field_data)
    if isinstance(mesh.info, dict):
        by_block = {key: mesh.info[key] for key in (SECTIONS, ABAQUS_TYPES) if key in mesh.info}
        out.info = mesh.info | {key: [parts[k] for k in kept] for key, parts in by_block.items()}
    if stem != "su2" and recall(mesh, SU2_REST):
        notes.append(
            f"{stem} files have no place for the other sections of the SU2 file; they are not written"
        )
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
    if stem in VTK_FORMATS and values.ndim == 2 and values.shape[1] == 2:
        values = np.pad(values, ((0, 0), (0, 1)))  # VTK's vectors have three components
    return values


def _check_upright(mesh: meshio.Mesh) -> None:
    """Raise `MeshFileError` where x and y alone would not say where plane elements are."""
    nodes = np.unique(np.concatenate([cells.data.ravel() for cells in mesh.cells if cells.dim == 2]))
    extent = np.ptp(mesh.points[nodes], axis=0)
    if len(extent) == 3 and extent[2] > 1e-5 * extent[:2].max():
        raise MeshFileError(
            "su2 files hold x and y of plane meshes and nothing else, but this one lies in another plane; "
            "choose another format"
        )


# --- Writers -----------------------------------------------------------------------------


def _write_any(path: Path, mesh: meshio.Mesh, format: str, dim: int) -> None:
    meshio.write(path, mesh, file_format=stem_format(format))


def _write_rare(path: Path, mesh: meshio.Mesh, format: str, dim: int) -> list[str]:
    """Formats whose writers leave out cells or data without a word: what they wrote is read again.

    Returns notes on what is missing then."""
    stem = stem_format(format)
    if stem in _ONE_BLOCK:
        _merge_blocks(mesh)
    said = dict.fromkeys((*mesh.point_data, *mesh.cell_data))
    if stem == "h5m":  # fails with any
        mesh.cell_data = {}
    material = material_name(mesh, dim)
    meshio.write(path, mesh, file_format=stem)
    if stem not in reader_map:
        return []
    again = read_format(path, stem)
    if len(again.points) != len(mesh.points) or _sizes(again) != _sizes(mesh):
        raise ValueError(f"it would have {_sizes(again)} instead of {_sizes(mesh)}")
    kept = {*again.point_data, *again.cell_data, "gmsh:dim_tags"}
    if material_name(again, dim):
        kept.add(material)
    lost = [name for name in said if name not in kept]
    return [f"{stem} files can't hold these data, which are not written: {', '.join(lost)}"] if lost else []


def _sizes(mesh: meshio.Mesh) -> str:
    sizes: dict[str, int] = {}
    for cells in mesh.cells:
        name = SYNONYMS.get(cells.type, cells.type)
        sizes[name] = sizes.get(name, 0) + len(cells)
    return ", ".join(f"{n} {name}" for name, n in sorted(sizes.items())) or "no cells"


def _merge_blocks(mesh: meshio.Mesh) -> None:
    """One cell block a type."""
    parts = {c.type: [k for k, o in enumerate(mesh.cells) if o.type == c.type] for c in mesh.cells}
    mesh.cell_data = {
        name: [np.concatenate([values[k] for k in own]) for own in parts.values()]
        for name, values in mesh.cell_data.items()
    }
    mesh.cells = [
        meshio.CellBlock(kind, np.concatenate([mesh.cells[k].data for k in own]))
        for kind, own in parts.items()
    ]


def _write_vtk(path: Path, mesh: meshio.Mesh, format: str, dim: int) -> None:
    mesh.point_data = {name.replace(" ", "_"): v for name, v in mesh.point_data.items()}
    mesh.cell_data = {name.replace(" ", "_"): v for name, v in mesh.cell_data.items()}
    meshio.write(path, mesh, file_format=stem_format(format), binary=not format.endswith(":ascii"))


def _write_xdmf(path: Path, mesh: meshio.Mesh, format: str, dim: int) -> None:
    # one file: a companion .h5 could not be renamed together with it
    meshio.write(path, mesh, file_format="xdmf", data_format="XML")


def _write_gmsh(path: Path, mesh: meshio.Mesh, format: str, dim: int) -> None:
    binary = not format.endswith(":ascii")
    in_gmsh_order(mesh)
    _tag(mesh, dim)
    if stem_format(format) == "gmsh":
        write_msh41(path, split_by_entity(mesh), binary)
        return
    bare = copy.copy(mesh)
    bare.points = mesh.points.astype(np.float64)
    bare.point_data, bare.cell_data = {}, {name: mesh.cell_data[name] for name in GMSH_TAGS}
    meshio.write(path, bare, file_format="gmsh22", binary=binary)
    write_data_sections(path, mesh, binary)


def _tag(mesh: meshio.Mesh, dim: int) -> None:
    """Both of Gmsh's tags for all cells; other material tags are physical groups to it."""
    if "gmsh:physical" not in mesh.cell_data:
        name = material_name(mesh, dim)
        zero = [np.zeros(len(cells), np.int32) for cells in mesh.cells]
        used = name not in (None, *GMSH_TAGS)
        mesh.cell_data["gmsh:physical"] = as_tags(mesh.cell_data[name]) if used else zero
    if "gmsh:geometrical" not in mesh.cell_data:
        mesh.cell_data["gmsh:geometrical"] = mesh.cell_data["gmsh:physical"]
    for name in GMSH_TAGS:
        mesh.cell_data[name] = [part.astype(np.int32) for part in mesh.cell_data[name]]


def _write_abaqus(path: Path, mesh: meshio.Mesh, format: str, dim: int) -> None:
    write_abaqus(path, mesh)


def _write_su2(path: Path, mesh: meshio.Mesh, format: str, dim: int) -> None:
    write_su2(path, mesh)


def _write_exodus(path: Path, mesh: meshio.Mesh, format: str, dim: int) -> None:
    write_exodus(path, mesh, next(iter(mesh.cell_data), None))


def _write_ugrid(path: Path, mesh: meshio.Mesh, format: str, dim: int) -> None:
    write_ugrid(path, mesh)


def _write_npz(path: Path, mesh: meshio.Mesh, format: str, dim: int) -> None:
    arrays = {"points": mesh.points, **mesh.point_data}
    for name in dict.fromkeys(cells.type for cells in mesh.cells):
        own = [k for k, cells in enumerate(mesh.cells) if cells.type == name]
        arrays[name] = np.concatenate([mesh.cells[k].data for k in own])
        for key, parts in mesh.cell_data.items():
            arrays[f"{name}/{key}"] = np.concatenate([parts[k] for k in own])
    with open(path, "wb") as out:
        np.savez_compressed(out, **arrays)


_WRITERS = {
    "vtu": _write_any,
    "medit": _write_any,
    "vtk": _write_vtk,
    "vtk42": _write_vtk,
    "xdmf": _write_xdmf,
    "gmsh": _write_gmsh,
    "gmsh22": _write_gmsh,
    "abaqus": _write_abaqus,
    "exodus": _write_exodus,
    "su2": _write_su2,
    "ugrid": _write_ugrid,
    "npz": _write_npz,
}
