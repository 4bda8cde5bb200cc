"""Formats that meshio reads and writes as they are."""

from __future__ import annotations

from pathlib import Path

import meshio

from jaxsmooth.files.formats.meshios import read_as, reduce_rare, write_again
from jaxsmooth.files.formats.record import Format, Holds, Patch
from jaxsmooth.files.formats.tables import patch_table

__all__ = ["RARE"]


def _format(
    name: str,
    *suffixes: str,
    types: frozenset[str] | None = None,
    text: bool = False,
    end: str = "",
    needs: str | None = None,
    refusal: str | None = None,
    patch: Patch | None = None,
) -> Format:
    def write(path: Path, mesh: meshio.Mesh, dim: int, variant: str) -> list[str]:
        return write_again(path, mesh, dim, format)

    format = Format(
        name,
        suffixes,
        read_as(name, text=text, end=end),
        write,
        Holds(types=types, reduce=reduce_rare),
        needs=needs,
        refuse=lambda path: refusal,
        patch=patch,
    )
    return format


def _surfaces(name: str, *suffixes: str) -> Format:
    refusal = f"{name} files are read only; write .vtu, .msh or .xdmf instead"
    return _format(name, *suffixes, refusal=refusal)


_LINEAR = frozenset({"line", "triangle", "quad", "tetra", "wedge", "pyramid", "hexahedron"})
_SOLID = frozenset({"tetra", "wedge", "pyramid", "hexahedron"})
_AVS = rb"\A\s*(\d+)(?:[ \t]+\d+){4}[ \t]*\r?\n"
_NETGEN = rb"^points\s+(\d+)"
_ROOMLESS = "dolfin-xml files have no room for data, tags and sets; write .xdmf instead"

RARE = (
    _format("ansys", ".msh"),
    _format("avsucd", ".avs", ".inp", types=_LINEAR | {"vertex"}, text=True, patch=patch_table(_AVS, 1)),
    _format("cgns", ".cgns", types=frozenset({"tetra"}), needs="h5py"),
    _format("dolfin-xml", ".xml", refusal=_ROOMLESS),
    _format("flac3d", ".f3grid", types=_SOLID, text=True),
    _format("h5m", ".h5m", needs="h5py"),
    _format("hmf", ".hmf", needs="h5py"),
    _format("mdpa", ".mdpa", text=True),
    _format("netgen", ".vol", ".vol.gz", text=True, end="endmesh", patch=patch_table(_NETGEN, 0)),
    _format("permas", ".post", ".post.gz", ".dato", ".dato.gz", text=True),
    _format("tecplot", ".dat", ".tec", text=True),
    _format("tetgen", ".ele", ".node", types=frozenset({"tetra"})),
    _surfaces("neuroglancer"),
    _surfaces("svg", ".svg"),
    _surfaces("wkt", ".wkt"),
)
"""Of Ansys' ``.msh`` and AVS' ``.inp`` are the files that no other format of the suffix takes for its own."""
