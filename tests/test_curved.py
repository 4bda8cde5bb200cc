"""Sliding on curved faces and along curved edges, against surfaces known from how each mesh was made."""

import itertools
from functools import partial

import jax
import jax.numpy as jnp
import meshes
import numpy as np
import pytest
from scipy.optimize import minimize

import jaxsmooth as js
from jaxsmooth.cells.table import element_type
from jaxsmooth.mesh.topology import node_pairs, signed_measures
from jaxsmooth.motion.curved import Patches, Sliding
from jaxsmooth.motion.curves import Layout, Located, find_curves
from jaxsmooth.motion.sides import Segments, segments_of
from jaxsmooth.numerics.small import Frame

# --- Meshes ------------------------------------------------------------------------------------

slide = partial(js.detect_constraints, boundary="slide", interfaces="slide")


def round_off(square):
    """The cube [−1, 1]ⁿ to the unit ball, its boundary to the sphere."""
    size, radius = np.abs(square).max(axis=1), np.linalg.norm(square, axis=1)
    return square * np.where(radius > 0, size / np.where(radius > 0, radius, 1), 1)[:, None]


def ball(kind, n):
    points, blocks = meshes.grid(kind, (n, n, n), 0.0)
    return js.Mesh(round_off(np.tan((2 * points - 1) * np.pi / 4)), blocks)


def torus(kind, n):
    """A quarter of a torus, radii 3 and 1, with flat ends."""
    points, blocks = meshes.grid(kind, n, 0.0)
    disc, angle = round_off(2 * points[:, :2] - 1), points[:, 2] * np.pi / 2
    radius = 3 + disc[:, 0]
    return js.Mesh(np.c_[radius * np.cos(angle), radius * np.sin(angle), disc[:, 1]], blocks)


def pipe(kind, n):
    """A quarter of a pipe, radii 1 to 2, length 1."""
    points, blocks = meshes.grid(kind, n, 0.0)
    radius, angle = 1 + points[:, 0], points[:, 1] * np.pi / 2
    return js.Mesh(np.c_[radius * np.cos(angle), radius * np.sin(angle), points[:, 2]], blocks), points


def disc(kind, n):
    points, blocks = meshes.grid(kind, (n, n), 0.0)
    return js.Mesh(round_off(2 * points - 1), blocks)


def off_sphere(points):
    return np.abs(np.linalg.norm(points, axis=1) - 1)


def off_torus(points):
    return np.abs(np.hypot(np.linalg.norm(points[:, :2], axis=1) - 3, points[:, 2]) - 1)


def off_pipe(points):
    radius = np.linalg.norm(points[:, :2], axis=1)
    return np.minimum(np.abs(radius - 1), np.abs(radius - 2))


def edge_length(mesh):
    points, pairs = np.asarray(mesh.points), node_pairs(mesh)
    size = np.repeat(np.linalg.norm(points[pairs[:, 1]] - points[pairs[:, 0]], axis=1), 2)
    count = np.bincount(pairs.reshape(-1), minlength=len(points))
    return np.bincount(pairs.reshape(-1), size, len(points)) / np.maximum(count, 1)


def wander(mesh, motion, steps=10, seed=0):
    """Points after random admissible moves of about a third of an edge each."""
    rng, local = np.random.default_rng(seed), edge_length(mesh)[:, None]

    @jax.jit
    def go(points, move):
        return motion.retract(points, motion.at(points).project(move))

    points = mesh.points
    for _ in range(steps):
        points = go(points, jnp.asarray(rng.normal(size=points.shape) * 0.3 * local, points.dtype))
    return np.asarray(points)


def sliding_nodes(motion):
    return np.unique(np.concatenate([np.asarray(carrier.nodes) for carrier in motion.carriers]))


