"""What a mesh file says, item by item, so that two files of different formats can be compared."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

import jaxsmooth as js
from jaxsmooth.cells.table import TYPES
from jaxsmooth.convert.regions import NOT_SETS, REGION_NAMES, folded, region_arrays

__all__ = ["KINDS", "Item", "Missing", "items", "missing"]

KINDS = (
    *("nodes", "elements", "materials", "boundary cells", "boundary tags"),
    *("sets", "point data", "cell data"),
)
"""What an item may be."""

_TAGS = ("materials", "boundary tags")

_UNWRITTEN = "cells; they are not written"

_ROUNDED = 2e-6
"""Coordinates and data agree to this, relative to the largest: some formats store single precision."""

_FOLDED = {folded(name) for name in REGION_NAMES}
_OWN = {folded(name) for name in ("gmsh:dim_tags", "point_tags", "medit:ref", "su2:tag")}


@dataclass(frozen=True)
class Item:
    """One thing that a file says.

    Attributes:
        kind: one of `KINDS`.
        name: of a set or of data; else words of which a note on a loss has one.
        value: a row a node for what belongs to nodes; a dictionary by cell for what belongs to cells.
    """

    kind: str
    name: str
    value: Any


@dataclass(frozen=True)
class Missing:
    """An item of one file that another lacks: its kind and name, and whether a note names it."""

    kind: str
    name: str
    said: bool


def items(file: js.MeshFile) -> list[Item]:
    """All that a file says, in terms of its own nodes; the nodes come first."""
    labels, source = file.mesh.labels, file.source
    elements = [_rows(name, rows) for name, rows in zip(file.mesh.types, file.mesh.connectivity, strict=True)]
    features = [_rows(*pair) for pair in zip(labels.feature_types, labels.features, strict=True)]
    top = [k for k, cells in enumerate(source.cells) if _dim(cells.type) == file.mesh.dim]
    lower = [k for k, cells in enumerate(source.cells) if _dim(cells.type) < file.mesh.dim]
    found = [
        Item("nodes", "nodes", np.asarray(source.points, float)),
        Item("elements", "elements", _joined(elements, [np.zeros(len(rows)) for rows in elements])),
        Item("materials", _tag_names(file, top) or "material", _joined(elements, labels.regions)),
        Item("boundary cells", _UNWRITTEN, _joined(features, [np.zeros(len(rows)) for rows in features])),
        Item(
            "boundary tags", f"{_UNWRITTEN}|{_tag_names(file, lower)}", _joined(features, labels.feature_tags)
        ),
    ]
    masks = {name: np.asarray(mask) for name, mask in file.named_sets.items() if np.any(mask)}
    known = {*_FOLDED, *_OWN}
    found += [Item("sets", name, mask) for name, mask in masks.items() if folded(name) not in known]
    known |= {folded(name) for name in masks}
    for name, values in source.point_data.items():
        if folded(name) not in known and np.asarray(values).dtype.kind in "iuf":
            found.append(Item("point data", name, np.asarray(values, float).reshape(len(values), -1)))
    cells = [_rows(block.type, block.data) for block in source.cells]
    for name, parts in source.cell_data.items():
        if folded(name) not in known and all(np.asarray(part).dtype.kind in "iuf" for part in parts):
            rows = [np.reshape(part, (len(part), -1)) for part in parts]
            found.append(Item("cell data", name, _joined(cells, rows)))
    if file.source.cell_sets:
        found.append(Item("membership", "", _joined(cells, _membership(file))))
    return [item for item in found if len(item.value) and not _trivial(item)]


def _membership(file: js.MeshFile) -> list[np.ndarray]:
    """In which cell sets each cell is, ``[cells, sets]`` a block."""
    sets = [members for name, members in file.source.cell_sets.items() if name not in NOT_SETS]
    masks = [np.zeros((len(cells), len(sets))) for cells in file.source.cells]
    for column, members in enumerate(sets):
        for mask, rows in zip(masks, members, strict=False):
            if rows is not None and len(rows):
                mask[np.asarray(rows), column] = 1
    return masks


def _dim(name: str) -> int:
    return TYPES[name].dim if name in TYPES else 0


def _tag_names(file: js.MeshFile, blocks: list[int]) -> str:
    return "|".join(
        name for name, tags in region_arrays(file.source, blocks) if any(map(np.any, tags.values()))
    )


def _rows(kind: str, rows: Any) -> list[tuple]:
    """What tells cells apart: their type and nodes."""
    return [(kind, *sorted(row)) for row in np.asarray(rows).tolist()]


def _joined(cells: list[list[tuple]], parts: Any) -> dict[tuple, np.ndarray]:
    pairs = (zip(rows, np.asarray(part), strict=True) for rows, part in zip(cells, parts, strict=True))
    return {row: np.atleast_1d(value).astype(float) for part in pairs for row, value in part}


def _trivial(item: Item) -> bool:
    """Whether there is one material only, or no tag: nothing that could be lost."""
    if item.kind not in _TAGS:
        return False
    return len({value.tobytes() for value in item.value.values()}) == 1


def missing(before: list[Item], after: list[Item], notes: tuple[str, ...]) -> Iterator[Missing]:
    """Items of the first file that the second lacks; their names, and the numbers of tags, may differ.

    Sets and tags may also be there as data."""
    text = " ".join(notes)
    if not _near(before[0].value, after[0].value):
        yield Missing("nodes", "nodes", "nodes" in text)
        return
    for item in before[1:]:
        others = [other for other in after if other.kind == item.kind or "data" in other.kind]
        others += [other for other in after if other.kind == "membership" and item.kind in _TAGS]
        others = [other for other in others if isinstance(other.value, type(item.value))]
        if item.kind in KINDS and not any(_same(item, other) for other in others):
            yield Missing(item.kind, item.name, any(word in text for word in item.name.split("|") if word))


def _near(one: np.ndarray, other: np.ndarray) -> bool:
    """Whether arrays of nodes agree; a plane mesh may have a third coordinate."""
    if one.ndim == 2 and other.ndim == 2 and one.shape[1] != other.shape[1]:
        width = max(one.shape[1], other.shape[1])
        one, other = (np.pad(array, ((0, 0), (0, width - array.shape[1]))) for array in (one, other))
    return one.shape == other.shape and np.allclose(one, other, atol=_ROUNDED * np.abs(one).max(), rtol=0)


def _same(item: Item, found: Item) -> bool:
    other = found.value
    if isinstance(item.value, np.ndarray):
        return _near(item.value.astype(float), other.astype(float))
    if not item.value.keys() <= other.keys():
        return False
    if item.kind in ("elements", "boundary cells"):
        return True
    pairs = [(tuple(value), tuple(np.atleast_1d(other[row]))) for row, value in item.value.items()]
    if item.kind in _TAGS:  # the division counts, not its numbers; sets may divide further
        one, other, both = ({pair[0] for pair in pairs}, {pair[1] for pair in pairs}, set(pairs))
        return len(both) == len(other) and (found.kind == "membership" or len(both) == len(one))
    return all(len(a) == len(b) and np.allclose(a, b, atol=_ROUNDED) for a, b in pairs)
