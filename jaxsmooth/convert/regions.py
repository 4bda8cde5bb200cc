"""Which elements belong together: materials, from tags, groups, sections and sets of a file.

1. Sections of an Abaqus file say it: elements of sections that read the same are one region,
   elements in no section another.
2. Else the first array of `REGION_NAMES` that is not the same everywhere.  An element may be in several
   groups (Gmsh 2.2 repeats it, 4.1 gives its entity several): regions are the distinct combinations, so
   a group of everything changes nothing and the order of groups does not matter.
3. Else cell sets that divide the elements among them; of several divisions the finest, and one by
   element types only where there is no other.
4. Else the distinct combinations of those cell sets that are bodies: with a node inside the mesh that
   only they have.  A strip of elements along the boundary, where loads act, has none.
5. Else all elements are one region.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import meshio
import numpy as np

from jaxsmooth.cells.table import element_type
from jaxsmooth.mesh.topology import facet_keys

__all__ = [
    "GROUPS",
    "NOT_SETS",
    "REGION_NAMES",
    "SECTIONS",
    "find_regions",
    "folded",
    "integers",
    "members_of",
    "plain",
    "recall",
    "region_arrays",
]

REGION_NAMES = (
    "gmsh:physical",
    "gmsh:geometrical",
    "medit:ref",
    "su2:tag",
    "nastran:ref",
    "netgen:index",
    "tetgen:ref",
    "ugrid:ref",
    "unv:property",
    "avsucd:material",
    "flac3d:group",
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
    "cell_tags",
)
"""Cell data taken for material tags, first match first; case, ``_``, ``-`` and blanks don't count."""

NOT_SETS = ("gmsh:bounding_entities",)

GROUPS = "gmsh:groups"
"""In `meshio.Mesh.info`: all physical groups of Gmsh's entities ``{(dim, tag): [groups]}``."""

SECTIONS = "abaqus:regions"
"""In `meshio.Mesh.info`: the section of every cell, one array a cell block (0: none)."""

_TRIES = 10_000  # steps of the search for a division by sets; files have a dozen sets or so


def recall(source: meshio.Mesh, key: str) -> Any:
    """What a reader of this package left in `meshio.Mesh.info` under this key; None if nothing."""
    info = getattr(source, "info", None)
    return info.get(key) if isinstance(info, dict) else None


def plain(array: Any) -> np.ndarray:
    """An ordinary array in native byte order; readers return masked and big-endian ones.

    Masked floats become NaN, so that the checks find them."""
    if isinstance(array, np.ma.MaskedArray):
        array = array.filled(np.nan if array.dtype.kind == "f" else -1)
    array = np.asarray(array)
    return array.astype(array.dtype.newbyteorder("="), copy=False)


def folded(name: str) -> str:
    """A name of cell data without case, ``_``, ``-`` and blanks."""
    return name.lower().replace("_", "").replace("-", "").replace(" ", "")


def integers(values: Any) -> np.ndarray | None:
    """A column of whole numbers (also stored as floats) as int64; None for anything else."""
    values = plain(values)
    values = values[:, 0] if values.ndim == 2 and values.shape[1] == 1 else values
    if values.ndim != 1 or values.dtype.kind not in "iufb":
        return None
    if values.dtype.kind == "f" and (not np.isfinite(values).all() or (values != np.round(values)).any()):
        return None
    return values.astype(np.int64)


def region_arrays(source: meshio.Mesh, blocks: Sequence[int]) -> Iterator[tuple[str, dict[int, np.ndarray]]]:
    """Arrays of `REGION_NAMES` that have whole numbers in all these cell blocks, first match first."""
    if not blocks:
        return
    found = {folded(name): name for name in source.cell_data}
    for wanted in REGION_NAMES:
        name = found.get(folded(wanted))
        if name is not None:
            tags = {k: integers(source.cell_data[name][k]) for k in blocks}
            whole = {k: t for k, t in tags.items() if t is not None}
            if len(whole) == len(tags):
                yield name, whole


def members_of(members: Any, block: int) -> np.ndarray | None:
    """Cells of one block in a cell set, as integers; None where the set has no entry for it."""
    if block >= len(members) or members[block] is None:
        return None
    rows = np.asarray(members[block])
    if rows.dtype == bool:
        rows = np.flatnonzero(rows)
    return rows.astype(np.int64).ravel()