# --- What is found -----------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["tetra", "hexahedron", "wedge", "tetra10", "hexahedron27"])
def test_freedom_of_a_pipe(kind):
    linear = kind in ("tetra", "hexahedron", "wedge")
    mesh, parameters = pipe(kind, (3, 9, 3) if linear else (2, 4, 2))
    motion = slide(mesh)
    freedom = motion.at(mesh.points).freedom
    np.testing.assert_array_equal(freedom, [3 - len(s) for s in meshes.box_normals(parameters)])
    round_ = np.abs(parameters[:, 0] - 0.5) > 0.5 - 1e-9
    ends = (np.abs(parameters[:, 1:] - 0.5) > 0.5 - 1e-9).sum(axis=1)
    assert motion.counts == {
        "along curved edges": int((round_ & (ends == 1) & (np.abs(parameters[:, 2] - 0.5) > 0.49)).sum()),
        "on curved faces": int((round_ & (ends == 0)).sum()),
    }
    # what is flat or straight keeps the constant projectors of the planar rule
    planar = js.detect_constraints(mesh, boundary="planar")
    rest = np.setdiff1d(np.arange(len(freedom)), sliding_nodes(motion))
    np.testing.assert_array_equal(np.asarray(motion.projectors)[rest], np.asarray(planar.projectors)[rest])


@pytest.mark.parametrize("kind", ["quad", "triangle", "triangle6", "quad9"])
def test_boundary_of_a_disc(kind):
    mesh = disc(kind, 6)
    motion = slide(mesh, surface_tolerance=0.1)
    rim = off_sphere(np.asarray(mesh.points)) < 1e-9
    if kind in ("quad", "triangle"):
        freedom = motion.at(mesh.points).freedom
        assert (freedom[rim] == 0).sum() == 1  # the node that keeps the disc from turning
        assert (freedom[rim] == 1).sum() == rim.sum() - 1
        assert (freedom[~rim] == 2).all()
        normal = np.asarray(mesh.points)[rim]
        found = np.asarray(motion.at(mesh.points).projectors)[rim]
        np.testing.assert_allclose(np.einsum("nij,nj->ni", found, normal), 0, atol=2e-3)
    assert (motion.at(mesh.points).freedom[~rim] == 2).sum() >= (~rim).sum() - 24
    held = js.detect_constraints(mesh, boundary="planar")
    assert isinstance(held, js.Constraints)
    if kind in ("quad", "triangle"):
        np.testing.assert_array_equal(held.freedom[rim], 0)


def test_meshes_without_curves_have_constant_constraints():
    for name in ("mixed 2d", "mixed 3d", "tetra10"):
        make = {"mixed 2d": meshes.mixed_2d, "mixed 3d": meshes.mixed_3d}
        points, blocks = make[name](0.1) if name in make else meshes.grid(name, None, 0.1)
        one, other = (js.detect_constraints(js.Mesh(points, blocks), boundary=b) for b in ("slide", "planar"))
        assert type(one) is js.Constraints
        np.testing.assert_array_equal(one.projectors, other.projectors)


def bent_plate(angle, n=6):
    """Two flat halves, and a fold of `angle` degrees between them."""
    points, blocks = meshes.grid("tetra", (2 * n, n, 2), 0.0)
    x = 2 * points[:, 0] - 1
    drop = np.tan(np.deg2rad(angle)) * np.maximum(x, 0)
    return js.Mesh(np.c_[x, points[:, 1], points[:, 2] / 3 - drop], blocks), x


@pytest.mark.parametrize("angle", [1.0, 10.0, 60.0])
def test_a_fold_between_flat_faces_is_kept_however_shallow(angle):
    mesh, x = bent_plate(angle)
    motion = slide(mesh)
    assert isinstance(motion, js.Constraints)
    np.testing.assert_array_equal(motion.freedom, js.detect_constraints(mesh, boundary="planar").freedom)
    assert (motion.freedom[np.abs(x) < 1e-9] <= 1).sum() > 10


def folded_dome(angle, noise=0.0, n=12):
    """A slab whose top is curved across, with a crease of `angle` degrees along y in its middle."""
    points, blocks = meshes.grid("tetra", (n, n, 3), 0.0)
    x, y, z = (2 * points[:, 0] - 1), points[:, 1], points[:, 2]
    top = 0.3 * (1 - x**2) - np.tan(np.deg2rad(angle) / 2) * np.abs(x) + 0.05 * np.sin(3 * y)
    bumps = noise * np.random.default_rng(0).normal(size=len(x)) * (z == 1)
    return js.Mesh(np.c_[x, y, -0.5 + z * (0.5 + top) + bumps], blocks), (x, y, z)


