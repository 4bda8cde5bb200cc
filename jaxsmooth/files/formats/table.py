"""The table of file formats, in the order in which they are asked; users may add theirs.

    from jaxsmooth.files.formats.record import Format, Holds
    from jaxsmooth.files.formats.table import register

    register(Format("xyz", (".xyz",), read=read_xyz, write=write_xyz))

``read_xyz(path)`` returns a `meshio.Mesh` and a list of notes, ``write_xyz(path, mesh, dim, variant)`` a
list of notes.  From then on `jaxsmooth.read` and `jaxsmooth.write` know the suffix.  With a `Format.patch`,
output in the format of the input is a copy of the input with other coordinates in it; `tables.patch_table`
makes one for text in which the nodes stand one after another.
"""

from __future__ import annotations

from pathlib import Path

from jaxsmooth.convert.checks import MeshFileError
from jaxsmooth.files.formats.abaqus import ABAQUS
from jaxsmooth.files.formats.exodus import EXODUS
from jaxsmooth.files.formats.gmsh import GMSH, GMSH22
from jaxsmooth.files.formats.med import MED
from jaxsmooth.files.formats.medit import MEDIT
from jaxsmooth.files.formats.nastran import NASTRAN
from jaxsmooth.files.formats.npz import NPZ
from jaxsmooth.files.formats.rare import RARE
from jaxsmooth.files.formats.record import Format, stem_format
from jaxsmooth.files.formats.su2 import SU2
from jaxsmooth.files.formats.surfaces import SURFACES
from jaxsmooth.files.formats.ugrid import UGRID
from jaxsmooth.files.formats.unv import UNV
from jaxsmooth.files.formats.vtk import VTK, VTK42
from jaxsmooth.files.formats.vtu import VTU
from jaxsmooth.files.formats.xdmf import XDMF

__all__ = ["FORMATS", "detect_format", "format_named", "format_of_suffix", "register"]

FORMATS: dict[str, Format] = {}
"""All formats by name."""


def register(format: Format) -> None:
    """Add a format; one of the same name is replaced, where it stands.

    Raises `ValueError` for a suffix without its dot, or with capitals."""
    for suffix in format.suffixes:
        if not suffix.startswith(".") or suffix != suffix.lower():
            raise ValueError(f"the suffix {suffix!r} of the format {format.name} must be like '.xyz'")
    FORMATS[format.name] = format


for _format in (
    *(GMSH22, GMSH, VTU, VTK, VTK42, XDMF, ABAQUS, MEDIT, SU2, EXODUS, MED, NASTRAN, UNV, UGRID, NPZ),
    *SURFACES,
    *RARE,
):
    register(_format)


def format_named(name: str) -> Format | None:
    """The format of a name such as ``"gmsh:binary"``; None where there is none."""
    return FORMATS.get(stem_format(name))


def detect_format(path: Path) -> str:
    """The format of an existing file, by its suffix and its first bytes.

    Raises `MeshFileError` where nothing is known about the suffix."""
    with open(path, "rb") as stream:
        head = stream.read(4096)
    formats = _formats_of(path)
    for format in formats:
        if format.sniff is not None and (variant := format.sniff(head)) is not None:
            return format.full_name(variant)
    others = [format for format in formats if format.sniff is None]
    return others[0].full_name() if others else format_of_suffix(path)


def format_of_suffix(path: Path) -> str:
    """The format that a new file of this name is written in.

    Raises `MeshFileError` where nothing is known about the suffix."""
    if found := _formats_of(path):
        return found[0].full_name()
    raise MeshFileError(
        f"{path}: no mesh format is known for the suffix {path.suffix!r}; "
        "use .msh, .vtu, .vtk, .inp, .mesh, .xdmf, .npz or another that meshio reads"
    )


def _formats_of(path: Path) -> list[Format]:
    """Formats for which the name's last two suffixes stand; else those for which the last does."""
    suffixes = [suffix.lower() for suffix in path.suffixes]
    for end in ("".join(suffixes[-2:]), "".join(suffixes[-1:])):
        if found := [format for format in FORMATS.values() if end and end in format.suffixes]:
            return found
    return []
