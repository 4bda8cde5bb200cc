"""Writing a mesh anew in any format: what the format can hold, so that nothing is lost in silence."""

from __future__ import annotations

import copy
import importlib.util
from collections.abc import Iterable
from pathlib import Path

import meshio
import numpy as np

from jaxsmooth.cells.table import supported
from jaxsmooth.convert.checks import MeshFileError
from jaxsmooth.convert.regions import NOT_SETS, SECTIONS, plain, recall
from jaxsmooth.files.formats.meshios import quiet
from jaxsmooth.files.formats.record import Format, stem_format
from jaxsmooth.files.formats.table import FORMATS, format_named
from jaxsmooth.files.reduction import BLOCKWISE, UNKEPT, add_materials, families_to_sets, sets_to_data

__all__ = ["check_types", "check_writable", "write_source"]


def check_writable(format: str) -> Format:
    """The record of a format; raises `MeshFileError` where nothing writes it, or a package is missing."""
    record = format_named(format)
    if record is None or record.write is None:
        raise MeshFileError(f"nothing writes {stem_format(format)} files; write .vtu, .msh or .xdmf instead")
    if record.needs and importlib.util.find_spec(record.needs) is None:
        raise MeshFileError(
            f"writing {record.name} files needs {record.needs}; install it with: pip install 'jaxsmooth[io]'"
        )
    return record


def check_types(names: Iterable[str], path: Path, format: str) -> None:
    """Raise `MeshFileError` where a format can't be written, or can't hold elements of these types."""
    try:
        record = check_writable(format)
    except MeshFileError as error:
        raise MeshFileError(f"{path}: {error}") from None
    if refusal := record.refuse(Path(path)):
        raise MeshFileError(f"{path}: {refusal}")
    missing = [name for name in names if name in supported() and not record.holds.cells(name)]
    if missing:
        raise MeshFileError(
            f"{path}: {record.name} files can't hold {missing[0]} elements; write {_instead(missing)} instead"
        )


def _instead(names: Iterable[str]) -> str:
    """The formats to recommend for elements of these types."""
    suffixes = {"vtu": ".vtu", "gmsh22": ".msh", "xdmf": ".xdmf"}
    able = [end for stem, end in suffixes.items() if all(map(FORMATS[stem].holds.cells, names))]
    return " or ".join(filter(None, (", ".join(able[:-1]), *able[-1:]))) or ".npz"


def write_source(path: Path, mesh: meshio.Mesh, format: str, dim: int) -> list[str]:
    """Write a mesh, and say in notes what the format can't hold.

    Args:
        path: where to; an existing file is replaced.
        mesh: what to write; not modified.
        format: its name, with a variant or without.
        dim: dimension of the elements.

    Raises:
        MeshFileError: this mesh can't be written in this format.
    """
    record, notes = check_writable(format), []
    mesh = _clean(mesh, record, notes)
    if not record.holds.materials:
        add_materials(mesh, record.holds, dim, notes)
    sets_to_data(mesh, record, notes)
    if not record.holds.any_data:
        names = dict.fromkeys(record.holds.reduce(mesh, dim))
        if lost := [name for name in names if name != "gmsh:dim_tags"]:
            notes.append(
                f"{record.name} files can't hold these data, which are not written: {', '.join(lost)}"
            )
    variant = format.partition(":")[2] or record.variants[0]
    try:
        with quiet() as said:
            # check_writable refuses formats without a writer
            notes += record.write(path, mesh, dim, variant)  # pyright: ignore[reportOptionalCall]
    except ModuleNotFoundError as error:
        raise MeshFileError(
            f"{path}: writing {record.name} files needs {error.name}; "
            "install it with: pip install 'jaxsmooth[io]'"
        ) from error
    except (Exception, SystemExit) as error:  # meshio's writers raise anything
        kind = f"it has no place for {error}" if isinstance(error, KeyError) else " ".join(str(error).split())
        kind = kind or "the writer does not take it"
        others = " or ".join(suffix for suffix in (".vtu", ".msh", ".xdmf", ".npz") if suffix != path.suffix)
        raise MeshFileError(
            f"{path}: this mesh can't be written as {record.name}: {kind}; write {others} instead"
        ) from error
    if "kipping" in said.getvalue() and "cells" in said.getvalue():
        raise MeshFileError(
            f"{path}: {record.name} files can't hold all cells of this mesh; write .vtu instead"
        )
    return notes


def _clean(mesh: meshio.Mesh, record: Format, notes: list[str]) -> meshio.Mesh:
    """A copy with native arrays that every writer takes, without cells that the format lacks."""
    out, holds = copy.copy(mesh), record.holds
    families_to_sets(out)
    kept = [k for k, cells in enumerate(mesh.cells) if len(cells)]
    lacking = [k for k in kept if not holds.cells(mesh.cells[k].type)]
    if lacking:
        names = ", ".join(sorted({mesh.cells[k].type for k in lacking}))
        notes.append(f"{record.name} files can't hold {names} cells; they are not written")
        kept = [k for k in kept if k not in lacking]
    out.cells = [mesh.cells[k] for k in kept]
    out.cells = [
        c if c.type.startswith("polyhedron") else meshio.CellBlock(c.type, plain(c.data)) for c in out.cells
    ]
    out.points = plain(mesh.points)
    if holds.space and out.points.shape[1] == 2:
        out.points = np.pad(out.points, ((0, 0), (0, 1)))
    # a mixture of types may differ in dtype from block to block
    out.cell_data = {}
    for name, parts in mesh.cell_data.items():
        arrays = [array for k in kept if (array := _array(parts[k])) is not None]
        if len(arrays) < len(kept) or len({array.shape[1:] for array in arrays}) > 1:
            notes.append(f"the cell data {name!r} are not numbers in every cell; they are not written")
        else:
            common = np.result_type(*arrays)
            out.cell_data[name] = [array.astype(common) for array in arrays]
    out.point_data = {}
    for name, values in mesh.point_data.items():
        if (array := _array(values)) is None:
            notes.append(f"the point data {name!r} are not numbers; they are not written")
        else:
            out.point_data[name] = array
    out.cell_sets = {
        name: [members[k] if k < len(members) else None for k in kept]
        for name, members in out.cell_sets.items()
        if name not in NOT_SETS or name in holds.private
    }
    out.field_data = dict(mesh.field_data)
    if isinstance(mesh.info, dict):
        by_block = {key: mesh.info[key] for key in (SECTIONS, *BLOCKWISE) if key in mesh.info}
        out.info = mesh.info | {key: [parts[k] for k in kept] for key, parts in by_block.items()}
    for owner, what in recall(mesh, UNKEPT) or ():
        if owner != record.name:
            notes.append(f"{record.name} files have no place for {what}; they are not written")
    return out


def _array(values) -> np.ndarray | None:
    values = plain(values)
    if values.dtype == bool:
        values = values.astype(np.int32)
    if values.dtype.kind not in "iuf":
        return None
    if values.dtype.kind == "f" and values.dtype.itemsize not in (4, 8):
        values = values.astype(np.float64)
    if values.ndim > 2 or (values.ndim == 2 and values.shape[1] == 1):
        values = values.reshape(len(values), -1) if values.size != len(values) else values.ravel()
    return values
