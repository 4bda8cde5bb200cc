"""The elastic method: reference runs, symmetries, weights, and meshes that are no good."""

import jax
import jax.numpy as jnp
import meshes
import numpy as np
import pytest
import reference

from jaxsmooth.mesh.record import Mesh
from jaxsmooth.methods.elastic.method import Elastic
from jaxsmooth.metrics import evaluation as patches
from jaxsmooth.motion.detect import detect_constraints
from jaxsmooth.motion.planar import Constraints

evaluate = jax.jit(patches.evaluate)
EXACT = Elastic(guard=None, tolerance=1e-12)


@jax.jit
def step(method, mesh, constraints):
    return method.step(mesh, constraints, patches.evaluate(mesh))


def averages(mesh, constraints, steps):
    found = [float(np.concatenate(evaluate(mesh).quality).mean())]
    for _ in range(steps):
        result = step(EXACT, mesh, constraints)
        mesh = mesh.with_points(result.points)
        found.append(float(np.concatenate(result.evaluation.quality).mean()))
    return found


# --- The reference runs of another implementation (Lagrange system, 5 steps) ------------


def trilinear(points, corners):
    """Unit cube (square) to the block with these corners."""
    value = 0
    for place, corner in zip(
        meshes.ideal_corners("hexahedron" if len(corners) == 8 else "quad"), corners, strict=True
    ):
        value = value + np.prod(np.where(place == 1, points, 1 - points), axis=1)[:, None] * np.array(
            corner, float
        )
    return value


def serendipity(points, nodes):
    """Unit square to the 8-node block, by the textbook shape functions."""
    r, s = (2 * points - 1).T
    value = 0
    for a, b, node in zip((-1, 1, 1, -1, 0, 1, 0, -1), (-1, -1, 1, 1, -1, 0, 1, 0), nodes, strict=True):
        if a and b:
            n = (1 + a * r) * (1 + b * s) * (a * r + b * s - 1) / 4
        elif a:
            n = (1 + a * r) * (1 - s**2) / 2
        else:
            n = (1 - r**2) * (1 + b * s) / 2
        value = value + n[:, None] * np.array(node, float)
    return value


BLOCK = [(1, 0), (2, 0), (0, 2), (0, 1), (1.5, 0), (1.5, 1.5), (0, 1.5), (0.7, 0.7)]
HEXAHEDRON = [(0, 0, 0), (2, 0, 0), (2, 1, 0), (0, 1, 0), (0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1)]


def chord_constraints(points, facets):
    """One normal a facet, of its chord, at all its nodes; normals 1e-4 apart are distinct."""
    normals = {}
    for facet in facets:
        t = points[facet[1]] - points[facet[0]]
        for node in facet:
            normals.setdefault(int(node), []).append(np.array([t[1], -t[0]]) / np.linalg.norm(t))
    projectors = np.tile(np.eye(2), (len(points), 1, 1))
    for node, found in normals.items():
        single = all(np.abs(n - found[0]).max() <= 1e-4 for n in found)
        projectors[node] = single * (np.eye(2) - np.outer(found[0], found[0]))
    return Constraints(jnp.asarray(projectors))


def outer_facets(blocks):
    """Corner and mid-side nodes of the element sides that occur once."""
    ((kind, nodes),) = blocks.items()
    corners = meshes.CORNERS[meshes.LINEAR[kind]]
    sides = [
        (element[a], element[b], element[corners + i])
        for element in nodes
        for i, (a, b) in enumerate(meshes.EDGES[meshes.LINEAR[kind]])
    ]
    count = {}
    for side in sides:
        count[frozenset(side)] = count.get(frozenset(side), 0) + 1
    return [side for side in sides if count[frozenset(side)] == 1]


RUNS = {
    "quad": ((2, 2), [1.0, 1.0, 1.0, 1.0, 1.0, 1.0]),
    "triangle": ((2, 2), [0.8915, 0.9363, 0.9474, 0.9500, 0.9506, 0.9507]),
    "hexahedron": ((3, 3, 3), [0.8932, 0.9460, 0.9530, 0.9542, 0.9544, 0.9545]),
    "quad8": ((3, 6), [0.9824, 0.9887, 0.9895, 0.9895, 0.9896, 0.9896]),
    "triangle6": ((3, 6), [0.8723, 0.8941, 0.8941, 0.8957, 0.8958, 0.8963]),
}


