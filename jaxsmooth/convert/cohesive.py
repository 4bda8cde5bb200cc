"""Elements without thickness: cohesive cells, which open as a model is loaded."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from jaxsmooth.cells.table import ElementType
from jaxsmooth.mesh.topology import lengths, pair_codes
from jaxsmooth.numerics.rounding import CLOSE, ROUNDINGS, coordinate_error

__all__ = ["without_thickness"]

_THIN = 1e-6  # of its own extent, where nothing is there to compare an element's thickness with

Blocks = Sequence[tuple[ElementType, np.ndarray]]


def without_thickness(points: np.ndarray, blocks: Blocks) -> tuple[list[np.ndarray], np.ndarray]:
    """Elements whose facing nodes coincide pairwise, as cohesive cells have them.

    Only elements that a mesh needs so count: their edges of no length belong to no other element.

    Args:
        points: coordinates ``[nodes, dim]``.
        blocks: element types with connectivity ``[elements, k]``.

    Returns:
        One mask ``[elements]`` a block, and the pairs ``[m, 2]`` of nodes that coincide through them.
    """
    allowed = ROUNDINGS * coordinate_error(points)
    points = np.asarray(points, np.float64)
    found = [_closed(kind, points, nodes, allowed) for kind, nodes in blocks]
    while any(axis.max(initial=-1) >= 0 for axis in found):
        near, shared = _beside(points, blocks, found)
        kept = []
        for (kind, nodes), axis in zip(blocks, found, strict=True):
            axis = axis.copy()
            for d in kind.extruded_axes:
                rows = np.flatnonzero(axis == d)
                through, within = _edges_along(kind, d)
                gap = lengths(points, nodes[rows][:, through]).max(axis=1)
                extent = lengths(points, nodes[rows][:, within]).min(axis=1)
                around = near[nodes[rows]].min(axis=1)
                limit = np.where(np.isfinite(around), CLOSE * around, _THIN * extent)
                codes = pair_codes(nodes[rows][:, through], len(points))
                collapsed = np.isin(codes, shared).any(axis=1)
                axis[rows[(gap > limit) | (extent <= 2 * gap) | collapsed]] = -1
            kept.append(axis)
        if all(np.array_equal(a, b) for a, b in zip(kept, found, strict=True)):
            break
        found = kept
    pairs = [np.zeros((0, 2), np.int64)]
    for (kind, nodes), axis in zip(blocks, found, strict=True):
        for d in range(kind.dim):
            pairs += [nodes[axis == d][:, ends] for ends in _through(kind, d)]
    return [axis >= 0 for axis in found], np.unique(np.concatenate(pairs), axis=0)


def _edges_along(kind: ElementType, axis: int) -> tuple[np.ndarray, np.ndarray]:
    """Edges along a natural direction, and the others, between corners ``[m, 2]``."""
    along = kind.natural[kind.edges[:, 0], axis] != kind.natural[kind.edges[:, 1], axis]
    return kind.edges[along], kind.edges[~along]


def _through(kind: ElementType, axis: int) -> list[list[int]]:
    """Every node above the lowest ones in a natural direction, and the lowest one below it."""
    bottom = kind.natural[:, axis].min()
    below = kind.natural.copy()
    below[:, axis] = bottom
    lowest = np.abs(below[:, None] - kind.natural).sum(axis=-1).argmin(axis=1)
    return [[i, int(lowest[i])] for i in range(kind.k) if kind.natural[i, axis] > bottom]


def _closed(kind: ElementType, points: np.ndarray, nodes: np.ndarray, allowed: np.ndarray) -> np.ndarray:
    """For every element the natural direction in which its facing nodes coincide, or −1."""
    found = np.full(len(nodes), -1)
    for axis in kind.extruded_axes:
        first = _edges_along(kind, axis)[0][0]
        close = lengths(points, nodes[:, first]) <= allowed[nodes[:, first]].max(axis=1)
        rows = np.flatnonzero(close & (found < 0))  # one edge tells most elements out
        facing = kind.natural.copy()
        facing[:, axis] *= -1
        partner = np.abs(facing[:, None] - kind.natural).sum(axis=-1).argmin(axis=1)
        gap = np.linalg.norm(points[nodes[rows]] - points[nodes[rows][:, partner]], axis=-1)
        found[rows[(gap <= allowed[nodes[rows]]).all(axis=1)]] = axis
    return found


def _beside(points: np.ndarray, blocks: Blocks, found: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Around the elements found, of all others: the shortest edge of each node, and all edges."""
    count = len(points)
    touched = np.zeros(count, bool)
    for (_, nodes), axis in zip(blocks, found, strict=True):
        touched[nodes[axis >= 0]] = True
    near, codes = np.full(count, np.inf), []
    for (kind, nodes), axis in zip(blocks, found, strict=True):
        rows = nodes[(axis < 0) & touched[nodes].any(axis=1)]
        edges = rows[:, kind.edges].reshape(-1, 2)
        np.minimum.at(near, edges, lengths(points, edges)[:, None])
        codes.append(pair_codes(edges, count))
    return near, np.unique(np.concatenate(codes))
