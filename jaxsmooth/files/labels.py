"""What the data of a `meshio.Mesh` say about its parts: materials, features, named sets, held nodes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import meshio
import numpy as np

from jaxsmooth.elements import TYPES
from jaxsmooth.mesh import Labels

__all__ = ["REGION_NAMES", "held_nodes", "make_labels", "make_named_sets", "plain"]

REGION_NAMES = (
    "gmsh:physical",
    "gmsh:geometrical",
    "medit:ref",
    "su2:tag",
    "nastran:ref",
    "netgen:index",
    "tetgen:ref",
    "ugrid:ref",
    "avsucd:material",
    "flac3d:group",
    "cell_tags",
    "material",
    "materials",
    "materialid",
    "materialids",
    "matid",
    "mat",
    "region",
    "regions",
    "regionid",
    "regionids",
    "subdomain",
    "subdomains",
    "domain",
    "domains",
    "attribute",
    "attributes",
    "physical",
    "physicalids",
    "elementblockids",
    "blockid",
    "partid",
    "group",
    "groups",
    "groupid",
)
"""Cell data taken for material tags, first match first; case, ``_``, ``-`` and blanks don't count."""

_NOT_SETS = ("gmsh:bounding_entities",)


def plain(array: Any) -> np.ndarray:
    """An ordinary array in native byte order; readers return masked and big-endian ones.

    Masked floats become NaN, so that the checks find them."""
    if isinstance(array, np.ma.MaskedArray):
        array = array.filled(np.nan if array.dtype.kind == "f" else -1)
    array = np.asarray(array)
    return array.astype(array.dtype.newbyteorder("="), copy=False)


def make_labels(
    source: meshio.Mesh,
    cells: Sequence[tuple[str, Any]],
    dim: int,
    parts: Sequence[Sequence[int]],
    kept: Sequence[np.ndarray],
) -> Labels:
    """Regions of the element blocks, and the lower-dimensional cells with their tags.

    Element block b is made of the source's cell blocks ``parts[b]``, of which it has rows ``kept[b]``.

    A tag of 0 everywhere says nothing, so the next array of `REGION_NAMES` is asked; without any,
    cell sets that divide the elements among them (Abaqus' way to assign materials) are regions."""
    inside = sorted(k for own in parts for k in own)
    lower = [
        k for k, (name, data) in enumerate(cells) if len(data) and (name == "vertex" or _lower(name, dim))
    ]
    tags = _tags(source, inside)
    if tags is None:
        tags = _partition(source, inside)
    if tags is None:
        tags = {k: np.zeros(len(cells[k][1]), np.int64) for k in inside}
    regions = tuple(
        np.concatenate([tags[k] for k in own])[rows] for own, rows in zip(parts, kept, strict=True)
    )
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
        regions=regions,
        features=tuple(np.asarray(cells[k][1]).astype(np.int64) for k in features),
        feature_tags=tuple(feature_tags[k] for k in features),
        feature_types=tuple(cells[k][0] for k in features),
    )


def _lower(name: str, dim: int) -> bool:
    return name in TYPES and TYPES[name].dim < dim


def _folded(name: str) -> str:
    return name.lower().replace("_", "").replace("-", "").replace(" ", "")


def _tags(source: meshio.Mesh, blocks: Sequence[int]) -> dict[int, np.ndarray] | None:
    """Tags of these cell blocks: the first array of `REGION_NAMES` that has some."""
    if not blocks:
        return None
    folded = {_folded(name): name for name in source.cell_data}
    for wanted in REGION_NAMES:
        name = folded.get(_folded(wanted))
        if name is None:
            continue
        arrays = {k: plain(source.cell_data[name][k]) for k in blocks}
        arrays = {k: a[:, 0] if a.ndim == 2 and a.shape[1] == 1 else a for k, a in arrays.items()}
        if any(a.ndim != 1 or a.dtype.kind not in "iufb" for a in arrays.values()):
            continue
        joined = np.concatenate(list(arrays.values()))
        if not np.isfinite(joined).all() or (joined != np.round(joined)).any() or not joined.any():
            continue
        return {k: a.astype(np.int64) for k, a in arrays.items()}
    return None


def _partition(source: meshio.Mesh, blocks: Sequence[int]) -> dict[int, np.ndarray] | None:
    """Regions from two or more cell sets that divide all elements of these blocks among them."""
    sizes = [len(source.cells[k]) for k in blocks]
    starts = np.cumsum([0, *sizes])
    region = np.full(starts[-1], -1, np.int64)
    sets = []
    for name, members in source.cell_sets.items():
        if name in _NOT_SETS:
            continue
        chosen = [
            starts[i] + m for i, k in enumerate(blocks) if (m := _members(members, k)) is not None and len(m)
        ]
        if chosen:
            sets.append(np.concatenate(chosen))
    used = 0
    for members in sorted(sets, key=len, reverse=True):
        if len(members) < len(region) and (region[members] < 0).all():
            region[members] = used
            used += 1
    if used < 2 or (region < 0).any():
        return None
    return dict(zip(blocks, np.split(region, starts[1:-1]), strict=True))


def _members(members: Any, block: int) -> np.ndarray | None:
    """Cells of one block in a cell set, as integers; None where the set has no entry for it."""
    if block >= len(members) or members[block] is None:
        return None
    rows = np.asarray(members[block])
    if rows.dtype == bool:
        rows = np.flatnonzero(rows)
    return rows.astype(np.int64).ravel()


def held_nodes(source: meshio.Mesh, count: int) -> np.ndarray:
    """Nodes ``[nodes]`` that point data, cell data (where not zero) or a set called ``fixed`` chooses."""
    held = np.zeros(count, bool)
    for name, values in source.point_data.items():
        if name.lower() == "fixed":
            held |= _nonzero(values)
    for name, parts in source.cell_data.items():
        if name.lower() == "fixed":
            for cells, values in zip(source.cells, parts, strict=True):
                held |= _nodes_of(cells, _nonzero(values), count)
    for name, mask in _all_sets(source, count):
        if name.lower() == "fixed":
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
        if name in _NOT_SETS:
            continue
        mask = np.zeros(count, bool)
        for k, cells in enumerate(source.cells):
            rows = _members(members, k)
            if rows is not None and len(rows):
                mask |= _nodes_of(cells, rows, count)
        yield str(name), mask
    yield from _tagged_sets(source, count)
    for name, values in source.point_data.items():
        if is_mask(values):
            yield name, _nonzero(values)
    for name, parts in source.cell_data.items():
        if name not in REGION_NAMES and all(is_mask(values) for values in parts):
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
