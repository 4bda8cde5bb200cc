"""Families of element types: corners, ideal coordinates, edges and faces, and the rule that places nodes.

All members of a family are one shape, and differ in the nodes that they have beside the corners.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from jaxsmooth.cells.spans import Span

__all__ = [
    "HEXAHEDRON",
    "LINE",
    "PYRAMID",
    "QUADRILATERAL",
    "TETRAHEDRON",
    "TRIANGLE",
    "WEDGE",
    "Family",
    "NodeRule",
]

Array = np.ndarray


@dataclass(frozen=True)
class NodeRule:
    """Which entities of an element carry nodes beside its vertices.

    The nodes come in this order, those of one sort in the order of the family's entities.

    Attributes:
        edge: nodes within every edge, evenly spaced.
        quadrilateral: whether quadrilateral faces have a node at their centre; a plane quadrilateral is
            its own face.
        triangle: whether triangular faces have one.
        cell: whether solids have one.
    """

    edge: int = 0
    quadrilateral: bool = False
    triangle: bool = False
    cell: bool = False


@dataclass(frozen=True, eq=False)
class Family:
    """A shape of elements, with straight sides.

    Attributes:
        corners: natural coordinates ``[corners, dim]``.
        ideal: coordinates of the ideal element of unit measure ``[corners, dim]`` (Eqs. 16–20), an
            affine image of `corners`.
        edges: pairs of corners, in the order of the mid-side nodes.
        faces: corners of the faces, outward in a solid, in the order of their centres; a plane element
            is its own.
        factors: dimensions of the simplices whose product is the natural domain, or, with an apex, its
            image in the collapsed coordinates x / (1 − z), y / (1 − z), z.  Lines go from −1 to 1, others
            from 0 to 1.
        span: that of the functions of the corners.
        ideal_is_optimum: whether no straight element has less surface for its measure than the ideal one.
    """

    corners: Array
    ideal: Array
    edges: tuple[tuple[int, int], ...]
    faces: tuple[tuple[int, ...], ...]
    factors: tuple[int, ...]
    span: Span
    ideal_is_optimum: bool

    @property
    def dim(self) -> int:
        """Dimension: 1, 2 or 3."""
        return self.corners.shape[1]

    @property
    def facets(self) -> tuple[tuple[int, ...], ...]:
        """Corners of the faces of a solid, of the edges of a plane element; outward."""
        return {1: (), 2: self.edges, 3: self.faces}[self.dim]

    @cached_property
    def singular_corners(self) -> tuple[int, ...]:
        """Corners where more edges meet than there are dimensions: the apex of a pyramid."""
        meeting = np.bincount(np.ravel(self.edges))
        return tuple(np.flatnonzero(meeting > self.dim).tolist())

    def straight(self, points: Array) -> Array:
        """The functions of the corners ``[points, corners]`` at natural points ``[points, dim]``."""
        return self.span.at(points)[0] @ np.linalg.inv(self.span.at(self.corners)[0])

    def margin(self, points: Array) -> Array:
        """How far natural points ``[points, dim]`` are within the factors ``[points]``; negative outside."""
        least, start = np.full(len(points), np.inf), 0
        for size in self.factors:
            part = points[:, start : start + size]
            sides = 1 - np.abs(part) if size == 1 else np.c_[part, 1 - part.sum(axis=1)]
            least, start = np.minimum(least, sides.min(axis=1)), start + size
        return least

    def place(self, rule: NodeRule) -> Array:
        """Natural coordinates of the nodes that a rule asks for ``[k, dim]``, corners first."""
        within = np.arange(1, rule.edge + 1)[:, None] / (rule.edge + 1)
        nodes = [self.corners]
        for first, last in self.edges:
            nodes.append((1 - within) * self.corners[first] + within * self.corners[last])
        for corners, wanted in ((4, rule.quadrilateral), (3, rule.triangle)):
            chosen = [face for face in self.faces if wanted and len(face) == corners]
            nodes += [self.corners[list(face)].mean(axis=0, keepdims=True) for face in chosen]
        if rule.cell:
            nodes.append(self.corners.mean(axis=0, keepdims=True))
        return np.concatenate(nodes)


_L3, _L4 = 2 / 3**0.25, (6 * 2**0.5) ** (1 / 3)
_L5, _L6 = (3 * 2**0.5) ** (1 / 3), (4 / 3**0.5) ** (1 / 3)
_RIGHT = np.array([[0, 0], [1, 0], [0, 1]], float)
_EQUILATERAL = np.array([[0, 0], [1, 0], [1 / 2, 3**0.5 / 2]])
_SQUARE = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], float)
_RING3, _RING4 = ((0, 1), (1, 2), (2, 0)), ((0, 1), (1, 2), (2, 3), (3, 0))


def _stack(base: Array, low: float, high: float) -> Array:
    return np.concatenate([np.c_[base, np.full(len(base), z)] for z in (low, high)])


LINE = Family(
    corners=np.array([[-1.0], [1.0]]),
    ideal=np.array([[0.0], [1.0]]),
    edges=((0, 1),),
    faces=(),
    factors=(1,),
    span=Span.of("0 1"),
    ideal_is_optimum=True,
)
TRIANGLE = Family(
    corners=_RIGHT,
    ideal=_L3 * _EQUILATERAL,
    edges=_RING3,
    faces=((0, 1, 2),),
    factors=(2,),
    span=Span.of("00 10 01"),
    ideal_is_optimum=True,
)
QUADRILATERAL = Family(
    corners=2 * _SQUARE - 1,
    ideal=_SQUARE,
    edges=_RING4,
    faces=((0, 1, 2, 3),),
    factors=(1, 1),
    span=Span.of("00 10 01 11"),
    ideal_is_optimum=True,
)
TETRAHEDRON = Family(
    corners=np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], float),
    ideal=_L4 * np.r_[np.c_[_EQUILATERAL, np.zeros(3)], [[1 / 2, 3**0.5 / 6, 6**0.5 / 3]]],
    edges=(*_RING3, (0, 3), (1, 3), (2, 3)),
    faces=((0, 2, 1), (0, 1, 3), (1, 2, 3), (2, 0, 3)),
    factors=(3,),
    span=Span.of("000 100 010 001"),
    ideal_is_optimum=True,
)
PYRAMID = Family(
    corners=np.r_[np.c_[2 * _SQUARE - 1, np.zeros(4)], [[0, 0, 1]]],
    ideal=_L5 * np.r_[np.c_[_SQUARE, np.zeros(4)], [[1 / 2, 1 / 2, 2**0.5 / 2]]],
    edges=(*_RING4, (0, 4), (1, 4), (2, 4), (3, 4)),
    faces=((0, 3, 2, 1), (0, 1, 4), (1, 2, 4), (2, 3, 4), (3, 0, 4)),
    factors=(1, 1, 1),
    span=Span.of("000 100 010 001 110/1"),
    ideal_is_optimum=False,
)
WEDGE = Family(
    corners=_stack(_RIGHT, -1, 1),
    ideal=_L6 * _stack(_EQUILATERAL, 0, 1),
    edges=(*_RING3, (3, 4), (4, 5), (5, 3), (0, 3), (1, 4), (2, 5)),
    faces=((0, 2, 1), (3, 4, 5), (0, 1, 4, 3), (1, 2, 5, 4), (2, 0, 3, 5)),
    factors=(2, 1),
    span=Span.of("000 100 010 001 101 011"),
    ideal_is_optimum=False,
)
HEXAHEDRON = Family(
    corners=_stack(2 * _SQUARE - 1, -1, 1),
    ideal=_stack(_SQUARE, 0, 1),
    edges=(*_RING4, (4, 5), (5, 6), (6, 7), (7, 4), (0, 4), (1, 5), (2, 6), (3, 7)),
    faces=((0, 4, 7, 3), (1, 2, 6, 5), (0, 1, 5, 4), (2, 3, 7, 6), (0, 3, 2, 1), (4, 5, 6, 7)),
    factors=(1, 1, 1),
    span=Span.of("000 100 010 110 001 101 011 111"),
    ideal_is_optimum=True,
)
