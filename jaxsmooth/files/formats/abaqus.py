"""Abaqus' and CalculiX' .inp files.

meshio's writer (5.3.5) turns C3D8 into C3D8RH and CPS3 into rigid R3D3.  So this format is written here.
"""

from __future__ import annotations

from pathlib import Path

import meshio
import numpy as np
from jaxtyping import Float

from jaxsmooth.convert.regions import recall
from jaxsmooth.files.formats.abaqusread import (
    ABAQUS_TYPES,
    CARDS,
    HEADING,
    in_part,
    is_abaqus,
    place,
    read_abaqus,
    read_model,
)
from jaxsmooth.files.formats.cards import node_places
from jaxsmooth.files.formats.record import Format, Holds, Patched, Source, UnpatchableError
from jaxsmooth.files.numbers import Places, check_old, put_text
from jaxsmooth.files.reduction import data_to_sets

__all__ = ["ABAQUS", "write_abaqus"]

_WRITTEN = {
    "line": "T3D2",
    "line3": "T3D3",
    "triangle": "CPS3",
    "triangle6": "CPS6",
    "quad": "CPS4",
    "quad8": "CPS8",
    "tetra": "C3D4",
    "tetra10": "C3D10",
    "pyramid": "C3D5",
    "pyramid13": "C3D13",
    "wedge": "C3D6",
    "wedge15": "C3D15",
    "hexahedron": "C3D8",
    "hexahedron20": "C3D20",
    "hexahedron27": "C3D27",
    "quad9": "S9R5",
}


def write_abaqus(path: Path, mesh: meshio.Mesh, dim: int, variant: str = "") -> list[str]:
    """Nodes, elements, sets and sections; types that Abaqus doesn't have raise `ValueError`."""
    own = recall(mesh, ABAQUS_TYPES)
    types = own if own is not None else [_WRITTEN.get(cells.type) for cells in mesh.cells]
    missing = [cells.type for cells, name in zip(mesh.cells, types, strict=True) if name is None]
    if missing:
        raise ValueError(f"Abaqus files have no {missing[0]} elements")
    starts = np.cumsum([0] + [len(cells) for cells in mesh.cells])
    with open(path, "w") as out:
        out.write(f"*HEADING\n{HEADING} {len(mesh.points)} nodes, {starts[-1]} elements\n*NODE\n")
        numbers = np.arange(1, len(mesh.points) + 1)
        width = mesh.points.shape[1]
        rows = np.column_stack([numbers, mesh.points])
        np.savetxt(out, rows, fmt=["%d"] + ["%.16e"] * width, delimiter=", ")
        for start, cells, name in zip(starts, mesh.cells, types, strict=False):
            out.write(f"*ELEMENT, TYPE={name}\n")
            numbers = np.arange(start + 1, start + len(cells) + 1)
            rows = np.column_stack([numbers, np.asarray(cells.data).astype(np.int64) + 1])
            lines = [["%d"] * len(part) for part in np.array_split(rows[0], -(-rows.shape[1] // 15))]
            np.savetxt(out, rows, fmt=",\n".join(map(",".join, lines)))  # a line has at most 16 numbers
        for name, members in mesh.cell_sets.items():
            pairs = zip(starts, members, strict=False)
            chosen = [start + np.asarray(rows) for start, rows in pairs if rows is not None]
            _write_set(out, "ELSET", name, np.concatenate(chosen or [np.zeros(0, int)]))
        for name, members in mesh.point_sets.items():
            members = np.asarray(members)
            _write_set(out, "NSET", name, np.flatnonzero(members) if members.dtype == bool else members)
        for key, options, lines in recall(mesh, CARDS) or ():
            if options["ELSET"] in mesh.cell_sets:
                words = ", ".join(f"{name}={value}" if value else name for name, value in options.items())
                out.write(f"*{key}, {words}\n" + "".join(f"{line}\n" for line in lines))
    return []


def _write_set(out, key: str, name: str, members: np.ndarray) -> None:
    out.write(f"*{key}, {key}={name}\n")
    words = (members.astype(np.int64) + 1).astype(str)
    for k in range(0, len(words), 12):
        out.write(",".join(words[k : k + 12]) + ",\n")


def patch_abaqus(
    source: Source, old: Float[np.ndarray, "nodes dim"], new: Float[np.ndarray, "nodes dim"]
) -> Patched:
    """The file with other coordinates in its node cards, those of instances in their part."""
    model = read_model(source.content, source.path.parent, frozenset({"NODE", "INSTANCE"}))
    if any(span is None for part in model.parts for span in part.spans):
        raise UnpatchableError(f"its nodes are in other files ({', '.join(model.files)})")
    check_old(np.concatenate([place(part)[0] for part in model.parts]), old, 1e-15)
    starts, ends, before, after, at = [], [], [], [], 0
    for part in model.parts:
        own = np.concatenate([np.zeros((0, 3)), *part.points])
        rows = slice(at, at + len(own))
        at += len(own)
        changed = new[rows] != old[rows]
        if part.turn is not None:
            changed |= changed.any(axis=1, keepdims=True)
        before.append(own)
        after.append(np.where(changed, in_part(part, new[rows].astype(np.float64)), own))
        for span in filter(None, part.spans):  # none is None, see above
            found = node_places(source.content, *span)
            starts.append(found.starts)
            ends.append(found.ends)
    places = Places(np.concatenate(starts), np.concatenate(ends))
    content = put_text(source.content, *_once(places, np.concatenate(before), np.concatenate(after)))
    return Patched(content, refers=tuple(name for name in model.files if not Path(name).is_absolute()))


def _once(places: Places, old: np.ndarray, new: np.ndarray) -> tuple[Places, np.ndarray, np.ndarray]:
    """Each node of the file once, where several instances have it; what is left out can't change."""
    if ((places.ends == 0) & (old != new)).any():
        raise UnpatchableError("a coordinate changes that its node card leaves out")
    _, first, which = np.unique(places.starts.max(axis=1), return_index=True, return_inverse=True)
    which = which.reshape(-1)
    if np.abs(new - new[first][which]).max(initial=0) > 1e-12 * np.abs(new).max(initial=0):
        raise UnpatchableError("a node of a *PART moves in one instance as it does not in another")
    return Places(places.starts[first], places.ends[first]), old[first], new[first]


ABAQUS = Format(
    "abaqus",
    (".inp",),
    read_abaqus,
    write_abaqus,
    Holds(
        types=frozenset(_WRITTEN),
        sets=True,
        space=True,
        reduce=data_to_sets,
        materials=True,
    ),
    sniff=lambda head: "" if is_abaqus(head) else None,
    patch=patch_abaqus,
)
