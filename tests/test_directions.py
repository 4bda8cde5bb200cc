"""Which way nodes may move among facets that are tiny or have no height, against how the meshes were made."""

import meshes
import numpy as np
from damage import Damage, damaged

from jaxsmooth.mesh.record import Mesh
from jaxsmooth.motion.detect import detect_constraints


def test_a_facet_without_height_holds_its_nodes_at_any_size():
    """In the largest mesh its angle to the others is past what numbers can tell."""
    points, blocks = meshes.grid("tetra")
    side = points[:, 0] == 0
    middle = np.flatnonzero(side & (points[:, 1:] == 0.5).all(axis=1))[0]
    points[middle] = 0  # onto a corner of the cube
    for size in (1.0, 1e17):
        free = detect_constraints(Mesh(size * points, blocks)).freedom
        assert free[middle] == 0
        assert free.max() == 3


def test_nodes_among_tiny_facets_slide_in_the_plane_of_the_large_ones():
    """A graded and turned side, 1000 times as long as wide: tiny facets have normals off by 1e-8."""
    case = damaged("tetra10", Damage(jiggle=0.8, grading=4.0, stretch=1e3, turned=True, seed=124))
    free = np.asarray(detect_constraints(case.mesh).projectors)
    for nodes, normal, _ in case.planes:
        assert np.abs(free[nodes] @ normal).max() < 1e-12
