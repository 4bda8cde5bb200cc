"""Whole runs: what belongs together stays together, and gains more than where it is held."""

from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import meshes
import meshio
import numpy as np
import periodic
import pytest
from test_cli import run as command
from test_coupled import periodic_square

import jaxsmooth as js
from jaxsmooth.assembly import patch_min
from jaxsmooth.guards.patch import PatchGuard
from jaxsmooth.guards.smart import SmartGuard
from jaxsmooth.mesh.topology import find_facets
from jaxsmooth.methods import METHODS
from jaxsmooth.metrics.evaluation import evaluate
from jaxsmooth.numerics.admissible import Admissible

CASES = Path(__file__).parents[2] / "shared" / "cases"
TOGETHER = 1e-12  # of the domain


def shared(name):
    if not CASES.exists():
        pytest.skip("needs the shared cases")
    return js.read(CASES / name)


def apart(mesh, result):
    """How much further nodes are from where their parents lead them than they were, over the domain."""
    links, old, new = mesh.labels.links, np.asarray(mesh.points), np.asarray(result.mesh.points)
    move = new - old
    led = (links.weights[..., None] * move[links.parents]).sum(axis=1)
    error = move[links.nodes] - np.einsum("mij,mj->mi", links.rotations, led)
    return np.abs(error).max() / np.ptp(old, axis=0).max()


def with_nodes_held(mesh):
    """The constraints that hold all linked nodes."""
    free = mesh.with_labels(eqx.tree_at(lambda labels: labels.links, mesh.labels, None))
    return js.detect_constraints(free, fixed=mesh.labels.links.members(len(mesh.points)))


def gain(mesh, method, steps):
    """The last statistics where linked nodes are held and where they move together."""
    held = js.smooth(mesh, method, constraints=with_nodes_held(mesh), steps=steps)
    free = js.smooth(mesh, method, steps=steps)
    assert apart(mesh, free) <= TOGETHER
    moved = (np.asarray(free.mesh.points) != np.asarray(mesh.points)).any(axis=1)
    assert moved.any()
    if not getattr(method, "smart", False):
        assert moved[mesh.labels.links.members(len(moved))].any()
    return held.history[-1].statistics, free.history[-1].statistics


@pytest.mark.parametrize("version", periodic.VERSIONS)
def test_a_solid_that_is_periodic_along_all_axes(tmp_path, version):
    periodic.box(tmp_path / "box.msh", version, 0.45)
    file = js.read(tmp_path / "box.msh")
    mesh, points = file.mesh, np.asarray(file.mesh.points)
    on_faces = ((np.abs(points) < 1e-9) | (np.abs(points - 1) < 1e-9)).any(axis=1)
    np.testing.assert_array_equal(mesh.labels.links.members(len(points)), on_faces)
    assert "move together" in "".join(file.notes)
    assert len(np.unique(mesh.labels.regions[0])) == 2
    held, free = gain(mesh, js.Elastic(), 3)
    assert free.q_avg > held.q_avg
    assert free.q_min > held.q_min


@pytest.mark.parametrize("version", periodic.VERSIONS)
def test_a_sector_that_is_periodic_by_a_quarter_turn(tmp_path, version):
    periodic.sector(tmp_path / "sector.msh", version)
    mesh = js.read(tmp_path / "sector.msh").mesh
    links = mesh.labels.links
    assert np.abs(links.rotations - [[0, -1], [1, 0]]).max() < 1e-9
    held, free = gain(mesh, js.Elastic(), 3)
    assert free.q_avg > held.q_avg
    assert free.q_min > held.q_min


@pytest.mark.parametrize("name", ["13_cohesive_straight", "14_contact_straight", "02_hanging"])
def test_parts_gain_more_than_where_they_are_held(name):
    held, free = gain(shared(f"{name}.vtu").mesh, js.Elastic(), 4)
    assert free.q_avg > held.q_avg + 1e-3
    assert free.q_min > held.q_min + 0.04


