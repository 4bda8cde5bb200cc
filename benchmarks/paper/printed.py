"""The numbers that the paper prints."""

from __future__ import annotations

# Tables 3–6: q_min, q_max, q_avg, σ at iterations 0, 1, …
EVOLUTION = {
    "1": (
        (0.233, 0.998, 0.750, 0.17859),
        (0.561, 1.000, 0.932, 0.07129),
        (0.794, 1.000, 0.975, 0.04108),
        (0.849, 1.000, 0.982, 0.03779),
        (0.868, 1.000, 0.983, 0.03735),
        (0.871, 1.000, 0.983, 0.03719),
    ),
    "2": (
        (0.252, 0.999, 0.838, 0.15122),
        (0.603, 0.999, 0.961, 0.05705),
        (0.886, 1.000, 0.989, 0.01701),
        (0.891, 1.000, 0.995, 0.01078),
        (0.892, 1.000, 0.997, 0.01049),
    ),
    "3": (
        (0.765, 1.000, 0.935, 0.04708),
        (0.796, 1.000, 0.963, 0.03180),
        (0.802, 1.000, 0.966, 0.02969),
        (0.812, 1.000, 0.967, 0.02923),
        (0.817, 1.000, 0.967, 0.02913),
    ),
    "3-extruded": ((0.525, None, 0.884, None), (None, None, None, None), (0.634, None, 0.915, None)),
    "4": (
        (0.519, 0.949, 0.834, 0.06839),
        (0.700, 0.994, 0.914, 0.05660),
        (0.738, 0.995, 0.922, 0.06019),
        (0.805, 0.992, 0.920, 0.04773),
    ),
}

# Tables 7 and 8: q_avg, elements with q < 0.2, seconds per increment, after three iterations.
COMPARISON = {
    "5": {
        "initial mesh": (0.785, 273, None),
        "smart-laplacian": (0.809, 134, 0.42),
        "smart-weighted-laplacian": (0.811, 131, 0.63),
        "elastic": (0.819, 75, 1.05),
        "elastic-extended": (0.808, 65, 1.07),
    },
    "6": {
        "initial mesh": (0.724, 938, None),
        "smart-laplacian": (0.739, 503, 1.32),
        "smart-weighted-laplacian": (0.740, 481, 1.79),
        "elastic": (0.747, 296, 2.52),
        "elastic-extended": (0.742, 213, 2.58),
    },
}
ELEMENTS = {"4": 560, "5": 12865, "6": 32383}

# Figs. 1 and 2: the shapes are printed as pictures only; these coordinates give the printed values.
_ROOF = (0.5, 3**0.5 / 2)
_SQUARE = ((0, 0), (1, 0), (1, 1), (0, 1))
_TRAPEZIUM = ((0, 0), (1, 0), (0.6, 1), (0.4, 1))
_RIGHT = ((0, 0), (1, 0), (0, 1))


def _prism(base: tuple[tuple[float, float], ...], height: float) -> tuple[tuple[float, ...], ...]:
    return tuple((*spot, z) for z in (0, height) for spot in base)


SHAPES: dict[str, dict[str, tuple[tuple[float, ...], ...]]] = {
    "triangle": {
        "a": ((0, 0), (1, 0), _ROOF),
        "b": _RIGHT,
        "c": ((0, 0), (0.3, 0), (0.15, 1)),
        "d": ((0, 0), (2, 0), (1, 0.15)),
    },
    "quad": {
        "a": _SQUARE,
        "b": _TRAPEZIUM,
        "c": ((0, 0), (0.4, 0), (0.8, 1), (0.7, 1)),
        "d": ((0, 0), (1, 0), (1, 0.05), (0, 0.05)),
    },
    "tetra": {
        "a": ((0, 0, 0), (1, 0, 0), (*_ROOF, 0), (0.5, 3**0.5 / 6, (2 / 3) ** 0.5)),
        "b": ((0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)),
        "c": ((0, 0, 0), (0.25, 0, 0), (0, 0.25, 0), (0, 0, 1)),
    },
    "hexahedron": {
        "a": _prism(_SQUARE, 1),
        "b": _prism(_TRAPEZIUM, 1),
        "c": (
            *((0, 1, 0), (0.3, 1, 0), (1, 1, 1), (0.7, 1, 1)),
            *((0, 0, 0), (0.3, 0, 0), (1, 0, 1), (0.7, 0, 1)),
        ),
        "d": _prism(_SQUARE, 0.1),
    },
    "wedge": {
        "a": _prism(((0, 0), (1, 0), _ROOF), 1),
        "b": _prism(_RIGHT, 1),
        "d": _prism(_RIGHT, 0.07),
    },
}

# Tables 1 and 2, the rows that `jaxsmooth.metrics.table.METRICS` has: type, row, metric, columns a to d.
# For triangles and tetrahedra the mean ratio is Lo's and Liu and Joe's formula.
METRIC_ROWS = (
    ("triangle", "Proposed", "shape", (1.000, 0.892, 0.578, 0.193)),
    ("triangle", "Lo: 4√3 A / Σl²", "mean_ratio", (1.000, 0.866, 0.487, 0.172)),
    ("triangle", "Baker: l_min / l_max", "edge_ratio", (1.000, 0.707, 0.297, 0.506)),
    ("quad", "Proposed", "shape", (1.000, 0.853, 0.511, 0.181)),
    ("quad", "Lo: q₃q₄ / (q₁q₂)", "lo", (1.000, 0.076, 0.071, 1.000)),
    ("quad", "Knupp", "mean_ratio", (1.000, 0.490, 0.234, 0.100)),
    ("tetra", "Proposed", "shape", (1.000, 0.851, 0.556, 0.208)),
    ("tetra", "Liu and Joe: 12 (3V)^⅔ / Σl²", "mean_ratio", (1.000, 0.840, 0.353, 0.300)),
    ("tetra", "Knupp et al.: l_min / l_max", "edge_ratio", (1.000, 0.707, 0.243, 0.265)),
    ("hexahedron", "Proposed", "shape", (1.000, 0.878, 0.545, 0.290)),
    ("hexahedron", "Knupp", "mean_ratio", (1.000, 0.625, 0.521, 0.322)),
    ("wedge", "Proposed", "shape", (1.000, 0.929, 0.735, 0.34)),
    ("wedge", "Knupp et al.: l_min / l_max", "edge_ratio", (1.000, 0.707, 0.156, 0.049)),
    ("wedge", "Knupp et al.: min J / V", "relative_jacobian", (1.000, 1.000, 0.245, 1.000)),
)
