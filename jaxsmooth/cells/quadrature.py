"""Quadrature rules on the natural domains of the families: points ``[q, dim]`` and weights ``[q]``."""

from __future__ import annotations

from itertools import permutations

import numpy as np

__all__ = [
    "PYRAMID_4",
    "PYRAMID_27",
    "TETRAHEDRON_14",
    "TRIANGLE_3",
    "TRIANGLE_6",
    "Rule",
    "cone",
    "gauss",
    "gauss_heights",
    "product",
    "simplex_centre",
]

Array = np.ndarray
Rule = tuple[Array, Array]


def gauss(n: int) -> Rule:
    """The Gauss rule of n points on −1 … 1, exact to degree 2n − 1."""
    x, w = np.polynomial.legendre.leggauss(n)
    return x[:, None], w


def product(*rules: Rule) -> Rule:
    """The rule on the product of the domains of rules, whose coordinates follow each other."""
    points, weights = rules[0]
    for more_points, more_weights in rules[1:]:
        points = np.concatenate(
            [np.repeat(points, len(more_points), axis=0), np.tile(more_points, (len(points), 1))], axis=1
        )
        weights = np.repeat(weights, len(more_weights)) * np.tile(more_weights, len(weights))
    return points, weights


def _orbits(dim: int, *orbits: tuple[tuple[float, ...], float]) -> Rule:
    """A symmetric simplex rule from barycentric orbits and weights that sum to 1."""
    points, weights = [], []
    for barycentric, weight in orbits:
        orbit = sorted(set(permutations(barycentric)))
        points += [p[1:] for p in orbit]
        weights += [weight] * len(orbit)
    volume = {2: 1 / 2, 3: 1 / 6}[dim]
    return np.array(points), volume * np.array(weights)


def simplex_centre(dim: int) -> Rule:
    """One point in a triangle or tetrahedron, exact to degree 1."""
    return _orbits(dim, ((1 / (dim + 1),) * (dim + 1), 1.0))


TRIANGLE_3 = _orbits(2, ((2 / 3, 1 / 6, 1 / 6), 1 / 3))  # degree 2
_A, _B = 0.445948490915965, 0.091576213509771  # degree 4 (Dunavant 1985)
TRIANGLE_6 = _orbits(2, ((_A, _A, 1 - 2 * _A), 0.223381589678011), ((_B, _B, 1 - 2 * _B), 0.109951743655322))
_C, _D, _E = 0.3108859192633006, 0.0927352503108912, 0.0455037041256497  # degree 5 (Walkington 2000)
TETRAHEDRON_14 = _orbits(
    3,
    ((_C, _C, _C, 1 - 3 * _C), 0.1126879257180159),
    ((_D, _D, _D, 1 - 3 * _D), 0.0734930431163620),
    ((_E, _E, 0.5 - _E, 0.5 - _E), 0.0425460207770815),
)


def cone(n: int, heights: Rule) -> Rule:
    """Points of a pyramid: a Gauss square shrunk towards the apex; weights hold (1 − z)²."""
    (square, square_weights), (z, z_weights) = product(gauss(n), gauss(n)), heights
    points = [np.c_[square * (1 - h), np.full(len(square), h)] for h in z]
    return np.concatenate(points), np.concatenate([square_weights * w for w in z_weights])


def gauss_heights(n: int) -> Rule:
    """Heights ``[n]`` of a `cone`: the Gauss rule for ∫₀¹ f(z) (1 − z)² dz, exact to degree 2n − 1.

    From the eigenvalues of its Jacobi matrix (Golub and Welsch 1969)."""
    fine, fine_weights = np.polynomial.legendre.leggauss(n + 2)
    z, mass = (fine + 1) / 2, fine_weights / 2 * ((1 - fine) / 2) ** 2
    basis = np.linalg.qr(np.sqrt(mass)[:, None] * np.vander(z, n, increasing=True))[0]
    nodes, vectors = np.linalg.eigh(basis.T @ (z[:, None] * basis))
    moments = basis.T @ np.sqrt(mass)
    return nodes, (vectors.T @ moments) ** 2


# The Jacobian of a linear pyramid is constant along every line to the apex.
PYRAMID_4 = cone(2, (np.array([1 / 4]), np.array([1 / 3])))
PYRAMID_27 = cone(3, gauss_heights(3))  # degree 5
