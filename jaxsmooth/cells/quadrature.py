"""Quadrature rules on the natural domains of the element types: points and weights."""

from __future__ import annotations

from itertools import permutations

import numpy as np

__all__ = ["RULES"]

Array = np.ndarray


def _gauss(n: int) -> tuple[Array, Array]:
    x, w = np.polynomial.legendre.leggauss(n)
    return x[:, None], w


def _product(*rules: tuple[Array, Array]) -> tuple[Array, Array]:
    points, weights = rules[0]
    for more_points, more_weights in rules[1:]:
        points = np.concatenate(
            [np.repeat(points, len(more_points), axis=0), np.tile(more_points, (len(points), 1))], axis=1
        )
        weights = np.repeat(weights, len(more_weights)) * np.tile(more_weights, len(weights))
    return points, weights


def _orbits(dim: int, *orbits: tuple[tuple[float, ...], float]) -> tuple[Array, Array]:
    """A symmetric simplex rule from barycentric orbits and weights that sum to 1."""
    points, weights = [], []
    for barycentric, weight in orbits:
        orbit = sorted(set(permutations(barycentric)))
        points += [p[1:] for p in orbit]
        weights += [weight] * len(orbit)
    volume = {2: 1 / 2, 3: 1 / 6}[dim]
    return np.array(points), volume * np.array(weights)


def _simplex_centre(dim: int) -> tuple[Array, Array]:
    return _orbits(dim, ((1 / (dim + 1),) * (dim + 1), 1.0))


_TRI3 = _orbits(2, ((2 / 3, 1 / 6, 1 / 6), 1 / 3))
_A, _B = 0.445948490915965, 0.091576213509771  # degree 4 (Dunavant 1985)
_TRI6 = _orbits(2, ((_A, _A, 1 - 2 * _A), 0.223381589678011), ((_B, _B, 1 - 2 * _B), 0.109951743655322))
_C, _D, _E = 0.3108859192633006, 0.0927352503108912, 0.0455037041256497  # degree 5 (Walkington 2000)
_TET14 = _orbits(
    3,
    ((_C, _C, _C, 1 - 3 * _C), 0.1126879257180159),
    ((_D, _D, _D, 1 - 3 * _D), 0.0734930431163620),
    ((_E, _E, 0.5 - _E, 0.5 - _E), 0.0425460207770815),
)


def _cone(n: int, heights: tuple[Array, Array]) -> tuple[Array, Array]:
    """Points of a pyramid: a Gauss square shrunk towards the apex; weights hold (1 − z)²."""
    (square, square_weights), (z, z_weights) = _product(_gauss(n), _gauss(n)), heights
    points = [np.c_[square * (1 - h), np.full(len(square), h)] for h in z]
    return np.concatenate(points), np.concatenate([square_weights * w for w in z_weights])


def _gauss_cone_heights(n: int) -> tuple[Array, Array]:
    """Gauss rule for ∫₀¹ f(z) (1 − z)² dz, from the eigenvalues of its Jacobi matrix."""
    fine, fine_weights = np.polynomial.legendre.leggauss(n + 2)
    z, mass = (fine + 1) / 2, fine_weights / 2 * ((1 - fine) / 2) ** 2
    basis = np.linalg.qr(np.sqrt(mass)[:, None] * np.vander(z, n, increasing=True))[0]
    nodes, vectors = np.linalg.eigh(basis.T @ (z[:, None] * basis))
    moments = basis.T @ np.sqrt(mass)
    return nodes, (vectors.T @ moments) ** 2


RULES: dict[str, tuple[Array, Array]] = {
    "line": _gauss(1),
    "line3": _gauss(4),
    "triangle": _simplex_centre(2),
    "triangle6": _TRI6,
    "quad": _product(_gauss(2), _gauss(2)),
    "quad8": _product(_gauss(3), _gauss(3)),
    "quad9": _product(_gauss(3), _gauss(3)),
    "tetra": _simplex_centre(3),
    "tetra10": _TET14,
    # The Jacobian of a linear pyramid is constant along every line to the apex.
    "pyramid": _cone(2, (np.array([0.25]), np.array([1 / 3]))),
    "pyramid13": _cone(3, _gauss_cone_heights(3)),
    "wedge": _product(_TRI3, _gauss(2)),
    "wedge15": _product(_TRI6, _gauss(3)),
    "hexahedron": _product(_gauss(2), _gauss(2), _gauss(2)),
    "hexahedron20": _product(_gauss(3), _gauss(3), _gauss(3)),
    "hexahedron27": _product(_gauss(3), _gauss(3), _gauss(3)),
}