@pytest.mark.parametrize("name", [name for name in METHODS if name != "untangle"])  # it leaves valid ones
def test_all_methods_keep_hanging_nodes_on_their_edges(name):
    mesh = shared("02_hanging.vtu").mesh
    held, free = gain(mesh, METHODS[name](), 2)
    if name in ("elastic", "optimize"):  # the others do not promise a better average
        assert free.q_avg > held.q_avg


def test_hanging_nodes_stay_on_their_edges_when_a_mesh_is_untangled():
    mesh = shared("02_hanging.vtu").mesh
    motion = js.detect_constraints(mesh)
    free = np.flatnonzero(np.asarray(motion.at(mesh.points).freedom) == mesh.dim)
    free = np.setdiff1d(free, mesh.labels.links.members(len(mesh.points)).nonzero()[0])
    points = np.asarray(mesh.points).copy()
    size = np.ptp(points, axis=0).max()
    points[free] += np.random.default_rng(0).uniform(-0.15, 0.15, points[free].shape) * size
    tangled = mesh.with_points(jnp.asarray(points))
    done = js.smooth(tangled, js.Untangle(), steps=1, constraints=motion)
    assert js.statistics(tangled).inverted > js.statistics(done.mesh).inverted
    assert apart(mesh, done) < 1e-12 * size


def test_optimised_periodic_mesh():
    held, free = gain(periodic_square(), js.Optimize(), 1)
    assert free.q_avg > held.q_avg + 0.05
    assert free.q_min > held.q_min + 0.05


def test_a_contact_along_a_curve_stays():
    """Nodes that neither part may move are held, and nothing has to follow."""
    mesh = shared("14_contact_wavy.vtu").mesh
    motion = js.detect_constraints(mesh)
    links = mesh.labels.links
    assert isinstance(motion, js.Constraints)
    assert (motion.freedom[links.members(len(mesh.points))] == 0).all()
    assert apart(mesh, js.smooth(mesh, steps=2)) == 0


@pytest.mark.parametrize("guard", [PatchGuard(), SmartGuard()])
def test_guards_never_move_one_of_a_pair_alone(guard):
    """Moves that the patches refuse at one end of a link only."""
    mesh = periodic_square()
    points = np.asarray(mesh.points).copy()
    left, right = (np.flatnonzero(points[:, 0] == x) for x in (0, 1))
    points[(points[:, 0] > 0.5) & (points[:, 0] < 1), 0] += 0.18  # elements that bear little, at one end
    mesh = mesh.with_points(jnp.asarray(points))
    motion = js.detect_constraints(mesh)
    wish = np.zeros(points.shape)
    wish[:, 1] = 0.3 * np.sin(7 * points[:, 1])
    move = motion.at(mesh.points).project(jnp.asarray(wish))
    done = jax.jit(guard)(mesh.bare, motion, move, evaluate(mesh.bare))
    moved = np.asarray(done.points) - points
    assert int(done.shortened) > 0
    np.testing.assert_allclose(moved[left], moved[right], atol=TOGETHER)
    full = np.abs(moved - np.asarray(move)).max(axis=1) < 1e-12
    assert (full[left] == full[right]).all()


def graded_hanging():
    """A row of large quadrilaterals below rows of smaller ones, twice: every second node hangs."""
    rows, quads, first = [], [], 0
    for number, low, high in ((3, 0.0, 1.0), (6, 1.0, 1.5), (12, 1.5, 1.75)):
        rows += [np.c_[np.linspace(0, 3, number + 1), np.full(number + 1, y)] for y in (low, high)]
        node = first + np.arange(number)
        quads.append(np.c_[node, node + 1, node + number + 2, node + number + 1])
        first += 2 * (number + 1)
    points, number = np.unique(np.concatenate(rows), axis=0, return_inverse=True)
    return js.as_mesh((points, {"quad": number.reshape(-1)[np.concatenate(quads)]}))


