"""Quality metrics against the paper's tables, geometry done elsewhere, and differences."""

import json
from functools import lru_cache
from pathlib import Path

import jax
import jax.numpy as jnp
import meshes
import numpy as np
import pytest
from scipy.integrate import quad as integrate
from scipy.spatial import ConvexHull

from jaxsmooth.cells.table import element_type
from jaxsmooth.mesh.record import Mesh
from jaxsmooth.metrics.shape import SHAPE_AND_CORNERS, surface
from jaxsmooth.metrics.table import USUAL, named, quality, quality_mean
from jaxsmooth.numerics.small import least

KINDS = meshes.KINDS
METRICS = {row.name: row for row in (*USUAL, SHAPE_AND_CORNERS)}  # those of all types, curved ones too
TABLE = json.loads((Path(__file__).parent / "data" / "quality_tables.json").read_text())["elements"]


@lru_cache
def compiled(kind):
    """All metrics of a batch of elements ``[n, k, dim]``: one compiled function a type."""
    row = element_type(kind)
    return jax.jit(jax.vmap(lambda x: {name: m(row, x) for name, m in METRICS.items()}))


def evaluate(kind, *elements):
    """Metrics of up to 12 elements, always in one batch shape."""
    batch = np.repeat(np.asarray(elements[:1], float), 12, axis=0)
    batch[: len(elements)] = elements
    return {name: np.asarray(v)[: len(elements)] for name, v in compiled(kind)(batch).items()}


@lru_cache
def gradients(kind):
    """Reverse-mode gradients of all metrics of a batch ``[n, metrics, k, dim]``."""
    row = element_type(kind)

    def all_metrics(x):
        return jnp.stack([m(row, x) for m in METRICS.values()])

    return jax.jit(jax.vmap(jax.jacrev(all_metrics)))


@pytest.fixture(scope="module", params=KINDS)
def kind(request):
    """Module scope groups the tests by type, so that each type is compiled once."""
    return request.param


@pytest.mark.parametrize("row", TABLE, ids=lambda r: f"{r['cell_type']}-{r['column']}")
def test_tables_of_the_paper(row):
    found = evaluate(row["cell_type"], row["points"])["shape"][0]
    assert abs(found) == pytest.approx(row["quality"], abs=1e-3)
    assert found > 0


def test_table_has_all_values():
    assert len(TABLE) == 20


def test_ideal_element(kind):
    size = meshes.UNIT_MEASURE[meshes.LINEAR[kind]] ** (-1 / meshes.dim_of(kind))
    for name, values in evaluate(kind, meshes.ideal(kind, size)).items():
        assert values[0] == pytest.approx(1, abs=1e-12), name
        assert METRICS[name].ideal == 1
        low, high = METRICS[name].range
        assert low <= 1 <= high
        assert METRICS[name].acceptable[0] >= low


def test_invariance(kind):
    dim, nodes = meshes.dim_of(kind), meshes.distorted(kind)
    rotated = nodes @ meshes.rotation_matrix(dim).T
    found = evaluate(kind, nodes, rotated, nodes + 3.5, 1e-3 * nodes, 1e4 * nodes)
    for name, values in found.items():
        scale = np.ones(5)
        if name in ("measure", "min_jacobian"):
            scale = np.array([1, 1, 1, 1e-3**dim, 1e4**dim])
        np.testing.assert_allclose(values / scale, values[0], rtol=1e-10, err_msg=name)
        assert values[0] != pytest.approx(1, abs=1e-3)  # the element is not ideal


def test_node_renumbering_by_symmetry(kind):
    nodes = meshes.distorted(kind)
    permutations = [meshes.extend(kind, p) for p in meshes.SYMMETRIES[meshes.LINEAR[kind]]]
    found = evaluate(kind, nodes, *(nodes[p] for p in permutations))
    for name, values in found.items():
        np.testing.assert_allclose(values, values[0], rtol=1e-12, err_msg=name)