@pytest.mark.parametrize("noise", [0.0, 1e-3])
@pytest.mark.parametrize("angle", [25.0, 70.0])
def test_a_crease_between_curved_faces_is_an_edge(angle, noise):
    mesh, (x, y, z) = folded_dome(angle, noise)
    motion = slide(mesh)
    freedom = motion.at(mesh.points).freedom
    crease = (np.abs(x) < 1e-9) & (z == 1) & (y > 1e-9) & (y < 1 - 1e-9)
    np.testing.assert_array_equal(freedom[crease], 1)
    top = (z == 1) & (np.abs(x) > 0.1) & (np.abs(x) < 0.9) & (y > 1e-9) & (y < 1 - 1e-9)
    np.testing.assert_array_equal(freedom[top], 2)  # and noise makes no edges
    along = np.asarray(motion.at(mesh.points).projectors)[crease] @ [0.0, 1, 0]
    assert (np.linalg.norm(along, axis=1) > 0.98).all()


def test_one_facet_askew_is_no_edge():
    mesh = ball("tetra", 8)
    points = np.asarray(mesh.points).copy()
    rim = np.flatnonzero(off_sphere(points) < 1e-9)
    node = rim[np.argmin(np.linalg.norm(points[rim] - [0.6, 0.64, 0.48], axis=1))]
    points[node] *= 1.02
    mesh = mesh.with_points(jnp.asarray(points))
    freedom = slide(mesh).at(mesh.points).freedom
    assert (freedom[rim] == 2).sum() >= len(rim) - 3  # but for those that keep the ball from turning


def test_nodes_on_a_ridge_slide_along_it():
    """Folds of 30° are no edges, but too sharp to be left: of 10° they are not."""
    for many, freedom in ((3, 1), (9, 2)):
        mesh, parameters = pipe("hexahedron", (3, many, 3))
        inside = (np.abs(parameters[:, 1:] - 0.5) < 0.5 - 1e-9).all(axis=1)
        on = inside & (np.abs(parameters[:, 0] - 0.5) > 0.5 - 1e-9)
        admissible = slide(mesh).at(mesh.points)
        np.testing.assert_array_equal(admissible.freedom[on], freedom)
        found = np.asarray(admissible.projectors)[on]
        np.testing.assert_allclose(found @ [0.0, 0, 1], [[0, 0, 1]] * int(on.sum()), atol=0.02)  # fits
        np.testing.assert_allclose(found @ found, found, atol=1e-9)


# --- The surface ---------------------------------------------------------------------------------

ROUND = {
    "ball of tetrahedra": (lambda: ball("tetra", 10), off_sphere),
    "ball of hexahedra": (lambda: ball("hexahedron", 10), off_sphere),
    "torus": (lambda: torus("hexahedron", (12, 12, 20)), off_torus),
    "pipe": (lambda: pipe("tetra", (3, 12, 4))[0], off_pipe),
    "disc": (lambda: disc("triangle", 10), off_sphere),
}


@pytest.mark.parametrize("name", ROUND)
def test_nodes_stay_on_the_true_surface(name):
    make, off = ROUND[name]
    mesh = make()
    motion = slide(mesh, surface_tolerance=0.1)
    points, nodes, local = wander(mesh, motion), sliding_nodes(motion), edge_length(mesh)
    assert np.median(np.linalg.norm(points - np.asarray(mesh.points), axis=1)[nodes] / local[nodes]) > 0.5
    distance = (off(points) / local)[nodes]
    # facets meet at up to 20°, where a facet itself is off by 2e-2 to 5e-2 of its edges
    assert np.median(distance) < 5e-4
    assert np.percentile(distance, 95) < 2.5e-3
    assert distance.max() < 1e-2


def test_the_surface_converges_with_the_fourth_power_of_the_angle():
    distance = []
    for n in (6, 12):
        mesh = ball("hexahedron", n)
        motion = slide(mesh, surface_tolerance=0.1)
        points = wander(mesh, motion, steps=4)
        distance.append(off_sphere(points)[sliding_nodes(motion)].mean())
    assert distance[1] < distance[0] / 2**3.5


@pytest.mark.parametrize("tolerance", [0.0, 0.01])
def test_nodes_keep_the_distance_to_the_facets(tolerance):
    mesh = ball("tetra", 6)
    motion = slide(mesh, surface_tolerance=tolerance)
    points, nodes = wander(mesh, motion, steps=4), sliding_nodes(motion)
    start = np.asarray(mesh.points)
    (patches,) = motion.carriers
    facets = np.asarray(patches.corners)
    distance = np.array([to_triangles(points[node], facets) for node in nodes])
    longest = np.linalg.norm(facets - np.roll(facets, 1, axis=1), axis=-1).max()
    assert distance.max() <= tolerance * longest + 1e-12
    assert np.linalg.norm(points - start, axis=1)[nodes].min() > 0