def test_a_patch_of_a_node_that_hangs_is_kept_by_all_that_it_follows():
    """One of its parents stays, the other one goes on: by that alone no patch may become worse."""
    mesh = graded_hanging()
    motion = js.couple(js.Constraints.hold(mesh, []), mesh)
    parents = np.unique(mesh.labels.links.parents)
    points = np.asarray(mesh.points)
    inner = 0.05 * ((points[:, 1:] > 0) & (points[:, 1:] < 1.75))
    guard = jax.jit(PatchGuard(gamma=1.0, poor=0.0, corner=0.0, halvings=2))
    least = jax.jit(lambda mesh: patch_min(mesh, evaluate(mesh).quality))
    project, moved = motion.at(mesh.points).project, 0
    for seed in range(30, 45):
        rng = np.random.default_rng(seed)
        start = mesh.points + project(jnp.asarray(rng.normal(size=points.shape) * inner))
        wish = np.zeros(start.shape)
        wish[rng.choice(parents, 3)] = rng.normal(size=(3, 2)) * 0.1
        here = mesh.bare.with_points(start)
        done = guard(here, motion, project(jnp.asarray(wish)), evaluate(here))
        gone = np.asarray((done.points != start).any(axis=1))
        rise = np.asarray(least(here.with_points(done.points)) - least(here))
        assert (rise[gone] >= -1e-12).all()
        moved += gone.sum()
    assert moved > 10


# --- Matching on request -------------------------------------------------------------------


def shifted_box(move=0.0, axis=1):
    """A box far from the origin; the nodes of the face at its end in x are moved within it."""
    points, blocks = meshes.grid("hexahedron", (2, 3, 3), 0.05)
    points = points * [2, 1, 1] + [10, -3, 0.1]
    low, high = (np.flatnonzero(points[:, 0] == x) for x in (10, 12))
    points[high, 1:] = points[low, 1:]
    points[high[5], axis] += move
    return js.as_mesh((points, blocks)), low, high


@pytest.mark.parametrize("along", ["x", [(2.0, 0, 0)], [(-2.0, 0, 0)]])
def test_opposite_faces_are_matched(along):
    mesh, low, high = shifted_box()
    links = js.find_periodic(mesh, along)
    assert len(links.nodes) == 16
    pairs = {frozenset(pair) for pair in np.c_[links.nodes, links.parents].tolist()}
    assert pairs == {frozenset(pair) for pair in np.c_[low, high].tolist()}
    np.testing.assert_array_equal(links.rotations, np.tile(np.eye(3), (16, 1, 1)))


@pytest.mark.parametrize("precision", [np.float32, np.float64])
def test_faces_are_matched_to_the_precision_of_the_coordinates(precision):
    mesh, *_ = shifted_box()
    turn = meshes.rotation_matrix(3)
    points = (np.asarray(mesh.points) @ turn.T).astype(precision)
    mesh = js.Mesh(points, [("hexahedron", mesh.connectivity[0])])
    assert len(js.find_periodic(mesh, [2 * turn[:, 0]]).nodes) == 16


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("origin", [None, "elsewhere"])
def test_faces_of_a_sector_are_matched(dim, origin):
    points, blocks = meshes.grid("quad" if dim == 2 else "hexahedron", (2,) * dim)
    shift = np.zeros(dim) if origin is None else np.arange(1.0, dim + 1)
    links = js.find_periodic((points + shift, blocks), angle=90, origin=None if origin is None else shift)
    assert len(links.nodes) == 3 ** (dim - 1)
    x, y = points[links.parents[:, 0]][:, :2].T
    np.testing.assert_allclose(points[links.nodes][:, :2], np.c_[-y, x], atol=1e-15)


def test_faces_that_do_not_match_are_told():
    mesh, *_ = shifted_box(1e-4)
    with pytest.raises(ValueError, match=r"the faces do not match: the facet of nodes .* mesh the two faces"):
        js.find_periodic(mesh, "x")
    assert len(js.find_periodic(mesh, "x", tolerance=1e-3).nodes) == 16
    with pytest.raises(ValueError, match=r"no boundary facet lies on another one after the translation by"):
        js.find_periodic(mesh, [(1.5, 0, 0)])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({}, "nothing to find: give axes or vectors"),
        ({"along": "w"}, "periodic axes must be some of x, y, z, got 'w'"),
        ({"along": [(1.0, 0)]}, "a translation must have 3 components"),
        ({"angle": 360}, "the angle must be a number of degrees, no multiple of 360"),
        ({"angle": 90, "axis": "q"}, "the axis must be x, y, z or a vector, got 'q'"),
        ({"angle": 90, "axis": (0, 0, 0)}, "the axis must have three components"),
    ],
)
def test_requests_that_make_no_sense(options, message):
    with pytest.raises(ValueError, match=message):
        js.find_periodic(shifted_box()[0], **options)


