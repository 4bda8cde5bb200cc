"""Facets that meet several smaller ones, whose other nodes hang on them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.sparse import csr_matrix

from jaxsmooth.cells.table import ElementType
from jaxsmooth.mesh.links import NodeLinks

__all__ = ["covered"]

_COVERED = 1e-3  # of its area, by which a facet and those that cover it may differ


def covered(
    points: np.ndarray, facets: Sequence[tuple[ElementType, np.ndarray]], links: NodeLinks
) -> np.ndarray:
    """Pairs ``[m, 2]`` of a facet and one of those that cover it from the other side.

    The covering ones have nodes of the facet and nodes that hang on it, and no others; the vector areas
    (outward) of all of them are together the opposite of the facet's.

    Args:
        points: coordinates ``[nodes, dim]``.
        facets: types and connectivity; facets are counted through all of these.
        links: those that do not hang are left aside.
    """
    links = links.select(~links.rigid)
    if len(links.nodes) == 0:
        return np.zeros((0, 2), int)
    touched = links.members(len(points))
    numbers, rows, columns, areas, start = [], [], [], [], 0
    for kind, nodes in facets:
        near = np.flatnonzero(touched[nodes[:, : kind.corners]].all(axis=1))
        numbers.append(start + near)
        rows.append(np.repeat(sum(map(len, areas)) + np.arange(len(near)), nodes.shape[1]))
        columns.append(nodes[near].ravel())
        areas.append(_vector_areas(kind, points[nodes[near]]))
        start += len(nodes)
    number, area = np.concatenate(numbers), np.concatenate(areas)
    has = _incidence(np.concatenate(rows), np.concatenate(columns), (len(number), len(points)))
    link, slot = np.nonzero(links.weights)
    shape = len(links.nodes), len(points)
    parents = _incidence(link, links.parents[link, slot], shape)
    hangs = _incidence(np.arange(len(links.nodes)), links.nodes, shape)
    reach = csr_matrix((has + _contains(has, parents) @ hangs).astype(bool).astype(np.int32))
    pairs = _contains(reach, has).tocoo()
    whole, part = pairs.row[pairs.row != pairs.col], pairs.col[pairs.row != pairs.col]
    rest = area.copy()
    np.add.at(rest, whole, area[part])
    closed = np.linalg.norm(rest, axis=1) <= _COVERED * np.linalg.norm(area, axis=1)
    return np.stack([number[whole], number[part]], axis=1)[closed[whole]]


def _incidence(rows: np.ndarray, columns: np.ndarray, shape: tuple[int, int]) -> csr_matrix:
    return csr_matrix((np.ones(len(rows), np.int32), (rows, columns)), shape)


def _contains(sets: csr_matrix, others: csr_matrix) -> csr_matrix:
    """1 where a set (row) has all nodes of another one (column)."""
    common = (sets @ others.T).tocoo()
    all_ = common.data == np.asarray(others.sum(axis=1)).ravel()[common.col]
    return csr_matrix((all_[all_].astype(np.int32), (common.row[all_], common.col[all_])), common.shape)


def _vector_areas(kind: ElementType, nodes: np.ndarray) -> np.ndarray:
    """``∫ n dA`` of facets ``[m, k, dim]``."""
    if kind.dim == 1:
        along = nodes[:, 1] - nodes[:, 0]
        return np.stack([along[:, 1], -along[:, 0]], axis=1)
    tangents = np.einsum("mkd,qke->mqde", nodes, kind.slopes)
    return np.einsum("mqd,q->md", np.cross(tangents[..., 0], tangents[..., 1]), kind.slope_weights)
