"""Salome's MED files (HDF5), through meshio (5.3.5)."""

from __future__ import annotations

import io
from pathlib import Path

import meshio
import numpy as np
from jaxtyping import Float

from jaxsmooth.files.formats.hdf5 import read_array, replace_array
from jaxsmooth.files.formats.meshios import read_as, reduce_rare, write_again
from jaxsmooth.files.formats.record import Format, Holds, Patched, Source, UnpatchableError
from jaxsmooth.files.numbers import check_columns, check_old
from jaxsmooth.files.reduction import sets_as_masks

__all__ = ["MED"]


def _write(path: Path, mesh: meshio.Mesh, dim: int, variant: str) -> list[str]:
    """Sets are families: each combination of them has a number, positive for nodes, negative for cells."""
    of_points, of_cells = sets_as_masks(mesh)
    mesh.point_sets, mesh.cell_sets, mesh.field_data = {}, {}, {}
    notes = []
    if slashed := [name for name in (*of_points, *of_cells) if "/" in name]:
        notes.append(f"names in med files have no slash; written with underscores: {', '.join(slashed)}")
    if of_points:
        tags, names = _families(of_points)
        setattr(mesh, "point_tags", names)  # noqa: B010  meshio's own, which its class does not declare
        mesh.point_data["point_tags"] = tags
    if of_cells:
        tags, families = _families({name: np.concatenate(masks) for name, masks in of_cells.items()})
        ends = np.cumsum([len(cells) for cells in mesh.cells])[:-1]
        mesh.cell_data["cell_tags"] = np.split(-tags, ends)
        setattr(mesh, "cell_tags", {-number: names for number, names in families.items()})  # noqa: B010
    return [*notes, *write_again(path, mesh, dim, MED)]


def _families(masks: dict[str, np.ndarray]) -> tuple[np.ndarray, dict[int, list[str]]]:
    """A number for every combination of sets, 0 for none, and the names of each."""
    rows, tags = np.unique(np.stack(list(masks.values()), axis=1), axis=0, return_inverse=True)
    names = [name.replace("/", "_") for name in masks]
    sets = [[name for name, inside in zip(names, row, strict=True) if inside] for row in rows]
    numbers = np.cumsum([bool(own) for own in sets]) * [bool(own) for own in sets]
    return numbers[tags.reshape(-1)], {int(n): own for n, own in zip(numbers, sets, strict=True) if own}


def patch_med(
    source: Source, old: Float[np.ndarray, "nodes dim"], new: Float[np.ndarray, "nodes dim"]
) -> Patched:
    """The file with other coordinates; they are stored x of all nodes first, then y, then z."""
    import h5py

    paths: list[str] = []
    with h5py.File(io.BytesIO(source.content), "r") as file:
        group = file["ENS_MAA"]
        if not isinstance(group, h5py.Group):
            raise UnpatchableError("its ENS_MAA is not a group")
        group.visit(lambda name: paths.append(name) if name.endswith("NOE/COO") else None)
    if len(paths) != 1:
        raise UnpatchableError(f"it has coordinates of {len(paths)} meshes or steps")
    path = f"ENS_MAA/{paths[0]}"
    found = read_array(source.content, path).reshape(-1, len(old)).T
    check_old(found, old)
    check_columns(found.shape[1], old, new)
    return Patched(replace_array(source.content, path, new[:, : found.shape[1]].T.reshape(-1)))


MED = Format(
    "med",
    (".med",),
    read_as("med"),
    _write,
    Holds(sets=True, reduce=reduce_rare),
    needs="h5py",
    patch=patch_med,
)
