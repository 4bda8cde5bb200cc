"""VTK's XML files of unstructured grids: read by meshio (5.3.5), which takes what is there."""

from __future__ import annotations

import re
from pathlib import Path

import meshio
import numpy as np
from jaxtyping import Float

from jaxsmooth.files.formats.record import Format, Holds, Patched, Source
from jaxsmooth.files.formats.vtk import pad_pairs
from jaxsmooth.files.formats.vtuarrays import replace_points

__all__ = ["VTU", "check_vtu", "read_vtu", "write_vtu"]

_CUT = "the file is damaged or cut short"


def read_vtu(path: Path) -> tuple[meshio.Mesh, list[str]]:
    """A file of one grid, in one piece or several."""
    mesh = meshio.read(path, file_format="vtu")
    check_vtu(path.read_bytes(), mesh)
    return mesh, []


def check_vtu(content: bytes, mesh: meshio.Mesh) -> None:
    """Raise `ValueError` where an XML file has other counts than `mesh`, which meshio read from it."""
    cells = sum(len(block) for block in mesh.cells)
    for key, found in (("Points", len(mesh.points)), ("Cells", cells)):
        said = [int(n) for n in re.findall(rb"NumberOf" + key.encode() + rb"\s*=\s*[\"'](\d+)", content)]
        if said and sum(said) != found:
            raise ValueError(f"it says NumberOf{key} {sum(said)}, and has {found}; {_CUT}")


def write_vtu(path: Path, mesh: meshio.Mesh, dim: int, variant: str = "") -> list[str]:
    """Write one piece, its arrays compressed."""
    pad_pairs(mesh)
    meshio.write(path, mesh, file_format="vtu")
    return []


def patch_vtu(
    source: Source, old: Float[np.ndarray, "nodes dim"], new: Float[np.ndarray, "nodes dim"]
) -> Patched:
    """The file with other coordinates, in its own precision and encoding."""
    return Patched(replace_points(source.content, old, new))


VTU = Format("vtu", (".vtu",), read_vtu, write_vtu, Holds(any_data=True, space=True), patch=patch_vtu)