def to_triangles(x, triangles):
    """Distance to the nearest of triangles ``[m, 3, 3]``: the plane's inside, else the edges."""
    a, b, c = np.moveaxis(triangles, 1, 0)
    best = np.inf
    for p, q in itertools.combinations((a, b, c), 2):
        t = np.clip(((x - p) * (q - p)).sum(axis=1) / ((q - p) ** 2).sum(axis=1), 0, 1)
        best = min(best, np.linalg.norm(p + t[:, None] * (q - p) - x, axis=1).min())
    frame = np.stack([b - a, c - a], axis=-1)
    weights = np.einsum("mij,mj->mi", np.linalg.pinv(frame), x - a)
    inside = (weights > 0).all(axis=1) & (weights.sum(axis=1) < 1)
    gaps = np.linalg.norm(a + np.einsum("mij,mj->mi", frame, weights) - x, axis=1)
    return min(best, gaps[inside].min(initial=np.inf))


def test_nearest_points_against_a_minimiser():
    """Of SciPy over single patches: a sample of the ball, and the circle."""
    rng = np.random.default_rng(0)
    for mesh in (ball("tetra", 6), disc("triangle", 6)):
        motion = slide(mesh, surface_tolerance=0.1)
        (patches,) = motion.carriers
        chosen = rng.permutation(len(patches.nodes))[:12]
        start = np.asarray(mesh.points)[np.asarray(patches.nodes)]
        away = start + rng.normal(size=start.shape) * 0.05
        feet = np.asarray(patches.foot(jnp.asarray(away)))
        for index in chosen:
            assert np.linalg.norm(feet[index] - away[index]) == pytest.approx(
                nearest_distance(patches, away[index]), abs=1e-6
            )


def nearest_distance(patches, x):
    corners, bulges = np.asarray(patches.corners), np.asarray(patches.bulges)
    near = np.argsort(np.linalg.norm(corners.mean(axis=1) - x, axis=1))[:12]
    best = np.inf
    for corner, bulge in zip(corners[near], bulges[near], strict=True):
        many = len(corner)

        def gap(u, corner=corner, bulge=bulge, many=many):
            w = np.append(1 - u.sum(), u)
            point = w @ corner
            if many == 2:
                point = point + 4 * w[0] * w[1] * bulge[0]
            else:
                point = point + sum(4 * w[i - 2] * w[i - 1] * bulge[i] for i in range(3))
            return ((point - x) ** 2).sum()

        limits = [{"type": "ineq", "fun": lambda u: 1 - u.sum()}] if many == 3 else ()
        middle = np.full(many - 1, 1 / many)
        found = minimize(
            gap, middle, bounds=[(0, 1)] * (many - 1), constraints=limits, method="SLSQP", tol=1e-14
        )
        best = min(best, found.fun)
    return np.sqrt(best)


@pytest.mark.parametrize("kind", ["triangle6", "quad9", "tetra10", "hexahedron20", "hexahedron27"])
def test_quadratic_facets_are_taken_as_they_are(kind):
    """Nodes lie on the surface, whatever the tolerance: the nearest points of nodes are they themselves."""
    dim = meshes.dim_of(kind)
    mesh = disc(kind, 4) if dim == 2 else pipe(kind, (2, 4, 2))[0]
    motion = slide(mesh, surface_tolerance=0.0)
    assert motion.carriers
    for carrier in motion.carriers:
        start = mesh.points[carrier.nodes]
        np.testing.assert_allclose(carrier.foot(start), start, atol=1e-12)
        assert np.abs(carrier.bulges).max() > 1e-3


def test_curves_through_points_of_a_circle_are_arcs():
    angle = np.sort(np.random.default_rng(0).uniform(0, 2, 9))
    points = np.c_[np.cos(angle), np.sin(angle), 0 * angle]
    nodes = np.c_[np.arange(8), np.arange(1, 9)]
    segments = segments_of(element_type("line"), nodes, points)
    curves = find_curves(segments, points, np.zeros(9, bool), 50.0, 1.0)
    middles = points[nodes].mean(axis=1) + curves.bulge
    np.testing.assert_allclose(np.linalg.norm(middles, axis=1), 1, atol=1e-12)
    np.testing.assert_array_equal(np.flatnonzero(curves.smooth), np.arange(1, 8))
    assert isinstance(curves.segments, Segments)


