"""The Laplacian family against an explicit node-by-node reference in NumPy."""

from itertools import pairwise

import jax
import jax.numpy as jnp
import meshes
import numpy as np
import pytest

from jaxsmooth.mesh.record import Mesh
from jaxsmooth.methods import METHODS, Elastic, Laplacian
from jaxsmooth.metrics.evaluation import evaluate
from jaxsmooth.motion.detect import detect_constraints
from jaxsmooth.motion.planar import Constraints
from jaxsmooth.runs.driver import smooth

EXACT = 1e-12  # float64, meshes of unit size
evaluated = jax.jit(evaluate)
stepped = jax.jit(lambda method, mesh, held, before, state: method.step(mesh, held, before, state))


def grid(kind, cells=3, amplitude=0.3, seed=0):
    """A box of cubic cells of one type, inner nodes displaced by a part of the cell size."""
    dim = meshes.dim_of(kind)
    base = meshes.LINEAR[kind]
    corners = np.stack(np.meshgrid(*[np.arange(cells + 1.0)] * dim, indexing="ij"), axis=-1).reshape(-1, dim)
    number = {tuple(c.astype(int)): i for i, c in enumerate(corners)}
    cuts = {
        "triangle": [(0, 1, 2), (0, 2, 3)],
        "quad": [(0, 1, 2, 3)],
        "tetra": [(0, 1, 2, 6), (0, 2, 3, 6), (0, 3, 7, 6), (0, 7, 4, 6), (0, 4, 5, 6), (0, 5, 1, 6)],
        "wedge": [(0, 1, 2, 4, 5, 6), (0, 2, 3, 4, 6, 7)],
        "hexahedron": [tuple(range(8))],
    }[base]
    ring = np.array([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1)])
    elements = []
    for origin in np.ndindex(*[cells] * dim):
        spots = [tuple(np.array(origin) + r[:dim]) for r in ring[: 2**dim]]
        elements += [[number[spots[c]] for c in cut] for cut in cuts]
    random = np.random.default_rng(seed)
    inside = ((corners > 0) & (corners < cells)).all(axis=1)
    points = corners + amplitude * random.uniform(-1, 1, corners.shape) * inside[:, None]
    if kind == base:
        return Mesh(points, {kind: elements})
    points, grown, known = list(points), [], {}
    for element in elements:
        own = []
        for group in meshes.groups(kind):
            key = tuple(sorted(element[c] for c in group))
            if len(key) > 1 and key not in known:
                known[key] = len(points)
                points.append(np.mean([points[n] for n in key], axis=0))
            own.append(key[0] if len(key) == 1 else known[key])
        grown.append(own)
    return Mesh(np.array(points), {kind: grown})


def neighbours(mesh):
    """Sets of connected nodes, one by one from the table of edges."""
    found = [set() for _ in mesh.points]
    for name, nodes in zip(mesh.types, mesh.connectivity, strict=True):
        base = meshes.LINEAR[name]
        groups = meshes.groups(name)
        for element in np.asarray(nodes):
            for edge in meshes.EDGES[base]:
                path = [element[edge[0]], element[edge[1]]]
                if name != base:
                    path.insert(1, element[groups.index(edge)])
                for a, b in pairwise(path):
                    found[a].add(b)
                    found[b].add(a)
    return found


def classical(mesh, node, near):
    points = np.asarray(mesh.points)
    return np.mean([points[n] for n in sorted(near[node])], axis=0) - points[node]


def weighted(mesh, node, _):
    """Eq. 38 for straight triangles, parallelograms and tetrahedra: centroid and measure."""
    points, top, bottom = np.asarray(mesh.points), 0.0, 0.0
    for nodes in mesh.connectivity:
        for element in np.asarray(nodes):
            if node in element:
                corners = points[element]
                volume = abs(np.linalg.det(corners[1 : len(corners[0]) + 1] - corners[0]))
                top, bottom = top + volume * (corners.mean(axis=0) - points[node]), bottom + volume
    return top / bottom


def patch_minima(mesh, evaluation):
    least = np.full(len(mesh.points), np.inf)
    for nodes, q in zip(mesh.connectivity, evaluation.quality, strict=True):
        for element, value in zip(np.asarray(nodes), np.asarray(q), strict=True):
            least[element] = np.minimum(least[element], value)
    return least


