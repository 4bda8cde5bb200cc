"""From the cell blocks of a file to the element blocks of a mesh; `notes` say what was done."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from jaxsmooth.cells.table import element_type
from jaxsmooth.convert.checks import MeshFileError
from jaxsmooth.convert.cohesive import without_thickness
from jaxsmooth.mesh.orientation import orient
from jaxsmooth.mesh.topology import at_nodes

__all__ = ["collected", "count_orphans", "oriented", "placed", "without_cohesive"]


def collected(cells, names, parts, notes: list[str]) -> tuple[list, list, list]:
    """For each element block its connectivity, the cells it takes, and the element of every cell."""
    numbering, kept, element = [], [], []
    for name, own in zip(names, parts, strict=True):
        nodes = np.concatenate([np.asarray(cells[k][1]).astype(np.int64) for k in own])
        rows, of_cell = _distinct(name, nodes, notes)
        numbering.append(nodes[rows])
        kept.append(rows)
        element.append(of_cell)
    return numbering, kept, element


def placed(cells, parts, element, chosen) -> list[tuple[int, np.ndarray]]:
    """`MeshFile.placement`, with the elements of each block that are `chosen` and no others."""
    placement = [(-1, np.zeros(0, np.int64))] * len(cells)
    block = 0
    for own, of_cell, rows in zip(parts, element, chosen, strict=True):
        if not rows.any():
            continue
        number = np.where(rows, np.cumsum(rows) - 1, -1)[of_cell]
        ends = np.cumsum([len(cells[k][1]) for k in own])[:-1]
        for k, part in zip(own, np.split(number, ends), strict=True):
            placement[k] = (block, part)
        block += 1
    return placement


def without_cohesive(points, names, numbering, notes: list[str]) -> tuple[list[np.ndarray], np.ndarray]:
    """Masks of the elements that have a thickness, and the pairs of nodes that others join ``[m, 2]``."""
    blocks = [(element_type(name), nodes) for name, nodes in zip(names, numbering, strict=True)]
    closed, pairs = without_thickness(points, blocks)
    number = sum(int(mask.sum()) for mask in closed)
    if number == sum(map(len, numbering)):
        raise MeshFileError(
            f"none of the {number} elements has a thickness (their facing nodes coincide, as those of "
            "cohesive cells do); give the elements between them too"
        )
    if number:
        notes.append(
            f"{number} elements have no thickness (cohesive cells); they are neither smoothed nor counted, "
            f"and their {len(np.unique(pairs))} nodes move in pairs"
        )
    return [~mask for mask in closed], pairs


def _distinct(name: str, nodes: np.ndarray, notes: list[str]) -> tuple[np.ndarray, np.ndarray]:
    """Rows to keep of a block ``[elements, k]``, and for every row its element among those.

    Gmsh 2.2 files have an element once for each of its physical groups."""
    every = np.arange(len(nodes))
    weights = np.random.default_rng(0).integers(2**63, size=int(nodes.max()) + 1, dtype=np.uint64)
    sums = np.sort(sum(weights[column] for column in nodes.T))
    if (sums[1:] != sums[:-1]).all():  # the usual case, found fast
        return every, every
    kept, element = np.unique(np.sort(nodes, axis=1), axis=0, return_index=True, return_inverse=True)[1:]
    if len(kept) == len(nodes):
        return every, every
    notes.append(
        f"{len(nodes) - len(kept)} of the {len(nodes)} {name} cells repeat another one, as Gmsh writes "
        "elements of several groups; each is used once, and written as often as it was"
    )
    order = np.argsort(kept)  # in the order of the file
    return kept[order], np.argsort(order)[element.ravel()]


def oriented(points, names, numbering, notes: list[str]) -> list[tuple[str, np.ndarray]]:
    """Blocks with reversed elements mirrored; notes on them, on tangled and on flat elements."""
    kinds = [element_type(name) for name in names]
    precision = np.finfo(points.dtype).eps if points.dtype.kind == "f" else np.finfo(np.float64).eps
    points = points.astype(np.float64)
    found = orient(points, list(zip(kinds, numbering, strict=True)))
    blocks = []
    for kind, nodes, reverse, measures in zip(kinds, numbering, found.reverse, found.measures, strict=True):
        if reverse.any():
            nodes = np.where(reverse[:, None], nodes[:, kind.mirror], nodes)
            which = "all" if reverse.all() else str(int(reverse.sum()))
            mixed = "" if reverse.all() else "the numbering of the file is mixed: "
            notes.append(
                f"{mixed}{which} of the {len(nodes)} {kind.name} elements are numbered the other way round; "
                "they are turned for the computation and written in the file's own order"
            )
        corners = at_nodes(points, nodes[:, : kind.corners])
        low, high = corners.min(axis=1), corners.max(axis=1)
        size = (high - low).max(axis=0) + precision * np.maximum(np.abs(low), np.abs(high)).max(axis=0)
        flat = np.abs(measures) <= 64 * precision * size**kind.dim
        if flat.any():
            notes.append(
                f"{int(flat.sum())} of the {len(nodes)} {kind.name} elements have zero measure, "
                f"the first is {kind.name} {int(np.argmax(flat))} (counted from 0)"
            )
        inverted = (measures < 0) & ~flat
        if inverted.any():
            notes.append(
                f"{int(inverted.sum())} of the {len(nodes)} {kind.name} elements are inverted (numbered "
                f"like their neighbours, negative measure), first {kind.name} {int(np.argmax(inverted))}; "
                "the mesh is tangled"
            )
        blocks.append((kind.name, nodes))
    return blocks


def count_orphans(count: int, cells: Sequence[tuple[str, Any]], notes: list[str]) -> None:
    used = np.zeros(count, bool)
    for name, data in cells:
        if len(data) and not name.startswith("polyhedron"):
            nodes = np.asarray(data)
            used[nodes[(nodes >= 0) & (nodes < count)]] = True
    if not used.all():
        notes.append(f"{int((~used).sum())} of the {count} nodes belong to no cell; they stay where they are")
