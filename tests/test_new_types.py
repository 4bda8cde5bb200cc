"""Element types that a user adds to the table from outside, and what the table refuses."""

from dataclasses import replace
from itertools import pairwise

import jax
import jax.numpy as jnp
import meshes
import meshio
import numpy as np
import pytest
from meshio._mesh import topological_dimension

import jaxsmooth as js
from jaxsmooth.cells import families, quadrature
from jaxsmooth.cells.families import NodeRule
from jaxsmooth.cells.spans import Span
from jaxsmooth.cells.table import TYPES, ElementType, add_element_type, element_type, supported
from jaxsmooth.convert.checks import MeshFileError
from jaxsmooth.metrics.table import min_jacobian
from jaxsmooth.metrics.validity import determinant_bound, inverted


@pytest.fixture
def table():
    """Whatever a test adds is gone after it."""
    before = [(known, set(known)) for known in (TYPES, topological_dimension)]
    yield TYPES
    for known, names in before:
        for name in set(known) - names:
            del known[name]


def add_triangle7():
    """A triangle with nodes at its corners, mid-sides and centre."""
    return add_element_type(
        ElementType(
            name="triangle7",
            family=families.TRIANGLE,
            node_rule=NodeRule(edge=1, triangle=True),
            span=Span.of("00 10 01 20 11 02 11-21-12"),
            rule=quadrature.TRIANGLE_6,
        )
    )


def centred(amplitude):
    """A square of triangles with mid-side nodes, and of the same with a node at the centre of each."""
    points, blocks = meshes.grid("triangle6", (3, 3), amplitude)
    nodes = blocks["triangle6"]
    weights = element_type("triangle6").shape_functions(np.full((1, 2), 1 / 3))[0]
    centres = np.einsum("k,ekd->ed", weights, points[nodes])
    numbers = len(points) + np.arange(len(nodes))[:, None]
    return (points, blocks), (np.concatenate([points, centres]), {"triangle7": np.c_[nodes, numbers]})


def test_a_triangle_with_a_centre_is_smoothed(table):
    add_triangle7()
    six, seven = (js.Mesh(*given) for given in centred(0.35))
    np.testing.assert_allclose(js.quality(seven)[0], js.quality(six)[0], rtol=1e-12)  # the same elements
    for name in ("scaled_jacobian", "measure"):  # the mean ratio looks at the nodes
        np.testing.assert_allclose(js.quality(seven, name)[0], js.quality(six, name)[0], rtol=1e-12)
    moved = jax.jit(js.step)(seven.bare, js.Elastic(), js.detect_constraints(seven))
    assert inverted(seven.with_points(moved.points))[0].sum() < inverted(seven)[0].sum() / 2
    assert float(js.quality_mean(seven.with_points(moved.points))) > float(js.quality_mean(seven)) + 0.01
    result = js.smooth(seven, steps=2)
    assert result.history[-1].statistics.q_min > result.history[0].statistics.q_min
    assert result.history[-1].statistics.inverted == 0


def test_the_new_type_is_one_like_the_others(table):
    row = add_triangle7()
    assert element_type("triangle7") is row
    assert "triangle7" in supported(2)
    points = np.random.default_rng(0).dirichlet(np.ones(3), 5)[:, :2]
    values = row.shape_functions(points)
    np.testing.assert_allclose(values.sum(axis=1), 1, atol=1e-14)
    bubble = 27 * points.prod(axis=1) * (1 - points.sum(axis=1))
    np.testing.assert_allclose(values[:, 6], bubble, atol=1e-14)
    np.testing.assert_array_equal(row.facets[0].nodes, element_type("triangle6").facets[0].nodes)
    np.testing.assert_array_equal(row.mirror, [0, 2, 1, 5, 4, 3, 6])
    assert row.facets[0].type is element_type("line3")
    assert not row.linear
    assert row.ideal_surface == pytest.approx(element_type("triangle6").ideal_surface, rel=1e-14)
    # the bubble bends the inside: seen at the centre, and by the proof
    fold = np.array(row.ideal)
    fold[6] += 0.4
    assert float(min_jacobian(row, jnp.asarray(fold))) < 0
    bound = jax.jit(lambda x: determinant_bound(row, x))
    assert float(bound(jnp.asarray(fold))) < 0 < float(bound(jnp.asarray(row.ideal)))


