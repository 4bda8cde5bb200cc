"""What goes in comes out: the bytes of the input with other coordinates in them.

A format that can find the coordinates in its files (`Format.patch`) is written so where output and input are
of one format.  Where more is done than to put numbers in the place of numbers, what was made is read again,
and must have the coordinates that were asked for and the cells of the input; else the file is written anew,
and a note says so.
"""

from __future__ import annotations

import os
import struct
import tempfile
import zlib
from dataclasses import replace
from pathlib import Path

import meshio
import numpy as np
from jaxtyping import Float

from jaxsmooth.convert.meshfile import MeshFile
from jaxsmooth.convert.original import fingerprint
from jaxsmooth.convert.regions import plain
from jaxsmooth.files.formats.meshios import quiet
from jaxsmooth.files.formats.record import Format, Patched, Source, UnpatchableError
from jaxsmooth.files.formats.table import format_named

__all__ = ["patch_file"]

_ROUNDING = 1e-12  # of the largest coordinate, when a copy is read again


def patch_file(
    file: MeshFile, points: Float[np.ndarray, "nodes dim"], output: Path, format: str
) -> Patched | None:
    """The file that was read, with other coordinates in it.

    Args:
        file: what was read.
        points: coordinates in the order, and of the dimension, of ``file.source.points``.
        output: what the file will be called.
        format: the one to write.

    Returns:
        The new bytes; None where input and output are of different formats or compressed, the file was not
        read from one, its source was changed since, or the format knows no way.

    Raises:
        UnpatchableError: it should be possible, but isn't.
    """
    record = format_named(format)
    if file.original is None or record is None or record.patch is None or format != file.format:
        return None
    if fingerprint(file.source) != file.original.marks or ".gz" in (output.suffix, file.original.path.suffix):
        return None
    content = file.original.read()
    if content is None:
        raise UnpatchableError("the input is gone, or was changed after it had been read")
    old = plain(file.source.points)
    old = old if old.dtype.kind == "f" else old.astype(np.float64)
    new = np.asarray(points).astype(old.dtype)
    try:
        source = Source(content, file.original.path, output)
        with quiet():
            patched = record.patch(source, old, new)
            if not patched.proven:
                _check(record, patched, source, file.source, new)
    except UnpatchableError:
        raise
    except OSError as error:  # a companion that is gone, no room for the check
        raise UnpatchableError(
            f"the copy could not be made or checked ({error.strerror or error})"
        ) from error
    except (ValueError, LookupError, struct.error, zlib.error) as error:
        text = " ".join(str(error).split())[:200]
        raise UnpatchableError(f"the coordinates could not be found in it ({text})") from error
    here, there = output.parent.resolve(), file.original.path.parent.resolve()
    if patched.refers and here != there:
        told = (
            f"{output.name} refers to {', '.join(patched.refers)} beside it; copy from {there} what is there"
        )
        patched = replace(patched, notes=(*patched.notes, told))
    return patched


def _check(
    record: Format, patched: Patched, source: Source, mesh: meshio.Mesh, new: Float[np.ndarray, "nodes dim"]
) -> None:
    """Read what was made; raise `UnpatchableError` where it isn't the mesh with these coordinates."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, *"abcdefgh", f"mesh{source.path.suffix}")  # deep, for names with ../ in them
        path.parent.mkdir(parents=True)
        path.write_bytes(patched.content)
        for name, content in patched.companions.items():
            (path.parent / name).write_bytes(content)
        for name in patched.refers:
            link = Path(os.path.normpath(path.parent / name))
            link.parent.mkdir(parents=True, exist_ok=True)
            link.symlink_to((source.path.parent / name).resolve())
        try:
            again = record.read(path)[0]
        except MemoryError:
            raise
        except (Exception, SystemExit) as error:  # meshio's readers raise anything, and exit
            raise UnpatchableError(
                f"the copy can't be read ({' '.join(str(error).split())[:200]})"
            ) from error
    found = plain(again.points)
    size = np.abs(new).max(initial=0.0)
    same = found.shape == new.shape and np.abs(found - new).max(initial=0.0) <= _ROUNDING * size
    if not same:
        raise UnpatchableError("its coordinates are others when the copy is read again")
    if [cells.type for cells in again.cells] != [cells.type for cells in mesh.cells] or not all(
        np.array_equal(plain(one.data), plain(other.data))
        for one, other in zip(again.cells, mesh.cells, strict=True)
        if not one.type.startswith("polyhedron")
    ):
        raise UnpatchableError("its cells are others when the copy is read again")
