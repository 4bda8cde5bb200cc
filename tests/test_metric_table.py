"""Every metric of the table on every linear type, quadratic ones by their corners, and one from outside."""

import dataclasses
from functools import lru_cache

import jax
import jax.numpy as jnp
import meshes
import numpy as np
import pytest

import jaxsmooth as js
from jaxsmooth.cells.table import element_type
from jaxsmooth.mesh.record import Mesh
from jaxsmooth.metrics.record import Metric
from jaxsmooth.metrics.shape import MEASURE, MIN_JACOBIAN, SHAPE
from jaxsmooth.metrics.table import METRICS, USUAL, as_metric, named, quality, quality_mean

LINEAR = sorted(set(meshes.LINEAR.values()))
BATCH = 12
NOT_BEST_AT_IDEAL = {("pyramid", "scaled_jacobian")}  # taller ones have squarer corners


def of(kind):
    return [row for row in METRICS.values() if row.applies_to(element_type(kind))]


@lru_cache
def compiled(kind):
    """All metrics of a batch ``[12, k, dim]``, compared with elements of measure 1."""
    row = element_type(kind)

    def element(x):
        mean = jnp.ones((), x.dtype)
        return jnp.stack([m(row, x, mean) if m.relative else m(row, x) for m in of(kind)])

    return jax.jit(jax.vmap(element)), jax.jit(jax.vmap(jax.jacrev(element)))


def evaluate(kind, *elements, gradient=False):
    batch = np.repeat(np.asarray(elements[:1], float), BATCH, axis=0)
    batch[: len(elements)] = elements
    return np.asarray(compiled(kind)[gradient](batch))[: len(elements)]


@pytest.fixture(scope="module", params=LINEAR)
def kind(request):
    return request.param


def test_ideal_value(kind):
    row = element_type(kind)
    for metric, value in zip(of(kind), evaluate(kind, row.ideal)[0], strict=True):
        assert value == pytest.approx(metric.ideal_value(row), rel=1e-9, abs=1e-9), metric.name
        low, high = metric.range
        assert low - 1e-9 <= value <= high + 1e-9, metric.name


def test_invariance(kind):
    row, dim, nodes = element_type(kind), meshes.dim_of(kind), meshes.distorted(kind)
    permutations = [list(p) for p in meshes.SYMMETRIES[kind]]
    moved = [nodes @ meshes.rotation_matrix(dim).T, nodes + 3.5, *(nodes[p] for p in permutations)]
    found = evaluate(kind, nodes, *moved, 1e-3 * nodes, 1e3 * nodes)
    for k, metric in enumerate(of(kind)):
        same = found[: len(moved) + 1, k]
        np.testing.assert_allclose(same, same[0], rtol=1e-9, atol=1e-10, err_msg=metric.name)
        if metric.relative:
            continue  # the mean stays
        scale = np.array([1e-3, 1e3]) ** metric.length_power(row)
        np.testing.assert_allclose(found[-2:, k] / scale, same[0], rtol=1e-8, atol=1e-9, err_msg=metric.name)


def test_the_ideal_is_best(kind):
    row = element_type(kind)
    rng = np.random.default_rng(0)
    some = [row.ideal + 0.05 * rng.normal(size=row.ideal.shape) for _ in range(BATCH - 1)]
    some = [x * abs(float(MEASURE(row, jnp.asarray(x)))) ** (-1 / row.dim) for x in some]
    found = evaluate(kind, row.ideal, *some)
    for metric, (best, *others) in zip(of(kind), found.T, strict=True):
        if metric.larger_is_better is not None and (kind, metric.name) not in NOT_BEST_AT_IDEAL:
            gain = (np.array(others) - best) * (1 if metric.larger_is_better else -1)
            assert gain.max() <= 1e-9, metric.name


def test_gradients(kind):
    """Against central differences; finite on flat, inverted, collapsed and folded elements too."""
    nodes = meshes.distorted(kind)
    flat, inverted, joined = nodes.copy(), nodes.copy(), nodes.copy()
    flat[:, -1] = 0
    inverted[:, 0] *= -1
    joined[1] = joined[0]
    folded = nodes.copy()
    folded[-1] = folded[-2]
    elements = (nodes, inverted, flat, np.zeros_like(nodes), joined, folded, element_type(kind).ideal)
    slopes = evaluate(kind, *elements, gradient=True)
    assert not np.isnan(evaluate(kind, *elements)).any()
    step = 1e-6
    along = np.random.default_rng(4).normal(size=nodes.shape)
    for k, metric in enumerate(of(kind)):
        if metric.differentiable:
            assert np.isfinite(slopes[:, k]).all(), metric.name
    for element, slope in zip(elements[:2], slopes, strict=False):
        up, down = evaluate(kind, element + step * along, element - step * along)
        for k, metric in enumerate(of(kind)):
            if metric.differentiable and np.isfinite([up[k], down[k]]).all():
                expected = (up[k] - down[k]) / (2 * step)
                # truncation is step², rounding 1e-16 of the value over the step
                tolerance = 1e-6 * max(1, abs(expected), abs(up[k]))
                assert (slope[k] * along).sum() == pytest.approx(expected, abs=tolerance), metric.name