def test_a_name_that_meshio_lacks(table, tmp_path):
    """Such cells are checked like others, written where a format takes any name, refused elsewhere."""
    add_element_type(replace(add_triangle7(), name="bubble"))
    points, blocks = centred(0.2)[1]
    mesh = js.as_mesh((points, {"bubble": blocks["triangle7"][:, [0, 2, 1, 5, 4, 3, 6]]}))
    np.testing.assert_array_equal(mesh.connectivity[0], blocks["triangle7"])  # turned
    file = js.from_meshio(meshio.Mesh(points, {"bubble": blocks["triangle7"]}))
    js.write(tmp_path / "a.npz", file)
    np.testing.assert_array_equal(js.read(tmp_path / "a.npz").mesh.connectivity[0], blocks["triangle7"])
    for suffix in ("vtu", "msh", "xdmf", "inp"):
        with pytest.raises(MeshFileError, match=r"bubble.*; write "):
            js.write(tmp_path / f"a.{suffix}", file)


CUBIC = "00 10 01 20 11 02 30 21 12 03"


def test_there_is_room_for_cubic_types(table):
    """Two nodes an edge: facets, segments and mirror follow from the places of the nodes."""
    add_element_type(ElementType("line4", families.LINE, NodeRule(edge=2), Span.of("0 1 2 3"), _gauss(1, 6)))
    rule = NodeRule(edge=2, triangle=True)
    row = add_element_type(
        ElementType("triangle10", families.TRIANGLE, rule, Span.of(CUBIC), quadrature.TRIANGLE_6)
    )
    np.testing.assert_array_equal(row.facets[0].nodes, [[0, 1, 3, 4], [1, 2, 5, 6], [2, 0, 7, 8]])
    np.testing.assert_array_equal(row.outline, [0, 3, 4, 1, 5, 6, 2, 7, 8])
    np.testing.assert_array_equal(row.mirror, [0, 2, 1, 8, 7, 6, 5, 4, 3, 9])
    halves = {frozenset(pair) for pair in row.segments.tolist()}
    ring = [0, 3, 4, 1, 5, 6, 2, 7, 8, 0]
    assert halves == {frozenset(pair) for pair in pairwise(ring)}
    quad = ElementType(
        "quad12", families.QUADRILATERAL, NodeRule(edge=2), Span.of(CUBIC + " 31 13"), _gauss(2, 4)
    )
    assert add_element_type(quad).facets[0].type is element_type("line4")


def _gauss(dim, n):
    return quadrature.product(*[quadrature.gauss(n)] * dim)


LINEAR = "00 10 01"
BAD = [
    ("triangle6", NodeRule(), LINEAR, 1, "in the table already"),
    ("x", NodeRule(edge=1), LINEAR, 1, "has 6 nodes in 2D, and its span 3 functions in 2D"),
    ("x", NodeRule(), "000 100 010", 1, "has 3 nodes in 2D, and its span 3 functions in 3D"),
    ("x", NodeRule(), "10 01 10-01", 1, "values at its nodes don't tell functions"),
    ("x", NodeRule(), "00 20 02", 1, "its span lacks linear functions"),
    ("x", NodeRule(), LINEAR, 2, "a measure of 2, not 1"),
    ("x", NodeRule(edge=2, triangle=True), CUBIC, 1, r"has 4 nodes on the side with the corners \[0, 1\]"),
]


@pytest.mark.parametrize(("name", "rule", "span", "factor", "sentence"), BAD)
def test_what_is_no_element_is_refused(table, name, rule, span, factor, sentence):
    before = list(table)
    points, weights = quadrature.TRIANGLE_6
    row = ElementType(name, families.TRIANGLE, rule, Span.of(span), (points, factor * weights))
    with pytest.raises(ValueError, match=sentence):
        add_element_type(row)
    assert list(table) == before


@pytest.mark.parametrize("text", ["00 1x", "00 10 001", "10/", "+"])
def test_what_is_no_span_is_refused(text):
    with pytest.raises(ValueError, match=r"is no function of a span|need as many exponents"):
        Span.of(text)


def test_spans_are_what_their_text_says():
    points = np.random.default_rng(1).uniform(-0.5, 0.5, (4, 3))
    x, y, z = points.T
    span = Span.of("000 120-013 220/2 211-101/1")
    values, slopes = span.at(points)
    w = 1 - z
    expected = [x**0, x * y**2 - y * z**3, (x * y / w) ** 2, x**2 * y * z - x * z / w]
    np.testing.assert_allclose(values, np.stack(expected, axis=1), atol=1e-15)
    for axis in range(3):
        step = 1e-6 * np.eye(3)[axis]
        difference = (span.at(points + step)[0] - span.at(points - step)[0]) / 2e-6
        np.testing.assert_allclose(slopes[..., axis], difference, atol=1e-9)