def test_the_command_line_ties_faces(tmp_path, capsys):
    mesh = periodic_square()
    source, out = tmp_path / "in.vtu", tmp_path / "out.vtu"
    points = np.c_[np.asarray(mesh.points), np.zeros(len(mesh.points))]
    meshio.write(source, meshio.Mesh(points, [("triangle", np.asarray(mesh.connectivity[0]))]))
    assert command("smooth", source, out, "--periodic", "x", "--steps", 1) == 0
    assert "2 of them following others" in capsys.readouterr().out
    moved = meshio.read(out).points - points
    left, right = (np.flatnonzero(points[:, 0] == x) for x in (0, 1))
    assert np.abs(moved[left]).max() > 1e-3
    np.testing.assert_allclose(moved[left], moved[right], atol=TOGETHER)
    assert command("smooth", source, out, "--force", "--periodic", "xz") == 2
    assert "periodic axes must be some of x, y, got 'xz'" in capsys.readouterr().err


# --- A motion from outside -----------------------------------------------------------------


class OnSphere(js.Motion):
    """Nodes of a mask slide on a sphere; the others go where they like."""

    nodes: jax.Array
    centre: jax.Array

    def at(self, points):
        away = points - self.centre
        normals = away / jnp.linalg.norm(away, axis=1, keepdims=True)
        tangents = jnp.eye(3) - normals[:, :, None] * normals[:, None, :]
        return Admissible(jnp.where(self.nodes[:, None, None], tangents, jnp.eye(3)))

    def retract(self, points, move):
        old, new = points - self.centre, points + move - self.centre
        stretch = jnp.linalg.norm(old, axis=1) / jnp.linalg.norm(new, axis=1)
        return jnp.where(self.nodes[:, None], self.centre + new * stretch[:, None], points + move)

    def within(self, frame):
        return OnSphere(self.nodes, frame.into(self.centre))


def test_a_motion_of_a_user_keeps_nodes_on_a_sphere():
    points, blocks = meshes.grid("hexahedron", (4, 4, 2), 0.1)
    top = points[:, 2] == 1
    inside = ((points[:, :2] > 0) & (points[:, :2] < 1)).all(axis=1)
    centre = np.array([5.0, -2, 3])
    directions = np.c_[points[:, :2] - 0.5, np.ones(len(points))]
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    points = centre + directions * (1 + points[:, 2:])
    file = js.from_meshio(meshio.Mesh(points, blocks, point_sets={"BALL": np.flatnonzero(top & inside)}))
    ball = file.named_sets["BALL"]
    assert ball.sum() == 9
    rest = np.unique(np.concatenate([f.nodes[f.partner < 0].ravel() for f in find_facets(file.mesh)]))
    motion = OnSphere(jnp.asarray(ball), jnp.asarray(centre)) & js.Constraints.hold(
        file.mesh, np.setdiff1d(rest, np.flatnonzero(ball))
    )
    result = js.smooth(file, constraints=motion, steps=3)
    moved = np.linalg.norm(np.asarray(result.mesh.points) - points, axis=1)
    assert moved[ball].max() > 0.02
    radius = np.linalg.norm(np.asarray(result.mesh.points)[ball] - centre, axis=1)
    np.testing.assert_allclose(radius, 2, atol=1e-14)
    first, last = result.history[0].statistics, result.history[-1].statistics
    assert last.q_avg > first.q_avg
    held = js.Constraints.hold(file.mesh, rest)
    assert last.q_avg > js.smooth(file, constraints=held, steps=3).history[-1].statistics.q_avg + 0.01
