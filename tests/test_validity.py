"""Elements that are invalid inside: bounds of the Jacobian determinant, and the verdict."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from meshes import (
    KINDS,
    LINEAR,
    SYMMETRIES,
    UNIT_MEASURE,
    dim_of,
    extend,
    ideal,
    nodes_from_corners,
    rotation_matrix,
)

import jaxsmooth as js
from jaxsmooth.cells.bernstein import bernstein
from jaxsmooth.cells.table import element_type
from jaxsmooth.metrics.validity import determinant_bound, inverted

COUNT = 120  # random elements a type; everywhere the same, so that compiled functions are shared


def points_inside(kind, count):
    """Random points inside, on faces, on edges, and the corners, in natural coordinates; those of
    pyramids are x / (1 − z), y / (1 − z), z."""
    rng = np.random.default_rng(0)
    base, dim = LINEAR[kind], dim_of(kind)
    cube = rng.uniform(-1, 1, (count, dim))
    cube = np.where(rng.uniform(size=cube.shape) < 0.3, np.sign(cube), cube)
    size = {"triangle": 2, "tetra": 3, "wedge": 2}.get(base, 0)
    if size:
        barycentric = rng.dirichlet(np.ones(size + 1), count)
        barycentric[:, 1:] *= rng.uniform(size=(count, size)) < 0.7
        barycentric[: count // 3, 0] *= 1e-12
        cube[:, :size] = barycentric[:, 1:] / barycentric.sum(axis=1, keepdims=True)
    corners = element_type(base).natural
    if base == "pyramid":
        cube[:, 2] = (1 + cube[:, 2]) / 2
        corners = np.concatenate([corners[:4], corners[:4] + np.eye(3)[2]])
    return np.concatenate([corners, cube])


def determinants(kind, points, nodes):
    """Determinants ``[elements, points]`` by NumPy."""
    if LINEAR[kind] == "pyramid":
        z = np.minimum(points[:, 2:], 1 - 1e-9)
        points = np.c_[points[:, :2] * (1 - z), z]
    return np.linalg.det(np.einsum("nkd,qke->nqde", nodes, element_type(kind).gradients_at(points)))


def sampled(kind, nodes):
    """Least determinant ``[elements]`` at many points; at more around the least if it is small."""
    points = points_inside(kind, 1000)
    values = determinants(kind, points, nodes)
    least, where = values.min(axis=1), points[values.argmin(axis=1)]
    for n in np.flatnonzero((least > 0) & (least < 0.3)):
        for shrink in (0.3, 0.1, 0.03, 0.01):  # the domain is convex: these points are inside
            near = where[n] + shrink * (points[::3] - where[n])
            values = determinants(kind, near, nodes[n : n + 1])[0]
            if values.min() < least[n]:
                least[n], where[n] = values.min(), near[values.argmin()]
    return least


def mesh_of(kind, nodes):
    """Separate elements with these nodes ``[elements, k, dim]`` as one mesh."""
    count, k, dim = nodes.shape
    return js.Mesh(nodes.reshape(-1, dim), {kind: np.arange(count * k).reshape(count, k)})


def verdict(kind, nodes):
    return inverted(mesh_of(kind, nodes))[0]


def bounds(kind, nodes):
    return np.asarray(jax.jit(jax.vmap(partial(determinant_bound, element_type(kind))))(jnp.asarray(nodes)))


def random_elements(kind, seed=0):
    """Ideal elements whose nodes have moved by very different amounts: some invalid, some just not."""
    rng = np.random.default_rng(seed)
    start = ideal(kind)
    amplitude = rng.uniform(0.02, 0.9, (COUNT, 1, 1)) * (1 if kind == LINEAR[kind] else 0.3)
    return start + amplitude * rng.uniform(-1, 1, (COUNT, *start.shape))


# By hand: dimension and degree of the determinant in every factor of the domain.
DEGREES = {
    "triangle": [(2, 0)],
    "triangle6": [(2, 2)],
    "quad": [(1, 1), (1, 1)],
    "quad8": [(1, 3), (1, 3)],
    "quad9": [(1, 3), (1, 3)],
    "tetra": [(3, 0)],
    "tetra10": [(3, 3)],
    "pyramid": [(1, 1), (1, 1), (1, 0)],
    "pyramid13": [(1, 4), (1, 4), (1, 3)],
    "pyramid14": [(1, 4), (1, 4), (1, 3)],
    "wedge": [(2, 1), (1, 2)],
    "wedge15": [(2, 4), (1, 5)],
    "wedge18": [(2, 4), (1, 5)],
    "hexahedron": [(1, 2), (1, 2), (1, 2)],
    "hexahedron20": [(1, 5), (1, 5), (1, 5)],
    "hexahedron27": [(1, 5), (1, 5), (1, 5)],
}


@pytest.mark.parametrize("kind", KINDS)
def test_degrees_by_hand(kind):
    table = bernstein(element_type(kind))
    assert [(factor.dim, factor.degree) for factor in table.factors] == DEGREES[kind]
    refined = kind in ("triangle6", "quad8", "quad9", "tetra10")  # bounds on halved elements, where cheap
    assert (len(table.bounding) > len(table.matrix)) == refined


@pytest.mark.parametrize("kind", KINDS)
def test_bernstein_form_reproduces_the_determinant(kind):
    """The degrees suffice: the polynomial from the samples agrees with the determinant everywhere."""
    table, nodes = bernstein(element_type(kind)), random_elements(kind)[0]
    frames = np.einsum("kd,qke->qde", nodes, element_type(kind).gradients_at(table.points))
    coefficients = table.matrix @ np.linalg.det(frames)
    domain = np.random.default_rng(1).dirichlet(np.ones(4), 50)[:, : dim_of(kind)]
    values, start = np.ones((50, 1)), 0
    for factor in table.factors:
        more = factor.values(domain[:, start : start + factor.dim])
        values = (values[:, :, None] * more[:, None]).reshape(50, -1)
        start += factor.dim
    frames = np.einsum("kd,qke->qde", nodes, element_type(kind).gradients_at(table.natural(domain)))
    np.testing.assert_allclose(values @ coefficients, np.linalg.det(frames), atol=1e-11)


@pytest.mark.parametrize("kind", KINDS)
def test_verdict_against_dense_sampling(kind):
    nodes = random_elements(kind)
    found, least, bound = verdict(kind, nodes), sampled(kind, nodes), bounds(kind, nodes)
    unit = UNIT_MEASURE[LINEAR[kind]]
    assert found[least <= 0].all()
    assert not found[least > 1e-3 * unit].any()
    assert (bound <= least + 1e-12 * unit).all()
    assert not found[bound > 0].any()
    assert 0.05 < found.mean() < 0.95  # the elements are of both sorts


@pytest.mark.parametrize("kind", KINDS)
def test_ideal_elements_have_their_measure(kind):
    unit, nodes = UNIT_MEASURE[LINEAR[kind]], ideal(kind)[None]
    np.testing.assert_allclose(bounds(kind, nodes), unit, rtol=1e-10)
    np.testing.assert_allclose(bounds(kind, nodes.astype(np.float32)), unit, rtol=2e-3)
    assert not verdict(kind, nodes)[0]
    assert verdict(kind, nodes[:, element_type(kind).mirror])[0]


@pytest.mark.parametrize("kind", KINDS)
def test_independent_of_place_size_rotation_and_numbering(kind):
    nodes, dim = random_elements(kind), dim_of(kind)
    expected, bound = verdict(kind, nodes), bounds(kind, nodes)
    moved = 1e-7 * (nodes @ rotation_matrix(dim).T + 5)
    assert (verdict(kind, moved) == expected).all()
    np.testing.assert_allclose(bounds(kind, moved) / 1e-7**dim, bound, atol=1e-7)
    for turn in SYMMETRIES[LINEAR[kind]]:
        turned = nodes[:, extend(kind, turn)]
        assert (verdict(kind, turned) == expected).all()
        if LINEAR[kind] not in ("tetra", "wedge"):
            np.testing.assert_allclose(bounds(kind, turned), bound, atol=1e-7)


@pytest.mark.parametrize("kind", KINDS)
def test_degenerate_elements_are_inverted(kind):
    flat = ideal(kind)
    flat[:, -1] = 0
    turned = flat @ rotation_matrix(dim_of(kind)).T
    nodes = np.array([flat, turned, np.zeros_like(flat), 1e3 + np.zeros_like(flat)])
    assert verdict(kind, nodes).all()
    assert (bounds(kind, nodes) <= 0).all()
    assert (bounds(kind, nodes.astype(np.float32)) <= 0).all()


@pytest.mark.parametrize("kind", KINDS)
def test_thin_elements_are_valid(kind):
    """Layers and needles of aspect 10⁵, askew in space."""
    dim = dim_of(kind)
    thin = [np.where(np.arange(dim) < axes, 1, 1e-5) for axes in range(1, dim)]
    nodes = np.array([ideal(kind) * scale @ rotation_matrix(dim).T for scale in thin])
    assert not verdict(kind, nodes).any()
    assert (bounds(kind, nodes) > 0).all()


def test_nan_is_inverted():
    mesh = mesh_of("tetra10", np.stack([ideal("tetra10")] * 2))
    assert inverted(mesh.with_points(mesh.points.at[3].set(jnp.nan)))[0].tolist() == [True, False]


@pytest.mark.parametrize(("place", "valid"), [(0.2501, True), (0.25, False), (0.2499, False)])
@pytest.mark.parametrize("kind", ["triangle6", "quad8", "tetra10", "hexahedron20"])
def test_quarter_point(kind, place, valid):
    """A mid-side node on its straight edge may come no nearer to a corner than a quarter."""
    nodes = nodes_from_corners(kind, ideal(LINEAR[kind]))
    middle = len(ideal(LINEAR[kind]))  # on the edge from corner 0 to corner 1
    nodes[middle] = nodes[0] + place * (nodes[1] - nodes[0])
    assert verdict(kind, nodes[None])[0] != valid


def seen(kind, nodes):
    """Least determinant ``[elements]`` at nodes and quadrature points."""
    gradients = element_type(kind).validity_gradients
    return np.linalg.det(np.einsum("nkd,qke->nqde", nodes, gradients)).min(axis=1)


@pytest.mark.parametrize(("kind", "amplitude"), [("tetra10", 0.2), ("quad9", 0.2), ("hexahedron", 0.6)])
def test_elements_that_are_invalid_between_their_samples(kind, amplitude):
    """Those that nodes and quadrature points take for valid."""
    start = ideal(kind)
    nodes = start + amplitude * np.random.default_rng(5).uniform(-1, 1, (20000, *start.shape))
    nodes = nodes[seen(kind, nodes) > 0.01][:200]
    wrong = sampled(kind, nodes) < 0
    assert wrong.any()
    assert verdict(kind, nodes)[wrong].all()


def test_single_precision_agrees_where_it_can():
    nodes = random_elements("tetra10")
    clear = np.abs(sampled("tetra10", nodes)) > 1e-3
    single = verdict("tetra10", nodes.astype(np.float32))
    assert (single == verdict("tetra10", nodes))[clear].all()


def test_more_elements_than_are_halved_at_a_time():
    """Undecided elements in several batches: nearly folded, and folded, in turn."""
    nodes = nodes_from_corners("hexahedron20", ideal("hexahedron"))
    middle = np.where(np.arange(3000) % 2, 0.2501, 0.2499)
    many = np.tile(nodes, (3000, 1, 1))
    many[:, 8, 0] = middle
    assert (verdict("hexahedron20", many) == (middle < 0.25)).all()
