"""Reading files through meshio: which format a file is in, and repairs where meshio (5.3.5) fails.

Formats are named as meshio names its writers, followed by ``:ascii`` or ``:binary`` where a format has
both: ``"gmsh22:ascii"``, ``"gmsh:binary"`` (that is 4.1), ``"vtk42:binary"``, ``"vtk"`` (5.1), ``"vtu"``.
"""

from __future__ import annotations

import contextlib
import gzip
import io
import re
import tempfile
import warnings
from collections.abc import Iterator
from pathlib import Path

import meshio
import numpy as np
from meshio._helpers import extension_to_filetypes

from jaxsmooth.cells.table import TYPES
from jaxsmooth.convert.checks import MeshFileError, check_last_line, check_references
from jaxsmooth.files.formats.abaqus import is_abaqus, read_abaqus
from jaxsmooth.files.formats.exodus import read_exodus
from jaxsmooth.files.formats.medit import read_medit
from jaxsmooth.files.formats.msh import in_vtk_order, keep_groups, read_msh_data, repaired_msh, sniff_msh
from jaxsmooth.files.formats.mshraw import check_msh, entity_groups
from jaxsmooth.files.formats.su2 import read_su2
from jaxsmooth.files.formats.ugrid import is_text, read_ugrid
from jaxsmooth.files.formats.vtk import check_vtk, check_vtu
from jaxsmooth.files.formats.xdmf import read_xdmf

__all__ = [
    "detect_format",
    "format_of_suffix",
    "quiet",
    "read_format",
    "read_source",
    "stem_format",
]

_TEXT = {"avsucd", "flac3d", "mdpa", "nastran", "netgen", "permas", "tecplot"}
_ENDS = {"nastran": b"\nENDDATA", "netgen": b"\nendmesh"}  # meshio waits for the first for ever


def stem_format(name: str) -> str:
    """The format without ``:ascii`` or ``:binary``."""
    return name.partition(":")[0]


def detect_format(path: Path) -> str:
    """The format of an existing file, by its suffix and its first bytes.

    Raises `MeshFileError` where nothing is known about the suffix."""
    with open(path, "rb") as stream:
        head = stream.read(4096)
    suffix = path.suffix.lower()
    if suffix == ".npz":
        return "npz"
    if suffix == ".msh":  # meshio tries ANSYS first
        return sniff_msh(head) or "ansys"
    if suffix == ".inp":  # AVS files have the same suffix
        return "abaqus" if is_abaqus(head) else "avsucd"
    if suffix == ".vtk":
        version = re.match(rb"# vtk DataFile Version (\d+)\.", head)
        lines = head.splitlines()
        kind = ":ascii" if len(lines) > 2 and lines[2].strip().upper() == b"ASCII" else ":binary"
        return ("vtk" if version and int(version[1]) >= 5 else "vtk42") + kind
    return format_of_suffix(path)


def format_of_suffix(path: Path) -> str:
    """The format that a file's name stands for.

    Raises `MeshFileError` where nothing is known about the suffix."""
    suffixes = [s.lower() for s in path.suffixes]
    if suffixes[-1:] == [".npz"]:
        return "npz"
    if suffixes[-1:] == [".msh"]:
        return "gmsh22:binary"  # holds any mixture of cells and tags
    for suffix in ("".join(suffixes[-2:]), "".join(suffixes[-1:])):
        if suffix in extension_to_filetypes:
            return extension_to_filetypes[suffix][0]
    raise MeshFileError(
        f"{path}: no mesh format is known for the suffix {path.suffix!r}; "
        "use .msh, .vtu, .vtk, .inp, .mesh, .xdmf, .npz or another that meshio reads"
    )


def read_source(path: Path) -> tuple[meshio.Mesh, str, list[str]]:
    """Read a file: the mesh, its format, and notes.

    Raises `MeshFileError`: not there, not readable, of an unknown format, or broken."""
    if not path.exists():
        raise MissingFileError(f"{path}: there is no such file; check the name")
    if not path.is_file():
        raise MeshFileError(f"{path}: this is a folder, not a file; name a mesh file in it")
    said, name = io.StringIO(), "?"
    try:
        name = detect_format(path)
        with quiet() as said:
            mesh, notes = _READERS.get(stem_format(name), _read_any)(path, stem_format(name))
            check_references(mesh)
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
        reason = _reason(error, said.getvalue())
        raise MeshFileError(f"{path}: not readable as {stem_format(name)}: {reason}") from error
    remarks = _said(said.getvalue())
    if trouble := [line for line in remarks if "cannot handle" in line]:  # meshio drops such cells
        raise MeshFileError(f"{path}: cell type not supported: {trouble[0]}")
    if trouble := [line for line in remarks if "End-of-file" in line]:
        raise MeshFileError(f"{path}: not readable as {stem_format(name)}: {trouble[0]}; it may be cut short")
    return mesh, name, [*notes, *remarks]


