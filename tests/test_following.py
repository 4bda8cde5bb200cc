"""Boundaries that turn with the points: against constraints that are detected anew."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from meshes import box_normals, grid

import jaxsmooth as js

STEP = 1e-3


def designed(points, design):
    """Turned, stretched and sheared in the plane of the first two coordinates."""
    turn, stretch, shear = design
    x, y = (1 + stretch) * points[:, 0] + shear * points[:, 1], points[:, 1]
    c, s = jnp.cos(turn), jnp.sin(turn)
    return jnp.concatenate([jnp.stack([c * x - s * y, s * x + c * y], axis=1), points[:, 2:]], axis=1)


@pytest.mark.parametrize(
    "make", [partial(grid, "triangle", (3, 3), 0.08), partial(grid, "tetra", (2, 2, 1), 0.1)]
)
def test_gradients_agree_with_constraints_detected_anew(make):
    points, blocks = make()
    points = points * np.array([1.0, 1.3, 0.7])[: points.shape[1]]
    mesh = js.Mesh(points, blocks)
    motion = js.follow(mesh, js.detect_constraints(mesh))
    weights = np.random.default_rng(0).normal(size=points.shape)
    method = js.Elastic(guard=None, tolerance=1e-12)

    def function(design, motion):
        done = js.run(mesh.with_points(designed(points, design)), method, constraints=motion, steps=2)
        return (jnp.sin(3 * done.points) * weights).sum()

    design, way = jnp.asarray([0.5, 0.2, 0.1]), jnp.asarray([1.0, -0.7, 0.4])
    value, gradient = jax.jit(jax.value_and_grad(function))(design, motion)
    anew = jax.jit(function)

    def detected(k):
        at = design + k * STEP * way
        return anew(at, js.detect_constraints(mesh.with_points(designed(points, at))))

    np.testing.assert_allclose(value, detected(0), rtol=1e-10)
    v = [detected(k) for k in (-2, -1, 1, 2)]
    np.testing.assert_allclose(gradient @ way, (v[0] - 8 * v[1] + 8 * v[2] - v[3]) / (12 * STEP), rtol=1e-8)


def test_nodes_stay_in_their_sides_however_these_turn():
    points, blocks = grid("triangle", (3, 3), 0.08)
    mesh = js.Mesh(points, blocks)
    motion = js.follow(mesh, js.detect_constraints(mesh))
    turned = mesh.with_points(designed(points, (0.5, 0.0, 0.0)))
    done = js.run(turned, constraints=motion, steps=2).points
    back = np.asarray(designed(done, (-0.5, 0.0, 0.0)))
    assert [list(axes) for axes in box_normals(back)] == [list(axes) for axes in box_normals(points)]
    assert np.abs(back - points).max() > 0.01


def test_projectors_are_those_detected():
    """Interfaces, a line on a face that only tags tell apart, and what nothing explains."""
    points, blocks = grid("hexahedron", (2, 2, 2))
    regions = (np.repeat([0, 1], 4),)
    mesh = js.Mesh(points, blocks, js.Labels(regions=regions))
    interface = js.detect_constraints(mesh)
    np.testing.assert_allclose(js.follow(mesh, interface).at(mesh.points).projectors, interface.projectors)
    own = np.array(interface.projectors)
    centre = np.flatnonzero(np.abs(points - 0.5).max(axis=1) < 1e-9)
    direction = np.array([1.0, 2.0, 2.0]) / 3
    own[centre] = np.outer(direction, direction)
    side = np.flatnonzero(np.abs(points - [0.5, 0.5, 0]).max(axis=1) < 1e-9)  # on a face, along an edge of it
    own[side] = np.diag([0.0, 1.0, 0.0])
    motion = js.follow(mesh, js.Constraints(jnp.asarray(own)))
    np.testing.assert_allclose(motion.at(mesh.points).projectors, own, atol=1e-15)
    turned = motion.at(designed(mesh.points, (0.3, 0.0, 0.0))).projectors
    along = np.array([-np.sin(0.3), np.cos(0.3), 0])
    np.testing.assert_allclose(turned[side][0], np.outer(along, along), atol=1e-14)
    np.testing.assert_allclose(turned[centre][0], own[centre][0], atol=1e-15)
    with pytest.raises(TypeError, match="boundary='planar'"):
        js.follow(mesh, motion)
