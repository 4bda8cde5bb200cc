"""The table of reference elements.

The ideal element of a type (Sec. 2.4 of the paper) *is* its reference element: all
gradients in this table are taken with respect to the coordinates of the ideal element of
unit measure, so that ``A = Xᵀ G`` is the deformation gradient from the ideal element to the
element with nodes ``X``, ``det A`` is 1 on the ideal element, and quadrature weights sum
to 1.  Node order is meshio's (VTK's, and Gmsh's prism for the linear wedge).

Adding a type is adding a row: its family, which entities carry nodes, the functions that span
its shape functions, and a quadrature rule.  Everything else is derived here.  `add_element_type`
adds one from outside.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from jaxsmooth.cells.families import (
    HEXAHEDRON,
    LINE,
    PYRAMID,
    QUADRILATERAL,
    TETRAHEDRON,
    TRIANGLE,
    WEDGE,
    Family,
    NodeRule,
)
from jaxsmooth.cells.quadrature import (
    PYRAMID_4,
    PYRAMID_27,
    TETRAHEDRON_14,
    TRIANGLE_3,
    TRIANGLE_6,
    Rule,
    gauss,
    product,
    simplex_centre,
)
from jaxsmooth.cells.spans import APEX, Span, tensor

__all__ = ["TYPES", "ElementType", "FacetGroup", "add_element_type", "element_type", "supported"]

Array = np.ndarray

_SAME = 1e-9  # a difference of natural coordinates, or of what is of size 1, that is rounding
_SINGULAR = 1e8  # condition of the values at the nodes that stands for a singular matrix; it is below 1e3


@dataclass(frozen=True)
class FacetGroup:
    """The facets of one type of an element: `nodes` are local node numbers [facets, kf]."""

    type: ElementType
    nodes: Array


@dataclass(frozen=True, eq=False, repr=False)
class ElementType:
    """One row of the table.  All arrays are NumPy float64 or int; `k` counts the nodes.

    Attributes:
        name: how the type is called: meshio's name, where it has one.
        family: its shape.
        node_rule: which entities carry nodes beside the corners.
        span: that of the shape functions; it has to hold all linear functions.
        rule: quadrature points ``[q, dim]`` and weights ``[q]`` on the natural domain.
    """

    name: str
    family: Family
    node_rule: NodeRule
    span: Span
    rule: Rule

    def __repr__(self) -> str:
        return f"ElementType({self.name!r})"

    @property
    def dim(self) -> int:
        """Dimension of the element: 1, 2 or 3."""
        return self.family.dim

    @property
    def corners(self) -> int:
        """Number of corner nodes; they come first in the node order."""
        return len(self.family.corners)

    @property
    def k(self) -> int:
        """Number of nodes."""
        return len(self.natural)

    @property
    def linear(self) -> bool:
        """Whether the corners are all its nodes: its edges are straight."""
        return self.node_rule == NodeRule()

    @property
    def constant_jacobian(self) -> bool:
        """Whether one Jacobian determinant holds for the whole element: straight simplices."""
        return self.linear and len(self.family.factors) == 1

    @property
    def ideal_is_optimum(self) -> bool:
        """Whether the paper's q is largest on the ideal element.

        Not on wedges and pyramids, nor with mid-side nodes, which raise it by bulging."""
        return self.linear and self.family.ideal_is_optimum

    @property
    def singular_corners(self) -> tuple[int, ...]:
        """Corners without a Jacobian, where more than `dim` edges meet: the apex of a pyramid."""
        return self.family.singular_corners

    @property
    def extruded_axes(self) -> tuple[int, ...]:
        """Natural axes along which the element is a facet times a line: its two ends face each other."""
        if self.singular_corners or self.dim == 1:
            return ()
        starts = np.cumsum(self.family.factors) - self.family.factors
        return tuple(int(a) for a, size in zip(starts, self.family.factors, strict=True) if size == 1)

    @cached_property
    def natural(self) -> Array:
        """Natural coordinates of the nodes ``[k, dim]``."""
        return self.family.place(self.node_rule)

    @cached_property
    def straight(self) -> Array:
        """Weights of the corners ``[k, corners]`` that give the nodes of an element with straight sides."""
        return self.family.straight(self.natural)

    @cached_property
    def ideal(self) -> Array:
        """Nodes of the ideal element of unit measure ``[k, dim]`` (C_l; Eqs. 16–20)."""
        return self.straight @ self.family.ideal

    @cached_property
    def edges(self) -> Array:
        """Corner nodes of the edges ``[edges, 2]``."""
        return np.array(self.family.edges)

    @cached_property
    def edge_nodes(self) -> FacetGroup:
        """The edges with all their nodes."""
        found = [self._side(edge) for edge in self.family.edges]
        return FacetGroup(found[0][0], np.array([nodes for _, nodes in found]))

    @cached_property
    def segments(self) -> Array:
        """Pairs of neighbouring nodes along the edges, through mid-side nodes ``[m, 2]``."""
        nodes = self.edge_nodes.nodes
        chain = np.c_[nodes[:, :1], nodes[:, 2:], nodes[:, 1:2]]
        return np.concatenate([chain[:, i : i + 2] for i in range(chain.shape[1] - 1)])

    @cached_property
    def outline(self) -> Array:
        """Nodes around a plane element, those of each edge in turn ``[m]``."""
        return np.delete(self.edge_nodes.nodes, 1, axis=1).ravel()

    @cached_property
    def facets(self) -> tuple[FacetGroup, ...]:
        """Facets (faces in 3D, edges in 2D) with all their nodes, grouped by type."""
        groups: dict[ElementType, list[list[int]]] = {}
        for corners in self.family.facets:
            kind, nodes = self._side(corners)
            groups.setdefault(kind, []).append(nodes)
        return tuple(FacetGroup(kind, np.array(nodes)) for kind, nodes in groups.items())

    def _side(self, corners: tuple[int, ...]) -> tuple[ElementType, list[int]]:
        """The type and the nodes, in its order, of the edge or face with these corners.

        It is the type whose nodes have the places of all nodes of this one that are there."""
        places = self.family.corners[list(corners)]
        along = places[1:] - places[0]
        apart = self.natural - places[0]
        apart = apart - apart @ np.linalg.pinv(along) @ along
        there = np.flatnonzero(np.abs(apart).max(axis=1) < _SAME)
        for kind in TYPES.values():
            if (kind.dim, kind.corners, kind.k) != (min(len(corners) - 1, 2), len(corners), len(there)):
                continue
            distance = np.abs((kind.straight @ places)[:, None] - self.natural).max(axis=-1)
            if (distance.min(axis=1) < _SAME).all():
                return kind, distance.argmin(axis=1).tolist()
        raise ValueError(
            f"element type {self.name!r} has {len(there)} nodes on the side with the corners "
            f"{list(corners)}, and the table has no type with nodes at these places; add that type first"
        )

    @cached_property
    def mirror(self) -> Array:
        """Node permutation ``[k]`` that reverses the orientation (x and y exchanged)."""
        swapped = self.natural.copy()
        swapped[:, :2] = swapped[:, 1::-1] if self.dim > 1 else -swapped
        distance = np.abs(swapped[:, None] - self.natural).sum(axis=-1)
        return distance.argmin(axis=1)

    @cached_property
    def _coefficients(self) -> Array:
        return np.linalg.inv(self.span.at(self.natural)[0])

    def shape_functions(self, points: Array) -> Array:
        """Values of the shape functions ``[points, k]`` at natural coordinates."""
        return self.span.at(np.asarray(points, float))[0] @ self._coefficients

    def slopes_at(self, points: Array) -> Array:
        """Derivatives ``[points, k, dim]`` in natural coordinates, at natural coordinates."""
        slopes = self.span.at(np.asarray(points, float))[1]
        return np.einsum("qmd,mk->qkd", slopes, self._coefficients)

    def gradients_at(self, points: Array) -> Array:
        """Gradients ``[points, k, dim]`` in ideal coordinates, at natural coordinates."""
        slopes = self.slopes_at(points)
        return slopes @ np.linalg.inv(np.einsum("kd,qke->qde", self.ideal, slopes))

    @cached_property
    def quadrature(self) -> tuple[Array, Array]:
        """Natural points ``[q, dim]`` and weights ``[q]`` on the ideal element; they sum to 1."""
        points, weights = self.rule
        jacobians = np.einsum("kd,qke->qde", self.ideal, self.slopes)
        return points, weights * np.linalg.det(jacobians)

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

        All nodes and quadrature points; one point where the Jacobian is constant.  In place of a
        singular corner points close to it on all its edges, which have the limits there; a linear
        element needs none, as its Jacobian is constant on every line to that corner."""
        if self.constant_jacobian:
            return self.gradients
        nodes = [np.delete(self.natural, self.singular_corners, axis=0)]
        for corner in self.singular_corners if not self.linear else ():
            ends = self.natural[self._neighbours(corner)]
            nodes.append(self.natural[corner] + APEX * (ends - self.natural[corner]))
        return np.concatenate([self.gradients_at(np.concatenate(nodes)), self.gradients])

    def _neighbours(self, corner: int) -> list[int]:
        """The corners that edges join to one."""
        return [a + b - corner for a, b in self.family.edges if corner in (a, b)]

    @property
    def framed_corners(self) -> tuple[int, ...]:
        """Corners that have a frame of edges: all but the apex of a pyramid."""
        return tuple(corner for corner in range(self.corners) if corner not in self.singular_corners)

    @cached_property
    def corner_frames(self) -> Array:
        """Tangents of the edges leaving a corner: ``[c, k, dim]``, right-handed.

        ``Xᵀ frame`` has the edge tangents as its columns.  Singular corners are left out."""
        frames = []
        for corner in self.framed_corners:
            directions = (self.natural[self._neighbours(corner)] - self.natural[corner]).T
            if np.linalg.det(directions) < 0:
                directions = directions[:, [1, 0, *range(2, self.dim)]]
            frames.append(self.slopes_at(self.natural[corner : corner + 1])[0] @ directions)
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
        return self.slopes_at(self.rule[0])

    @cached_property
    def slope_weights(self) -> Array:
        """Natural quadrature weights ``[q]`` that go with `slopes`."""
        return self.rule[1]


