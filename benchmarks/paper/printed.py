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
        # found by a search of coordinates on a grid of 0.05: the only one that gives all six values
        "d": ((0, 0, 0), (1, 0, 0), (0, 1, 0), (0.2, 0.3, 0.1)),
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
        # a right triangle, shrunk by 0.24, which J_min/J_max and J_min/V ask for with three heights: one of
        # many with flat faces that give all five values.  (0 0 0) (1 0 0) (0 0.7 0) (0 0 1) (0.2 0 1)
        # (0 0.2 1) does too, but for its warped face: W = 0.040, so that Kwok's is 0.122, not 0.127.
        "c": ((0, 0, 0), (1, 0, 0), (1, 1, 0), (0.95, 0.1, 1.2), (1.19, 0.1, 1.2), (1.19, 0.34, 1.2)),
        "d": _prism(_RIGHT, 0.07),
    },
}

# Tables 1 and 2: type, author and formula as meant, name in `jaxsmooth.metrics.table.METRICS`, columns a–d.
# Inverses as in the paper; the records say where a formula is not quite the printed one.
METRIC_ROWS = (
    ("triangle", "Proposed: (p_r/p)²", "shape", (1.000, 0.892, 0.578, 0.193)),
    ("triangle", "Lo: 4√3 A / Σl²", "mean_ratio", (1.000, 0.866, 0.487, 0.172)),
    ("triangle", "Baker: l_min / l_max", "edge_ratio", (1.000, 0.707, 0.297, 0.506)),
    ("triangle", "Berzins: 1 / (1/(4q_b) + √3 q_w/16)", "berzins", (1.000, 0.885, 0.552, 0.187)),
    ("triangle", "Serrate: 3 min φ / π", "serrate", (1.000, 0.750, 0.284, 0.142)),
    ("triangle", "Pébay and Baker: 4√3 A / (l_max Σl)", "pebay_baker", (1.000, 0.717, 0.443, 0.129)),
    ("quad", "Proposed: (p_r/p)²", "shape", (1.000, 0.853, 0.511, 0.181)),
    ("quad", "Lo: q₃q₄ / (q₁q₂)", "lo", (1.000, 0.076, 0.071, 1.000)),
    ("quad", "Robinson: min(X₁/X₂, X₂/X₁)", "robinson", (1.000, 0.600, 0.219, 0.050)),
    ("quad", "Frey and George: 8 A_min / (√2 h_max h_s)", "frey_george", (1.000, 0.265, 0.132, 0.100)),
    ("quad", "Knupp: 8 / Σ((λ₁₁ + λ₂₂)/α)", "mean_ratio", (1.000, 0.490, 0.234, 0.100)),
    ("quad", "Pébay: 4A / (l_max Σl)", "pebay", (1.000, 0.664, 0.293, 0.095)),
    ("quad", "Knupp et al.: √2 l_min / d_max", "stretch", (1.000, 0.243, 0.110, 0.071)),
    ("tetra", "Proposed: (s_r/s)²", "shape", (1.000, 0.851, 0.556, 0.208)),
    ("tetra", "Shephard et al.: 2187 V⁴ / (Σf²)³", "shephard", (1.000, 0.500, 0.096, 0.004)),
    ("tetra", "Liu and Joe: 12 (3V)^⅔ / Σl²", "mean_ratio", (1.000, 0.840, 0.353, 0.300)),
    ("tetra", "Parthasarathy: 12V / (√2 R³)", "parthasarathy", (1.000, 0.770, 0.210, 0.165)),
    ("tetra", "Weatherill et al.: 6√2 V / (Σl/6)³", "weatherill", (1.000, 0.804, 0.318, 0.196)),
    ("tetra", "Knupp et al.: l_min / l_max", "edge_ratio", (1.000, 0.707, 0.243, 0.265)),
    ("hexahedron", "Proposed: (s_r/s)²", "shape", (1.000, 0.878, 0.545, 0.290)),
    ("hexahedron", "Taylor: 1 / max(A₁, A₂, A₃)", "taylor", (1.000, 0.600, 0.246, 0.100)),
    ("hexahedron", "Kwok: (1 − W_max) J_min/J_max", "kwok", (1.000, 0.444, 1.000, 1.000)),
    ("hexahedron", "Knupp: 24 / Σ((λ₁₁ + λ₂₂ + λ₃₃)/α^⅔)", "mean_ratio", (1.000, 0.625, 0.521, 0.322)),
    ("hexahedron", "Menendez et al.: q₄q₅q₆ / (q₁q₂q₃)", "menendez", (1.000, 0.006, 0.343, 1.000)),
    ("hexahedron", "Knupp et al.: √3 l_min / d_max", "stretch", (1.000, 0.225, 0.300, 0.122)),
    ("wedge", "Proposed: (s_r/s)²", "shape", (1.000, 0.929, 0.735, 0.34)),
    ("wedge", "Kwok: (1 − W_max) J_min/J_max", "kwok", (1.000, 1.000, 0.127, 1.000)),
    ("wedge", "Knupp et al.: l_min / l_max", "edge_ratio", (1.000, 0.707, 0.156, 0.049)),
    ("wedge", "Knupp et al.: min J / V", "relative_jacobian", (1.000, 1.000, 0.245, 1.000)),
    ("wedge", "Knupp et al.: min √2 l_min / d_max", "face_stretch", (1.000, 0.816, 0.200, 0.070)),
)