# --- As a motion ---------------------------------------------------------------------------------


def test_still_nodes_stay_exactly_and_admissible_ones_are_found_again():
    mesh = ball("tetra", 6)
    motion = slide(mesh)
    np.testing.assert_array_equal(motion.retract(mesh.points, jnp.zeros_like(mesh.points)), mesh.points)
    points = jnp.asarray(wander(mesh, motion, steps=3))
    move = jnp.full_like(points, 1e-9)
    # from any admissible place to any other, in one move along the chord
    again = motion.retract(mesh.points, points - mesh.points)
    np.testing.assert_allclose(again, points, atol=1e-12)
    assert np.abs(motion.retract(points, move) - points).max() < 3e-9


def test_projectors_are_tangent_and_near_the_derivative_of_retract():
    for mesh in (ball("hexahedron", 6), disc("quad", 6)):
        motion = slide(mesh, surface_tolerance=0.1)
        points = jnp.asarray(wander(mesh, motion, steps=2))
        projectors = np.asarray(motion.at(points).projectors)
        np.testing.assert_allclose(projectors @ projectors, projectors, atol=1e-12)
        np.testing.assert_allclose(projectors, projectors.swapaxes(1, 2), atol=1e-12)
        nodes = sliding_nodes(motion)
        np.testing.assert_array_equal(motion.at(points).freedom[nodes], mesh.dim - 1)
        normal = np.asarray(points)[nodes]
        across = np.einsum("nij,nj->ni", projectors[nodes], normal)
        assert np.abs(across).max() < 0.02  # facets meet at 15° to 20°
        move = jnp.asarray(np.random.default_rng(1).normal(size=points.shape))
        zero = jnp.zeros_like(points)
        _, slope = jax.jvp(partial(motion.retract, points), (zero,), (move,))
        apart = np.abs(slope - motion.at(points).restrict(move)).max(axis=1)
        assert np.percentile(apart, 95) < 0.05  # but for nodes at a ridge between two patches


def test_derivatives_of_moves_against_differences():
    mesh = ball("tetra", 6)
    motion = slide(mesh)
    rng = np.random.default_rng(2)
    points = jnp.asarray(wander(mesh, motion, steps=2))
    start, change, weight = (jnp.asarray(rng.normal(size=points.shape)) for _ in range(3))
    start = 0.02 * start

    def places(move):
        return motion.retract(points, move)

    _, slope = jax.jvp(places, (start,), (change,))
    h = 1e-6
    differences = (places(start + h * change) - places(start - h * change)) / (2 * h)
    apart = np.abs(np.asarray(slope - differences)).max(axis=1)
    assert np.median(apart) < 1e-8
    assert (apart > 1e-6).mean() < 0.02  # those that cross an edge between two patches
    pulled = jax.vjp(places, start)[1](weight)[0]
    assert float(jnp.vdot(pulled, change)) == pytest.approx(float(jnp.vdot(weight, slope)), rel=1e-10)


@pytest.mark.parametrize("make", [lambda: ball("tetra", 6), lambda: torus("hexahedron", (8, 8, 14))])
def test_the_frame_changes_nothing(make):
    mesh = make()
    motion = slide(mesh)
    frame = Frame.of(5 * mesh.points)
    move = 0.02 * jnp.asarray(np.random.default_rng(3).normal(size=mesh.points.shape))
    inside = motion.within(frame)
    there = inside.retract(frame.into(mesh.points), move * frame.scale)
    np.testing.assert_allclose(
        there / frame.scale + frame.origin, motion.retract(mesh.points, move), atol=1e-12
    )
    one, other = motion.at(mesh.points).projectors, inside.at(frame.into(mesh.points)).projectors
    np.testing.assert_allclose(one, other, atol=1e-10)


def test_renumbered_nodes_slide_alike():
    mesh = ball("tetra", 6)
    order = np.random.default_rng(0).permutation(len(mesh.points))
    number = np.argsort(order)
    other = js.Mesh(mesh.points[order], {"tetra": number[np.asarray(mesh.connectivity[0])][::-1]})
    move = 0.05 * jnp.asarray(np.random.default_rng(1).normal(size=mesh.points.shape))
    one = slide(mesh).retract(mesh.points, move)
    two = slide(other).retract(other.points, move[order])
    np.testing.assert_allclose(np.asarray(one)[order], two, atol=1e-9)