def test_sign_under_mirror(kind):
    nodes = meshes.distorted(kind)
    reflected = nodes * np.r_[-1, np.ones(nodes.shape[1] - 1)]
    renumbered = nodes[meshes.extend(kind, meshes.MIRRORS[meshes.LINEAR[kind]])]
    found = evaluate(kind, nodes, reflected, renumbered)
    for name in ("shape", "measure"):
        np.testing.assert_allclose(found[name][1:], -found[name][0], rtol=1e-12)
        assert found[name][0] > 0
    for name in ("scaled_jacobian", "min_jacobian"):
        assert found[name][0] > 0
        assert (found[name][1:] < 0).all()
    np.testing.assert_array_equal(found["mean_ratio"][1:], 0)
    np.testing.assert_allclose(found["edge_ratio"], found["edge_ratio"][0], rtol=1e-12)


def test_known_isoperimetric_exceptions():
    """Linear wedges and pyramids can beat the ideal element; Eq. 5 folds the value."""
    wedge = meshes.ideal_corners("wedge") * [1, 1, 0.577]
    assert evaluate("wedge", wedge)["shape"][0] == pytest.approx(2 - 1.0645, abs=1e-4)
    pyramid = meshes.ideal_corners("pyramid")
    pyramid[4, 2] = 1.414
    assert evaluate("pyramid", pyramid)["shape"][0] == pytest.approx(2 - 1.1755, abs=1e-4)


@pytest.mark.parametrize("linear", ["triangle", "quad", "tetra", "pyramid", "wedge", "hexahedron"])
def test_measure_and_surface_of_straight_elements(linear):
    """Against the convex hull, for elements with flat faces: affine images of the ideal one."""
    dim = meshes.dim_of(linear)
    stretch = np.eye(dim) + 0.3 * np.random.default_rng(2).uniform(-1, 1, (dim, dim))
    assert np.linalg.det(stretch) > 0
    nodes = meshes.ideal_corners(linear) @ stretch
    hull = ConvexHull(nodes)  # in 2D `volume` is the area and `area` the perimeter
    assert evaluate(linear, nodes)["measure"][0] == pytest.approx(hull.volume, rel=1e-12)
    assert float(surface(element_type(linear), jnp.asarray(nodes))) == pytest.approx(hull.area, rel=1e-12)
    # and the value of Eqs. 1–4 from them
    unit = ConvexHull(meshes.ideal(linear))
    ratio = unit.area / unit.volume ** ((dim - 1) / dim) / hull.area * hull.volume ** ((dim - 1) / dim)
    expected = 1 - abs(1 - ratio**2)
    assert evaluate(linear, nodes)["shape"][0] == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("kind", ["triangle6", "quad8", "quad9"], scope="module")
@pytest.mark.parametrize("bulge", [0.1, -0.1])
def test_curved_side_is_integrated(kind, bulge):
    nodes = meshes.ideal(kind)
    middle = meshes.CORNERS[meshes.LINEAR[kind]]
    nodes[middle, 1] -= bulge  # the first side runs along x; its middle moves outward
    length, _ = integrate(lambda x: np.hypot(1, 4 * bulge * (1 - 2 * x)), 0, 1)
    radius = (0.25 + bulge**2) / (2 * abs(bulge))
    assert length == pytest.approx(2 * radius * np.arcsin(0.5 / radius), rel=2e-3)  # close to the arc
    perimeter = length + (meshes.CORNERS[meshes.LINEAR[kind]] - 1)
    assert float(surface(element_type(kind), jnp.asarray(nodes))) == pytest.approx(perimeter, rel=1e-6)
    area = meshes.UNIT_MEASURE[meshes.LINEAR[kind]] + 2 / 3 * bulge
    assert evaluate(kind, nodes)["measure"][0] == pytest.approx(area, rel=1e-12)