@dataclass(frozen=True)
class _Elements:
    """Elements, and the cells of the file that stand for them; Gmsh 2.2 has some several times.

    Attributes:
        blocks: indices of cell blocks of the source.
        rows: for each of them the element of every cell (−1: of none).
        types: the element type of each of them.
        count: how many elements there are.
    """

    blocks: list[int]
    rows: list[np.ndarray]
    types: list[str]
    count: int

    def spread(self, values: dict[int, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        """Elements and values of all cells."""
        element = np.concatenate(self.rows)
        value = np.concatenate([values[k] for k in self.blocks])
        return element[element >= 0], value[element >= 0]

    def mask(self, members: Any) -> np.ndarray:
        """Which elements a cell set has."""
        chosen = np.zeros(self.count, bool)
        for k, element in zip(self.blocks, self.rows, strict=True):
            rows = members_of(members, k)
            if rows is not None and len(rows):
                chosen[element[rows][element[rows] >= 0]] = True
        return chosen


def find_regions(
    source: meshio.Mesh,
    cells: Sequence[tuple[str, Any]],
    parts: Sequence[Sequence[int]],
    kept: Sequence[np.ndarray],
) -> list[np.ndarray]:
    """The region of every element: one array for each element block.

    Element block b is made of the source's cell blocks ``parts[b]``, of which it has rows ``kept[b]``."""
    elements = _elements(cells, parts, kept)
    region = _by_section(source, elements)
    region = _by_tag(source, elements) if region is None else region
    region = _by_sets(source, cells, elements) if region is None else region
    if region is None:  # one region; it keeps its number
        region = np.zeros(elements.count, np.int64)
        for _, tags in region_arrays(source, elements.blocks):
            element, values = elements.spread(tags)
            if values.any():
                region[element] = values
                break
    return np.split(region, np.cumsum([len(rows) for rows in kept])[:-1])


def _elements(cells, parts, kept) -> _Elements:
    blocks, found, types, first = [], [], [], 0
    for own, rows in zip(parts, kept, strict=True):
        sizes = [len(cells[k][1]) for k in own]
        if len(rows) == sum(sizes):
            element = np.arange(sum(sizes)) + first
        else:
            nodes = np.concatenate([np.asarray(cells[k][1]) for k in own])
            same = _numbered(np.sort(nodes, axis=1))
            number = np.full(len(nodes), -1, np.int64)
            number[same[rows]] = np.arange(len(rows)) + first
            element = number[same]
        blocks += own
        found += np.split(element, np.cumsum(sizes)[:-1])
        types += [cells[k][0] for k in own]
        first += len(rows)
    return _Elements(blocks, found, types, first)


def _by_section(source: meshio.Mesh, elements: _Elements) -> np.ndarray | None:
    sections = recall(source, SECTIONS)
    if sections is None:
        return None
    element, values = elements.spread(dict(enumerate(sections)))
    region = np.zeros(elements.count, np.int64)
    region[element] = values
    return region


def _by_tag(source: meshio.Mesh, elements: _Elements) -> np.ndarray | None:
    for name, tags in region_arrays(source, elements.blocks):
        element, values = elements.spread(tags)
        groups = recall(source, GROUPS) if name == "gmsh:physical" else None
        if groups:
            more = _more_groups(source, elements, groups)
            element, values = np.concatenate([element, more[0]]), np.concatenate([values, more[1]])
        region = _combinations(element, values, elements.count)
        if (region != region[0]).any():
            return region
    return None


def _more_groups(source: meshio.Mesh, elements: _Elements, groups: dict) -> tuple[np.ndarray, np.ndarray]:
    """Elements and groups of all entities that are in several."""
    found, values = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)]
    for k, rows in zip(elements.blocks, elements.rows, strict=True):
        tags = plain(source.cell_data["gmsh:geometrical"][k])
        for tag in np.unique(tags):
            own = rows[(tags == tag) & (rows >= 0)]
            for group in groups.get((source.cells[k].dim, int(tag)), ()):
                found.append(own)
                values.append(np.full(len(own), group, np.int64))
    return np.concatenate(found), np.concatenate(values)


def _combinations(element: np.ndarray, values: np.ndarray, count: int) -> np.ndarray:
    """One number for every distinct set of values; an element with a single value keeps it."""
    region = np.zeros(count, np.int64)
    region[element] = values
    if (region[element] == values).all():  # the usual case: one value each
        return region
    pairs = np.stack([element, values], axis=1)[values != 0]  # 0 is no group
    pairs = pairs[np.unique(_numbered(pairs), return_index=True)[1]]
    sizes = np.bincount(pairs[:, 0], minlength=count)
    starts = np.cumsum(sizes) - sizes
    region[pairs[:, 0]] = pairs[:, 1]
    several = np.flatnonzero(sizes > 1)
    if len(several):
        columns = np.arange(sizes.max())
        at = np.minimum(starts[several, None] + columns, len(pairs) - 1)
        table = np.where(columns < sizes[several, None], pairs[at, 1], 0)
        region[several] = values.max() + 1 + _numbered(table)
    return region


