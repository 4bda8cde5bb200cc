"""The table of reference elements against closed forms and node orders typed in by hand."""

import ast
import sys
from itertools import product
from math import factorial, gamma
from pathlib import Path

import meshes
import numpy as np
import pytest

from jaxsmooth import cells
from jaxsmooth.cells.table import TYPES, element_type, supported

KINDS = meshes.KINDS
QUADRATIC = [k for k in KINDS if k != meshes.LINEAR[k]]


def inside(kind, count=7, seed=0):
    """Random natural points within a type: convex combinations of its corners."""
    corners = element_type(kind).natural[: meshes.CORNERS[meshes.LINEAR[kind]]]
    return np.random.default_rng(seed).dirichlet(np.ones(len(corners)), count) @ corners


def numeric_slopes(kind, points, h=1e-6):
    """Central differences of the shape functions in natural coordinates ``[points, k, dim]``."""
    row = element_type(kind)
    steps = h * np.eye(row.dim)
    return np.stack(
        [(row.shape_functions(points + s) - row.shape_functions(points - s)) / (2 * h) for s in steps],
        axis=-1,
    )


def numeric_gradients(kind, points, h=1e-6):
    """The same in the coordinates of the ideal element of unit measure."""
    slopes = numeric_slopes(kind, points, h)
    ideal = unit_ideal(kind)
    return slopes @ np.linalg.inv(np.einsum("kd,qke->qde", ideal, slopes))


def unit_ideal(kind):
    base = meshes.LINEAR[kind]
    return meshes.ideal(kind, meshes.UNIT_MEASURE[base] ** (-1 / meshes.dim_of(kind)))


def test_all_types_are_there():
    assert set(supported()) == set(KINDS)
    assert set(supported(2)) == set(meshes.KINDS_2D)
    assert set(supported(3)) == set(meshes.KINDS_3D)
    with pytest.raises(ValueError, match=r"'hexahedron64' is not supported; known are triangle, "):
        element_type("hexahedron64")


@pytest.mark.parametrize("kind", KINDS)
def test_partition_of_unity(kind):
    values = element_type(kind).shape_functions(inside(kind))
    np.testing.assert_allclose(values.sum(axis=1), 1, rtol=0, atol=1e-13)
    sums = element_type(kind).gradients_at(inside(kind)).sum(axis=1)
    np.testing.assert_allclose(sums, 0, rtol=0, atol=1e-12)


@pytest.mark.parametrize("kind", KINDS)
def test_kronecker_delta(kind):
    row = element_type(kind)
    np.testing.assert_allclose(row.shape_functions(row.natural), np.eye(row.k), rtol=0, atol=1e-12)


@pytest.mark.parametrize("kind", KINDS)
def test_ideal_element_has_unit_measure_and_the_node_order_of_vtk(kind):
    # Eqs. 16–20: the edge lengths that give area or volume 1
    length = {
        "triangle": 2 / 3**0.25,
        "quad": 1,
        "tetra": (6 * 2**0.5) ** (1 / 3),
        "pyramid": (3 * 2**0.5) ** (1 / 3),
        "wedge": (4 / 3**0.5) ** (1 / 3),
        "hexahedron": 1,
    }[meshes.LINEAR[kind]]
    row = element_type(kind)
    np.testing.assert_allclose(row.ideal, meshes.ideal(kind, length), rtol=0, atol=1e-14)
    assert row.linear == (kind == meshes.LINEAR[kind])
    assert row.dim == meshes.dim_of(kind)
    assert row.corners == meshes.CORNERS[meshes.LINEAR[kind]]
    assert row.k == len(meshes.groups(kind))