TYPES: dict[str, ElementType] = {}


def add_element_type(row: ElementType) -> ElementType:
    """Add a row to the table, and return it: the type is known by its name everywhere then.

    Args:
        row: the type, with a name of its own; the types of its edges and facets have to be there.

    Raises:
        ValueError: the name is taken, the span doesn't fit the nodes or lacks linear functions, the
            quadrature rule doesn't measure the ideal element, or an edge or facet has no type.
    """
    where = f"element type {row.name!r}"
    if row.name in TYPES:
        raise ValueError(f"{where} is in the table already; choose another name")
    if (row.span.k, row.span.dim) != (row.k, row.dim):
        raise ValueError(
            f"{where} has {row.k} nodes in {row.dim}D, and its span {row.span.k} functions in "
            f"{row.span.dim}D; give as many functions as nodes"
        )
    if np.linalg.cond(row.span.at(row.natural)[0]) > _SINGULAR:
        raise ValueError(
            f"{where}: values at its nodes don't tell functions of its span apart; mend the span"
        )
    points, values = row.rule[0], row.shape_functions(row.rule[0])
    if max(np.abs(values.sum(axis=1) - 1).max(), np.abs(values @ row.natural - points).max()) > _SAME:
        raise ValueError(f"{where}: its span lacks linear functions; add 1 and the natural coordinates")
    if not abs(row.weights.sum() - 1) < _SAME:
        raise ValueError(
            f"{where}: its quadrature rule gives the ideal element a measure of {row.weights.sum():.6g}, not "
            "1; give points and weights of the natural domain"
        )
    if row.dim > 1:  # what the edges and facets are is found now, or refused
        _ = row.edge_nodes, row.facets
    TYPES[row.name] = row
    return row


