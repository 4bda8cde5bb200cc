"""Nodes on surfaces that a function gives, and derivatives of runs that slide on them."""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import meshes
import numpy as np
import pytest
from test_curved import ball, disc, off_sphere, pipe

import jaxsmooth as js
from jaxsmooth.motion.given import Given
from jaxsmooth.numerics.small import Frame

slide = partial(js.detect_constraints, boundary="slide", interfaces="slide")


class Ellipsoid(eqx.Module):
    """Nearest in the sense of the radius: no orthogonal projection but where it is a sphere."""

    centre: jax.Array
    axes: jax.Array

    def __call__(self, points):
        away = (points - self.centre) / self.axes
        return self.centre + self.axes * away / jnp.linalg.norm(away, axis=1, keepdims=True)


def unit_sphere(points):
    return points / jnp.linalg.norm(points, axis=1, keepdims=True)


def cylinder(points):
    across = points[:, :2] / jnp.linalg.norm(points[:, :2], axis=1, keepdims=True)
    return jnp.concatenate([2 * across, points[:, 2:]], axis=1)


def test_moves_end_on_the_surface_to_rounding():
    mesh = ball("tetra", 4)
    rim = off_sphere(np.asarray(mesh.points)) < 1e-9
    motion = slide(mesh, surfaces=[(rim, unit_sphere)])
    assert motion.counts == {"on given surfaces": rim.sum() - 2}
    freedom = motion.at(mesh.points).freedom
    assert (freedom[rim] == 0).sum() == 2
    assert (freedom[~rim] == 3).all()
    rim = freedom == 2
    normal = np.asarray(mesh.points)[rim]
    expected = np.eye(3) - np.einsum("ni,nj->nij", normal, normal)
    np.testing.assert_allclose(np.asarray(motion.at(mesh.points).projectors)[rim], expected, atol=1e-12)
    move = 0.1 * jnp.asarray(np.random.default_rng(0).normal(size=mesh.points.shape))
    moved = np.asarray(motion.retract(mesh.points, move))
    assert off_sphere(moved[rim]).max() < 1e-14
    np.testing.assert_allclose(moved[freedom == 3], np.asarray(mesh.points + move)[freedom == 3])
    np.testing.assert_array_equal(motion.retract(mesh.points, 0 * move), mesh.points)


def test_coarse_meshes_know_no_edges_on_a_given_surface():
    """Facets of a cube are a poor sphere: what the user says goes before the angles of the folds."""
    mesh = ball("hexahedron", 2)
    rim = off_sphere(np.asarray(mesh.points)) < 1e-9
    assert (slide(mesh, feature_angle=20.0).at(mesh.points).freedom[rim] < 2).any()
    motion = slide(mesh, surfaces=[(np.flatnonzero(rim), unit_sphere)], feature_angle=20.0)
    assert (motion.at(mesh.points).freedom[rim] == 2).sum() == rim.sum() - 2


def test_rims_slide_along_what_is_found_and_stay_on_the_given_surface():
    mesh, parameters = pipe("tetra", (3, 9, 3))
    outer = np.abs(parameters[:, 0] - 1) < 1e-9
    motion = slide(mesh, surfaces=[(outer, cylinder)])
    sides = meshes.box_normals(parameters)
    np.testing.assert_array_equal(motion.at(mesh.points).freedom, [3 - len(s) for s in sides])
    move = 0.03 * jnp.asarray(np.random.default_rng(0).normal(size=mesh.points.shape))
    moved = np.asarray(motion.retract(mesh.points, motion.at(mesh.points).project(move)))
    assert np.abs(np.linalg.norm(moved[outer, :2], axis=1) - 2)[outer[outer]].max() < 1e-12
    ends = parameters[:, 2] % 1 < 1e-9
    np.testing.assert_allclose(moved[ends, 2], np.asarray(mesh.points)[ends, 2], atol=1e-12)
    cut = parameters[:, 1] < 1e-9  # the flat face y = 0, its border at the cylinder with it
    np.testing.assert_allclose(moved[cut, 1], 0, atol=1e-12)


def test_given_curves_of_plane_meshes_and_names_of_sets():
    mesh = disc("triangle", 4)
    rim = off_sphere(np.asarray(mesh.points)) < 1e-9
    motion = slide(mesh, surfaces=[(rim, unit_sphere)])
    freedom = motion.at(mesh.points).freedom
    assert (freedom[rim] == 1).sum() == rim.sum() - 1
    assert (freedom[~rim] == 2).all()
    with pytest.raises(ValueError, match="unknown set 'rim' in surfaces; the mesh has none"):
        slide(mesh, surfaces={"rim": unit_sphere})


def test_the_frame_changes_nothing_and_frames_follow_one_another():
    points = jnp.asarray(np.random.default_rng(0).normal(size=(5, 3)))
    carrier = Given(jnp.arange(5, dtype=jnp.int32), unit_sphere)
    one, two = Frame(jnp.array([1.0, 2, 3]), jnp.array(0.5)), Frame(jnp.array([-1.0, 0, 2]), jnp.array(4.0))
    inside = carrier.within(one).within(two)
    np.testing.assert_allclose(
        inside.foot(two.into(one.into(points))), two.into(one.into(carrier.foot(points))), atol=1e-13
    )
    np.testing.assert_allclose(
        inside.tangents(two.into(one.into(points))), carrier.tangents(points), atol=1e-12
    )