def _numbered(table: np.ndarray) -> np.ndarray:
    """For every row its number among the distinct ones in order; NumPy's own way takes 20 times longer."""
    number = np.zeros(len(table), np.int64)
    for column in np.packbits(table, axis=1).T if table.dtype == bool else table.T:
        values, place = np.unique(column, return_inverse=True)
        number = np.unique(number * len(values) + place.reshape(-1), return_inverse=True)[1].reshape(-1)
    return number


# --- Sets ---------------------------------------------------------------------------------


def _by_sets(source: meshio.Mesh, cells, elements: _Elements) -> np.ndarray | None:
    """Regions from cell sets: a division of the elements among them, or bodies."""
    masks = [
        elements.mask(members)
        for name, members in source.cell_sets.items()
        if name not in NOT_SETS and not name.startswith("_")  # Abaqus' own, made for surfaces
    ]
    masks = [m for m in masks if m.any() and not m.all()]
    if not masks:
        return None
    signature = _numbered(np.stack(masks, axis=1))
    table = np.stack(masks, axis=1)[np.unique(signature, return_index=True)[1]]
    sets = list({column.tobytes(): column for column in table.T}.values())
    kinds = _type_sets(elements)
    by_type = [any((s[signature] == kind).all() for kind in kinds) for s in sets]
    division = _division([s for s, typed in zip(sets, by_type, strict=True) if not typed], signature)
    division = division or _division(sets, signature)
    if division:
        region = np.zeros(elements.count, np.int64)
        for number, chosen in enumerate(sorted(division, key=np.sum, reverse=True)):
            region[chosen] = number
        return region
    bodies = _bodies(cells, elements, masks)
    if not bodies:
        return None
    return _numbered(np.stack(bodies, axis=1))


def _type_sets(elements: _Elements) -> list[np.ndarray]:
    """For every element type the mask of its elements."""
    kinds = []
    for name in dict.fromkeys(elements.types):
        mask = np.zeros(elements.count, bool)
        for kind, rows in zip(elements.types, elements.rows, strict=True):
            if kind == name:
                mask[rows[rows >= 0]] = True
        kinds.append(mask)
    return kinds


def _division(sets: list[np.ndarray], signature: np.ndarray) -> list[np.ndarray] | None:
    """Sets that have every element once, as masks of elements; the smallest that do it.

    Elements of one signature are in the same sets, so a bit a signature is enough."""
    bits = [int("".join("01"[int(b)] for b in s[::-1]), 2) for s in sets]
    size = np.bincount(signature)
    order = sorted(range(len(sets)), key=lambda i: int(size @ sets[i]))
    everything = (1 << len(size)) - 1
    tries = 0

    def search(covered: int) -> list[int] | None:
        nonlocal tries
        tries += 1
        if covered == everything:
            return []
        if tries > _TRIES:
            return None
        lowest = ~covered & (covered + 1)
        for i in order:
            if bits[i] & lowest and not bits[i] & covered:
                rest = search(covered | bits[i])
                if rest is not None:
                    return [i, *rest]
        return None

    found = search(0)
    return [sets[i][signature] for i in sorted(found)] if found else None


def _bodies(cells, elements: _Elements, masks: list[np.ndarray]) -> list[np.ndarray]:
    """Those masks of elements that have a node inside the mesh for themselves."""
    corners, owner, sides = [], [], []
    for k, rows in zip(elements.blocks, elements.rows, strict=True):
        kind, nodes = element_type(cells[k][0]), np.asarray(cells[k][1])[rows >= 0]
        corners.append(nodes[:, : kind.corners].ravel())
        owner.append(np.repeat(rows[rows >= 0], kind.corners))
        sides += [nodes[:, g.nodes[:, : g.type.corners]].reshape(-1, g.type.corners) for g in kind.facets]
    nodes, owner = np.concatenate(corners), np.concatenate(owner)
    count = int(nodes.max()) + 1
    # as in `find_facets`: the lowest three corners tell faces apart, whatever their type
    keys = facet_keys(np.concatenate([np.sort(s, axis=1)[:, :3] for s in sides]), count)
    number, times = np.unique(keys, return_inverse=True, return_counts=True)[1:]
    alone = np.split(times[number.reshape(-1)] == 1, np.cumsum([len(s) for s in sides])[:-1])
    inner = np.ones(count, bool)
    for corner, outside in zip(sides, alone, strict=True):
        inner[corner[outside]] = False
    uses = np.bincount(nodes, minlength=count)
    return [m for m in masks if (inner & (uses > 0) & (np.bincount(nodes, m[owner], count) == uses)).any()]
