"""Nastran's bulk data, through meshio (5.3.5)."""

from __future__ import annotations

from pathlib import Path

import meshio

from jaxsmooth.files.formats.meshios import read_as, reduce_rare, write_again
from jaxsmooth.files.formats.record import Format, Holds

__all__ = ["NASTRAN"]

_TYPES = (
    "line triangle quad tetra wedge pyramid hexahedron line3 triangle6 quad8 tetra10 hexahedron20 wedge15 "
    "pyramid13"
)


def _write(path: Path, mesh: meshio.Mesh, dim: int, variant: str) -> list[str]:
    return write_again(path, mesh, dim, NASTRAN)


NASTRAN = Format(
    "nastran",
    (".bdf", ".fem", ".nas"),
    read_as("nastran", text=True, end="ENDDATA"),
    _write,
    Holds(
        types=frozenset(_TYPES.split()),
        reduce=lambda mesh, dim: reduce_rare(mesh, dim, own="nastran:ref"),
    ),
)
