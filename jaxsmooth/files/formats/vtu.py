"""VTK's XML files of unstructured grids: read by meshio (5.3.5), which takes what is there."""

from __future__ import annotations

import re
from pathlib import Path

import meshio
import numpy as np
from jaxtyping import Float

from jaxsmooth.files.formats.meshios import read_copy
from jaxsmooth.files.formats.record import Format, Holds, Patched, Source
from jaxsmooth.files.formats.vtk import pad_pairs
from jaxsmooth.files.formats.vtuarrays import replace_points
from jaxsmooth.files.reduction import UNKEPT

__all__ = ["VTU", "check_vtu", "read_vtu", "write_vtu"]

_CUT = "the file is damaged or cut short"


def read_vtu(path: Path) -> tuple[meshio.Mesh, list[str]]:
    """A file of one grid; text and bits among its data are left out, for meshio does not know them."""
    content = path.read_bytes()
    repaired, names = _without_text(content)
    mesh = read_copy(repaired, path, "vtu") if names else meshio.read(path, file_format="vtu")
    check_vtu(content, mesh)
    if not names:
        return mesh, []
    mesh.field_data = {key: v for key, v in mesh.field_data.items() if not key.startswith(_TEXT)}
    mesh.info = {UNKEPT: [("", f"data of text or bits ({', '.join(names)})")]}
    return mesh, [f"data of text or bits are kept in VTU files only ({', '.join(names)})"]


_TEXT = "jaxsmooth:text"


def _without_text(content: bytes) -> tuple[bytes, list[str]]:
    """The file with arrays of text and bits as bytes among the data of no node or cell; their names.

    They can't be taken out: meshio finds raw data by looking from one array to the next."""
    end = content.find(b"<AppendedData")
    head = content if end < 0 else content[:end]
    arrays, names = [], []

    def taken(found: re.Match) -> bytes:
        own = found[2]
        name = re.search(rb"\bName\s*=\s*[\"']([^\"']*)", own)
        names.append(name[1].decode(errors="replace") if name else "")
        own = re.sub(rb"\b(?:type|Name|NumberOfComponents|NumberOfTuples)\s*=\s*[\"'][^\"']*[\"']", b"", own)
        opening = b'<DataArray type="Int8" Name="%s %d" ' % (_TEXT.encode(), len(arrays))
        arrays.append(opening + own + b">" + (found[3] or b"") + b"</DataArray>\n")
        return b""

    pattern = rb"<(Array|DataArray)\b([^>]*\btype\s*=\s*[\"'](?:String|Bit)[\"'][^>]*?)(?:/>|>(.*?)</\1>)"
    head = re.sub(pattern, taken, head, flags=re.DOTALL)
    grid = re.search(rb"<UnstructuredGrid\b[^>]*>", head)
    if not names or grid is None:
        return content, []
    fields = b"<FieldData>\n" + b"".join(arrays) + b"</FieldData>\n"
    return head[: grid.end()] + fields + head[grid.end() :] + content[
        len(content) if end < 0 else end :
    ], names


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


VTU = Format(
    "vtu",
    (".vtu",),
    read_vtu,
    write_vtu,
    Holds(lacks=frozenset({"pyramid14"}), any_data=True, space=True),
    patch=patch_vtu,
)
