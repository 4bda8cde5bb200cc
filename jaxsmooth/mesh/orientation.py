"""Telling elements that are numbered the other way round from elements that are inverted.

Both have a negative measure.  Where two elements share a facet and are numbered alike, they
traverse it in opposite directions, wherever their nodes lie: so numbering is a question of
topology, and an inverted element is one that is numbered like its neighbours and negative.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from jaxsmooth.cells.table import ElementType
from jaxsmooth.mesh.topology import facet_keys, signed_measures

__all__ = ["Orientation", "orient"]


@dataclass(frozen=True)
class Orientation:
    """What `orient` found, one array ``[elements]`` a block.

    Attributes:
        reverse: elements numbered the other way round: apply `ElementType.mirror` to them.
        measures: signed measures after that; negative ones are inverted elements.
    """

    reverse: tuple[np.ndarray, ...]
    measures: tuple[np.ndarray, ...]


def orient(points: np.ndarray, blocks: Sequence[tuple[ElementType, np.ndarray]]) -> Orientation:
    """Find the elements whose numbering is reversed.

    Elements connected through facets are brought to one common numbering; its sign is that of
    their summed signed measure, which depends on the boundary only, however tangled the inside.
    Those of a surface in space are numbered as most of its area is.

    Args:
        points: coordinates ``[nodes, dim]``.
        blocks: element types with connectivity ``[elements, k]``.
    """
    measures = [signed_measures(kind, points, nodes) for kind, nodes in blocks]
    flat = points.shape[1] == blocks[0][0].dim
    if flat and all(m.min(initial=0.0) >= 0 for m in measures):  # nothing to tell apart
        return Orientation(tuple(np.zeros(len(m), bool) for m in measures), tuple(measures))
    whole = np.concatenate([np.full(len(m), bool((m < 0).all())) for m in measures])
    reverse = _reversed(*_neighbours(blocks, len(points)), np.concatenate(measures), whole)
    parts = np.split(reverse, np.cumsum([len(m) for m in measures])[:-1])
    if not flat:  # areas
        return Orientation(tuple(parts), tuple(measures))
    return Orientation(tuple(parts), tuple(np.where(r, -m, m) for r, m in zip(parts, measures, strict=True)))


def _neighbours(blocks, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Pairs of elements that share a facet ``[pairs, 2]``, and whether they are numbered alike."""
    keys, forward, owners, start = [], [], [], 0
    for kind, nodes in blocks:
        for group in kind.facets:
            width = group.type.corners
            corners = nodes[:, group.nodes[:, :width]].reshape(-1, width)
            keys.append(np.sort(corners, axis=1)[:, :3])
            forward.append(_forward(corners))
            owners.append(np.repeat(np.arange(start, start + len(nodes)), len(group.nodes)))
        start += len(nodes)
    key = facet_keys(np.concatenate(keys), count)
    sense, owner = np.concatenate(forward), np.concatenate(owners)
    order = np.argsort(key, kind="stable")
    same = np.concatenate([[False], key[order][1:] == key[order][:-1], [False]])
    # facets of three or more elements say nothing about numbering
    pair = np.flatnonzero(same[1:-1] & ~same[:-2] & ~same[2:])
    first, second = order[pair], order[pair + 1]
    return np.stack([owner[first], owner[second]], axis=1), sense[first] != sense[second]


def _forward(corners: np.ndarray) -> np.ndarray:
    """Direction in which facets ``[facets, c]`` run through their nodes, seen from the smallest."""
    count = corners.shape[1]
    if count == 2:
        return corners[:, 0] < corners[:, 1]
    row, least = np.arange(len(corners)), corners.argmin(axis=1)
    return corners[row, (least + 1) % count] < corners[row, (least - 1) % count]


def _reversed(pairs: np.ndarray, alike: np.ndarray, measures: np.ndarray, whole: np.ndarray) -> np.ndarray:
    """Elements to mirror, by the connected components of the two-sheeted cover of the mesh."""
    count = len(measures)
    a, b = pairs.T
    far = np.where(alike, b, b + count)
    rows, columns = np.concatenate([a, a + count]), np.concatenate([far, (far + count) % (2 * count)])
    graph = coo_matrix((np.ones(len(rows), np.int8), (rows, columns)), shape=(2 * count, 2 * count))
    sheet = connected_components(graph, directed=False)[1]
    component = np.minimum(sheet[:count], sheet[count:])
    spin = np.where(sheet[:count] == component, 1.0, -1.0)
    total = np.bincount(component, weights=spin * measures)
    one_sided = sheet[:count] == sheet[count:]  # no common numbering exists
    return np.where(one_sided, whole, spin * np.sign(total)[component] < 0)