@pytest.mark.parametrize("kind", RUNS)
def test_reference_runs(kind):
    shape, expected = RUNS[kind]
    points, blocks = meshes.grid(kind, shape)
    if kind == "hexahedron":
        points = trilinear(points, HEXAHEDRON)
    if kind in ("quad8", "triangle6"):
        points = serendipity(points, BLOCK)
        constraints = chord_constraints(points, outer_facets(blocks))
    else:
        constraints = detect_constraints(Mesh(points, blocks))
    found = averages(Mesh(points, blocks), constraints, 5)
    np.testing.assert_allclose(found, expected, rtol=0, atol=5e-4)


# --- Properties of a step --------------------------------------------------------------


MESHES = {"2d": lambda: meshes.mixed_2d(0.1), "3d": lambda: meshes.hexahedra_and_pyramids(0.1)}


@pytest.fixture(scope="module", params=MESHES)
def mixed(request):
    return MESHES[request.param]()


def lattice():
    """Equilateral triangles: a rhombus of 3 × 3 cells."""
    points, blocks = meshes.grid("triangle", (3, 3))
    cells = blocks["triangle"].reshape(2, 9, 3)  # cut along (0,0)–(1,1): lean the square the other way
    lean = np.array([[1, -0.5], [0, 3**0.5 / 2]])
    return points @ lean.T, {"triangle": cells.reshape(18, 3)}


@pytest.mark.parametrize(("name", "extended"), [("quad", True), ("triangle", False), ("hexahedron", True)])
def test_a_perfect_mesh_does_not_move(name, extended):
    points, blocks = lattice() if name == "triangle" else meshes.grid(name)
    mesh = Mesh(points, blocks)
    np.testing.assert_allclose(np.concatenate(evaluate(mesh).quality), 1, atol=1e-12)
    method = Elastic(guard=None, tolerance=1e-12, extended=extended)
    result = step(method, mesh, detect_constraints(mesh))
    np.testing.assert_allclose(result.points, points, atol=1e-12)
    assert np.isfinite(float(result.residual))


@pytest.mark.parametrize("extended", [False, True])
def test_rotation_scale_and_translation(mixed, extended):
    points, blocks = mixed
    method = Elastic(guard=None, tolerance=1e-12, extended=True) if extended else Elastic(tolerance=1e-12)
    turn = meshes.rotation_matrix(points.shape[1], 3)

    def change(x):
        return 1e3 * np.asarray(x) @ turn.T + 50

    def smoothed(points):
        mesh = Mesh(points, blocks)
        return step(method, mesh, detect_constraints(mesh)).points

    np.testing.assert_allclose(smoothed(change(points)), change(smoothed(points)), rtol=0, atol=1e-7)
    assert np.abs(np.asarray(smoothed(points)) - points).max() > 1e-3


def test_node_and_element_renumbering(mixed):
    points, blocks = mixed
    rng = np.random.default_rng(0)
    order = rng.permutation(len(points))
    number = np.argsort(order)
    shuffled = {kind: number[rng.permutation(nodes)] for kind, nodes in blocks.items()}
    for kind, nodes in shuffled.items():  # and the nodes within elements
        for i in range(0, len(nodes), 2):
            nodes[i] = nodes[i][list(meshes.SYMMETRIES[kind][0])]
    method = Elastic(tolerance=1e-12)
    first, second = (
        step(method, mesh, detect_constraints(mesh))
        for mesh in (Mesh(points, blocks), Mesh(points[order], shuffled))
    )
    np.testing.assert_allclose(np.asarray(first.points)[order], second.points, rtol=0, atol=1e-10)


@pytest.mark.parametrize("alpha", [1.0, 0.9])
def test_extended_weights(mixed, alpha):
    """Eqs. 35 and 36 computed again: (1 − q) / (1 − q_min) times the element forces."""
    points, blocks = mixed
    mesh = Mesh(points, blocks)
    q = dict(zip(blocks, map(np.asarray, evaluate(mesh).quality), strict=True))
    least = min(part.min() for part in q.values())
    weights = {kind: (1 - part) / (1 - least) for kind, part in q.items()}
    assert max(w.max() for w in weights.values()) == 1
    force = reference.forces(points, blocks, weights, alpha)
    axes = np.eye(points.shape[1])
    normals = [axes[s] for s in meshes.box_normals(points)]
    expected = reference.lagrange(reference.assemble(points, blocks), force, normals)
    method = Elastic(guard=None, tolerance=1e-12, extended=True, alpha=alpha)
    found = np.asarray(step(method, mesh, detect_constraints(mesh)).points) - points
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9 * np.abs(expected).max())