def test_a_move_that_is_too_long_is_shortened():
    mesh = ball("tetra", 6)
    motion = slide(mesh)
    points = motion.retract(mesh.points, 100 * jnp.ones_like(mesh.points))
    nodes = sliding_nodes(motion)
    assert np.isfinite(np.asarray(points)[nodes]).all()
    reach = np.asarray(motion.carriers[0].reach)
    assert (np.linalg.norm(np.asarray(points - mesh.points), axis=1)[nodes] <= 2 * reach + 1e-12).all()
    assert off_sphere(np.asarray(points)[nodes]).max() < 0.1


def test_rigid_motions_that_the_surface_allows_are_stopped():
    for mesh, modes in (
        (ball("tetra", 6), 3),
        (disc("triangle", 6), 1),
        (torus("hexahedron", (8, 8, 14)), 0),
    ):
        rim = np.zeros(len(mesh.points), bool)
        motion = slide(mesh)
        freedom = motion.at(mesh.points).freedom
        planar = js.detect_constraints(mesh, boundary="planar").freedom
        rim = (freedom < mesh.dim) & (planar == 0)
        corners = 0 if modes else 8
        assert (freedom[rim] == 0).sum() <= modes + corners
        rest = np.eye(mesh.dim) - np.asarray(motion.at(mesh.points).projectors)
        away = np.asarray(mesh.points)
        spins = (
            [np.cross(axis, away) for axis in np.eye(3)] if mesh.dim == 3 else [away @ [[0.0, 1], [-1, 0]]]
        )
        for spin in spins:
            assert np.abs(np.einsum("nij,nj->ni", rest, spin)).max() > 0.1


def test_tangents_of_the_host_are_those_of_the_device():
    for mesh in (torus("tetra", (8, 8, 14)), disc("quad9", 4)):
        motion = slide(mesh)
        for carrier in motion.carriers:
            place = Located(*(np.asarray(part) for part in (carrier.nodes, carrier.home, carrier.start)))
            arrays = (carrier.vertices, carrier.neighbours, carrier.corners, carrier.bulges)
            layout = Layout(*(np.asarray(part) for part in arrays), place)
            found = carrier.tangents(mesh.points[carrier.nodes])
            np.testing.assert_allclose(layout.tangents(place), found, atol=1e-9)


# --- Whole runs ----------------------------------------------------------------------------------


def squeezed_pipe():
    """A pipe whose nodes are displaced at random within its faces and edges; all elements are valid."""
    mesh, parameters = pipe("tetra", (3, 9, 3))
    inside = np.abs(parameters - 0.5) < 0.5 - 1e-9
    shift = np.random.default_rng(0).uniform(-1, 1, parameters.shape) * inside * [0.08, 0.035, 0.08]
    radius, angle, z = (parameters + shift).T * [[1], [np.pi / 2], [1]]
    points = np.c_[(1 + radius) * np.cos(angle), (1 + radius) * np.sin(angle), z]
    return mesh.with_points(jnp.asarray(points))


@pytest.mark.parametrize("method", [js.Elastic(), js.Laplacian(smart=True)])
def test_a_valid_mesh_stays_valid_and_gets_better_than_with_a_held_surface(method):
    mesh = squeezed_pipe()
    last, measure = {}, {}
    for boundary in ("planar", "slide"):
        held = js.detect_constraints(mesh, boundary=boundary, surface_tolerance=0.1)
        result = js.smooth(mesh, method, constraints=held, steps=4)
        first, last[boundary] = result.history[0].statistics, result.history[-1].statistics
        measure[boundary] = sum(
            signed_measures(kind, np.asarray(result.mesh.points), np.asarray(nodes)).sum()
            for kind, nodes in mesh.blocks
        )
        assert last[boundary].inverted == first.inverted == 0
        assert last[boundary].q_min >= first.q_min
    assert last["slide"].q_avg > last["planar"].q_avg + 0.01
    assert measure["slide"] == pytest.approx(measure["planar"], rel=2e-3)


def test_every_carrier_is_a_pytree_of_arrays():
    motion = slide(ball("tetra", 6))
    assert isinstance(motion, Sliding)
    assert all(isinstance(carrier, Patches) for carrier in motion.carriers)
    assert all(isinstance(leaf, jax.Array) for leaf in jax.tree.leaves(motion))
