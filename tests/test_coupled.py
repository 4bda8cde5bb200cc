"""Nodes that move together: the algebra of their links, against dense linear algebra."""

import equinox as eqx
import jax
import jax.numpy as jnp
import meshes
import numpy as np
import pytest
import reference
from derivatives import check, objective
from test_coupling import refined

import jaxsmooth as js
from jaxsmooth.convert.rigid import rotation_about
from jaxsmooth.mesh.links import NodeLinks
from jaxsmooth.motion.base import Both
from jaxsmooth.numerics.admissible import Links


def constraints_of(mesh, links, projectors):
    """Rows A with A u = 0: what links and tangents say, one by one."""
    count, dim = mesh.points.shape
    rows = []
    for node, parents, weights, rotation in zip(
        links.nodes, links.parents, links.weights, links.rotations, strict=True
    ):
        row = np.zeros((dim, count, dim))
        row[:, node] += np.eye(dim)
        for parent, weight in zip(parents, weights, strict=True):
            row[:, parent] -= weight * rotation
        rows.append(row)
    for node, projector in enumerate(np.asarray(projectors)):
        row = np.zeros((dim, count, dim))
        row[:, node] = np.eye(dim) - projector
        rows.append(row)
    return np.concatenate(rows).reshape(-1, count * dim)


def admissible_fields(admissible):
    """T as a matrix: the displacement of every independent unit field in a column."""
    count, dim = admissible.projectors.shape[:2]
    units = jnp.eye(count * dim).reshape(-1, count, dim)
    return np.asarray(jax.vmap(admissible.expand)(units)).reshape(len(units), -1).T


def compare(mesh, links, base, exact=True):
    """The fields that `couple` admits fulfil all constraints; and, if `exact`, they are all that do."""
    motion = js.couple(base, mesh, links)
    admissible = motion.at(mesh.points)
    rows = constraints_of(mesh, links, base.at(mesh.points).projectors)
    fields = admissible_fields(admissible)
    assert np.abs(rows @ fields).max() < 1e-12
    free = fields.shape[0] - np.linalg.matrix_rank(rows, tol=1e-9)
    if exact:
        assert np.linalg.matrix_rank(fields, tol=1e-9) == free
    assert free > 0
    return motion


def mesh_of(kind, shape, amplitude=0.0):
    points, blocks = meshes.grid(kind, shape, amplitude)
    return js.as_mesh((points, blocks))


def everything_free(mesh):
    return js.Constraints.hold(mesh, [])


@pytest.mark.parametrize("slide", [True, False])
def test_a_box_that_is_periodic_along_all_axes(slide):
    mesh = mesh_of("hexahedron", (2, 2, 2))
    links = js.find_periodic(mesh, "xyz")
    base = js.detect_constraints(mesh) if slide else everything_free(mesh)
    motion = compare(mesh, links, base)
    points = np.asarray(mesh.points)
    corners = np.flatnonzero((points % 1 == 0).all(axis=1))
    followers = np.asarray(motion.links.dependent) if slide else np.sort(np.asarray(motion.links.dependent))
    assert slide == (not np.isin(corners, followers).any())  # held where they may not slide
    if not slide:
        assert np.isin(corners, followers).sum() == 7  # one leads the group of 8
        leader = np.setdiff1d(corners, followers)
        rows = np.isin(followers, corners)
        assert (np.asarray(motion.links.parents)[np.argsort(motion.links.dependent)][rows] == leader).all()
    np.testing.assert_array_equal(motion.freedom, motion.at(mesh.points).freedom)
    np.testing.assert_array_equal(motion.freedom, base.freedom)


@pytest.mark.parametrize("dim", [2, 3])
def test_a_sector_moves_along_its_axis_only(dim):
    mesh = mesh_of("quad" if dim == 2 else "hexahedron", (2,) * dim)
    links = js.find_periodic(mesh, angle=90)
    points = np.asarray(mesh.points)
    axis = np.flatnonzero((points[:, :2] == 0).all(axis=1))
    motion = compare(mesh, links, everything_free(mesh))
    freedom = motion.freedom
    assert (freedom[axis] == dim - 2).all()
    assert (np.delete(freedom, axis) == dim).all()
    if dim == 3:
        np.testing.assert_allclose(
            motion.at(mesh.points).projectors[axis], np.tile(np.diag([0.0, 0, 1]), (len(axis), 1, 1))
        )


