"""Reading a file by its format, with one sentence for all that can go wrong."""

from __future__ import annotations

from pathlib import Path

import meshio

from jaxsmooth.convert.checks import MeshFileError, check_references
from jaxsmooth.files.formats.meshios import quiet, remarks
from jaxsmooth.files.formats.record import stem_format
from jaxsmooth.files.formats.table import FORMATS, detect_format

__all__ = ["MissingFileError", "read_source"]


def read_source(path: Path) -> tuple[meshio.Mesh, str, list[str]]:
    """Read a file: the mesh, its format, and notes.

    Raises `MeshFileError`: not there, not readable, of an unknown format, or broken."""
    if not path.exists():
        raise MissingFileError(f"{path}: there is no such file; check the name")
    if not path.is_file():
        raise MeshFileError(f"{path}: this is a folder, not a file; name a mesh file in it")
    name, said = "?", ""
    try:
        name = detect_format(path)
        with quiet() as stream:
            try:
                mesh, notes = FORMATS[stem_format(name)].read(path)
                check_references(mesh)
            finally:
                said = stream.getvalue()
    except MeshFileError:
        raise
    except PermissionError as error:
        raise MeshFileError(f"{path}: the file can't be read (permission denied)") from error
    except ModuleNotFoundError as error:
        raise MeshFileError(
            f"{path}: reading {stem_format(name)} files needs {error.name}; "
            "install it with: pip install 'jaxsmooth[io]'"
        ) from error
    except (Exception, SystemExit) as error:  # meshio's readers raise anything, and exit
        raise MeshFileError(f"{path}: not readable as {stem_format(name)}: {_reason(error, said)}") from error
    lines = remarks(said)
    if trouble := [line for line in lines if "cannot handle" in line]:  # meshio drops such cells
        raise MeshFileError(f"{path}: cell type not supported: {trouble[0]}")
    if trouble := [line for line in lines if "End-of-file" in line]:
        raise MeshFileError(f"{path}: not readable as {stem_format(name)}: {trouble[0]}; it may be cut short")
    return mesh, name, [*notes, *lines]


class MissingFileError(MeshFileError, FileNotFoundError):
    """The file isn't there."""

    def __str__(self) -> str:
        return str(self.args[0])


def _reason(error: BaseException, said: str) -> str:
    text = str(error).strip() if not isinstance(error, SystemExit) else " ".join(remarks(said)[:1])
    text = " ".join(text.split())
    if text.startswith("Couldn't read file"):  # meshio, without a reason
        text = ""
    if isinstance(error, KeyError):
        text = f"it has something unknown, {text}"
    elif not isinstance(error, (ValueError, RuntimeError, OSError, SystemExit)):
        text = "the file is damaged or of another format than its name says" + (f" ({text})" if text else "")
    if len(text) > 200:
        text = text[:200] + "…"
    return text or "the file is damaged or of another format than its name says"
