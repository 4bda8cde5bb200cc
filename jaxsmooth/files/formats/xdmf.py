"""XDMF files with mixed topologies, of which meshio (5.3.5) knows linear types only."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from xml.etree import ElementTree

import meshio
import numpy as np

from jaxsmooth.cells.table import TYPES, element_type
from jaxsmooth.files.formats.record import Format, Holds
from jaxsmooth.files.formats.xdmfgrids import only_grid, patch_xdmf

__all__ = ["XDMF", "read_xdmf", "write_xdmf"]


def read_xdmf(path: Path) -> tuple[meshio.Mesh, list[str]]:
    """An XDMF file; mixed topologies are taken apart before meshio reads it."""
    from meshio.xdmf.common import meshio_to_xdmf_type, xdmf_idx_to_meshio_type
    from meshio.xdmf.main import XdmfReader

    root = ElementTree.parse(path).getroot()
    reader = XdmfReader(str(path))
    notes = only_grid(root)
    for grid in root.iter("Grid"):
        for topology in grid.findall("Topology"):
            kind = topology.get("Type", topology.get("TopologyType"))
            if kind != "Mixed":
                continue
            numbers = reader._read_data_item(topology[0], root)
            at = list(grid).index(topology)
            grid.remove(topology)
            for code, nodes in _split_mixed(np.asarray(numbers).ravel(), xdmf_idx_to_meshio_type):
                part = ElementTree.Element("Topology", Type=meshio_to_xdmf_type[code][0])
                size = f"{nodes.shape[0]} {nodes.shape[1]}"
                item = ElementTree.SubElement(
                    part, "DataItem", DataType="Int", Precision="8", Dimensions=size, Format="XML"
                )
                item.text = " ".join(map(str, nodes.ravel().tolist()))
                grid.insert(at, part)
                at += 1
    version = root.attrib.get("Version", "3")
    read = reader.read_xdmf2 if version.startswith("2") else reader.read_xdmf3
    # meshio's own annotations of its Mesh say less than typings/
    return read(root), notes  # pyright: ignore[reportReturnType]


def _split_mixed(numbers: np.ndarray, types: dict[int, str]) -> Iterator[tuple[str, np.ndarray]]:
    """Runs of cells of one type; points and lines have their node count behind the type."""
    at = 0
    while at < len(numbers):
        code = int(numbers[at])
        name = types.get(code)
        if name != "vertex" and name not in TYPES:
            raise ValueError(f"cells of XDMF type {code} are not supported")
        skip = 2 if code in (1, 2) else 1
        width = skip + (1 if name == "vertex" else element_type(name).k)
        other = np.flatnonzero(numbers[at::width] != code)
        end = at + width * int(other[0]) if len(other) else len(numbers)
        yield name, numbers[at:end].reshape(-1, width)[:, skip:]
        at = end


def write_xdmf(path: Path, mesh: meshio.Mesh, dim: int, variant: str = "") -> list[str]:
    """Write one file: a companion .h5 could not be told from one that is there."""
    mesh.point_data = {name: _wide(values) for name, values in mesh.point_data.items()}
    mesh.cell_data = {name: [_wide(part) for part in parts] for name, parts in mesh.cell_data.items()}
    meshio.write(path, mesh, file_format="xdmf", data_format="XML")
    return []


def _wide(values: np.ndarray) -> np.ndarray:
    """meshio's XDMF has no integers of fewer than four bytes."""
    small = values.dtype.kind in "iu" and values.dtype.itemsize < 4
    return values.astype(np.int32) if small else values


XDMF = Format(
    "xdmf",
    (".xdmf", ".xmf"),
    read_xdmf,
    write_xdmf,
    Holds(lacks=frozenset({"pyramid14"}), any_data=True, space=True),
    needs="h5py",
    patch=patch_xdmf,
)