@pytest.mark.parametrize("kind", KINDS)
def test_edges_are_equal_and_in_order(kind):
    row = element_type(kind)
    assert [tuple(e) for e in row.edges] == meshes.EDGES[meshes.LINEAR[kind]]
    lengths = np.linalg.norm(row.ideal[row.edges[:, 0]] - row.ideal[row.edges[:, 1]], axis=1)
    np.testing.assert_allclose(lengths, lengths[0], rtol=1e-14)
    # segments are the edges, or their halves through the mid-side nodes
    halves = np.linalg.norm(np.diff(row.ideal[row.segments], axis=1)[:, 0], axis=1)
    order = 1 if kind == meshes.LINEAR[kind] else 2
    np.testing.assert_allclose(halves, lengths[0] / order, rtol=1e-14)
    assert len({frozenset(s) for s in row.segments.tolist()}) == order * len(row.edges)


@pytest.mark.parametrize("kind", KINDS)
def test_ideal_surface(kind):
    # Eqs. 3 and 4 at unit area or volume
    expected = {
        "triangle": 6 * (1 / 3**0.5) ** 0.5,
        "quad": 4,
        "tetra": 3**0.5 * (6 * 2**0.5) ** (2 / 3),
        "pyramid": (1 + 3**0.5) * (3 * 2**0.5) ** (2 / 3),
        "hexahedron": 6,
        "wedge": (3 + 3**0.5 / 2) * (4 / 3**0.5) ** (2 / 3),
    }[meshes.LINEAR[kind]]
    assert element_type(kind).ideal_surface == pytest.approx(expected, rel=1e-13)


def monomial_mean(base, exponents):
    """Mean of a monomial over the natural domain of a type, in closed form."""
    if base in ("triangle", "tetra"):
        n = len(exponents)
        top = np.prod([float(factorial(e)) for e in exponents])
        return factorial(n) * top / factorial(sum(exponents) + n)

    def along(e):  # mean over [−1, 1]
        return 0.0 if e % 2 else 1 / (e + 1)

    if base in ("quad", "hexahedron"):
        return np.prod([along(e) for e in exponents])
    a, b, c = exponents
    if base == "wedge":
        return monomial_mean("triangle", (a, b)) * along(c)
    beta = gamma(c + 1) * gamma(a + b + 3) / gamma(a + b + c + 4)  # ∫ zᶜ (1 − z)ᵃ⁺ᵇ⁺² dz
    return 3 * along(a) * along(b) * beta


def exact_exponents(kind):
    """Monomials that the rule of a type has to integrate exactly."""
    dim = meshes.dim_of(kind)
    total = {"triangle": 1, "triangle6": 4, "tetra": 1, "tetra10": 5, "pyramid": 1, "pyramid13": 5}
    total["pyramid14"] = 5
    everything = product(range(6), repeat=dim)
    if kind in total:
        return [e for e in everything if sum(e) <= total[kind]]
    if meshes.LINEAR[kind] == "wedge":
        plane, along = (2, 3) if kind == "wedge" else (4, 5)
        return [e for e in everything if sum(e[:2]) <= plane and e[2] <= along]
    each = 3 if kind in ("quad", "hexahedron") else 5
    return [e for e in everything if max(e) <= each]


@pytest.mark.parametrize("kind", KINDS)
def test_quadrature_is_exact(kind):
    points, weights = element_type(kind).quadrature
    assert weights.sum() == pytest.approx(1, rel=1e-13)
    assert (weights > 0).all()
    for exponents in exact_exponents(kind):
        value = weights @ np.prod(points**exponents, axis=1)
        assert value == pytest.approx(monomial_mean(meshes.LINEAR[kind], exponents), abs=2e-13), exponents


@pytest.mark.parametrize("kind", KINDS)
def test_gradients_agree_with_differences(kind):
    points = inside(kind)
    exact = element_type(kind).gradients_at(points)
    np.testing.assert_allclose(exact, numeric_gradients(kind, points), rtol=0, atol=1e-7)
    np.testing.assert_allclose(
        element_type(kind).gradients,
        numeric_gradients(kind, element_type(kind).quadrature[0]),
        rtol=0,
        atol=1e-7,
    )