def smart_reference(mesh, move):
    """The rule of `SmartGuard`, one node after another; also checks that every move pays."""
    elements = [set(map(int, e)) for nodes in mesh.connectivity for e in np.asarray(nodes)]
    rivals = [set().union(*(e for e in elements if node in e)) for node in range(len(mesh.points))]
    waiting = {node for node in range(len(mesh.points)) if np.abs(move[node]).max() > 0}
    points = np.array(mesh.points)
    while True:
        least = patch_minima(mesh, evaluated(mesh.with_points(jnp.asarray(points))))
        gain = {}
        for node in waiting:
            trial = points.copy()
            trial[node] += move[node]
            after = evaluated(mesh.with_points(jnp.asarray(trial)))
            if min(float(det.min()) for det in after.jacobian) > 0:
                gain[node] = patch_minima(mesh, after)[node] - least[node]
        best = [n for n in gain if gain[n] > 1e-14 and all(gain[n] >= gain.get(r, 0) for r in rivals[n])]
        if not best:
            return points
        for node in best:
            points[node] += move[node]
        risen = patch_minima(mesh, evaluated(mesh.with_points(jnp.asarray(points))))
        assert all(risen[node] > least[node] for node in best)
        waiting -= set(best)


KINDS = ("triangle", "quad", "tetra", "wedge", "hexahedron", "triangle6", "quad8", "tetra10", "hexahedron20")


@pytest.mark.parametrize("kind", KINDS)
def test_classical_displacement(kind):
    mesh = grid(kind, cells=2)
    held = detect_constraints(mesh)
    move = Laplacian().propose(mesh, held, evaluated(mesh), Laplacian().init(mesh)).move
    near = neighbours(mesh)
    expected = np.array([classical(mesh, n, near) for n in range(len(mesh.points))])
    expected = np.einsum("nij,nj->ni", held.projectors, expected)
    np.testing.assert_allclose(move, expected, atol=EXACT)


@pytest.mark.parametrize("kind", ["triangle", "tetra"])
def test_weighted_displacement(kind):
    mesh = grid(kind, cells=2)
    held = detect_constraints(mesh)
    move = Laplacian(weighted=True).propose(mesh, held, evaluated(mesh)).move
    expected = np.array([weighted(mesh, n, None) for n in range(len(mesh.points))])
    np.testing.assert_allclose(move, np.einsum("nij,nj->ni", held.projectors, expected), atol=EXACT)


def test_centroid_of_a_trapezium_is_that_of_its_area():
    mesh = Mesh([[0, 0], [3, 0], [1, 1], [0, 1]], {"quad": [[0, 1, 2, 3]]})
    free = Constraints(jnp.tile(jnp.eye(2), (4, 1, 1)))
    move = Laplacian(weighted=True).propose(mesh, free, evaluated(mesh)).move
    # parts: unit square at (1/2, 1/2), triangle of area 1 at (5/3, 1/3)
    np.testing.assert_allclose(mesh.points[0] + move[0], [13 / 12, 5 / 12], atol=EXACT)


@pytest.mark.parametrize("weights", [False, True])
@pytest.mark.parametrize("kind", ["triangle", "quad", "tetra", "triangle6"])
def test_smart_step_is_the_reference(kind, weights):
    mesh = grid(
        kind, cells=3 if meshes.dim_of(kind) == 2 else 2, amplitude=0.2 if kind == "triangle6" else 0.35
    )
    held = detect_constraints(mesh)
    method = Laplacian(smart=True, weighted=weights)
    before = evaluated(mesh)
    state = method.init(mesh)
    move = np.asarray(method.propose(mesh, held, before, state).move)
    step = stepped(method, mesh, held, before, state)
    np.testing.assert_allclose(step.points, smart_reference(mesh, move), atol=EXACT)
    after = evaluated(mesh.with_points(step.points))
    np.testing.assert_allclose(step.evaluation.quality[0], after.quality[0], atol=EXACT)
    assert min(q.min() for q in after.quality) >= min(q.min() for q in before.quality)