def test_turned_chains_hold_what_contradicts_itself():
    """Three nodes in a circle of links, whose turns do not close: only along the common axis they move."""
    mesh = mesh_of("tetra", (1, 1, 1))
    turn = rotation_about((1, 1, 0), 40, 3)
    links = NodeLinks.join(
        [NodeLinks.pairs([[1, 0]], turn), NodeLinks.pairs([[2, 1]], turn), NodeLinks.pairs([[0, 2]], turn)]
    )
    motion = compare(mesh, links, everything_free(mesh))
    assert (motion.freedom[[0, 1, 2]] == 1).all()
    assert (motion.freedom[3:] == 3).all()


def test_a_group_does_what_all_its_members_may():
    mesh = mesh_of("hexahedron", (2, 2, 2))
    links = NodeLinks.pairs([[1, 0], [2, 1], [5, 4]], np.eye(3))
    tangents = np.tile(np.eye(3), (len(mesh.points), 1, 1))
    tangents[0], tangents[2] = np.diag([1.0, 1, 0]), np.diag([1.0, 0, 1])
    tangents[5] = 0  # a held member holds its group
    motion = compare(mesh, links, js.Constraints(jnp.asarray(tangents)))
    np.testing.assert_array_equal(motion.freedom[[0, 1, 2, 4, 5]], [1, 1, 1, 0, 0])
    assert 5 not in np.asarray(motion.links.dependent)  # it has nobody to follow


@pytest.mark.parametrize("parts", [2, 4])
def test_hanging_nodes_follow(parts):
    points, nodes, hanging, _ = refined(parts)
    mesh = js.as_mesh((points, {"hexahedron": nodes}))
    motion = js.detect_constraints(mesh)
    base = js.detect_constraints(mesh.with_labels(js.Labels(regions=())))
    free = everything_free(mesh)
    compare(mesh, mesh.labels.links, free)
    # those on the edges of the box slide with the corners; all of the others follow these
    np.testing.assert_array_equal(np.sort(motion.links.dependent), np.flatnonzero(hanging))
    # the corners of the face between the two lie on edges of the box, and slide along them
    corners = np.unique(mesh.labels.links.parents)
    np.testing.assert_array_equal(motion.freedom[corners], 1)
    np.testing.assert_array_equal(base.freedom[corners], 0)


def test_nodes_that_hang_on_hanging_ones_and_on_followers():
    """Chains through both kinds of links, with a common turn."""
    mesh = mesh_of("hexahedron", (2, 2, 2))
    turn = rotation_about("z", 90, 3)
    links = NodeLinks.join(
        [
            NodeLinks.hanging(np.array([2]), np.array([[0, 1]]), np.array([[0.5, 0.5]]), 3),
            NodeLinks.hanging(np.array([3]), np.array([[0, 2]]), np.array([[0.5, 0.5]]), 3),
            NodeLinks.hanging(np.array([3]), np.array([[0, 1]]), np.array([[0.75, 0.25]]), 3),  # the same
            NodeLinks.hanging(np.array([9]), np.array([[7, 8]]), np.array([[0.25, 0.75]]), 3),
            NodeLinks.pairs([[7, 0], [8, 1], [10, 9]], turn),
        ]
    )
    motion = compare(mesh, links, everything_free(mesh))
    found = dict(zip(np.asarray(motion.links.dependent).tolist(), range(99), strict=False))
    assert set(found) == {2, 3, 7, 8, 9, 10}
    row = found[3]
    np.testing.assert_array_equal(
        np.sort(np.c_[motion.links.parents[row], motion.links.weights[row]], axis=0), [[0, 0.25], [1, 0.75]]
    )
    np.testing.assert_allclose(motion.links.rotations[found[10]], turn @ turn, atol=1e-15)


@pytest.mark.parametrize("kind", ["turned", "other"])
def test_links_that_fit_no_rotation_hold_their_nodes(kind):
    mesh = mesh_of("hexahedron", (2, 2, 2))
    parts = [NodeLinks.hanging(np.array([5]), np.array([[2, 3]]), np.array([[0.5, 0.5]]), 3)]
    if kind == "turned":  # one parent of node 5 leads, the other is turned against its leader
        parts.append(NodeLinks.pairs([[3, 1]], rotation_about("x", 30, 3)))
    else:
        parts.append(NodeLinks.hanging(np.array([5]), np.array([[2, 1]]), np.array([[0.5, 0.5]]), 3))
    motion = compare(mesh, NodeLinks.join(parts), everything_free(mesh), exact=False)
    freedom = motion.at(mesh.points).freedom
    assert (freedom[[1, 2, 3, 5]] == 0).all()
    assert (freedom[[0, 4, *range(6, len(freedom))]] == 3).all()