@pytest.mark.parametrize("kind", ["pyramid", "pyramid13", "pyramid14"])
@pytest.mark.parametrize("distance", [1e-2, 1e-4])
def test_pyramid_gradients_near_the_apex(kind, distance):
    # on lines to the apex: one edge, one within the pyramid, the axis
    points = np.array(
        [[d * distance, e * distance, 1 - distance] for d, e in ((0.9, 0.9), (0.3, -0.5), (0, 0))]
    )
    exact = element_type(kind).gradients_at(points)
    differences = numeric_gradients(kind, points, h=distance * 1e-4)
    np.testing.assert_allclose(exact, differences, rtol=0, atol=2e-6)


@pytest.mark.parametrize("kind", QUADRATIC)
def test_quadratic_fields_are_reproduced(kind):
    # all quadratic types span the complete polynomials of degree 2
    row, rng = element_type(kind), np.random.default_rng(3)
    a, b = rng.normal(size=(row.dim, row.dim)), rng.normal(size=row.dim)

    def field(x):
        return np.einsum("...i,ij,...j", x, a, x) + x @ b + 1

    points = inside(kind)
    x = row.shape_functions(points) @ row.ideal
    np.testing.assert_allclose(row.shape_functions(points) @ field(row.ideal), field(x), atol=1e-12)
    slope = np.einsum("k,qkd->qd", field(row.ideal), row.gradients_at(points))
    np.testing.assert_allclose(slope, x @ (a + a.T) + b, atol=1e-11)


def test_node_positions_of_vtk():
    # natural coordinates as VTK documents them
    hexahedron = element_type("hexahedron27").natural
    expected = {0: (-1, -1, -1), 6: (1, 1, 1), 8: (0, -1, -1), 11: (-1, 0, -1), 13: (1, 0, 1), 18: (1, 1, 0)}
    expected |= {20: (-1, 0, 0), 21: (1, 0, 0), 22: (0, -1, 0), 23: (0, 1, 0)}
    expected |= {24: (0, 0, -1), 25: (0, 0, 1), 26: (0, 0, 0)}
    for node, position in expected.items():
        np.testing.assert_array_equal(hexahedron[node], position)
    np.testing.assert_array_equal(element_type("hexahedron20").natural, hexahedron[:20])
    tetra = element_type("tetra10").natural
    np.testing.assert_array_equal(tetra[[4, 5, 6]], [(0.5, 0, 0), (0.5, 0.5, 0), (0, 0.5, 0)])
    np.testing.assert_array_equal(tetra[[7, 8, 9]], [(0, 0, 0.5), (0.5, 0, 0.5), (0, 0.5, 0.5)])
    wedge = element_type("wedge15").natural
    np.testing.assert_array_equal(wedge[[6, 9, 10]], [(0.5, 0, -1), (0.5, 0, 1), (0.5, 0.5, 1)])
    np.testing.assert_array_equal(wedge[[12, 13, 14]], [(0, 0, 0), (1, 0, 0), (0, 1, 0)])
    centres = [(0.5, 0, 0), (0.5, 0.5, 0), (0, 0.5, 0)]  # of VTK_BIQUADRATIC_QUADRATIC_WEDGE
    np.testing.assert_array_equal(element_type("wedge18").natural, [*wedge, *centres])
    pyramid = element_type("pyramid13").natural
    np.testing.assert_array_equal(element_type("pyramid14").natural, [*pyramid, (0, 0, 0)])
    np.testing.assert_array_equal(pyramid[[5, 7, 8]], [(0, -1, 0), (0, 1, 0), (-1, 0, 0)])
    np.testing.assert_array_equal(pyramid[[9, 11]], [(-0.5, -0.5, 0.5), (0.5, 0.5, 0.5)])
    np.testing.assert_array_equal(element_type("quad9").natural[[4, 7, 8]], [(0, -1), (-1, 0), (0, 0)])
    np.testing.assert_array_equal(element_type("triangle6").natural[3:], [(0.5, 0), (0.5, 0.5), (0, 0.5)])


