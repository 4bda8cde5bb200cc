"""The table of reference elements.

The ideal element of a type (Sec. 2.4 of the paper) *is* its reference element: all
gradients in this table are taken with respect to the coordinates of the ideal element of
unit measure, so that ``A = Xᵀ G`` is the deformation gradient from the ideal element to the
element with nodes ``X``, ``det A`` is 1 on the ideal element, and quadrature weights sum
to 1.  Node order is meshio's (VTK's, and Gmsh's prism for the linear wedge).

Adding a type is adding a row: its nodes in natural coordinates, the functions that span
its shape functions, its facets and a quadrature rule.  Everything else is derived here.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np

from jaxsmooth.cells.quadrature import RULES

__all__ = ["TYPES", "ElementType", "FacetGroup", "element_type", "supported"]

Array = np.ndarray


# --- Spans of the shape functions ------------------------------------------------------
# A span returns values [points, k] and derivatives [points, k, dim] at natural points.


def _monomials(exponents: str) -> Callable[[Array], tuple[Array, Array]]:
    """The span of monomials, written as exponent digits: ``"00 10 01"`` is 1, x, y."""
    powers = np.array([[int(digit) for digit in term] for term in exponents.split()])

    def span(points: Array) -> tuple[Array, Array]:
        values = np.prod(points[:, None, :] ** powers, axis=-1)
        slopes = np.empty((*values.shape, powers.shape[1]))
        for axis in range(powers.shape[1]):
            lowered = powers.copy()
            lowered[:, axis] = np.maximum(lowered[:, axis] - 1, 0)
            slopes[..., axis] = powers[:, axis] * np.prod(points[:, None, :] ** lowered, axis=-1)
        return values, slopes

    return span


def _pyramid(rational: tuple[tuple[int, int, int], ...], polynomial: str):
    """Monomials, and the rational terms xⁱ yʲ zᵏ / (1 − z) that pyramids need (Bedrosian 1992)."""
    monomials = _monomials(polynomial)

    def span(points: Array) -> tuple[Array, Array]:
        values, slopes = monomials(points)
        x, y, z = points.T
        w = np.maximum(1.0 - z, _APEX)  # at the apex x = y = 0 and every term vanishes
        more, more_slopes = [], []
        for i, j, k in rational:
            top, zk = x**i * y**j, z**k
            more.append(top * zk / w)
            dx = i * x ** max(i - 1, 0) * y**j * zk / w
            dy = j * x**i * y ** max(j - 1, 0) * zk / w
            dz = top * (k * z ** max(k - 1, 0) / w + zk / w**2)
            more_slopes.append(np.stack([dx, dy, dz], axis=-1))
        return (
            np.concatenate([values, np.stack(more, axis=1)], axis=1),
            np.concatenate([slopes, np.stack(more_slopes, axis=1)], axis=1),
        )

    return span


def _tensor(first: str, second: str) -> str:
    return " ".join(a + b for a in first.split() for b in second.split())


_APEX = 2.0**-40  # distance from an apex at which its Jacobian is taken, along the lateral edges
_P1, _P2 = "00 10 01", "00 10 01 20 11 02"
_Q1, _Q2 = _tensor("0 1", "0 1"), _tensor("0 1 2", "0 1 2")
_S2 = _Q1 + " 20 02 21 12"  # serendipity quadrilateral
_SPANS: dict[str, Callable[[Array], tuple[Array, Array]]] = {
    "line": _monomials("0 1"),
    "line3": _monomials("0 1 2"),
    "triangle": _monomials(_P1),
    "triangle6": _monomials(_P2),
    "quad": _monomials(_Q1),
    "quad8": _monomials(_S2),
    "quad9": _monomials(_Q2),
    "tetra": _monomials("000 100 010 001"),
    "tetra10": _monomials("000 100 010 001 200 020 002 110 011 101"),
    "pyramid": _pyramid(((1, 1, 0),), "000 100 010 001"),
    "pyramid13": _pyramid(
        ((1, 1, 0), (1, 1, 1), (2, 1, 0), (1, 2, 0)),
        "000 100 010 001 200 020 002 101 011",
    ),
    "wedge": _monomials(_tensor(_P1, "0 1")),
    "wedge15": _monomials(_tensor(_P2, "0 1") + " " + _tensor(_P1, "2")),
    "hexahedron": _monomials(_tensor(_Q1, "0 1")),
    "hexahedron20": _monomials(_tensor(_Q1, "0 1") + " 200 210 201 211 020 120 021 121 002 102 012 112"),
    "hexahedron27": _monomials(_tensor(_Q2, "0 1 2")),
}


# --- Nodes, edges, facets, ideal coordinates -------------------------------------------


@dataclass(frozen=True)
class _Shape:
    """A family of element types: what its linear and quadratic members share."""

    dim: int
    corners: Array  # natural coordinates [corners, dim]
    ideal: Array  # Eqs. 16–20, [corners, dim]
    edges: tuple[tuple[int, int], ...]  # in the order of the mid-side nodes
    facets: tuple[tuple[int, ...], ...]  # corner nodes, outward


_L3, _L4 = 2 / 3**0.25, (6 * 2**0.5) ** (1 / 3)
_L5, _L6 = (3 * 2**0.5) ** (1 / 3), (4 / 3**0.5) ** (1 / 3)
_TRI = np.array([[0, 0], [1, 0], [1 / 2, 3**0.5 / 2]])
_SQUARE = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], float)


def _stack(base: Array, low: float, high: float) -> Array:
    return np.concatenate([np.c_[base, np.full(len(base), z)] for z in (low, high)])


_RING3, _RING4 = ((0, 1), (1, 2), (2, 0)), ((0, 1), (1, 2), (2, 3), (3, 0))
_SHAPES = {
    "line": _Shape(1, np.array([[-1.0], [1.0]]), np.array([[0.0], [1.0]]), ((0, 1),), ()),
    "triangle": _Shape(2, np.array([[0, 0], [1, 0], [0, 1]], float), _L3 * _TRI, _RING3, _RING3),
    "quad": _Shape(2, 2 * _SQUARE - 1, _SQUARE, _RING4, _RING4),
    "tetra": _Shape(
        3,
        np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], float),
        _L4 * np.r_[np.c_[_TRI, np.zeros(3)], [[1 / 2, 3**0.5 / 6, 6**0.5 / 3]]],
        (*_RING3, (0, 3), (1, 3), (2, 3)),
        ((0, 2, 1), (0, 1, 3), (1, 2, 3), (2, 0, 3)),
    ),
    "pyramid": _Shape(
        3,
        np.r_[np.c_[2 * _SQUARE - 1, np.zeros(4)], [[0, 0, 1]]],
        _L5 * np.r_[np.c_[_SQUARE, np.zeros(4)], [[1 / 2, 1 / 2, 2**0.5 / 2]]],
        (*_RING4, (0, 4), (1, 4), (2, 4), (3, 4)),
        ((0, 3, 2, 1), (0, 1, 4), (1, 2, 4), (2, 3, 4), (3, 0, 4)),
    ),
    "wedge": _Shape(
        3,
        _stack(np.array([[0, 0], [1, 0], [0, 1]], float), -1, 1),
        _L6 * _stack(_TRI, 0, 1),
        (*_RING3, (3, 4), (4, 5), (5, 3), (0, 3), (1, 4), (2, 5)),
        ((0, 2, 1), (3, 4, 5), (0, 1, 4, 3), (1, 2, 5, 4), (2, 0, 3, 5)),
    ),
    "hexahedron": _Shape(
        3,
        _stack(2 * _SQUARE - 1, -1, 1),
        _stack(_SQUARE, 0, 1),
        (*_RING4, (4, 5), (5, 6), (6, 7), (7, 4), (0, 4), (1, 5), (2, 6), (3, 7)),
        ((0, 4, 7, 3), (1, 2, 6, 5), (0, 1, 5, 4), (2, 3, 7, 6), (0, 3, 2, 1), (4, 5, 6, 7)),
    ),
}

# name: (shape, order, facets and the volume carry centre nodes)
_ROWS = {
    "line": ("line", 1, False),
    "line3": ("line", 2, False),
    "triangle": ("triangle", 1, False),
    "triangle6": ("triangle", 2, False),
    "quad": ("quad", 1, False),
    "quad8": ("quad", 2, False),
    "quad9": ("quad", 2, True),
    "tetra": ("tetra", 1, False),
    "tetra10": ("tetra", 2, False),
    "pyramid": ("pyramid", 1, False),
    "pyramid13": ("pyramid", 2, False),
    "wedge": ("wedge", 1, False),
    "wedge15": ("wedge", 2, False),
    "hexahedron": ("hexahedron", 1, False),
    "hexahedron20": ("hexahedron", 2, False),
    "hexahedron27": ("hexahedron", 2, True),
}
_FACET_NAMES = {(2, 1): "line", (2, 2): "line3", (3, 1): "triangle", (3, 2): "triangle6"}


@dataclass(frozen=True)
class FacetGroup:
    """The facets of one type of an element: `nodes` are local node numbers [facets, kf]."""

    type: ElementType
    nodes: Array


@dataclass(frozen=True, eq=False)
class ElementType:
    """One row of the table.  All arrays are NumPy float64 or int; `k` counts the nodes."""

    name: str
    order: int
    centred: bool
    shape: _Shape

    @property
    def dim(self) -> int:
        """Dimension of the element: 1, 2 or 3."""
        return self.shape.dim

    @property
    def corners(self) -> int:
        """Number of corner nodes; they come first in the node order."""
        return len(self.shape.corners)

    @property
    def k(self) -> int:
        """Number of nodes."""
        return len(self.natural)

    @cached_property
    def natural(self) -> Array:
        """Natural coordinates of the nodes ``[k, dim]``."""
        corners = self.shape.corners
        nodes = [corners]
        if self.order == 2:
            nodes.append(np.array([corners[list(edge)].mean(axis=0) for edge in self.shape.edges]))
        if self.centred:
            if self.dim == 3:
                nodes.append(np.array([corners[list(f)].mean(axis=0) for f in self.shape.facets]))
            nodes.append(corners.mean(axis=0, keepdims=True))
        return np.concatenate(nodes)

    @cached_property
    def ideal(self) -> Array:
        """Nodes of the ideal element of unit measure ``[k, dim]`` (C_l; Eqs. 16–20)."""
        linear = element_type(_ROWS[self.name][0])
        return linear.shape_functions(self.natural) @ self.shape.ideal

    @cached_property
    def edges(self) -> Array:
        """Corner nodes of the edges ``[edges, 2]``."""
        return np.array(self.shape.edges)

    @cached_property
    def segments(self) -> Array:
        """Pairs of neighbouring nodes along the edges, through mid-side nodes ``[m, 2]``."""
        if self.order == 1:
            return self.edges
        middle = self.corners + np.arange(len(self.edges))
        return np.concatenate([np.c_[self.edges[:, 0], middle], np.c_[middle, self.edges[:, 1]]])

    @cached_property
    def facets(self) -> tuple[FacetGroup, ...]:
        """Facets (faces in 3D, edges in 2D) with all their nodes, grouped by type."""
        by_name: dict[str, list[list[int]]] = {}
        for corners in self.shape.facets:
            nodes = [*corners]
            if self.order == 2:
                ring = [{a, b} for a, b in zip(corners, (*corners[1:], corners[0]), strict=True)]
                ring = ring[:1] if len(corners) == 2 else ring
                edges = [set(edge) for edge in self.shape.edges]
                nodes += [self.corners + edges.index(side) for side in ring]
            if self.centred and self.dim == 3:
                nodes.append(self.corners + len(self.edges) + self.shape.facets.index(corners))
            quad = {1: "quad", 2: "quad9" if self.centred else "quad8"}[self.order]
            by_name.setdefault(_FACET_NAMES.get((len(corners), self.order), quad), []).append(nodes)
        return tuple(FacetGroup(element_type(name), np.array(nodes)) for name, nodes in by_name.items())

    @cached_property
    def mirror(self) -> Array:
        """Node permutation ``[k]`` that reverses the orientation (x and y exchanged)."""
        swapped = self.natural.copy()
        swapped[:, :2] = swapped[:, 1::-1] if self.dim > 1 else -swapped
        distance = np.abs(swapped[:, None] - self.natural).sum(axis=-1)
        return distance.argmin(axis=1)

    def _shape_functions(self, points: Array) -> tuple[Array, Array]:
        span = _SPANS[self.name]
        coefficients = np.linalg.inv(span(self.natural)[0])
        values, slopes = span(points)
        return values @ coefficients, np.einsum("qmd,mk->qkd", slopes, coefficients)

    def shape_functions(self, points: Array) -> Array:
        """Values of the shape functions ``[points, k]`` at natural coordinates."""
        return self._shape_functions(np.asarray(points, float))[0]

    def gradients_at(self, points: Array) -> Array:
        """Gradients ``[points, k, dim]`` in ideal coordinates, at natural coordinates."""
        slopes = self._shape_functions(np.asarray(points, float))[1]
        jacobian = np.einsum("kd,qke->qde", self.ideal, slopes)
        return slopes @ np.linalg.inv(jacobian)

    @cached_property
    def quadrature(self) -> tuple[Array, Array]:
        """Natural points ``[q, dim]`` and weights ``[q]`` on the ideal element; they sum to 1."""
        points, weights = RULES[self.name]
        slopes = self._shape_functions(points)[1]
        volume = np.linalg.det(np.einsum("kd,qke->qde", self.ideal, slopes))
        return points, weights * volume

    @cached_property
    def weights(self) -> Array:
        """Quadrature weights ``[q]``."""
        return self.quadrature[1]

    @cached_property
    def gradients(self) -> Array:
        """Gradients ``[q, k, dim]`` at the quadrature points."""
        return self.gradients_at(self.quadrature[0])

    @cached_property
    def values(self) -> Array:
        """Shape functions ``[q, k]`` at the quadrature points."""
        return self.shape_functions(self.quadrature[0])

    @cached_property
    def validity_gradients(self) -> Array:
        """Gradients ``[v, k, dim]`` where the Jacobian determinant has to be positive.

        All nodes and quadrature points; one point where the Jacobian is constant."""
        if self.order == 1 and self.corners == self.dim + 1:
            return self.gradients
        nodes = self.natural
        if self.shape is _SHAPES["pyramid"]:
            apex = np.c_[_APEX * self.shape.corners[:4, :2], np.full(4, 1 - _APEX)]
            nodes = np.concatenate([np.delete(nodes, 4, axis=0), apex])
            if self.order == 1:
                nodes = nodes[:4]
        return np.concatenate([self.gradients_at(nodes), self.gradients])

    @property
    def constant_jacobian(self) -> bool:
        """Whether one Jacobian determinant holds for the whole element: straight simplices."""
        return len(self.validity_gradients) == 1

    @cached_property
    def corner_frames(self) -> Array:
        """Tangents of the edges leaving a corner: ``[c, k, dim]``, right-handed.

        ``Xᵀ frame`` has the edge tangents as its columns.  The apex of a pyramid, where four
        edges meet, is left out."""
        count = 4 if self.shape is _SHAPES["pyramid"] else self.corners
        slopes = self._shape_functions(self.natural[:count])[1]
        frames = []
        for corner in range(count):
            ends = [a + b - corner for a, b in self.shape.edges if corner in (a, b)]
            directions = (self.natural[ends] - self.natural[corner]).T
            if np.linalg.det(directions) < 0:
                directions = directions[:, [1, 0, *range(2, self.dim)]]
            frames.append(slopes[corner] @ directions)
        return np.array(frames)

    @cached_property
    def facet_tangents(self) -> Array:
        """Natural derivatives ``[s, k, dim − 1]`` at the quadrature points of all facets."""
        rows = []
        for group in self.facets:
            for nodes in group.nodes:
                spread = np.zeros((len(group.type.slopes), self.k, self.dim - 1))
                spread[:, nodes] = group.type.slopes
                rows.append(spread)
        return np.concatenate(rows)

    @cached_property
    def facet_weights(self) -> Array:
        """Natural quadrature weights ``[s]`` that go with `facet_tangents`."""
        return np.concatenate([np.tile(g.type.slope_weights, len(g.nodes)) for g in self.facets])

    @cached_property
    def ideal_surface(self) -> float:
        """Perimeter or surface area of the ideal element of unit measure (Eqs. 3, 4)."""
        tangents = np.einsum("kd,ske->sde", self.ideal, self.facet_tangents)
        gram = np.einsum("sda,sdb->sab", tangents, tangents)
        return float(np.sqrt(np.linalg.det(gram)) @ self.facet_weights)

    @cached_property
    def slopes(self) -> Array:
        """Natural derivatives ``[q, k, dim]`` at the quadrature points (used for facets)."""
        return self._shape_functions(RULES[self.name][0])[1]

    @cached_property
    def slope_weights(self) -> Array:
        """Natural quadrature weights ``[q]`` that go with `slopes`."""
        return RULES[self.name][1]


TYPES: dict[str, ElementType] = {
    name: ElementType(name, order, centred, _SHAPES[shape]) for name, (shape, order, centred) in _ROWS.items()
}


@lru_cache
def element_type(name: str) -> ElementType:
    """The row called `name` (meshio's name).  Raises `ValueError` for a type that has none."""
    if name not in TYPES:
        raise ValueError(f"element type {name!r} is not supported; known are {', '.join(supported())}")
    return TYPES[name]


def supported(dim: int | None = None) -> list[str]:
    """Names of the types that can be smoothed: all of them, or those of dimension `dim`."""
    return [name for name, row in TYPES.items() if row.dim > 1 and dim in (None, row.dim)]
