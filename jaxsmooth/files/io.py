"""Mesh files in and out."""

from __future__ import annotations

import dataclasses
import os
import tempfile
import unicodedata
from collections.abc import Mapping
from itertools import combinations
from pathlib import Path
from typing import Any

from jaxsmooth.convert.meshfile import MeshFile, MeshFileError, as_file, as_mesh, from_meshio, to_meshio
from jaxsmooth.convert.original import Original
from jaxsmooth.files.formats.record import Patched, UnpatchableError, stem_format
from jaxsmooth.files.formats.table import format_named, format_of_suffix
from jaxsmooth.files.outputs import Outputs
from jaxsmooth.files.patching import patch_file
from jaxsmooth.files.reading import MissingFileError, read_source
from jaxsmooth.files.writing import check_types, write_source

__all__ = [
    "MeshFileError",
    "MissingFileError",
    "check_distinct",
    "check_output",
    "check_types",
    "output_format",
    "read",
    "write",
    "write_to",
]


def read(path: str | Path, *, dtype: Any = None) -> MeshFile:
    """Read a mesh file, by its suffix and its first bytes.

    All formats that meshio reads, universal files, and ``.npz`` archives with ``points`` and one array a cell
    type.  The file's bytes are kept, or read again if there are more than 64 MiB of them, for `write`.

    Args:
        path: the file.
        dtype: float32 or float64 for the points; by default the file's (as far as JAX allows it).

    Returns:
        The mesh with all that the file says about it; `MeshFile.notes` are worth showing.

    Raises:
        MeshFileError: a `ValueError` with one sentence that says what, where and what to do
            (`MissingFileError`, also a `FileNotFoundError`, where the file isn't there).
    """
    path = Path(path)
    source, name, notes = read_source(path)
    try:
        file = from_meshio(source, path=path, format=name, dtype=dtype)
    except MeshFileError as error:
        raise MeshFileError(f"{path}: {error}") from error
    return dataclasses.replace(file, notes=(*notes, *file.notes), original=Original.of(path, source))


def write(
    path: str | Path,
    file: Any,
    points: Any = None,
    *,
    file_format: str | None = None,
    force: bool = False,
    cell_data: Mapping[str, Any] | None = None,
    point_data: Mapping[str, Any] | None = None,
) -> tuple[str, ...]:
    """Write a file that was read, with other coordinates; or any mesh, and what `smooth` returned.

    In the format of the input the output is the input, byte for byte, with other coordinates in it, so that
    also what this package knows nothing of is kept.  A note says where that is not possible; it is not
    with `cell_data` and `point_data`.  In another format, and then too, the mesh is written anew.

    The output is complete or not there: it is written beside its target and renamed.  A link is written
    through to its target; a file that is replaced gives its mode to the new one.

    Args:
        path: where to.  A name of the input's format keeps its version; others choose the format.
        file: what was read; its data, sets and cells are written in their own order.  Or what `smooth`
            returned, or whatever else `as_mesh` takes.
        points: coordinates ``[nodes, dim]``, or what has them as ``.mesh.points`` (the result of
            smoothing) or ``.points`` (a mesh); None for those of the file.
        file_format: overrules the name: ``"gmsh"`` (4.1), ``"gmsh22"``, ``"vtk"``, ``"vtu"``, …, followed by
            ``:ascii`` or ``:binary`` where the format has both.
        force: allow the output to replace the input.
        cell_data: more data of elements, ``{name: {type: [elements, …]}}``; see `to_meshio`.
        point_data: more data of nodes ``{name: [nodes, …]}``.

    Returns:
        Notes: sentences on what the format can't hold.

    Raises:
        MeshFileError: the output is the input (without `force`), its folder is missing or can't be
            written, or the format can't hold the mesh.
    """
    options = {"file_format": file_format, "cell_data": cell_data, "point_data": point_data}
    with Outputs() as outputs:
        notes = write_to(outputs, path, file, points, force=force, **options)
        try:
            outputs.commit()
        except OSError as error:
            raise _unwritable(error.filename, error) from error
    return notes


def write_to(
    outputs: Outputs,
    path: str | Path,
    file: Any,
    points: Any = None,
    *,
    file_format: str | None = None,
    force: bool = False,
    cell_data: Mapping[str, Any] | None = None,
    point_data: Mapping[str, Any] | None = None,
) -> tuple[str, ...]:
    """`write` as one of several outputs: the file is put in place when they are committed."""
    path = Path(path)
    if not isinstance(file, MeshFile):
        mesh, file = as_mesh(file), as_file(file)
        points = mesh if points is None else points
    check_output(path, file.path, force)
    if file.path is not None:
        outputs.protect(file.path)
    name = output_format(path, file, file_format)
    check_types(file.mesh.types, path, name)
    for attribute in ("mesh", "points"):
        points = getattr(points, attribute, points)
    mesh = to_meshio(file, points, point_data=point_data, cell_data=cell_data)
    patched, notes = None, []
    if point_data or cell_data:
        notes += _lost_by_data(file, name, path)
    else:
        try:
            patched = patch_file(file, mesh.points, path, name)
        except UnpatchableError as error:
            notes.append(
                f"{path.name} is written anew, without what is neither mesh, nor data, nor sets, because "
                f"the input can't be copied with other coordinates: {error}"
            )
    try:
        with outputs.file(path) as part:
            if patched is None:
                notes += write_source(part, mesh, name, file.mesh.element_dim)
            else:
                _write_patched(outputs, part, patched)
                notes += patched.notes
    except MeshFileError as error:
        if isinstance(error.__cause__, OSError):  # not for the format to help: a full disk, say
            raise _unwritable(path, error.__cause__) from error
        # only the writer raises it, which has a part
        message = str(error).replace(str(part), str(path))  # pyright: ignore[reportPossiblyUnboundVariable]
        raise MeshFileError(message) from error
    except OSError as error:
        raise _unwritable(path, error) from error
    return tuple(notes)