def facet_integrals(kind, nodes):
    """Area vectors ``[s, dim]`` and positions at the quadrature points of all facets."""
    vectors, positions = [], []
    for group in element_type(kind).facets:
        for facet in group.nodes:
            tangents = np.einsum("kd,qke->qde", nodes[facet], group.type.slopes)
            if group.type.dim == 1:
                normal = np.stack([tangents[:, 1, 0], -tangents[:, 0, 0]], axis=1)
            else:
                normal = np.cross(tangents[..., 0], tangents[..., 1])
            vectors.append(normal * group.type.slope_weights[:, None])
            positions.append(group.type.values @ nodes[facet])
    return vectors, positions


@pytest.mark.parametrize("kind", KINDS)
def test_facets_point_outward_and_close(kind):
    nodes = meshes.ideal(kind)
    vectors, positions = facet_integrals(kind, nodes)
    centre = nodes.mean(axis=0)
    for vector, position in zip(vectors, positions, strict=True):
        assert (np.einsum("qd,qd->q", vector, position - centre) > 0).all()
    flux = sum((v * x).sum() for v, x in zip(vectors, positions, strict=True)) / nodes.shape[1]
    assert flux == pytest.approx(meshes.UNIT_MEASURE[meshes.LINEAR[kind]], rel=1e-12)
    vectors, _ = facet_integrals(kind, meshes.distorted(kind))
    np.testing.assert_allclose(np.concatenate(vectors).sum(axis=0), 0, atol=1e-13)


@pytest.mark.parametrize("kind", KINDS)
def test_facets_have_all_their_nodes(kind):
    base = meshes.LINEAR[kind]
    corner_sets = {frozenset(f) for f in (meshes.FACES[base] if base in meshes.FACES else meshes.EDGES[base])}
    members = meshes.groups(kind)
    found = [facet for group in element_type(kind).facets for facet in group.nodes.tolist()]
    for facet in found:
        corners = frozenset(n for n in facet if n < meshes.CORNERS[base])
        assert corners in corner_sets
        # a facet has exactly those nodes that are means of its corners
        assert set(facet) == {n for n, g in enumerate(members) if set(g) <= corners}
    assert len({frozenset(f) for f in found}) == len(found) == len(corner_sets)
    # and in the order of the facet's own type
    for group in element_type(kind).facets:
        for facet in group.nodes:
            nodes = meshes.ideal(kind)[facet]
            if group.type.dim == 2:
                expected = meshes.nodes_from_corners(group.type.name, nodes[: group.type.corners])
            else:
                expected = np.array([nodes[0], nodes[1], (nodes[0] + nodes[1]) / 2])[: len(nodes)]
            np.testing.assert_allclose(nodes, expected, atol=1e-15)


@pytest.mark.parametrize("kind", KINDS)
def test_traces_are_the_functions_of_the_facets(kind):
    """On a facet an element has its facet type's shape functions, so that neighbours conform."""
    row = element_type(kind)
    for group in row.facets:
        inner = np.random.default_rng(6).dirichlet(np.ones(group.type.corners), 5)
        places = inner @ group.type.natural[: group.type.corners]
        expected = group.type.shape_functions(places)
        for facet in group.nodes:
            # the straight facet: the facet's linear functions carry its places to the element
            linear = element_type({2: "line", 3: "triangle", 4: "quad"}[group.type.corners]).shape_functions(
                places
            )
            values = row.shape_functions(linear @ row.natural[facet[: group.type.corners]])
            np.testing.assert_allclose(values[:, facet], expected, atol=1e-13)
            np.testing.assert_allclose(np.delete(values, facet, axis=1), 0, atol=1e-13)


FACETS = {
    "quad9": {"line3": 4},
    "tetra10": {"triangle6": 4},
    "pyramid": {"quad": 1, "triangle": 4},
    "pyramid13": {"quad8": 1, "triangle6": 4},
    "pyramid14": {"quad9": 1, "triangle6": 4},
    "wedge": {"triangle": 2, "quad": 3},
    "wedge15": {"triangle6": 2, "quad8": 3},
    "wedge18": {"triangle6": 2, "quad9": 3},
    "hexahedron20": {"quad8": 6},
    "hexahedron27": {"quad9": 6},
}


@pytest.mark.parametrize("kind", FACETS)
def test_types_of_facets(kind):
    assert {g.type.name: len(g.nodes) for g in element_type(kind).facets} == FACETS[kind]


