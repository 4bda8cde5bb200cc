"""Whether VTK's files hold what their headers say; meshio (5.3.5) takes what is there."""

from __future__ import annotations

import re

import meshio

from jaxsmooth.convert.checks import check_last_line

__all__ = ["check_vtk", "check_vtu"]

_CUT = "the file is damaged or cut short"


def check_vtk(content: bytes, mesh: meshio.Mesh) -> None:
    """Raise `ValueError` where a legacy file has other counts than `mesh`, which meshio read from it."""
    lines = content[:4096].splitlines()
    if len(lines) > 2 and lines[2].strip().upper() == b"ASCII":
        check_last_line(content)
    cells = sum(len(block) for block in mesh.cells)
    for key, found in (("POINTS", len(mesh.points)), ("CELL_TYPES", cells), ("CELL_DATA", cells)):
        said = _counts(content, key)
        if said and said[0] != found:
            raise ValueError(f"its section {key} says {said[0]}, the file has {found}; {_CUT}")
    said = _counts(content, "CELLS")
    if len(said) < 2 or any(block.type.startswith("poly") for block in mesh.cells):
        return
    newer = re.search(rb"^OFFSETS\s", content, re.MULTILINE) is not None
    numbers = sum(block.data.size for block in mesh.cells)
    if said[1] != numbers + (0 if newer else cells):
        raise ValueError(f"its section CELLS has other numbers of nodes than its CELL_TYPES want; {_CUT}")


def _counts(content: bytes, key: str) -> list[int]:
    found = re.search(rb"^[ \t]*" + key.encode() + rb"[ \t]+(\d+)(?:[ \t]+(\d+))?", content, re.M | re.I)
    return [] if found is None else [int(word) for word in found.groups() if word]


def check_vtu(content: bytes, mesh: meshio.Mesh) -> None:
    """Raise `ValueError` where an XML file has other counts than `mesh`, which meshio read from it."""
    cells = sum(len(block) for block in mesh.cells)
    for key, found in (("Points", len(mesh.points)), ("Cells", cells)):
        said = [int(n) for n in re.findall(rb"NumberOf" + key.encode() + rb"\s*=\s*[\"'](\d+)", content)]
        if said and sum(said) != found:
            raise ValueError(f"it says NumberOf{key} {sum(said)}, and has {found}; {_CUT}")
