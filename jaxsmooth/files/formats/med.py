"""Salome's MED files (HDF5), through meshio (5.3.5)."""

from __future__ import annotations

from pathlib import Path

import meshio

from jaxsmooth.files.formats.meshios import read_as, reduce_rare, write_again
from jaxsmooth.files.formats.record import Format, Holds

__all__ = ["MED"]


def _write(path: Path, mesh: meshio.Mesh, dim: int, variant: str) -> list[str]:
    return write_again(path, mesh, dim, MED)


MED = Format("med", (".med",), read_as("med"), _write, Holds(reduce=reduce_rare), needs="h5py")