def test_functions_of_the_host_by_callback():
    mesh = ball("tetra", 4)
    rim = off_sphere(np.asarray(mesh.points)) < 1e-9

    def host(points):
        assert isinstance(points, np.ndarray)
        return points / np.linalg.norm(points, axis=1, keepdims=True)

    move = 0.1 * jnp.asarray(np.random.default_rng(0).normal(size=mesh.points.shape))
    one = js.on_surface(mesh, rim, unit_sphere)
    other = js.on_surface(mesh, rim, js.host_nearest(host, 1e-5))

    @jax.jit
    def results(motion, move):
        move = motion.at(mesh.points).project(move)
        back = jax.grad(lambda m: (motion.retract(mesh.points, m) ** 3).sum())(move)
        return motion.retract(mesh.points, move), back

    for a, b in zip(results(one, move), results(other, move), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-8)
    with pytest.raises(Exception, match="the nearest points have shape"):
        jax.block_until_ready(
            js.on_surface(mesh, rim, js.host_nearest(lambda x: x[:1], 1e-5)).at(mesh.points)
        )


def test_a_given_surface_joins_other_motions():
    mesh = ball("tetra", 4)
    rim = off_sphere(np.asarray(mesh.points)) < 1e-9
    hold = js.Constraints.hold(mesh, np.flatnonzero(rim)[:5])
    motion = js.on_surface(mesh, rim, unit_sphere) & hold
    freedom = motion.at(mesh.points).freedom
    np.testing.assert_array_equal(freedom[rim], np.where(np.arange(rim.sum()) < 5, 0, 2))


# --- Derivatives of runs -------------------------------------------------------------------------


def bumpy(mesh):
    """The mesh with displaced nodes, its rim, and some nodes of this to hold."""
    rng = np.random.default_rng(5)
    points = np.asarray(mesh.points)
    rim = off_sphere(points) < 1e-9
    points = points + 0.03 * rng.normal(size=points.shape)
    points[rim] /= np.linalg.norm(points[rim], axis=1)[:, None]
    return mesh.with_points(jnp.asarray(points)), rim, np.flatnonzero(rim)[::7], rng


MESHES = {"disc": lambda: bumpy(disc("triangle", 5)), "ball": lambda: bumpy(ball("hexahedron", 4))}


def after(mesh, motion, weight, steps=2):
    method = js.Elastic(guard=None, tolerance=1e-13)
    return jnp.vdot(weight, js.run(mesh, method, constraints=motion, steps=steps).points)


@pytest.mark.parametrize("name", MESHES)
def test_derivative_of_a_run_by_interior_points(name):
    mesh, rim, hold, rng = MESHES[name]()
    motion = slide(mesh, surface_tolerance=0.1, fixed=hold)
    change = np.where(rim[:, None], 0, rng.normal(size=mesh.points.shape))
    weight = jnp.asarray(rng.normal(size=mesh.points.shape))

    @jax.jit
    def function(points):
        return after(mesh.with_points(points), motion, weight)

    slope = float(jnp.vdot(jax.jit(jax.grad(function))(mesh.points), change))
    h = 1e-6
    difference = (function(mesh.points + h * change) - function(mesh.points - h * change)) / (2 * h)
    assert slope == pytest.approx(float(difference), rel=1e-6)


@pytest.mark.parametrize("name", MESHES)
def test_derivative_of_a_run_by_the_parameters_of_a_surface(name):
    mesh, rim, hold, rng = MESHES[name]()
    nodes = np.setdiff1d(np.flatnonzero(rim), hold)
    weight = jnp.asarray(rng.normal(size=mesh.points.shape))

    @jax.jit
    def function(axes, centre):
        surface = js.on_surface(mesh, nodes, Ellipsoid(centre, axes))
        return after(mesh, surface & js.Constraints.hold(mesh, hold), weight)

    axes, centre = jnp.ones(mesh.dim), jnp.zeros(mesh.dim)
    slopes = jax.jit(jax.grad(function, argnums=(0, 1)))(axes, centre)
    h = 1e-5
    for i in range(mesh.dim):
        step = jnp.zeros(mesh.dim).at[i].set(h)
        differences = (
            (function(axes + step, centre) - function(axes - step, centre)) / (2 * h),
            (function(axes, centre + step) - function(axes, centre - step)) / (2 * h),
        )
        for found, expected in zip(slopes, differences, strict=True):
            assert float(found[i]) == pytest.approx(float(expected), rel=1e-5, abs=1e-7)


def test_interfaces_between_regions_slide_where_they_are_curved():
    """A ball within a ball of another region; its facets are coarse: some nodes are on ridges."""
    mesh = ball("tetra", 8)
    points = np.asarray(mesh.points)
    nodes = np.asarray(mesh.connectivity[0])
    inside = (np.linalg.norm(points[nodes], axis=-1) < 0.62).all(axis=1)
    labels = js.Labels((inside.astype(int),))
    mesh = js.Mesh(points, {"tetra": nodes}, labels)
    shared = np.intersect1d(nodes[inside], nodes[~inside])
    freedom = slide(mesh).at(mesh.points).freedom
    assert (freedom[shared] == 2).mean() > 0.5
    assert (freedom[shared] >= 1).mean() > 0.95
    held = slide(mesh, interfaces="fixed")
    np.testing.assert_array_equal(held.at(mesh.points).freedom[shared], 0)
    planar = slide(mesh, interfaces="planar")
    np.testing.assert_array_equal(planar.at(mesh.points).freedom[shared], 0)
