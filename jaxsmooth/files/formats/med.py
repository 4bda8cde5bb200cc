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

__all__ = ["MED"]


def _write(path: Path, mesh: meshio.Mesh, dim: int, variant: str) -> list[str]:
    return write_again(path, mesh, dim, MED)


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
    "med", (".med",), read_as("med"), _write, Holds(reduce=reduce_rare), needs="h5py", patch=patch_med
)
