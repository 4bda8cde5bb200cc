"""Gmsh's two formats: 2.2, which holds any mixture of cells and tags, and 4."""

from __future__ import annotations

import copy
from pathlib import Path

import meshio
import numpy as np

from jaxsmooth.files.formats.meshios import read_copy
from jaxsmooth.files.formats.msh import (
    keep_groups,
    read_msh_data,
    repaired_msh,
    sniff_msh,
    split_by_entity,
    write_data_sections,
    write_msh41,
)
from jaxsmooth.files.formats.mshnodes import patch_msh
from jaxsmooth.files.formats.mshraw import check_msh, read_entities
from jaxsmooth.files.formats.mshtypes import reorder_for_writing, reorder_read
from jaxsmooth.files.formats.record import Format, Holds
from jaxsmooth.files.reduction import GMSH_TAGS, as_tags, tags_name

__all__ = ["GMSH", "GMSH22", "read_gmsh", "write_gmsh", "write_gmsh22"]


def read_gmsh(path: Path) -> tuple[meshio.Mesh, list[str]]:
    """A file of version 2 or 4, repaired where meshio could not read it."""
    content = path.read_bytes()
    check_msh(content)
    repaired = repaired_msh(content)
    if repaired is content or repaired == content:
        mesh = meshio.read(path, file_format="gmsh")
    else:
        mesh = read_copy(repaired, path, "gmsh")
        mesh.cell_data.update(read_msh_data(content, mesh))
    reorder_read(mesh)
    keep_groups(mesh, read_entities(content))
    return mesh, []


def write_gmsh(path: Path, mesh: meshio.Mesh, dim: int, variant: str = "binary") -> list[str]:
    """Version 4.1."""
    _tag(mesh, dim)
    write_msh41(path, split_by_entity(mesh), variant == "binary")
    return []


def write_gmsh22(path: Path, mesh: meshio.Mesh, dim: int, variant: str = "binary") -> list[str]:
    """Version 2.2."""
    _tag(mesh, dim)
    bare = copy.copy(mesh)
    bare.cells = list(mesh.cells)
    reorder_for_writing(bare)
    bare.points = mesh.points.astype(np.float64)
    bare.point_data, bare.cell_data = {}, {name: mesh.cell_data[name] for name in GMSH_TAGS}
    meshio.write(path, bare, file_format="gmsh22", binary=variant == "binary")
    write_data_sections(path, mesh, variant == "binary")
    return []


def _tag(mesh: meshio.Mesh, dim: int) -> None:
    """Both of Gmsh's tags for all cells; other material tags are physical groups to it."""
    if "gmsh:physical" not in mesh.cell_data:
        name = tags_name(mesh, dim)
        zero = [np.zeros(len(cells), np.int32) for cells in mesh.cells]
        used = name not in (None, *GMSH_TAGS)
        mesh.cell_data["gmsh:physical"] = as_tags(mesh.cell_data[name]) if used else zero
    if "gmsh:geometrical" not in mesh.cell_data:
        mesh.cell_data["gmsh:geometrical"] = mesh.cell_data["gmsh:physical"]
    for name in GMSH_TAGS:
        mesh.cell_data[name] = [part.astype(np.int32) for part in mesh.cell_data[name]]


def _sniff(head: bytes, name: str) -> str | None:
    stem, _, variant = (sniff_msh(head) or "").partition(":")
    return variant if stem == name else None


GMSH22 = Format(
    "gmsh22",
    (".msh",),
    read_gmsh,
    write_gmsh22,
    Holds(any_data=True, groups=True, space=True),
    sniff=lambda head: _sniff(head, "gmsh22"),
    variants=("binary", "ascii"),
    patch=patch_msh,
)
"""Version 2."""

GMSH = Format(
    "gmsh",
    (".msh",),
    read_gmsh,
    write_gmsh,
    Holds(any_data=True, groups=True, private=frozenset({"gmsh:bounding_entities"})),
    sniff=lambda head: _sniff(head, "gmsh"),
    variants=("binary", "ascii"),
    patch=patch_msh,
)
"""Version 4; written as 4.1."""
