"""Reference normals of surfaces: which side of an element is up, found once on the host."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from jaxsmooth.cells.table import ElementType

__all__ = ["reference_normals"]

_POOR = 0.1  # shape (4√3 A / Σl² of triangles) below which the normal of an element may be chance
_ASIDE = 0.5  # cosine of the angle at which a poor one is not believed
_OVER = -0.5  # and that at which an element has turned over


def reference_normals(
    points: np.ndarray, blocks: Sequence[tuple[ElementType, np.ndarray]]
) -> tuple[np.ndarray, ...]:
    """Unit normals of the surface at its elements, one array ``[elements, 3]`` a block.

    They are the elements' own, but for those of elements that have turned over, or that are slivers standing
    on the surface: these have the mean normal of the elements around them.  Elements are numbered alike.

    Args:
        points: coordinates ``[nodes, 3]``.
        blocks: element types with connectivity ``[elements, k]``.
    """
    points = np.asarray(points, np.float64)
    total, areas, shapes = np.zeros((len(points), 3)), [], []
    for kind, nodes in blocks:
        corners = nodes[:, : kind.corners]
        places = points[corners]
        places = places - places[:, :1]
        area = np.cross(places[:, 1:-1], places[:, 2:]).sum(axis=1) / 2
        sides = np.roll(places, -1, axis=1) - places
        square = np.einsum("mcd,mcd->m", sides, sides)
        ideal = 4 * np.sqrt(3) if kind.corners == 3 else 4
        shapes.append(ideal * np.linalg.norm(area, axis=1) / np.where(square > 0, square, 1))
        areas.append(area)
        for column in corners.T:
            np.add.at(total, column, area)
    found = []
    for (kind, nodes), area, shape in zip(blocks, areas, shapes, strict=True):
        around = total[nodes[:, : kind.corners]].sum(axis=1) - kind.corners * area
        own, mean = _unit(area), _unit(around)
        cosine = np.einsum("md,md->m", own, mean)
        doubtful = (cosine < _OVER) | ((shape < _POOR) & (cosine < _ASIDE))
        doubtful &= (mean != 0).any(axis=1)
        found.append(np.where(doubtful[:, None], mean, own))
    return tuple(found)


def _unit(vectors: np.ndarray) -> np.ndarray:
    size = np.linalg.norm(vectors, axis=1, keepdims=True)
    return vectors / np.where(size > 0, size, 1)