def test_properties_that_the_package_asks_for():
    linear = {kind for kind in KINDS if element_type(kind).linear}
    assert linear == set(meshes.CORNERS)
    assert {k for k in KINDS if element_type(k).constant_jacobian} == {"triangle", "tetra"}
    optimal = {k for k in KINDS if element_type(k).ideal_is_optimum}
    assert optimal == {"triangle", "quad", "tetra", "hexahedron"}
    axes = {"quad": (0, 1), "wedge": (2,), "hexahedron": (0, 1, 2)}
    for kind in KINDS:
        row, base = element_type(kind), meshes.LINEAR[kind]
        assert row.singular_corners == ((4,) if base == "pyramid" else ())
        assert row.extruded_axes == axes.get(base, ())
        np.testing.assert_allclose(row.straight @ row.natural[: row.corners], row.natural, atol=1e-15)
        if row.dim == 2:
            ring = [row.natural[: row.corners][list(e)] for e in meshes.EDGES[base]]
            count = 1 if row.linear else 2
            expected = [a + (b - a) * part / count for a, b in ring for part in range(count)]
            np.testing.assert_allclose(row.natural[row.outline], expected, atol=1e-15)


def signed_measure(kind, nodes):
    frames = np.einsum("kd,qke->qde", nodes, element_type(kind).gradients)
    return np.linalg.det(frames) @ element_type(kind).weights


@pytest.mark.parametrize("kind", KINDS)
def test_mirror_reverses_orientation(kind):
    row, nodes = element_type(kind), meshes.distorted(kind)
    np.testing.assert_array_equal(row.mirror[row.mirror], np.arange(row.k))
    assert signed_measure(kind, nodes) > 0
    assert signed_measure(kind, nodes[row.mirror]) == pytest.approx(-signed_measure(kind, nodes), rel=1e-12)
    # mid-side nodes go with their edges
    corners = [int(c) for c in row.mirror[: row.corners]]
    np.testing.assert_array_equal(row.mirror, meshes.extend(kind, corners))


@pytest.mark.parametrize("kind", KINDS)
def test_volume_of_a_curved_element(kind):
    """∫ det ∇Φ for the map Φ that the element reproduces, by a fine rule of the test's own."""
    dim, rng = meshes.dim_of(kind), np.random.default_rng(5)
    linear = np.eye(dim) + 0.1 * rng.normal(size=(dim, dim))
    bend = 0.05 * rng.normal(size=(dim, dim, dim)) * (kind != meshes.LINEAR[kind])
    nodes = unit_ideal(kind)
    image = nodes @ linear.T + np.einsum("dij,ki,kj->kd", bend, nodes, nodes)
    # collapsed Gauss rule over the ideal element: natural points → ideal by its corners
    base = meshes.LINEAR[kind]
    g, w = np.polynomial.legendre.leggauss(8)
    u = np.array(list(product((g + 1) / 2, repeat=dim)))
    weight = np.prod(np.array(list(product(w / 2, repeat=dim))), axis=1)
    x = u.copy()
    if base in ("triangle", "wedge", "tetra"):
        x[:, 1] *= 1 - u[:, 0]
        weight = weight * (1 - u[:, 0])
    if base == "tetra":
        x[:, 2] *= (1 - u[:, 0]) * (1 - u[:, 1])
        weight = weight * (1 - u[:, 0]) * (1 - u[:, 1])
    if base == "pyramid":
        shrink = (1 - u[:, 2])[:, None]
        x[:, :2] = u[:, :2] * shrink + 0.5 * u[:, 2:]
        weight = weight * shrink[:, 0] ** 2
    last = {"triangle": 2, "quad": 3, "tetra": 3, "pyramid": 4, "wedge": 3, "hexahedron": 4}[base]
    axes = nodes[[1, 2 if base in ("triangle", "wedge", "tetra") else 3, last][:dim]] - nodes[0]
    if base == "pyramid":  # x was written in the unit pyramid with its apex above the centre
        axes[2] -= 0.5 * (axes[0] + axes[1])
    place = nodes[0] + x @ axes
    slope = linear + np.einsum("dij,qj->qdi", bend + bend.swapaxes(1, 2), place)
    volume = weight @ np.linalg.det(slope) * abs(np.linalg.det(axes))
    assert weight.sum() * abs(np.linalg.det(axes)) == pytest.approx(1, rel=1e-12)
    assert signed_measure(kind, image) == pytest.approx(volume, rel=1e-12)


