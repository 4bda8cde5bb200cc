"""Example 4: a concave solid of 560 hexahedra, mapped from six quadratic macro-hexahedra."""

from __future__ import annotations

import numpy as np

from jaxsmooth.cells.table import element_type

__all__ = ["concave_solid"]

# A U in the (x, z) plane with one longer arm.  Corners of the six blocks, counter-clockwise seen
# along y, and the cells along their sides; the depth has five cells.
WIDTH, REACH, CELLS = 4, 5, 5
_OUTLINES = (
    ((0, 0), (4, 4)),
    ((4, 0), (9, 4)),
    ((9, 0), (13, 4)),
    ((9, 4), (13, 9)),
    ((0, 4), (4, 9)),
    ((0, 9), (4, 14)),
)


def concave_solid(
    shift: float = 1.0, skew: float = 0.16, depth: float = 8.5, arch: float = 0.8, seed: int = 48
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """A U-shaped solid with an arched underside.

    Its depth makes the cells oblong, so that the attainable average is near the paper's 0.92.

    Args:
        shift: how far corners of blocks are moved along the straight edges of the solid.
        skew: how far mid-side nodes are moved along their edges, relative to the length: this
            grades the cells.  The signs of both are drawn with `seed`.
        depth: extent along y.
        arch: rise of the middle of the underside.
        seed: of the random signs.

    Returns:
        Points ``[nodes, 3]`` and ``{"hexahedron": [560, 8]}``.
    """
    random = np.random.default_rng(seed)
    kind = element_type("hexahedron20")
    drawn: dict[tuple, np.ndarray] = {}

    def sign() -> int:
        return 1 if random.random() < 0.5 else -1

    def corner(x: int, y: int, z: int) -> np.ndarray:
        """A macro node; on an edge of the solid between two blocks it is shifted."""
        if (x, y, z) not in drawn:
            place = np.array([x, y * depth, z], float)
            if (x, z) in ((4, 0), (9, 0)):
                place[0] += shift * sign()
            elif (x, z) in ((13, 4), (0, 4), (0, 9), (4, 9)):
                place[2] += shift * sign()
            drawn[x, y, z] = place
        return drawn[x, y, z]

    def middle(a: tuple, b: tuple) -> np.ndarray:
        key = (min(a, b), max(a, b))
        if key not in drawn:
            low, high = corner(*key[0]), corner(*key[1])
            place = (low + high) / 2 + skew * sign() * (high - low)
            if (key[0][0], key[0][2], key[1][0], key[1][2]) == (4, 0, 9, 0):
                place[2] += arch
            drawn[key] = place
        return drawn[key]

    points, blocks = [], []
    for (x0, z0), (x1, z1) in _OUTLINES:
        names = [(x, y, z) for z in (z0, z1) for x, y in ((x0, 0), (x1, 0), (x1, 1), (x0, 1))]
        macro = np.array(
            [corner(*name) for name in names] + [middle(names[i], names[j]) for i, j in kind.edges]
        )
        cells = (x1 - x0, CELLS, z1 - z0)
        grid = np.stack(np.meshgrid(*[np.linspace(-1, 1, n + 1) for n in cells], indexing="ij"), axis=-1)
        natural = grid.reshape(-1, 3)
        number = np.arange(len(natural)).reshape(grid.shape[:3]) + sum(len(p) for p in points)
        points.append(kind.shape_functions(natural) @ macro)
        low, high = slice(None, -1), slice(1, None)
        ring = ((low, low), (high, low), (high, high), (low, high))
        blocks.append(
            np.stack([number[i, j, k] for k in (low, high) for i, j in ring], axis=-1).reshape(-1, 8)
        )
    return _merged(np.concatenate(points), np.concatenate(blocks))


def _merged(points: np.ndarray, hexahedra: np.ndarray) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Neighbouring blocks share the nodes of their common face."""
    _, first, which = np.unique(points.round(9), axis=0, return_index=True, return_inverse=True)
    return points[first], {"hexahedron": which.reshape(-1)[hexahedra]}