def element_type(name: str) -> ElementType:
    """The row called `name` (meshio's name).  Raises `ValueError` for a type that has none."""
    if name not in TYPES:
        raise ValueError(f"element type {name!r} is not supported; known are {', '.join(supported())}")
    return TYPES[name]


def supported(dim: int | None = None) -> list[str]:
    """Names of the types that can be smoothed: all of them, or those of dimension `dim`."""
    return [name for name, row in TYPES.items() if row.dim > 1 and dim in (None, row.dim)]


# --- The rows ---------------------------------------------------------------------------

_CORNERS, _EDGES, _FACES = NodeRule(), NodeRule(edge=1), NodeRule(edge=1, quadrilateral=True)
_ALL = NodeRule(edge=1, quadrilateral=True, cell=True)
_P1, _P2 = "00 10 01", "00 10 01 20 11 02"
_Q1, _Q2 = tensor("0 1", "0 1"), tensor("0 1 2", "0 1 2")
_S3 = tensor(_Q1, "0 1") + " 200 210 201 211 020 120 021 121 002 102 012 112"
# Both pyramids have all quadratic polynomials; xy is the difference of 110/1 and 111/1.  The larger span is
# that of Bergot, Cohen and Duruflé (2010) of degree 2: its last function makes the trace on the base that
# of a quad9, and is quadratic on the triangles, where x or y is ±(1 − z).
_PYRAMID13 = "000 100 010 001 200 020 002 101 011 110/1 111/1 210/1 120/1"  # Bedrosian 1992
_PYRAMID14 = _PYRAMID13 + " 220/2"
_G2, _G3 = gauss(2), gauss(3)
_ROWS: tuple[tuple[str, Family, NodeRule, str, Rule], ...] = (
    ("line", LINE, _CORNERS, "0 1", gauss(1)),
    ("line3", LINE, _EDGES, "0 1 2", gauss(4)),
    ("triangle", TRIANGLE, _CORNERS, _P1, simplex_centre(2)),
    ("triangle6", TRIANGLE, _EDGES, _P2, TRIANGLE_6),
    ("quad", QUADRILATERAL, _CORNERS, _Q1, product(_G2, _G2)),
    ("quad8", QUADRILATERAL, _EDGES, _Q1 + " 20 02 21 12", product(_G3, _G3)),
    ("quad9", QUADRILATERAL, _FACES, _Q2, product(_G3, _G3)),
    ("tetra", TETRAHEDRON, _CORNERS, "000 100 010 001", simplex_centre(3)),
    ("tetra10", TETRAHEDRON, _EDGES, "000 100 010 001 200 020 002 110 011 101", TETRAHEDRON_14),
    ("pyramid", PYRAMID, _CORNERS, "000 100 010 001 110/1", PYRAMID_4),
    ("pyramid13", PYRAMID, _EDGES, _PYRAMID13, PYRAMID_27),
    ("pyramid14", PYRAMID, _FACES, _PYRAMID14, PYRAMID_27),
    ("wedge", WEDGE, _CORNERS, tensor(_P1, "0 1"), product(TRIANGLE_3, _G2)),
    ("wedge15", WEDGE, _EDGES, tensor(_P2, "0 1") + " " + tensor(_P1, "2"), product(TRIANGLE_6, _G3)),
    ("wedge18", WEDGE, _FACES, tensor(_P2, "0 1 2"), product(TRIANGLE_6, _G3)),
    ("hexahedron", HEXAHEDRON, _CORNERS, tensor(_Q1, "0 1"), product(_G2, _G2, _G2)),
    ("hexahedron20", HEXAHEDRON, _EDGES, _S3, product(_G3, _G3, _G3)),
    ("hexahedron27", HEXAHEDRON, _ALL, tensor(_Q2, "0 1 2"), product(_G3, _G3, _G3)),
)
for _name, _family, _rule, _span, _points in _ROWS:
    add_element_type(ElementType(_name, _family, _rule, Span.of(_span), _points))