@pytest.mark.parametrize(
    "kind", ["tetra10", "wedge15", "wedge18", "pyramid13", "pyramid14", "hexahedron20", "hexahedron27"]
)
def test_curved_faces_are_integrated(kind):
    """Faces bent by a quadratic map: the area of their image by a fine rule in ideal coordinates."""
    base = meshes.LINEAR[kind]
    corners = meshes.ideal_corners(base)
    bend = 0.08 * np.random.default_rng(7).normal(size=(3, 3, 3))
    bend = bend + bend.swapaxes(1, 2)
    g, w = np.polynomial.legendre.leggauss(12)
    u, v = ((x.ravel() + 1) / 2 for x in np.meshgrid(g, g))
    weight = (w[:, None] * w / 4).ravel()
    area = 0.0
    for face in meshes.FACES[base]:
        a, b, d = corners[[face[0], face[1], face[-1]]]
        s, t, jacobian = (u, v, 1.0) if len(face) == 4 else (u, v * (1 - u), 1 - u)
        x = a + s[:, None] * (b - a) + t[:, None] * (d - a)
        slope = np.eye(3) + np.einsum("dij,qj->qdi", bend, x)  # of Φ = x + ½ xᵀ B x
        normal = np.cross(slope @ (b - a), slope @ (d - a))
        area += weight @ (np.linalg.norm(normal, axis=1) * jacobian)
    nodes = meshes.nodes_from_corners(kind, corners)
    nodes = nodes + np.einsum("dij,ki,kj->kd", bend, nodes, nodes) / 2
    found = float(surface(element_type(kind), jnp.asarray(nodes)))
    straight = ConvexHull(corners).area
    assert abs(area - straight) > 1e-2  # it matters
    assert found == pytest.approx(area, rel=5e-4)


R2, R3 = 2**0.5, 3**0.5
HAND = [
    # the angle of 45° over the ideal 60°
    ("triangle", [(0, 0), (1, 0), (0, 1)], (1 / R2) / (R3 / 2)),
    ("quad", [(0, 0), (3, 0), (3, 1), (0, 1)], 1.0),
    ("quad", [(0, 0), (1, 0), (1.5, R3 / 2), (0.5, R3 / 2)], R3 / 2),
    ("quad", [(0, 0), (1, 0), (0.25, 0.25), (0, 1)], -0.8),  # concave: sin of −(270° − 2·71.565°)
    ("quad", [(0, 0), (0, 1), (1, 1), (1, 0)], -1.0),
    # at a far corner: edges (−1,0,0), (−1,1,0), (−1,0,1) have det 1 over 1·√2·√2; ideal √2/2
    ("tetra", [(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)], 0.5 / (R2 / 2)),
    ("wedge", [(x, y, z) for z in (0, 5) for x, y in ((0, 0), (1, 0), (0, 1))], (1 / R2) / (R3 / 2)),
    # base corner of a pyramid of height 1: 1 / |(½, ½, 1)|; ideal √2/2
    ("pyramid", [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0.5, 0.5, 1)], (1 / 1.5**0.5) / (R2 / 2)),
    ("hexahedron", [(x + z, y, z) for z in (0, 1) for x, y in ((0, 0), (2, 0), (2, 1), (0, 1))], 1 / R2),
]


@pytest.mark.parametrize(("kind", "nodes", "expected"), HAND)
def test_scaled_jacobian_by_hand(kind, nodes, expected):
    assert evaluate(kind, np.array(nodes, float))["scaled_jacobian"][0] == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("shift", [0.0, 100.0])
def test_scaled_jacobian_where_a_tangent_vanishes(shift):
    """With the mid-side nodes of a corner at the quarter of their edges: the tangents there are 0."""
    nodes = np.array([(0, 0), (1, 0), (0, 1), (0.25, 0), (0.5, 0.5), (0, 0.25)])
    turned = nodes @ meshes.rotation_matrix(2, 3).T + shift
    assert evaluate("triangle6", turned)["scaled_jacobian"][0] == 0


def test_mean_ratio_and_edge_ratio_by_hand():
    # one affine map from the ideal element: dim det^(2/dim) / |A|² at every corner
    for kind, dim in (
        ("triangle", 2),
        ("quad", 2),
        ("tetra", 3),
        ("pyramid", 3),
        ("wedge", 3),
        ("hexahedron", 3),
    ):
        nodes = meshes.ideal_corners(kind) * ([3, 1] if dim == 2 else [3, 1, 1])
        expected = dim * 3 ** (2 / dim) / (9 + dim - 1)
        assert evaluate(kind, nodes)["mean_ratio"][0] == pytest.approx(expected, rel=1e-12)
    assert evaluate("quad", [(0, 0), (3, 0), (3, 1), (0, 1)])["edge_ratio"][0] == pytest.approx(1 / 3)
    assert evaluate("tetra", [(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)])["edge_ratio"][0] == pytest.approx(
        1 / R2
    )