def test_a_node_hangs_on_parents_that_may_do_no_more_than_it():
    mesh = mesh_of("hexahedron", (2, 2, 2))
    links = NodeLinks.hanging(np.array([2]), np.array([[0, 1]]), np.array([[0.5, 0.5]]), 3)
    tangents = np.tile(np.eye(3), (len(mesh.points), 1, 1))
    tangents[2] = np.diag([1.0, 0, 1])
    motion = compare(mesh, links, js.Constraints(jnp.asarray(tangents)), exact=False)
    np.testing.assert_array_equal(motion.freedom[[0, 1, 2]], 2)
    tangents[2] = 0
    motion = js.couple(js.Constraints(jnp.asarray(tangents)), mesh, links)
    assert isinstance(motion, js.Constraints)
    np.testing.assert_array_equal(motion.freedom[[0, 1, 2]], 0)


# --- Moving --------------------------------------------------------------------------------


def periodic_square():
    mesh = mesh_of("triangle", (3, 3), 0.08)
    points = np.asarray(mesh.points).copy()
    left, right = (np.flatnonzero(points[:, 0] == x) for x in (0, 1))
    points[left, 1] += [0, 0.05, -0.08, 0]
    points[right, 1] = points[left, 1]
    mesh = mesh.with_points(jnp.asarray(points))
    return mesh.with_links(js.find_periodic(mesh, "x"))


def hanging_square():
    """One large square beside four small ones beside one large one, deformed."""
    points, nodes, *_ = refined(2)
    flat = np.unique(np.round(points[points[:, 2] == 0][:, :2], 12), axis=0)
    number = {tuple(p): i for i, p in enumerate(flat)}
    quads = [
        [number[tuple(np.round(points[n][:2], 12))] for n in e[:4]] for e in nodes if points[e[0], 2] == 0
    ]
    more = np.array([[0.0, 2], [1, 2], [2, 2]])
    top = [number[0, 1], number[1, 1], number[1.5, 1], number[2, 1]]
    first = len(flat)
    quads += [[top[0], top[1], first + 1, first], [top[1], top[3], first + 2, first + 1]]
    flat = np.concatenate([flat, more])
    flat[number[1, 1]] += [0.1, -0.07]
    flat[number[1.5, 0.5]] += [0.05, 0.1]
    flat[number[1, 0.5]] = (flat[number[1, 0]] + flat[number[1, 1]]) / 2
    flat[number[1.5, 1]] = (flat[number[1, 1]] + flat[number[2, 1]]) / 2
    return js.as_mesh((flat, {"quad": np.array(quads)}))


MADE = {"periodic": periodic_square, "hanging": hanging_square}


@pytest.mark.parametrize("name", MADE)
def test_one_step_against_the_lagrange_system(name):
    mesh = MADE[name]()
    motion = js.detect_constraints(mesh)
    assert isinstance(motion, js.Coupled)
    points = np.asarray(mesh.points)
    blocks = {t: np.asarray(c) for t, c in zip(mesh.types, mesh.connectivity, strict=True)}
    stiffness, force = reference.assemble(points, blocks), reference.forces(points, blocks)
    plain = motion.base.at(mesh.points).projectors
    rows = constraints_of(mesh, mesh.labels.links, plain)
    system = np.block([[stiffness.toarray(), rows.T], [rows, np.zeros((len(rows),) * 2)]])
    right = np.r_[force.ravel(), np.zeros(len(rows))]
    expected = np.linalg.lstsq(system, right, rcond=1e-12)[0][: force.size].reshape(force.shape)
    method = js.Elastic(guard=None, tolerance=1e-13)
    moved = jax.jit(js.step)(mesh.bare, method, motion).points
    assert np.abs(expected).max() > 1e-3
    np.testing.assert_allclose(moved - points, expected, atol=1e-11)


@pytest.mark.parametrize("name", MADE)
def test_derivatives_of_runs(name):
    mesh = MADE[name]()
    motion, bare = js.detect_constraints(mesh), mesh.bare
    rng = np.random.default_rng(0)
    weights, direction = rng.normal(size=(2, *mesh.points.shape))

    def function(points):
        return objective(js.run(bare.with_points(points), constraints=motion, steps=2), weights)

    check(function, mesh.points, jnp.asarray(direction), step=1e-6, rtol=1e-5)


def test_a_batch_of_points_moves_as_each_does():
    mesh = periodic_square()
    motion, bare = js.detect_constraints(mesh), mesh.bare
    scales = jnp.asarray([1.0, 1.1])

    def final(scale):
        points = mesh.points * jnp.stack([jnp.ones(()), scale])
        return js.run(bare.with_points(points), constraints=motion, steps=2).points

    batch = jax.jit(jax.vmap(final))(scales)
    for scale, points in zip(scales, batch, strict=True):
        np.testing.assert_allclose(points, jax.jit(final)(scale), atol=1e-12)


