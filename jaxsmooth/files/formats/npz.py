"""NumPy's archives: ``points``, one array a cell type, ``type/name`` for cell data; else point data."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path

import meshio
import numpy as np
from jaxtyping import Float

from jaxsmooth.cells.table import TYPES
from jaxsmooth.files.formats.record import Format, Holds, Patched, Source
from jaxsmooth.files.numbers import check_old

__all__ = ["NPZ", "patch_npz", "read_npz", "write_npz"]


def read_npz(path: Path) -> tuple[meshio.Mesh, list[str]]:
    """An archive as the module describes it."""
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
            notes.append(f"the array {key!r} is neither cells nor data; it is kept in .npz files only")
    filled = {
        key: [parts.get(kind, np.full(len(nodes), np.nan)) for kind, nodes in cells]
        for key, parts in cell_data.items()
    }
    return meshio.Mesh(points, cells, point_data=point_data, cell_data=filled), notes


def write_npz(path: Path, mesh: meshio.Mesh, dim: int, variant: str = "") -> list[str]:
    """An archive as the module describes it, compressed."""
    arrays = {"points": mesh.points, **mesh.point_data}
    for name in dict.fromkeys(cells.type for cells in mesh.cells):
        own = [k for k, cells in enumerate(mesh.cells) if cells.type == name]
        arrays[name] = np.concatenate([mesh.cells[k].data for k in own])
        for key, parts in mesh.cell_data.items():
            arrays[f"{name}/{key}"] = np.concatenate([parts[k] for k in own])
    with open(path, "wb") as out:
        # no array is called allow_pickle
        np.savez_compressed(out, **arrays)  # pyright: ignore[reportArgumentType]
    return []


def patch_npz(
    source: Source, old: Float[np.ndarray, "nodes dim"], new: Float[np.ndarray, "nodes dim"]
) -> Patched:
    """The archive with other points; all other arrays, also those that are not known, as they are."""
    out, array = io.BytesIO(), io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(source.content)) as archive, zipfile.ZipFile(out, "w") as copy:
        for member in archive.infolist():
            data = archive.read(member)
            if member.filename == "points.npy":
                check_old(np.load(io.BytesIO(data)), old)
                np.save(array, new)
                data = array.getvalue()
            copy.writestr(member, data)
    return Patched(out.getvalue())


NPZ = Format("npz", (".npz",), read_npz, write_npz, Holds(any_data=True), patch=patch_npz)