def test_min_jacobian_by_hand():
    # bilinear quadrilateral: at a corner the determinant of its two edges
    nodes = [(0, 0), (1, 0), (0.25, 0.25), (0, 1)]
    assert evaluate("quad", nodes)["min_jacobian"][0] == pytest.approx(-0.75 * 0.75 + 0.25 * 0.25)
    # a mid-side node beyond the quarter point folds the end of its side: x(s) = 3.6 s − 2.6 s², x′(1) = −1.6
    bar = meshes.ideal("quad9")
    bar[:, 0] = np.where(bar[:, 0] == 0.5, 0.9, bar[:, 0])
    assert evaluate("quad9", bar)["min_jacobian"][0] == pytest.approx(-0.6, rel=1e-12)


def test_values_and_gradients(kind):
    """Gradients agree with differences; all is finite for flat, inverted and collapsed elements."""
    nodes = meshes.distorted(kind)
    flat, inverted, collapsed, joined = nodes.copy(), nodes.copy(), np.zeros_like(nodes), nodes.copy()
    flat[:, -1] = 0
    inverted[:, 0] *= -1
    joined[1] = joined[0]
    elements = (nodes, flat, inverted, collapsed, joined, meshes.ideal(kind))
    for name, values in evaluate(kind, *elements).items():
        assert np.isfinite(values).all(), name
        assert values[3] == 0, name
    assert abs(evaluate(kind, flat)["shape"][0]) < 1e-12
    slopes = np.asarray(gradients(kind)(np.stack(elements)))
    for name, rows in zip(METRICS, slopes.swapaxes(0, 1), strict=True):
        assert np.isfinite(rows).all(), name
    h = 1e-5
    for element, exact in zip((nodes, inverted), slopes[[0, 2]], strict=True):
        for along in np.random.default_rng(4).normal(size=(5, *nodes.shape)):
            found = evaluate(kind, element + h * along, element - h * along)
            for name, row in zip(METRICS, exact, strict=True):
                slope = (found[name][0] - found[name][1]) / (2 * h)
                assert (row * along).sum() == pytest.approx(slope, rel=1e-5, abs=1e-6), name


def test_quality_of_a_mesh():
    points, blocks = meshes.mixed_2d(0.1)
    mesh = Mesh(points, blocks)
    found = quality(mesh)
    assert [len(q) for q in found] == [len(nodes) for nodes in blocks.values()]
    for (kind, nodes), q in zip(blocks.items(), found, strict=True):
        expected = [evaluate(kind, points[element])["shape"][0] for element in nodes]
        np.testing.assert_allclose(q, expected, rtol=1e-13)
    assert float(quality_mean(mesh)) == pytest.approx(np.concatenate(found).mean(), rel=1e-14)
    area = sum(float(a.sum()) for a in quality(mesh, "measure"))
    assert area == pytest.approx(1, rel=1e-13)
    slope = jax.grad(lambda p: quality_mean(mesh.with_points(p)))(mesh.points)
    assert slope.shape == points.shape
    assert np.isfinite(slope).all()


def test_unknown_metric_suggests_a_name():
    with pytest.raises(ValueError, match=r"unknown metric 'scaled_jacobean'; did you mean scaled_jacobian"):
        named("scaled_jacobean")
    with pytest.raises(ValueError, match=r"unknown metric 'zzz'; known are shape, "):
        quality(Mesh(*meshes.grid("quad")), "zzz")


def test_derivative_of_the_least_value():
    values = jnp.array([3.0, 1.0, 2.0, 1.0])
    np.testing.assert_array_equal(jax.grad(least)(values), [0, 1, 0, 0])  # one of the two
    assert float(least(values)) == 1
    assert np.isnan(least(values.at[2].set(jnp.nan)))
    np.testing.assert_array_equal(jax.hessian(lambda v: least(v) ** 2)(values)[1], [0, 2, 0, 0])
