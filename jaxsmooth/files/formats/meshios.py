"""Reading and writing through meshio (5.3.5), with what it forgets to say."""

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

from jaxsmooth.convert.checks import SYNONYMS, check_last_line
from jaxsmooth.files.formats.record import Format, Reader
from jaxsmooth.files.reduction import as_tags, material_name, tags_name

__all__ = ["quiet", "read_as", "read_copy", "reduce_rare", "remarks", "write_again"]


@contextlib.contextmanager
def quiet() -> Iterator[io.StringIO]:
    """Catch what meshio prints, and silence its warnings; text that ends early is an error."""
    said = io.StringIO()
    with warnings.catch_warnings(), contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
        warnings.simplefilter("ignore")
        warnings.filterwarnings("error", message="string or file could not be read to its end")
        yield said


def remarks(text: str) -> list[str]:
    """Meshio's remarks, each on one line."""
    parts = re.split(r"(?:Warning|Info|Error):", re.sub(r"\x1b\[[0-9;]*m", "", text))
    return [" ".join(part.split()) for part in parts if part.strip()]


def read_as(name: str, *, text: bool = False, end: str = "") -> Reader:
    """A reader of files that meshio reads as they are.

    Args:
        name: of the format in meshio.
        text: it is text, so that a last line without an end tells of a file that was cut.
        end: the line that ends such a file, for which meshio may wait for ever.
    """

    def read(path: Path) -> tuple[meshio.Mesh, list[str]]:
        if text:
            content = path.read_bytes()
            content = gzip.decompress(content) if path.suffix == ".gz" else content
            check_last_line(content)
            if f"\n{end}".encode() not in content:
                raise ValueError(f"it has no line {end!r}; the file is damaged or cut short")
        return meshio.read(path, file_format=name), []

    return read


def read_copy(content: bytes, path: Path, name: str) -> meshio.Mesh:
    """Read repaired content: through a file, for NumPy wants one."""
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / ("mesh" + path.suffix)
        copy.write_bytes(content)
        return meshio.read(copy, file_format=name)


def write_again(path: Path, mesh: meshio.Mesh, dim: int, format: Format) -> list[str]:
    """Formats whose writers leave out cells or data without a word: what they wrote is read again.

    Returns notes on what is missing then; raises `ValueError` where cells are."""
    of_points, of_cells = list(mesh.point_data), list(mesh.cell_data)
    if format.name in ("med", "hmf", "h5m", "tetgen", "cgns"):
        _merge_blocks(mesh)
    if format.name == "avsucd" and len(mesh.cells) > 1:  # the reader fails with more than materials
        mesh.cell_data = dict(list(mesh.cell_data.items())[:1])
    if format.name == "h5m":  # fails with any
        mesh.cell_data = {}
    material = material_name(mesh, dim)
    meshio.write(path, mesh, file_format=format.name)
    if format.name == "svg":  # nothing reads it
        return []
    again = format.read(path)[0]
    if len(again.points) != len(mesh.points) or _sizes(again) != _sizes(mesh):
        raise ValueError(f"it would have {_sizes(again)} instead of {_sizes(mesh)}")
    kept = {*again.cell_data, "gmsh:dim_tags"}
    if material is not None and material_name(again, dim):
        kept.add(material)
    lost = [name for name in of_points if name not in {*again.point_data, "gmsh:dim_tags"}]
    lost += [name for name in of_cells if name not in kept and name not in lost]
    if not lost:
        return []
    return [f"{format.name} files can't hold these data, which are not written: {', '.join(lost)}"]


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


def reduce_rare(mesh: meshio.Mesh, dim: int, own: str | None = None) -> list[str]:
    """Put the material tags first: meshio's writers take the first whole numbers, or those of `own` name.

    What they leave out differs from format to format, so nothing is said to be lost here."""
    if name := tags_name(mesh, dim):
        tags = as_tags(mesh.cell_data.pop(name))
        mesh.cell_data = {own or name: tags, **mesh.cell_data}
    return []