def test_quadratic_elements_by_their_corners():
    row, straight = element_type("tetra10"), element_type("tetra")
    assert of("tetra10") == of("tetra")
    chosen = [m for m in of("tetra10") if not m.relative]
    bulged = jnp.asarray(meshes.distorted("tetra10"))
    curved, plain = (
        np.asarray(jax.jit(lambda x, kind=kind: jnp.stack([m(kind, x) for m in chosen]))(nodes))
        for kind, nodes in ((row, bulged), (straight, bulged[:4]))
    )
    corners = np.array([m.corners_only for m in chosen])
    np.testing.assert_allclose(curved[corners], plain[corners], rtol=1e-13)
    assert (np.abs(curved - plain)[~corners] > 1e-3).all()


def test_records():
    for name, metric in METRICS.items():
        assert metric.name == name
        assert metric.summary
        assert metric.reference
        assert len(f"{name}: {metric.summary}") <= 80
        assert metric.range[0] <= metric.acceptable[0] < metric.acceptable[1] <= metric.range[1]
        assert hash(metric) == hash(dataclasses.replace(metric))
    assert USUAL[0] is SHAPE
    assert named("volume") is named("area") is MEASURE
    assert as_metric(SHAPE) is as_metric("shape")
    assert METRICS["aspect_ratio"].length_power(element_type("tetra")) == 0
    assert MEASURE.length_power(element_type("tetra10")) == 3
    assert MIN_JACOBIAN.length_power(element_type("quad")) == 2


def test_a_metric_from_outside():
    def height(kind, nodes):
        return jnp.ptp(nodes[:, -1])

    extent = js.Metric("extent", height, units="length", families=("quad",), corners_only=True)
    points, blocks = meshes.mixed_2d(0.1)
    mesh = Mesh(points, blocks)
    for name, values in zip(mesh.types, js.quality(mesh, metric=extent), strict=True):
        expected = [np.ptp(points[nodes, 1]) for nodes in blocks[name]]
        np.testing.assert_allclose(values, expected if name == "quad" else np.nan)
    slope = jax.grad(lambda p: js.quality_mean(mesh.with_points(p), extent))(mesh.points)
    assert float(jnp.abs(slope).max()) > 0
    curved = Mesh(*meshes.grid("quad9", (2, 2)))
    np.testing.assert_allclose(js.quality(curved, extent)[0], 0.5)


def test_metrics_that_do_not_fit():
    mesh = Mesh(*meshes.grid("triangle", (2, 2)))
    with pytest.raises(ValueError, match="'oddy' is for quad, hexahedron, and the mesh has triangle"):
        quality(mesh, "oddy")
    with pytest.raises(ValueError, match="no element family 'tri'; known are triangle"):
        Metric("a", lambda kind, nodes: nodes.sum(), families=("tri",))
    with pytest.raises(ValueError, match="units are '', 'degrees', 'length' or 'measure', got 'mm'"):
        Metric("a", lambda kind, nodes: nodes.sum(), units="mm")


def test_mean_is_of_the_elements_that_have_the_metric():
    mesh = Mesh(*meshes.mixed_2d(0.1))
    found = dict(zip(mesh.types, quality(mesh, "taper"), strict=True))
    assert float(quality_mean(mesh, "taper")) == pytest.approx(float(found["quad"].mean()), rel=1e-14)
    size = dict(zip(mesh.types, quality(mesh, "measure"), strict=True))["triangle"]
    ratio = np.asarray(size / size.mean())
    relative = dict(zip(mesh.types, quality(mesh, "relative_size_squared"), strict=True))["triangle"]
    np.testing.assert_allclose(relative, np.minimum(ratio, 1 / ratio) ** 2, rtol=1e-12)


def test_warped_faces_lower_kwok():
    """A twisted cube: height of a side over the other, over the root of the projected area."""
    cube = element_type("hexahedron").ideal.copy()
    cube[6, 2] += 0.2  # the top face is warped, and the two at the lifted corner stay plane
    det = 1 + 0.2 * np.outer(
        [0.5 - 0.5 / 3**0.5, 0.5 + 0.5 / 3**0.5], [0.5 - 0.5 / 3**0.5, 0.5 + 0.5 / 3**0.5]
    )
    normal = np.cross([1, 1, 0.2], [-1, 1, 0])
    warping = abs(normal @ [1, 0, 0]) / np.linalg.norm(normal) / (np.linalg.norm(normal) / 2) ** 0.5
    expected = (1 - warping) * det.min() / det.max()
    assert float(METRICS["kwok"](element_type("hexahedron"), jnp.asarray(cube))) == pytest.approx(expected)