@pytest.mark.parametrize("kind", ["pyramid", "wedge", "hexahedron"])
def test_volume_with_bilinear_faces(kind):
    """Divergence theorem: a bilinear face adds the mean of its two triangulations."""
    nodes = meshes.distorted(kind, 0.3)

    def cone(a, b, c):
        return np.linalg.det(nodes[[a, b, c]]) / 6

    volume = 0.0
    for face in meshes.FACES[kind]:
        if len(face) == 3:
            volume += cone(*face)
        else:
            a, b, c, d = face
            volume += (cone(a, b, c) + cone(a, c, d) + cone(a, b, d) + cone(b, c, d)) / 2
    assert signed_measure(kind, nodes) == pytest.approx(volume, rel=1e-12)


@pytest.mark.parametrize("kind", KINDS)
def test_validity_is_tested_at_every_node(kind):
    """Wherever a node or quadrature point has a poor Jacobian, the table sees it."""
    row = element_type(kind)
    places = np.concatenate([row.natural, row.quadrature[0]])
    if meshes.LINEAR[kind] == "pyramid":  # the apex has no Jacobian: along its edges instead
        places = np.delete(places, 4, axis=0)
        near = 1e-3
        places = np.r_[places, [(a * near, b * near, 1 - near) for a in (-1, 1) for b in (-1, 1)]]
    slopes = numeric_gradients(kind, places)
    for seed in range(20):
        nodes = meshes.ideal(kind) + 0.4 * np.random.default_rng(seed).uniform(-1, 1, (row.k, row.dim))
        least = np.linalg.det(np.einsum("kd,qke->qde", nodes, slopes)).min()
        seen = np.linalg.det(np.einsum("kd,qke->qde", nodes, row.validity_gradients)).min()
        assert seen == pytest.approx(least, abs=2e-2 if "pyramid" in kind else 1e-6)


@pytest.mark.parametrize("kind", KINDS)
def test_corner_frames_are_edge_tangents(kind):
    row, nodes = element_type(kind), meshes.distorted(kind)
    base = meshes.LINEAR[kind]
    frames = np.einsum("kd,cke->cde", nodes, row.corner_frames)
    assert len(frames) == (4 if base == "pyramid" else meshes.CORNERS[base])
    assert (np.linalg.det(frames) > 0).all()
    middle = {frozenset(g): n for n, g in enumerate(meshes.groups(kind))}
    for corner, frame in enumerate(frames):
        expected = []
        for edge in meshes.EDGES[base]:
            if corner in edge:
                other = nodes[sum(edge) - corner]
                tangent = other - nodes[corner]
                if not row.linear:  # of the parabola through both ends and the middle
                    tangent = 4 * nodes[middle[frozenset(edge)]] - 3 * nodes[corner] - other
                expected.append(tangent / np.linalg.norm(tangent))
        found = (frame / np.linalg.norm(frame, axis=0)).T
        np.testing.assert_allclose(sorted(map(tuple, found)), sorted(map(tuple, expected)), atol=1e-12)


def test_table_is_cached_by_name():
    assert element_type("tetra") is TYPES["tetra"]


def test_the_table_needs_numpy_alone():
    folder = Path(cells.__file__).parent
    found = set()
    for path in folder.glob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Import):
                found |= {name.name for name in node.names}
            elif isinstance(node, ast.ImportFrom):
                found.add(node.module)
    packages = {name.split(".")[0] for name in found if not name.startswith("jaxsmooth.cells")}
    assert packages <= {"numpy", *sys.stdlib_module_names}
