"""Verdict's metrics from angles, axes and diagonals: skew, taper, warpage, stretch, distortion."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsmooth.metrics import verdict_plane as plane
from jaxsmooth.metrics import verdict_solid as solid
from jaxsmooth.metrics.geometry import greatest, quad_faces, triangle_faces
from jaxsmooth.metrics.verdict_values import INF, PLANE, Function, greatest_of, least_of, verdict

__all__ = ["ANGLES"]

Scalar = Float[Array, ""]


def _one(points: Array) -> Scalar:
    """Of straight triangles and tetrahedra, whose Jacobian is constant."""
    return jnp.ones((), points.dtype)


def _face_skew(name: str) -> Function:
    """Greatest equiangle skew of the faces of a family."""

    def skew(points):
        found = [jax.vmap(plane.quad_equiangle_skew)(quad_faces(name, points))]
        if name != "hexahedron":
            found.append(jax.vmap(plane.triangle_equiangle_skew)(triangle_faces(name, points)))
        return greatest(jnp.concatenate(found))

    return skew


_SKEWS = {
    "triangle": plane.triangle_equiangle_skew,
    "quad": plane.quad_equiangle_skew,
    "tetra": solid.tetra_equiangle_skew,
    **{name: _face_skew(name) for name in ("pyramid", "wedge", "hexahedron")},
}
_ABOVE = {"range": (1, INF), "larger_is_better": False}

ANGLES = (
    verdict(
        "min_angle",
        {"triangle": least_of(plane.triangle_angles), "quad": lambda points: plane.quad_angles(points)[0]},
        "least angle between two sides",
        units="degrees",
        range=(0, 360),
        acceptable=(30, 90),
        ideal={"triangle": 60.0, "quad": 90.0},
        note=f"{PLANE}; 360 for a quadrilateral with a side of length zero",
    ),
    verdict(
        "max_angle",
        {"triangle": greatest_of(plane.triangle_angles), "quad": lambda points: plane.quad_angles(points)[1]},
        "greatest angle between two sides",
        units="degrees",
        range=(0, 360),
        acceptable=(60, 135),
        ideal={"triangle": 60.0, "quad": 90.0},
        larger_is_better=False,
        note=f"{PLANE}; 0 for a quadrilateral with a side of length zero",
    ),
    verdict(
        "min_dihedral_angle",
        {"tetra": least_of(solid.tetra_dihedral_angles)},
        "least angle between two faces",
        units="degrees",
        range=(0, 180),
        acceptable=(40, 70.53),
        ideal={"tetra": solid.IDEAL_DIHEDRAL},
        note="VTK takes the supplements of two of the six angles, and 1e30 for 0",
    ),
    verdict(
        "max_dihedral_angle",
        {"tetra": greatest_of(solid.tetra_dihedral_angles)},
        "greatest angle between two faces",
        units="degrees",
        range=(0, 180),
        acceptable=(70.53, 130),
        ideal={"tetra": solid.IDEAL_DIHEDRAL},
        larger_is_better=False,
        note="the counterpart of the minimum angle, which VTK does not have",
    ),
    verdict(
        "max_stretch",
        {
            "wedge": lambda points: greatest(jax.vmap(plane.quad_stretch)(quad_faces("wedge", points))),
        },
        "greatest stretch of the quadrilateral faces",
        range=(0, INF),
        acceptable=(0.25, 1),
    ),
    verdict(
        "taper",
        {"quad": plane.quad_taper, "hexahedron": solid.hexahedron_taper},
        "cross derivative over principal axis",
        range=(0, INF),
        acceptable=(0, 0.7),
        ideal=0.0,
        larger_is_better=False,
    ),
    verdict(
        "skew",
        {"quad": plane.quad_skew, "hexahedron": solid.hexahedron_skew},
        "greatest cosine between principal axes",
        range=(0, INF),
        acceptable=(0, 0.5),
        ideal=0.0,
        larger_is_better=False,
        note="with a principal axis of length zero 0, for hexahedra infinite",
    ),
    verdict(
        "equiangle_skew",
        _SKEWS,
        "worst angle of the faces, over its distance from ideal",
        range=(-1, 3),
        acceptable=(0, 0.5),
        ideal=0.0,
        larger_is_better=False,
        note=f"{PLANE}; −1 for quadrilaterals with a side of length zero; VTK leaves flat faces out",
    ),
    verdict(
        "warpage",
        {"quad": plane.quad_warpage},
        "cube of the cosine between opposite corner normals",
        range=(-1, 1),
        acceptable=(0.3, 1),
        note="1 for plane convex quadrilaterals; 0 where a corner is flat",
    ),
    verdict(
        "max_edge_ratio",
        {"quad": plane.quad_max_edge_ratio, "hexahedron": solid.hexahedron_max_edge_ratio},
        "longest over shortest principal axis",
        acceptable=(1, 3),
        note="the inverse of Robinson's and Taylor's in the paper's tables",
        **_ABOVE,
    ),
    verdict(
        "oddy",
        {"quad": plane.quad_oddy, "hexahedron": solid.hexahedron_oddy},
        "worst deviatoric part of the metric tensor",
        range=(0, INF),
        acceptable=(0, 0.5),
        ideal=0.0,
        larger_is_better=False,
    ),
    verdict(
        "distortion",
        {
            "triangle": _one,
            "quad": plane.quad_distortion,
            "tetra": _one,
            "wedge": solid.wedge_distortion,
            "hexahedron": solid.hexahedron_distortion,
        },
        "least Jacobian over mean Jacobian",
        acceptable=(0.5, 1),
        ideal={
            "triangle": 1.0,
            "quad": 1.0,
            "tetra": 1.0,
            "wedge": 2 * 0.433013 / 0.866025,
            "hexahedron": 1.0,
        },
        note="of corners, also of quadratic elements; 2 for a quadrilateral that is a point, NaN in VTK",
    ),
    verdict(
        "diagonal",
        {"hexahedron": solid.hexahedron_diagonal},
        "shortest over longest diagonal",
        range=(0, INF),
        acceptable=(0.65, 1),
    ),
    verdict(
        "dimension",
        {"hexahedron": solid.hexahedron_dimension},
        "length of a stable time step",
        units="length",
        range=(0, INF),
        acceptable=(0, INF),
        ideal=3**-0.5,
        note="Taylor and Flanagan 1989; 0 where no node changes the volume, NaN in VTK",
    ),
    verdict(
        "collapse_ratio",
        {"tetra": solid.tetra_collapse_ratio},
        "least height over the longest edge of its face",
        acceptable=(0.1, 1),
        ideal=(2 / 3) ** 0.5,
        note="negative if inverted; VTK exchanges edges 12 and 13 in two of the faces",
    ),
    verdict(
        "equivolume_skew",
        {"tetra": solid.tetra_equivolume_skew},
        "lack of volume in the circumsphere",
        acceptable=(0, 0.6),
        range=(0, 1),
        ideal=0.0,
        larger_is_better=False,
        note="1 for flat tetrahedra, 1e30 in VTK",
    ),
    verdict(
        "squish_index",
        {"tetra": solid.tetra_squish_index},
        "how far the centroid is from above the faces",
        range=(0, 2),
        acceptable=(0, 0.3),
        ideal=0.0,
        larger_is_better=False,
        note="1 or more for flat faces, which VTK leaves out",
    ),
)
"""In the order of tables."""