@pytest.mark.parametrize("name", [name for name in METHODS if "laplacian" in name])
@pytest.mark.parametrize("kind", ["quad", "tetra"])
def test_numbering_does_not_matter(name, kind):
    mesh = grid(kind, cells=3)
    random = np.random.default_rng(3)
    order = random.permutation(len(mesh.points))  # new number of every old node
    points = np.empty_like(mesh.points)
    points[order] = mesh.points
    elements = random.permutation(order[np.asarray(mesh.connectivity[0])])
    other = Mesh(points, {kind: elements})
    ours, theirs = (smooth(m, METHODS[name](), steps=3, tolerance_avg=0) for m in (mesh, other))
    np.testing.assert_allclose(theirs.mesh.points[order], ours.mesh.points, atol=1e-10)


@pytest.mark.parametrize("name", [name for name in METHODS if "laplacian" in name])
@pytest.mark.parametrize("kind", ["triangle", "hexahedron"])
def test_constraints_are_kept(name, kind):
    mesh = grid(kind, cells=3)
    held = detect_constraints(mesh, fixed=[5])
    points = smooth(mesh, METHODS[name](), steps=2, constraints=held, tolerance_avg=0).mesh.points
    moved = np.asarray(points - mesh.points)
    across = moved - np.einsum("nij,nj->ni", held.projectors, moved)
    np.testing.assert_allclose(across, 0, atol=EXACT)
    assert np.abs(moved).max() > 0.01


def test_smart_rejects_what_classical_breaks():
    """A node next to a re-entrant corner: the mean of its neighbours lies outside."""
    points = [[0, 0], [4, 0], [4, 1], [1, 1], [1, 4], [0, 4], [0.5, 0.5]]
    ring = [0, 1, 2, 3, 4, 5]
    mesh = Mesh(points, {"triangle": [[a, b, 6] for a, b in zip(ring, ring[1:] + ring[:1], strict=True)]})
    plain = smooth(mesh, Laplacian(), steps=1)
    smart = smooth(mesh, Laplacian(smart=True), steps=1)
    assert plain.history[1].statistics.inverted > 0
    assert smart.history[1].statistics.inverted == 0
    np.testing.assert_array_equal(smart.mesh.points, mesh.points)


def test_a_symmetric_mesh_stays_symmetric():
    mesh = grid("quad", cells=4, amplitude=0.0)
    points = np.array(mesh.points)
    # the same shift towards the middle for the four nodes around it
    inner = (np.abs(points - 2) == 1).all(axis=1)
    points[inner] += 0.4 * (2 - points[inner])
    result = smooth(mesh.with_points(jnp.asarray(points)), Laplacian(smart=True), steps=2, tolerance_avg=0)
    found = np.asarray(result.mesh.points)
    mirrored = np.c_[4 - found[:, 0], found[:, 1]]
    lookup = {tuple(np.round(p, 9)) for p in found}
    assert {tuple(np.round(p, 9)) for p in mirrored} == lookup
    assert result.history[-1].statistics.q_min > result.history[0].statistics.q_min


def test_preparation_is_asked_for():
    mesh = grid("triangle", cells=2)
    with pytest.raises(ValueError, match="init"):
        Laplacian().propose(mesh, detect_constraints(mesh), evaluated(mesh))


def test_methods_table():
    assert isinstance(METHODS["elastic"](), Elastic)
    assert METHODS["elastic-extended"]().extended
    assert METHODS["smart-weighted-laplacian"]().weighted
    assert METHODS["smart-laplacian"]().guard is not None
    assert METHODS["laplacian"]().guard is None


def test_derivative_of_a_step():
    mesh = grid("triangle", cells=2)
    held = detect_constraints(mesh)
    method = Laplacian(smart=True)
    state = method.init(mesh)

    def total(points):
        here = mesh.with_points(points)
        return (stepped(method, here, held, evaluated(here), state).points ** 2).sum()

    direction = np.random.default_rng(1).normal(size=mesh.points.shape)
    slope = (jax.grad(total)(mesh.points) * direction).sum()
    h = 1e-6
    central = (total(mesh.points + h * direction) - total(mesh.points - h * direction)) / (2 * h)
    np.testing.assert_allclose(slope, central, rtol=1e-6)