def _lost_by_data(file: MeshFile, name: str, path: Path) -> list[str]:
    """A note where the input could have been copied but for the data that are added."""
    record = format_named(name)
    if file.original is None or name != file.format or record is None or record.patch is None:
        return []
    return [
        f"{path.name} is written anew, without what is neither mesh, nor data, nor sets, "
        "because data are added"
    ]


def _write_patched(outputs: Outputs, part: Path, patched: Patched) -> None:
    part.write_bytes(patched.content)
    for name, content in patched.companions.items():
        (part.parent / name).write_bytes(content)
    for path in patched.inputs:
        outputs.protect(path)


def _unwritable(path: Any, error: OSError) -> MeshFileError:
    reason = error.strerror or f"{error}: is the disk full?"  # NumPy's own has no more
    return MeshFileError(f"{path}: the file can't be written ({reason.partition('(')[0].strip()})")


def check_output(path: str | Path, input_path: str | Path | None = None, force: bool = False) -> None:
    """Whether an output (of any kind) can be written, before any work is done for it.

    Whether its name stands for a mesh format is for `output_format` to say.

    Args:
        path: the output.
        input_path: the input, if there is one.
        force: allow the two to be one file.

    Raises:
        MeshFileError: no such folder, a folder or a file that can't be written, no regular file, or the
            input without `force`.
    """
    path = Path(path)
    if path.is_dir():
        raise MeshFileError(f"{path}: this is a folder; give the name of a file")
    if path.exists():
        _check_existing(path)
    target = Path(os.path.realpath(path))
    folder = target.parent if path.is_symlink() else path.parent
    if not folder.is_dir():
        raise MeshFileError(f"{path}: there is no folder {folder}; create it or write elsewhere")
    if target.is_symlink():
        raise MeshFileError(f"{path}: this link leads back to itself; give another name")
    if input_path is not None and not force and _same(path, Path(input_path)):
        raise MeshFileError(f"{path}: this is the input; give another name, or --force to replace it")
    try:  # permissions alone don't tell (read-only file systems, root)
        tempfile.TemporaryFile(dir=folder).close()
    except OSError as error:
        raise MeshFileError(f"{path}: the folder {folder} can't be written ({error.strerror})") from error


def _check_existing(path: Path) -> None:
    if not path.is_file():
        raise MeshFileError(f"{path}: this is a device or a pipe; give the name of a file")
    if not os.access(path, os.W_OK):  # a rename would not ask
        raise MeshFileError(f"{path}: this file is read-only; give another name, or make it writable")
    try:
        printed = os.path.samestat(os.fstat(1), path.stat())
    except OSError:  # there is no standard output
        printed = False
    if printed:
        raise MeshFileError(f"{path}: standard output goes to this file; give another name")


def check_distinct(files: Mapping[str, str | Path]) -> None:
    """Whether files that one run reads or writes are different ones.

    Args:
        files: their paths, by what they are for (``"--json"``).

    Raises:
        MeshFileError: two of them are one file (by a link, or by names that differ in case only).
    """
    for (first, path), (second, other) in combinations(files.items(), 2):
        if _same(Path(path), Path(other)):
            raise MeshFileError(f"{other}: {second} and {first} are one file; give another name")


def _same(path: Path, other: Path) -> bool:
    try:
        return path.samefile(other)
    except OSError:  # one of them isn't there
        if path.exists() or other.exists():
            return False
    return _folded(path) == _folded(other)


def _folded(path: Path) -> str:
    """For files to be: some systems take names that differ in case, or in how accents are stored, as one."""
    return unicodedata.normalize("NFC", os.path.realpath(path)).casefold()


def output_format(path: str | Path, file: MeshFile, file_format: str | None = None) -> str:
    """The format of an output: the one asked for, else the input's if the name allows it, else the name's.

    Raises `MeshFileError` for suffixes that stand for no format."""
    path = Path(path)
    if file_format is not None:
        return file_format
    name = format_of_suffix(path)
    if file.format is not None:
        old = stem_format(file.format)
        suffix = {"gmsh22": "gmsh22", "gmsh": "gmsh22", "vtk42": "vtk", "avsucd": "abaqus"}.get(old, old)
        if name == file.format or suffix == stem_format(name):
            return file.format
    return name