class MissingFileError(MeshFileError, FileNotFoundError):
    """The file isn't there."""

    def __str__(self) -> str:
        return str(self.args[0])


@contextlib.contextmanager
def quiet() -> Iterator[io.StringIO]:
    """Catch what meshio prints, and silence its warnings; text that ends early is an error."""
    said = io.StringIO()
    with warnings.catch_warnings(), contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
        warnings.simplefilter("ignore")
        warnings.filterwarnings("error", message="string or file could not be read to its end")
        yield said


def _said(text: str) -> list[str]:
    """Meshio's remarks, each on one line."""
    parts = re.split(r"(?:Warning|Info|Error):", re.sub(r"\x1b\[[0-9;]*m", "", text))
    return [" ".join(part.split()) for part in parts if part.strip()]


def _reason(error: BaseException, said: str) -> str:
    text = str(error).strip() if not isinstance(error, SystemExit) else " ".join(_said(said)[:1])
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


# --- Readers -----------------------------------------------------------------------------


def _read_any(path: Path, name: str) -> tuple[meshio.Mesh, list[str]]:
    if name in _TEXT:
        content = gzip.decompress(path.read_bytes()) if path.suffix == ".gz" else path.read_bytes()
        check_last_line(content)
        if name in _ENDS and _ENDS[name] not in content:
            raise ValueError(f"it has no line {_ENDS[name].decode()}; the file is damaged or cut short")
    return meshio.read(path, file_format=_reader(name)), []


def read_format(path: Path, stem: str) -> meshio.Mesh:
    """Read a file of a known format, whatever its name says; raises anything."""
    return _READERS.get(stem, _read_any)(path, stem)[0]


def _reader(name: str) -> str:
    return {"gmsh22": "gmsh", "vtk42": "vtk"}.get(name, name)


def _read_copy(content: bytes, path: Path, name: str) -> meshio.Mesh:
    """Read repaired content: through a file, for NumPy wants one."""
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / ("mesh" + path.suffix)
        copy.write_bytes(content)
        return meshio.read(copy, file_format=_reader(name))


def _read_gmsh(path: Path, name: str) -> tuple[meshio.Mesh, list[str]]:
    content = path.read_bytes()
    check_msh(content)
    repaired = repaired_msh(content)
    if repaired is content or repaired == content:
        mesh = _read_any(path, name)[0]
    else:
        mesh = _read_copy(repaired, path, name)
        mesh.cell_data.update(read_msh_data(content, mesh))
    in_vtk_order(mesh)
    keep_groups(mesh, entity_groups(content))
    return mesh, []


def _read_vtk(path: Path, name: str) -> tuple[meshio.Mesh, list[str]]:
    mesh = _read_any(path, name)[0]
    check_vtk(path.read_bytes(), mesh)
    return mesh, []


def _read_vtu(path: Path, name: str) -> tuple[meshio.Mesh, list[str]]:
    mesh = _read_any(path, name)[0]
    check_vtu(path.read_bytes(), mesh)
    return mesh, []


def _read_ugrid(path: Path, name: str) -> tuple[meshio.Mesh, list[str]]:
    return (read_ugrid(path), []) if is_text(path) else _read_any(path, name)


def _read_npz(path: Path, name: str) -> tuple[meshio.Mesh, list[str]]:
    """``points``, one array a cell type, ``type/name`` for cell data; else point data."""
    notes = []
    with open(path, "rb") as stream, np.load(stream, allow_pickle=False) as arrays:
        content = dict(arrays.items())
    if "points" not in content:
        raise ValueError("the archive has no array called 'points'")
    points = content.pop("points")
    names = [key for key in content if key == "vertex" or key in TYPES]
    cells = [(key, content.pop(key)) for key in names]
    point_data, cell_data = {}, {}
    for key, values in content.items():
        kind, _, rest = key.partition("/")
        if kind in names and rest:
            cell_data.setdefault(rest, {})[kind] = values
        elif values.ndim and len(values) == len(points):
            point_data[key] = values
        else:
            notes.append(f"the array {key!r} is neither cells nor data of nodes or cells; it is not kept")
    filled = {
        key: [parts.get(kind, np.full(len(nodes), np.nan)) for kind, nodes in cells]
        for key, parts in cell_data.items()
    }
    return meshio.Mesh(points, cells, point_data=point_data, cell_data=filled), notes


_READERS = {
    "gmsh": _read_gmsh,
    "gmsh22": _read_gmsh,
    "vtk": _read_vtk,
    "vtk42": _read_vtk,
    "vtu": _read_vtu,
    "abaqus": lambda path, name: read_abaqus(path),
    "su2": lambda path, name: read_su2(path),
    "medit": lambda path, name: read_medit(path),
    "xdmf": lambda path, name: (read_xdmf(path), []),
    "exodus": lambda path, name: (read_exodus(path), []),
    "ugrid": _read_ugrid,
    "npz": _read_npz,
}