def test_float32(mixed):
    points, blocks = mixed
    found = []
    for dtype in (np.float64, np.float32):
        mesh = Mesh(points.astype(dtype), blocks)
        constraints = detect_constraints(mesh)
        for _ in range(3):
            result = step(Elastic(), mesh, constraints)
            assert result.points.dtype == dtype
            assert all(q.dtype == dtype for q in result.evaluation.quality)
            mesh = mesh.with_points(result.points)
        found.append(np.concatenate(result.evaluation.quality).astype(float))
    assert found[0].mean() > np.concatenate(evaluate(Mesh(points, blocks)).quality).mean() + 0.01
    assert found[1].mean() == pytest.approx(found[0].mean(), abs=1e-3)


@pytest.mark.parametrize(("guarded", "extended"), [(False, False), (True, False), (False, True)])
@pytest.mark.parametrize("fault", ["flat", "inverted", "collapsed"])
def test_bad_elements_give_finite_moves(mixed, fault, guarded, extended):
    points, blocks = mixed
    first = next(iter(blocks.values()))[0]
    bad, mesh = points.copy(), Mesh(points, blocks)
    inside = [n for n, s in enumerate(meshes.box_normals(points)) if len(s) < points.shape[1]]
    node = next(n for n in first if n in inside)
    others = [n for n in first if n != node]
    if fault == "flat":
        bad[node] = bad[others[:2]].mean(axis=0)
    elif fault == "inverted":
        bad[node] = 3 * bad[others].mean(axis=0) - 2 * bad[node]
    else:
        bad[first] = bad[others[0]]
    constraints = detect_constraints(mesh)
    method = (Elastic(extended=extended) if guarded else Elastic(guard=None, extended=extended)).loosely()
    result = step(method, mesh.with_points(jnp.asarray(bad)), constraints)
    assert np.isfinite(result.points).all()
    assert np.abs(np.asarray(result.points) - bad).max() < 2
    assert float(result.residual) <= method.tolerance
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(result.evaluation))


@pytest.mark.parametrize("kind", ["triangle", "pyramid", "hexahedron"])
def test_one_free_element_becomes_ideal_and_keeps_its_measure(kind):
    nodes = meshes.distorted(kind)
    mesh = Mesh(nodes, {kind: np.arange(len(nodes))[None]})
    hold = Constraints.hold(mesh, [])
    result = step(EXACT, mesh, hold)
    # without constraints the solution is the target itself, up to a small linearised rigid motion
    lengths = np.linalg.norm(np.diff(np.asarray(result.points)[meshes.EDGES[kind]], axis=1)[:, 0], axis=1)
    size = (abs(reference.measure(kind, nodes)) / meshes.UNIT_MEASURE[kind]) ** (1 / nodes.shape[1])
    np.testing.assert_allclose(lengths, size, rtol=2e-2)
    for held in (None, [0, 1]):
        constraints = detect_constraints(mesh, fixed=held)
        assert (constraints.freedom == 0).all()  # every corner of an element alone is a corner
        np.testing.assert_array_equal(step(EXACT, mesh, constraints).points, nodes)


@pytest.mark.parametrize("seed", range(4))
def test_a_tangled_mesh_gets_no_worse(mixed, seed):
    points, blocks = mixed
    rng = np.random.default_rng(seed)
    move = 0.25 * rng.normal(size=points.shape) * ((points > 1e-9) & (points < 1 - 1e-9))
    constraints = detect_constraints(Mesh(points, blocks))
    mesh = Mesh(points + move, blocks)
    before = np.concatenate(evaluate(mesh).jacobian)
    assert (before <= 0).any()
    inverted = before <= 0
    for _ in range(3):
        result = step(Elastic(), mesh, constraints)
        mesh = mesh.with_points(result.points)
        now = np.concatenate(evaluate(mesh).jacobian) <= 0
        assert not (now & ~inverted).any()  # no element is inverted that was not
        inverted = now


@pytest.mark.parametrize("kind", ["triangle6", "tetra", "wedge15", "pyramid"])
def test_three_guarded_steps_improve_and_stay_valid(kind):
    points, blocks = meshes.grid(kind, amplitude=0.12)
    mesh = Mesh(points, blocks)
    constraints = detect_constraints(mesh)
    first = np.concatenate(evaluate(mesh).quality)
    for _ in range(3):
        result = step(Elastic(), mesh, constraints)
        mesh = mesh.with_points(result.points)
    assert np.concatenate(result.evaluation.quality).mean() > first.mean() + 0.005
    assert np.concatenate(result.evaluation.jacobian).min() > 0
    side = meshes.box_normals(points)
    for node, sides in enumerate(side):
        np.testing.assert_allclose(np.asarray(mesh.points)[node, sides], points[node, sides], atol=1e-12)