def test_a_fixed_point_keeps_pairs_together():
    mesh = periodic_square()
    motion = js.detect_constraints(mesh)
    found = js.fixed_point(mesh.bare, js.Elastic(guard=None), constraints=motion, tolerance=1e-8)
    assert float(found.change) <= 1e-8
    points = np.asarray(found.mesh.points)
    left, right = (np.flatnonzero(points[:, 0] == x) for x in (0, 1))
    np.testing.assert_allclose(points[left, 1], points[right, 1], atol=1e-13)
    again = js.step(found.mesh, js.Elastic(guard=None, tolerance=1e-12), motion).points
    np.testing.assert_allclose(again, points, atol=1e-6)


def test_stack_says_what_to_do():
    mesh = periodic_square()
    with pytest.raises(ValueError, match="mesh 1 has Coupled; detect them"):
        js.stack([mesh.with_labels(None), mesh])
    held = js.Constraints.hold(mesh, mesh.labels.links.members(len(mesh.points)))
    assert len(js.stack([mesh], [held]).points()) == 1


def test_links_of_another_mesh_are_refused():
    mesh = periodic_square()
    with pytest.raises(ValueError, match="the links are for 2D, the mesh is 3D"):
        mesh_of("hexahedron", (1, 1, 1)).with_links(mesh.labels.links)
    with pytest.raises(ValueError, match="a linked node is out of range; the mesh has 4 nodes"):
        mesh_of("quad", (1, 1)).with_links(mesh.labels.links)


def test_links_are_given_all_at_once():
    mesh = periodic_square()
    coupled = js.detect_constraints(mesh)
    with pytest.raises(ValueError, match="can't be coupled again; give it all links at once"):
        js.couple(coupled, mesh)
    with pytest.raises(ValueError, match="give all links to one of them"):
        (coupled & coupled).at(mesh.points)


# --- Two motions ---------------------------------------------------------------------------


class Bent(js.Motion):
    """Nodes that may go anywhere, on paths that bend."""

    nodes: int = eqx.field(static=True)

    def at(self, points):
        return everything_free(js.as_mesh((points, {"quad": [[0, 1, 2, 3]]}))).at(points)

    def retract(self, points, move):
        return points + move + move**2


@pytest.mark.parametrize("first", [True, False])
def test_what_binds_a_follower_binds_those_it_follows(first):
    mesh = periodic_square()
    coupled = js.detect_constraints(mesh)
    follower = int(coupled.links.dependent[0])
    leader = int(coupled.links.parents[0, 0])
    other = js.Constraints.hold(mesh, [follower])
    both = coupled & other if first else other & coupled
    freedom = both.at(mesh.points).freedom
    assert freedom[follower] == freedom[leader] == 0
    rest = np.setdiff1d(np.arange(len(freedom)), [follower, leader])
    np.testing.assert_array_equal(freedom[rest], coupled.freedom[rest])


@pytest.mark.parametrize("first", [True, False])
def test_followers_stay_with_their_leaders_on_any_path(first):
    mesh = periodic_square()
    coupled, bent = js.detect_constraints(mesh), Bent(len(mesh.points))
    both = Both(coupled, bent) if first else Both(bent, coupled)
    wish = jnp.asarray(np.random.default_rng(1).normal(size=mesh.points.shape))
    new = both.retract(mesh.points, both.at(mesh.points).project(0.1 * wish))
    moved = np.asarray(new - mesh.points)
    links = coupled.links
    assert np.abs(moved[links.dependent]).max() > 0.01
    np.testing.assert_allclose(moved[links.dependent], moved[links.parents[:, 0]], atol=1e-15)


def test_links_place_nodes_exactly():
    """Nodes of one place stay in one place, and those whose parents stay are not even rounded."""
    rng = np.random.default_rng(0)
    old = rng.normal(size=(6, 3)) * 10.0 ** rng.integers(-3, 3, (6, 1))
    old[1] = old[0]
    turn = rotation_about("x", 33, 3)
    links = Links(
        jnp.asarray([1, 3]),
        jnp.asarray([[0], [2]]),
        jnp.ones((2, 1)),
        jnp.asarray(np.stack([np.eye(3), turn])),
    )
    new = jnp.asarray(old).at[0].add(rng.normal(size=3))
    placed = links.carried(jnp.asarray(old), new)
    np.testing.assert_array_equal(placed[1], placed[0])
    np.testing.assert_array_equal(placed[3], old[3])
