"""Exodus files: names and node orders that meshio (5.3.5) gets wrong, and element blocks as materials."""

from __future__ import annotations

import tempfile
from pathlib import Path

import meshio
import numpy as np
from jaxtyping import Float

from jaxsmooth.cells.table import element_type, supported
from jaxsmooth.convert.regions import NOT_SETS
from jaxsmooth.files.formats.hdf5 import is_hdf5, replace_array
from jaxsmooth.files.formats.record import Format, Holds, Patched, Source
from jaxsmooth.files.numbers import check_columns, check_old
from jaxsmooth.files.reduction import as_tags, material_name

__all__ = ["EXODUS", "EXODUS_BLOCKS", "EXODUS_ORDER", "extend_exodus", "read_exodus", "write_exodus"]


def read_exodus(path: Path) -> tuple[meshio.Mesh, list[str]]:
    """An Exodus file; its element blocks are materials.

    Exodus has its own order of mid-side nodes; meshio leaves it, and writes VTK's.  Files of both kinds
    exist, so the nodes' places decide."""
    extend_exodus()
    mesh = meshio.read(path, file_format="exodus")
    mesh.points = np.ma.filled(mesh.points, np.nan)
    for k, cells in enumerate(mesh.cells):
        order = EXODUS_ORDER.get(cells.type)
        if order is None or not len(cells):
            continue
        nodes = np.ma.filled(cells.data, -1)
        turned = nodes[:, np.argsort(order)]
        if _bend(mesh.points, turned, cells.type) < _bend(mesh.points, nodes, cells.type):
            mesh.cells[k] = meshio.CellBlock(cells.type, turned)
    numbers = [np.full(len(cells), k + 1) for k, cells in enumerate(mesh.cells)]
    mesh.cell_data.setdefault(EXODUS_BLOCKS, numbers)
    return mesh, []


def _reduce(mesh: meshio.Mesh, dim: int) -> list[str]:
    name = material_name(mesh, dim)
    lost = [other for other in mesh.cell_data if other != name]
    mesh.cell_data = {name: as_tags(mesh.cell_data[name])} if name else {}
    return lost + [name for name in (*mesh.cell_sets, *mesh.field_data) if name not in NOT_SETS]


def write_exodus(path: Path, mesh: meshio.Mesh, dim: int, variant: str = "") -> list[str]:
    """Write a mesh; its first cell data are its material tags.

    Cells of one type and one material are one block.  The tags are an element variable, too: a material
    with elements of two types is two blocks."""
    import netCDF4

    extend_exodus()
    name = next(iter(mesh.cell_data), None)
    tags = mesh.cell_data[name] if name else [np.zeros(len(cells), np.int64) for cells in mesh.cells]
    blocks, values = [], []
    for kind in dict.fromkeys(cells.type for cells in mesh.cells):
        own = [k for k, cells in enumerate(mesh.cells) if cells.type == kind]
        nodes = np.concatenate([mesh.cells[k].data for k in own])
        nodes = nodes[:, EXODUS_ORDER[kind]] if kind in EXODUS_ORDER else nodes
        tag = np.concatenate([tags[k] for k in own])
        for value in dict.fromkeys(tag.tolist()):
            blocks.append(meshio.CellBlock(kind, nodes[tag == value]))
            values.append(value)
    plain = meshio.Mesh(mesh.points, blocks, point_data=mesh.point_data, point_sets=mesh.point_sets)
    meshio.write(path, plain, file_format="exodus")
    if name is None:
        return []
    with netCDF4.Dataset(path, "a") as out:
        out.createDimension("num_elem_var", 1)
        names = out.createVariable("name_elem_var", "S1", ("num_elem_var", "len_string"))
        names.set_auto_mask(False)
        for i, letter in enumerate(name[:32]):
            names[0, i] = letter.encode()
        for k, (cells, value) in enumerate(zip(blocks, values, strict=True)):
            variable = out.createVariable(
                f"vals_elem_var1eb{k + 1}", "f8", ("time_step", f"num_el_in_blk{k + 1}")
            )
            variable[0] = np.full(len(cells), float(value))
    return []


def extend_exodus() -> None:
    """Add the names of Exodus types that meshio's tables lack, replacing none."""
    from meshio.exodus import _exodus

    for name, kind in _EXODUS_NAMES.items():
        _exodus.exodus_to_meshio_type.setdefault(name, kind)
        _exodus.meshio_to_exodus_type.setdefault(kind, name)


def _bend(points: np.ndarray, nodes: np.ndarray, name: str) -> float:
    """Mean distance of nodes from where straight elements have them."""
    kind = element_type(name)
    straight = np.einsum("ac,ecd->ead", kind.straight, points[nodes[:, : kind.corners]])
    return float(np.linalg.norm(points[nodes] - straight, axis=-1).mean())


_HEX20 = [*range(12), 16, 17, 18, 19, 12, 13, 14, 15]
_WEDGE15 = [*range(9), 12, 13, 14, 9, 10, 11]
EXODUS_ORDER = {
    "wedge15": _WEDGE15,
    "wedge18": [*_WEDGE15, 15, 16, 17],
    "hexahedron20": _HEX20,
    "hexahedron27": [*_HEX20, 26, 24, 25, 20, 21, 22, 23],
}
"""Nodes of VTK's element in Exodus' order."""

EXODUS_BLOCKS = "ElementBlockIds"

_EXODUS_NAMES = {
    "HEX8": "hexahedron",
    "TET": "tetra",
    "TET10": "tetra10",
    "PYRAMID5": "pyramid",
    "PYRAMID13": "pyramid13",
    "PYRAMID14": "pyramid14",
    "WEDGE6": "wedge",
    "WEDGE15": "wedge15",
    "WEDGE18": "wedge18",
}


def patch_exodus(
    source: Source, old: Float[np.ndarray, "nodes dim"], new: Float[np.ndarray, "nodes dim"]
) -> Patched:
    """The file with other coordinates: ``coordx``, ``coordy``, ``coordz``, or all of them in ``coord``."""
    import netCDF4

    content = source.content
    with netCDF4.Dataset("memory", memory=content) as file:
        file.set_auto_mask(False)
        names = [name for name in ("coordx", "coordy", "coordz", "coord") if name in file.variables]
        found = np.concatenate([np.atleast_2d(file.variables[name][:]) for name in names]).T
    check_old(found, old)
    check_columns(found.shape[1], old, new)
    values = (
        dict(zip(names, new.T, strict=False)) if names != ["coord"] else {"coord": new.T[: found.shape[1]]}
    )
    if is_hdf5(content):
        for name, array in values.items():
            content = replace_array(content, name, array)
        return Patched(content)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "mesh.e"
        path.write_bytes(content)
        with netCDF4.Dataset(path, "r+") as file:
            for name, array in values.items():
                file.variables[name][:] = array
        return Patched(path.read_bytes())


EXODUS = Format(
    "exodus",
    (".e", ".exo", ".ex2"),
    read_exodus,
    write_exodus,
    Holds(types=frozenset({"vertex", "line", "line3", *supported()}), sets=True, reduce=_reduce),
    needs="netCDF4",
    patch=patch_exodus,
)
