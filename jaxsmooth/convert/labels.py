"""What the data of a `meshio.Mesh` say about its parts: materials, features, named sets, held nodes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import meshio
import numpy as np

from jaxsmooth.cells.table import TYPES
from jaxsmooth.convert.regions import (
    NOT_SETS,
    REGION_NAMES,
    find_regions,
    folded,
    members_of,
    plain,
    recall,
    region_arrays,
)
from jaxsmooth.mesh.record import Labels

__all__ = ["HELD", "held_nodes", "is_mask", "make_labels", "make_named_sets", "plain"]


HELD_SETS = ("fixed", "requiredvertices", "corners")
"""Names (in any case) of sets whose nodes are held: this package's own, and Medit's two."""

_FOLDED = {folded(name) for name in REGION_NAMES}

HELD = "medit:held"
"""In `meshio.Mesh.info`: nodes that required edges and faces of a Medit file hold."""


def make_labels(
    source: meshio.Mesh,
    cells: Sequence[tuple[str, Any]],
    dim: int,
    parts: Sequence[Sequence[int]],
    kept: Sequence[np.ndarray],
) -> Labels:
    """Regions of the element blocks, and the lower-dimensional cells with their tags.

    Element block b is made of the source's cell blocks ``parts[b]``, of which it has rows ``kept[b]``.

    `jaxsmooth.convert.regions` says what makes a region."""
    lower = [
        k for k, (name, data) in enumerate(cells) if len(data) and (name == "vertex" or _lower(name, dim))
    ]
    features: list[int] = []
    feature_tags: dict[int, np.ndarray] = {}
    for d in range(dim):
        same = [k for k in lower if (0 if cells[k][0] == "vertex" else TYPES[cells[k][0]].dim) == d]
        found = _tags(source, same)
        features += same
        for k in same:
            feature_tags[k] = np.zeros(len(cells[k][1]), np.int64) if found is None else found[k]
    features.sort()
    return Labels(
        regions=tuple(find_regions(source, cells, parts, kept)),
        features=tuple(np.asarray(cells[k][1]).astype(np.int64) for k in features),
        feature_tags=tuple(feature_tags[k] for k in features),
        feature_types=tuple(cells[k][0] for k in features),
    )


def _lower(name: str, dim: int) -> bool:
    return name in TYPES and TYPES[name].dim < dim


def _tags(source: meshio.Mesh, blocks: Sequence[int]) -> dict[int, np.ndarray] | None:
    """Tags of lower-dimensional cells: the first array that has any."""
    for _, tags in region_arrays(source, blocks):
        if any(t.any() for t in tags.values()):
            return tags
    return None


def held_nodes(source: meshio.Mesh, count: int) -> np.ndarray:
    """Nodes ``[nodes]`` that the file marks: point data, cell data (where not zero) or a set called
    ``fixed``, and Medit's corners, required vertices, edges and faces."""
    held = np.zeros(count, bool)
    if (required := recall(source, HELD)) is not None:
        held[required] = True
    for name, values in source.point_data.items():
        if name.lower() == "fixed":
            held |= _nonzero(values)
    for name, parts in source.cell_data.items():
        if name.lower() == "fixed":
            for cells, values in zip(source.cells, parts, strict=True):
                held |= _nodes_of(cells, _nonzero(values), count)
    for name, mask in _all_sets(source, count):
        if name.lower() in HELD_SETS:
            held |= mask
    return held


def _nonzero(values: Any) -> np.ndarray:
    values = plain(values)
    marked = (values != 0) & ~np.isnan(values) if values.dtype.kind == "f" else values != 0
    return marked.reshape(len(values), -1).any(axis=1)


def _nodes_of(cells: meshio.CellBlock, chosen: np.ndarray, count: int) -> np.ndarray:
    mask = np.zeros(count, bool)
    if not cells.type.startswith("polyhedron") and len(cells):
        nodes = np.asarray(cells.data)[chosen].ravel()
        mask[nodes[(nodes >= 0) & (nodes < count)]] = True
    return mask


def make_named_sets(source: meshio.Mesh, count: int) -> dict[str, np.ndarray]:
    """Masks ``[nodes]`` of everything that has a name and chooses nodes or cells.

    Point sets, cell sets, Gmsh's physical names (also those of lower-dimensional cells), MED families,
    and point or cell data that are only 0 and 1."""
    found: dict[str, np.ndarray] = {}
    for name, mask in _all_sets(source, count):
        found[name] = found[name] | mask if name in found else mask
    return found


def _all_sets(source: meshio.Mesh, count: int) -> Iterator[tuple[str, np.ndarray]]:
    for name, members in source.point_sets.items():
        mask, members = np.zeros(count, bool), plain(members)
        mask[members.ravel() if members.dtype == bool else members.astype(np.int64).ravel()] = True
        yield str(name), mask
    for name, members in source.cell_sets.items():
        if name in NOT_SETS:
            continue
        mask = np.zeros(count, bool)
        for k, cells in enumerate(source.cells):
            rows = members_of(members, k)
            if rows is not None and len(rows):
                mask |= _nodes_of(cells, rows, count)
        yield str(name), mask
    yield from _tagged_sets(source, count)
    for name, values in source.point_data.items():
        if is_mask(values):
            yield name, _nonzero(values)
    for name, parts in source.cell_data.items():
        if folded(name) not in _FOLDED and all(is_mask(values) for values in parts):
            mask = np.zeros(count, bool)
            for cells, values in zip(source.cells, parts, strict=True):
                mask |= _nodes_of(cells, _nonzero(values), count)
            yield name, mask


def _tagged_sets(source: meshio.Mesh, count: int) -> Iterator[tuple[str, np.ndarray]]:
    physical = source.cell_data.get("gmsh:physical")
    for name, entry in source.field_data.items():
        if physical is None or np.shape(entry) != (2,):
            continue
        mask = np.zeros(count, bool)
        for cells, tags in zip(source.cells, physical, strict=True):
            if cells.dim == entry[1]:
                mask |= _nodes_of(cells, plain(tags) == entry[0], count)
        yield str(name), mask
    for tag, names in getattr(source, "cell_tags", {}).items():  # MED
        mask = np.zeros(count, bool)
        for cells, tags in zip(source.cells, source.cell_data.get("cell_tags", []), strict=False):
            mask |= _nodes_of(cells, plain(tags) == tag, count)
        for name in names:
            yield str(name), mask
    for tag, names in getattr(source, "point_tags", {}).items():
        tags = source.point_data.get("point_tags")
        for name in names if tags is not None else ():
            yield str(name), plain(tags) == tag


def is_mask(values: Any) -> bool:
    """Whether an array is one column of numbers that are only 0 and 1 (Gmsh stores them as floats)."""
    values = np.asarray(values)
    if values.dtype.kind not in "iubf" or values.size != len(values):
        return False
    return bool(((values == 0) | (values == 1)).all())
