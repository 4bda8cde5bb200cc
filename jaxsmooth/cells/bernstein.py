"""Bernstein (Bézier) form of the Jacobian determinant of every element type.

The determinant of an element is a polynomial on its reference domain, and a polynomial lies between
the least and the greatest of its Bernstein coefficients (Johnen, Remacle and Geuzaine 2013).  The
domain of every type is a product of simplices: lines, a triangle, a tetrahedron.  That of a pyramid
is a cube, in the collapsed coordinates x / (1 − z), y / (1 − z), z, in which its determinant is a
polynomial up to and including the apex.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache, reduce
from itertools import product
from math import factorial

import numpy as np

from jaxsmooth.cells.table import ElementType

__all__ = ["Bernstein", "bernstein", "determinant_degrees"]

Array = np.ndarray

_HALVED = 64  # coefficients; types with mid-side nodes and no more have bounds on halved elements
_SAME = 1e-12  # difference of gradients, which are of order 1, that is rounding


@dataclass(frozen=True)
class _Simplex:
    """Polynomials of one degree on the unit simplex ``x ≥ 0, Σx ≤ 1``; `m` coefficients."""

    dim: int
    degree: int

    @cached_property
    def exponents(self) -> Array:
        """Barycentric exponents ``[m, dim + 1]`` of the Bernstein polynomials."""
        grid = product(range(self.degree, -1, -1), repeat=self.dim + 1)
        return np.array([row for row in grid if sum(row) == self.degree])

    @cached_property
    def lattice(self) -> Array:
        """As many points ``[m, dim]``, one for every coefficient."""
        if self.degree == 0:
            return np.full((1, self.dim), 1 / (self.dim + 1))
        return self.exponents[:, 1:] / self.degree

    @cached_property
    def corners(self) -> Array:
        """The coefficients that are values at the corners of the simplex."""
        return np.flatnonzero(self.exponents.max(axis=1) == self.degree)

    def values(self, points: Array) -> Array:
        """The Bernstein polynomials ``[points, m]``."""
        barycentric = np.c_[1 - points.sum(axis=1), points]
        scale = [factorial(self.degree) / np.prod([factorial(i) for i in row]) for row in self.exponents]
        return np.array(scale) * np.prod(barycentric[:, None] ** self.exponents, axis=-1)

    @cached_property
    def halves(self) -> Array:
        """Coefficients on the parts of the halved simplex from those on the whole ``[parts, m, m]``."""
        inverse = np.linalg.inv(self.values(self.lattice))
        children = np.array([inverse @ self.values(self._place(part)) for part in _PARTS[self.dim]])
        # the entries are whole numbers of 2⁻ᵈᵉᵍʳᵉᵉ: products of midpoints
        return np.rint(children * 2**self.degree) / 2**self.degree

    def _place(self, part: Sequence[Sequence[float]]) -> Array:
        corners = np.array(part)
        return corners[0] + self.lattice @ (corners[1:] - corners[0])


def _tetra_parts() -> list[list[list[float]]]:
    """Four tetrahedra at the corners, four around the diagonal of the octahedron between them."""
    corners = np.r_[np.zeros((1, 3)), np.eye(3)]
    middle = {(i, j): (corners[i] + corners[j]) / 2 for i in range(4) for j in range(4)}
    parts = [[middle[i, j] for j in range(4)] for i in range(4)]
    ring = [(0, 2), (0, 3), (1, 3), (1, 2)]
    for a, b in zip(ring, [*ring[1:], ring[0]], strict=True):
        parts.append([middle[0, 1], middle[2, 3], middle[a], middle[b]])
    return [np.array(part).tolist() for part in parts]


_PARTS = {
    1: [[[0.0], [0.5]], [[0.5], [1.0]]],
    2: [
        [[0.0, 0.0], [0.5, 0.0], [0.0, 0.5]],
        [[0.5, 0.0], [1.0, 0.0], [0.5, 0.5]],
        [[0.0, 0.5], [0.5, 0.5], [0.0, 1.0]],
        [[0.5, 0.5], [0.0, 0.5], [0.5, 0.0]],
    ],
    3: _tetra_parts(),
}


def determinant_degrees(kind: ElementType) -> tuple[int, ...]:
    """Degree of the determinant in every factor of the domain of a type, from the span.

    The determinant is a sum of products of one derivative along each axis, so its degree is at most
    the sum of theirs.  In the collapsed coordinates a, b and w = 1 − z of a pyramid xⁱ yʲ (1 − z)ᵖ⁻ⁱ⁻ʲ is
    aⁱ bʲ wᵖ, and the determinant that of the columns ∂/∂a / w, ∂/∂b / w and ∂/∂w.  A multiple of the first
    added to the third takes the terms with p = i out of it, which would count too much along a; the
    second does the same along b.
    """
    span, powers = kind.span, kind.span.powers
    if not kind.singular_corners:
        ends = np.cumsum(kind.family.factors)[:-1]
        return tuple(
            sum(
                int((powers[:, part].sum(axis=1) - (d in part))[powers[:, d] > 0].max())
                for d in range(kind.dim)
            )
            for part in np.split(np.arange(kind.dim), ends)
        )
    lowest = powers[:, 0] + powers[:, 1] - span.poles  # zᵏ = (1 − w)ᵏ has powers of w up to k
    terms = {(i, j, p + n) for (i, j, k), p in zip(powers, lowest, strict=True) for n in range(k + 1)}
    i, j, p = np.array(sorted(terms)).T
    along_a = (i - 1)[i > 0].max() + i[j > 0].max() + i[p != i].max()
    along_b = (j - 1)[j > 0].max() + j[i > 0].max() + j[p != j].max()
    along_w = sum((p - 1)[chosen > 0].max() for chosen in (i, j, p))
    return int(along_a), int(along_b), int(along_w)


def _kron(matrices: Sequence[Array]) -> Array:
    return reduce(np.kron, matrices)


@dataclass(frozen=True, eq=False)
class Bernstein:
    """The determinant of one element type; its `s` coefficients are ordered as its sample points.

    Everything refers to the determinant relative to the ideal element (see `elements`): the ideal
    element of measure V has V everywhere.  The ideal elements are affine images of their reference
    domains, so this is the determinant of the natural coordinates times a constant.
    """

    kind: ElementType

    @cached_property
    def factors(self) -> tuple[_Simplex, ...]:
        """The simplices whose product is the domain."""
        degrees = determinant_degrees(self.kind)
        return tuple(_Simplex(*pair) for pair in zip(self.kind.family.factors, degrees, strict=True))

    @cached_property
    def _sampling(self) -> tuple[Array, ...]:
        """Sample points on every factor: Chebyshev–Lobatto on lines, where they lose fewest digits."""
        points = []
        for axis, factor in enumerate(self.factors):
            # the gradients of a pyramid do not exist at its apex: leave that end out
            count = factor.degree + (2 if self._collapsed and axis == 2 else 1)
            lobatto = (1 - np.cos(np.pi * np.arange(count) / max(count - 1, 1))) / 2
            points.append(lobatto[: factor.degree + 1, None] if factor.dim == 1 else factor.lattice)
        return tuple(points)

    @property
    def _collapsed(self) -> bool:
        return bool(self.kind.singular_corners)

    def natural(self, points: Array) -> Array:
        """Natural coordinates of points of the domain, both ``[points, dim]``."""
        if self._collapsed:
            return np.c_[(2 * points[:, :2] - 1) * (1 - points[:, 2:]), points[:, 2]]
        line = np.repeat([f.dim == 1 for f in self.factors], [f.dim for f in self.factors])
        return np.where(line, 2 * points - 1, points)

    @cached_property
    def points(self) -> Array:
        """Sample points in natural coordinates ``[s, dim]``."""
        grid = [np.concatenate(rows) for rows in product(*self._sampling)]
        return self.natural(np.array(grid))

    @cached_property
    def tangents(self) -> tuple[Array, ...]:
        """Gradients by column: for every ideal axis ``[m₁, …, k]``, one axis a factor.

        The length is 1 along factors on which the column does not depend, so that columns
        broadcast: those of a hexahedron depend on two of the three coordinates."""
        shape = [len(points) for points in self._sampling]
        gradients = self.kind.gradients_at(self.points).reshape(*shape, self.kind.k, self.kind.dim)
        columns = []
        for column in np.moveaxis(gradients, -1, 0):
            for axis in range(len(shape)):
                first = column.take([0], axis=axis)
                column = first if (np.abs(column - first) < _SAME).all() else column
            columns.append(column)
        return tuple(columns)

    @cached_property
    def _transforms(self) -> list[Array]:
        pairs = zip(self.factors, self._sampling, strict=True)
        return [np.linalg.inv(factor.values(points)) for factor, points in pairs]

    @cached_property
    def matrix(self) -> Array:
        """Coefficients from samples ``[s, s]``."""
        return _kron(self._transforms)

    @property
    def layer_matrices(self) -> tuple[Array, Array]:
        """The same as a product: of the first factor, and of all others."""
        return self._transforms[0], _kron(self._transforms[1:])

    @cached_property
    def layers(self) -> Array:
        """`tangents` written out, by samples of the first factor ``[layers, k, dim · samples]``."""
        shape = (*(len(points) for points in self._sampling), self.kind.k)
        columns = np.stack([np.broadcast_to(rows, shape) for rows in self.tangents], axis=1)
        return np.swapaxes(columns.reshape(shape[0], -1, self.kind.k), 1, 2)

    @cached_property
    def ends(self) -> tuple[Array, ...]:
        """The rows of `tangents` at the corners of the domain, one array ``[e, k]`` a column."""
        chosen = []
        for rows in self.tangents:
            places = [f.corners if n > 1 else [0] for f, n in zip(self.factors, rows.shape, strict=False)]
            chosen.append(rows[np.ix_(*places)].reshape(-1, self.kind.k))
        return tuple(chosen)

    @cached_property
    def halves(self) -> Array:
        """Coefficients on the parts of the halved domain from those on the whole ``[parts, s, s]``."""
        return np.array([_kron(parts) for parts in product(*(f.halves for f in self.factors))])

    def halve(self, coefficients: Array) -> Array:
        """Coefficients on the parts ``[n · parts, s]`` of elements with coefficients ``[n, s]``."""
        parts = coefficients.reshape(-1, *(len(factor.exponents) for factor in self.factors))
        for axis, factor in enumerate(self.factors, start=1):
            split = np.tensordot(parts, factor.halves, axes=(axis, 2))  # part and row come last
            split = np.moveaxis(split, (-2, -1), (1, axis + 1))
            parts = split.reshape(-1, *parts.shape[1:])
        return parts.reshape(-1, coefficients.shape[1])

    @cached_property
    def bounding(self) -> Array:
        """Coefficients whose least bounds the determinant, from samples ``[b, s]``.

        Those of the halved element where that is cheap, each once: neighbours share some."""
        if self.kind.linear or len(self.points) > _HALVED:
            return self.matrix
        rows = np.unique(np.concatenate(self.halves), axis=0)
        return rows @ self.matrix

    @cached_property
    def corners(self) -> Array:
        """The coefficients that are values of the determinant: at the corners of the domain."""
        grid = np.arange(len(self.points)).reshape([len(f.exponents) for f in self.factors])
        return grid[np.ix_(*(f.corners for f in self.factors))].ravel()


@lru_cache
def bernstein(kind: ElementType) -> Bernstein:
    """The Bernstein form of a type, made once."""
    return Bernstein(kind)
