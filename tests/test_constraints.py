"""Which way nodes may move, against normals known from how each mesh was made."""

import meshes
import numpy as np
import pytest

from jaxsmooth.mesh.record import Labels, Mesh
from jaxsmooth.motion.detect import detect_constraints
from jaxsmooth.motion.planar import Constraints
from jaxsmooth.numerics.rounding import coordinate_error

MIXED = {"mixed 2d": meshes.mixed_2d, "mixed 3d": meshes.mixed_3d}


def build(name, amplitude=0.1, shape=None):
    return MIXED[name](amplitude) if name in MIXED else meshes.grid(name, shape, amplitude)


def projectors_of(normals, dim):
    """Onto what is normal to the listed vectors of every node, by the pseudo-inverse."""
    found = []
    for vectors in normals:
        n = np.asarray(vectors, float).reshape(-1, dim)
        found.append(np.eye(dim) - np.linalg.pinv(n) @ n)
    return np.array(found)


@pytest.mark.parametrize("name", [*meshes.KINDS, *MIXED])
def test_box_turned_and_sheared(name):
    points, blocks = build(name)
    dim = points.shape[1]
    change = meshes.rotation_matrix(dim) @ (np.eye(dim) + 0.3 * np.eye(dim, k=1))
    axes = np.linalg.inv(change)
    sides = meshes.box_normals(points)
    found = detect_constraints(Mesh(100 * points @ change.T - 30, blocks))
    np.testing.assert_allclose(found.projectors, projectors_of([axes[s] for s in sides], dim), atol=1e-7)
    np.testing.assert_array_equal(found.freedom, [dim - len(s) for s in sides])


def test_counts_of_a_cube():
    found = detect_constraints(Mesh(*meshes.grid("tetra"))).freedom
    np.testing.assert_array_equal(np.bincount(found), [8, 12, 6, 1])


def test_polygon_with_a_reentrant_corner():
    points, blocks = meshes.grid("quad", (4, 4))
    centre = points[blocks["quad"]].mean(axis=1)
    kept = blocks["quad"][~((centre > 0.5).all(axis=1))]
    used, nodes = np.unique(kept, return_inverse=True)
    x, y = points[used].T
    found = detect_constraints(
        Mesh(points[used] @ meshes.rotation_matrix(2).T, {"quad": nodes.reshape(-1, 4)})
    )
    corner = ((x == 0) | (x == 1) | ((x == 0.5) & (y >= 0.5))) & (
        (y == 0) | (y == 1) | ((y == 0.5) & (x >= 0.5))
    )
    vertical = (x == 0) | (x == 1) | ((x == 0.5) & (y >= 0.5))
    horizontal = (y == 0) | (y == 1) | ((y == 0.5) & (x >= 0.5))
    assert corner.sum() == 6  # of the L
    np.testing.assert_array_equal(found.freedom, 2 - vertical.astype(int) - horizontal)


@pytest.mark.parametrize("name", ["triangle", "quad8", "tetra", "hexahedron", "tetra10", "mixed 3d"])
@pytest.mark.parametrize("rounding", ["float32", 5, 6, 7])
def test_coordinates_of_limited_precision(name, rounding):
    points, blocks = build(name)
    dim = points.shape[1]
    turned = 3 * points @ meshes.rotation_matrix(dim, 4).T + 1
    if rounding == "float32":
        rounded = turned.astype(np.float32)
    else:
        rounded = np.array([[float(f"{x:.{rounding}g}") for x in row] for row in turned])
    found = detect_constraints(Mesh(rounded, blocks))
    assert found.projectors.dtype == rounded.dtype
    expected = detect_constraints(Mesh(turned, blocks))
    np.testing.assert_array_equal(found.freedom, expected.freedom)
    np.testing.assert_array_equal(found.freedom, [dim - len(s) for s in meshes.box_normals(points)])
    np.testing.assert_allclose(found.projectors, expected.projectors, atol=5e-3)


@pytest.mark.parametrize("digits", [5, 6, 7])
def test_coordinate_error(digits):
    values = np.random.default_rng(0).uniform(1, 10, (50, 3))
    rounded = np.array([[float(f"{x:.{digits}g}") for x in row] for row in values])
    assert coordinate_error(rounded) == pytest.approx(0.5 * 10.0 ** (1 - digits), rel=1e-6)
    assert coordinate_error(values).max() < 1e-14
    assert 1e-8 < coordinate_error(values.astype(np.float32)).max() < 1e-5
    assert (coordinate_error(np.zeros((3, 3))) == 0).all()
    far = (values * np.where(np.arange(50) < 25, 1e-3, 1e3)[:, None]).astype(np.float32)
    near_error, far_error = np.split(coordinate_error(far), 2)
    assert near_error.max() < 1e-4 * far_error.min()  # a far field does not blur what is near the origin


def pipe(kind, amplitude=0.0):
    """A quarter of a pipe, radii 1 to 2, length 1 along z; the unit cube is its parameter space."""
    points, blocks = meshes.grid(kind, (3, 3, 3), amplitude)
    radius, angle = 1 + points[:, 0], points[:, 1] * np.pi / 2
    return points, np.c_[radius * np.cos(angle), radius * np.sin(angle), points[:, 2]], blocks


@pytest.mark.parametrize("kind", ["hexahedron", "wedge", "hexahedron20", "hexahedron27"])
def test_curved_side_is_held_but_slides_along_its_straight_lines(kind):
    parameters, points, blocks = pipe(kind)
    turn = meshes.rotation_matrix(3, 2)
    found = detect_constraints(Mesh(points @ turn.T, blocks), boundary="planar")
    curved = np.abs(parameters[:, 0] - 0.5) > 0.5 - 1e-9
    ends = meshes.box_normals(parameters)
    angle = parameters[:, 1] * np.pi / 2
    normals = []
    for node, sides in enumerate(ends):
        mine = []
        if curved[node]:
            mine += [(1, 0, 0), (0, 1, 0)]  # nothing but the axis is left
        if 1 in sides:
            mine.append((-np.sin(angle[node]), np.cos(angle[node]), 0))
        if 2 in sides:
            mine.append((0, 0, 1))
        normals.append(np.reshape(mine, (-1, 3)) @ turn.T)
    expected = projectors_of(normals, 3)
    if kind == "wedge":  # diagonals of the curved side are cut by the fold: still straight along z
        assert len(blocks["wedge"]) == 54
    np.testing.assert_allclose(found.projectors, expected, atol=1e-6)


def test_feature_angle_tells_folds_of_a_curve_from_edges():
    parameters, points, blocks = pipe("hexahedron")  # folds of 30° along the curved sides
    radius_side = np.abs(parameters[:, 0] - 0.5) > 0.5 - 1e-9
    inner = radius_side & (parameters[:, 1] % 1 > 1e-9) & (parameters[:, 2] % 1 > 1e-9)
    edges = radius_side & (parameters[:, 1] % 1 < 1e-9) & (parameters[:, 2] % 1 > 1e-9)
    for angle, freedom in ((0.0, 1), (25.0, 1), (35.0, 0)):
        found = detect_constraints(Mesh(points, blocks), boundary="planar", feature_angle=angle).freedom
        np.testing.assert_array_equal(found[inner], freedom)
        np.testing.assert_array_equal(found[edges], 1)  # real edges of the pipe, near 90°
        assert (found == 2).any()


def test_flatness_can_be_given():
    points, blocks = meshes.grid("quad", (4, 4))
    points = (
        points + np.c_[np.zeros(len(points)), 0.01 * points[:, 0] * (1 - points[:, 0])]
    )  # angles of 0.005
    side = (points[:, 0] > 0) & (points[:, 0] < 1) & (np.abs(points[:, 1] - 0.005) < 0.006)
    assert side.sum() == 3
    mesh = Mesh(points, blocks)
    np.testing.assert_array_equal(detect_constraints(mesh, boundary="planar").freedom[side], 0)
    np.testing.assert_array_equal(detect_constraints(mesh, flatness=0.02).freedom[side], 1)


@pytest.mark.parametrize("name", ["quad", "tetra10", "mixed 3d"])
def test_fixed_boundary(name):
    points, blocks = build(name)
    inside = np.array([len(s) == 0 for s in meshes.box_normals(points)])
    found = detect_constraints(Mesh(points, blocks), boundary="fixed")
    np.testing.assert_array_equal(found.freedom, points.shape[1] * inside)
    assert inside.any() or name == "mixed 3d"


def test_fixed_nodes_by_mask_and_by_index():
    points, blocks = meshes.grid("tetra")
    mesh, free = Mesh(points, blocks), detect_constraints(Mesh(points, blocks)).freedom
    chosen = np.array([3, 13, 20])
    mask = np.zeros(len(points), bool)
    mask[chosen] = True
    for fixed in (mask, chosen, chosen.tolist()):
        found = detect_constraints(mesh, fixed=fixed).freedom
        np.testing.assert_array_equal(found[chosen], 0)
        np.testing.assert_array_equal(found[~mask], free[~mask])
        np.testing.assert_array_equal(Constraints.hold(mesh, fixed).freedom, np.where(mask, 0, 3))
    np.testing.assert_array_equal(detect_constraints(mesh, fixed=[]).freedom, free)


def test_wrong_arguments_are_refused():
    mesh = Mesh(*meshes.grid("quad"))
    with pytest.raises(ValueError, match="boundary must be 'slide', 'planar' or 'fixed', got 'glue'"):
        detect_constraints(mesh, boundary="glue")
    with pytest.raises(ValueError, match="interfaces must be"):
        detect_constraints(mesh, interfaces="open")
    with pytest.raises(ValueError, match=r"mask of fixed nodes has shape \[3\]; the mesh has 16 nodes"):
        detect_constraints(mesh, fixed=np.ones(3, bool))
    for bad in ([16], [-1]):
        with pytest.raises(ValueError, match="out of range; the mesh has 16 nodes"):
            detect_constraints(mesh, fixed=bad)


def halves(points, nodes, axis=0):
    return (points[nodes].mean(axis=1)[:, axis] > 0.5).astype(int)


@pytest.mark.parametrize("kind", ["quad", "triangle6", "tetra", "hexahedron20"])
@pytest.mark.parametrize("tags", [(0, 1), (7, 3), (-1, 4), (-5, -2)])
def test_interfaces_between_regions(kind, tags):
    shape = (4, 4) if meshes.dim_of(kind) == 2 else (2, 2, 2)
    points, blocks = meshes.grid(kind, shape)
    dim, nodes = points.shape[1], blocks[kind]
    labels = Labels(regions=(np.array(tags)[halves(points, nodes)],))
    mesh = Mesh(points, blocks, labels)
    between = np.abs(points[:, 0] - 0.5) < 1e-9
    sides = meshes.box_normals(points)
    expected = projectors_of(
        [np.eye(dim)[sorted({*s, 0} if b else s)] for s, b in zip(sides, between, strict=True)], dim
    )
    np.testing.assert_allclose(detect_constraints(mesh).projectors, expected, atol=1e-12)
    held = detect_constraints(mesh, interfaces="fixed")
    np.testing.assert_array_equal(held.freedom[between], 0)
    np.testing.assert_allclose(np.asarray(held.projectors)[~between], expected[~between], atol=1e-12)


@pytest.mark.parametrize(
    ("first", "second", "same"), [(1, 2, False), (4, 4, True), (-1, -2, False), (-3, -3, True)]
)
def test_interfaces_between_blocks(first, second, same):
    """Two blocks of different types: their regions decide, not their being two blocks."""
    points, blocks = meshes.grid("quad", (2, 2))
    right = halves(points, blocks["quad"]).astype(bool)
    quads, cut = blocks["quad"][~right], blocks["quad"][right]
    triangles = np.concatenate([cut[:, [0, 1, 2]], cut[:, [0, 2, 3]]])
    regions = (np.full(2, first), np.full(4, second))
    mesh = Mesh(points, {"quad": quads, "triangle": triangles}, Labels(regions=regions))
    centre = (np.abs(points - 0.5) < 1e-9).all(axis=1)
    assert detect_constraints(mesh).freedom[centre] == (2 if same else 1)


def test_same_negative_region_in_blocks_with_other_regions():
    points, blocks = meshes.grid("quad", (2, 3))
    nodes = blocks["quad"]
    left = ~halves(points, nodes).astype(bool)
    region = np.where(points[nodes].mean(axis=1)[:, 1] > 0.7, -3, -1)
    parts = [("quad", nodes[left]), ("quad", nodes[~left])]
    region_parts = (np.full(left.sum(), -1), region[~left])  # −3 only in the second block
    mesh = Mesh(points, parts, Labels(regions=region_parts))
    centre = (np.abs(points - [0.5, 1 / 3]) < 1e-9).all(
        axis=1
    )  # all four elements around it are of region −1
    assert detect_constraints(mesh).freedom[centre] == 2


def test_embedded_line_is_kept():
    points, blocks = meshes.grid("quad")
    on = np.flatnonzero(np.abs(points[:, 1] - 1 / 3) < 1e-9)
    on = on[np.argsort(points[on, 0])][:4]
    lines = np.c_[on[:-1], on[1:]]
    labels = Labels((np.zeros(9, int),), (lines,), (np.zeros(3, int),), ("line",))
    found = detect_constraints(Mesh(points, blocks, labels))
    np.testing.assert_allclose(np.asarray(found.projectors)[on[1:3]], [np.diag([1.0, 0])] * 2, atol=1e-12)
    np.testing.assert_array_equal(found.freedom[on[[0, 3]]], 0)  # its ends
    free = detect_constraints(Mesh(points, blocks)).freedom
    others = np.setdiff1d(np.arange(16), on)
    np.testing.assert_array_equal(found.freedom[others], free[others])
    # two tags meet at the second node: it is an end of both
    labels = Labels((np.zeros(9, int),), (lines,), (np.array([1, 2, 2]),), ("line",))
    found = detect_constraints(Mesh(points, blocks, labels))
    np.testing.assert_array_equal(found.freedom[on], [0, 0, 1, 0])


def test_tagged_patches_on_one_plane_keep_their_border():
    points, blocks = meshes.grid("hexahedron", (4, 2, 2))
    top = [f for f in blocks["hexahedron"][:, 4:] if (points[f][:, 2] == 1).all()]
    assert len(top) == 8
    tags = halves(points, np.array(top))
    labels = Labels((np.zeros(16, int),), (np.array(top),), (tags,), ("quad",))
    found = detect_constraints(Mesh(points, blocks, labels))
    x, y, z = points.T
    border = (np.abs(x - 0.5) < 1e-9) & (z == 1)
    middle = border & (np.abs(y - 0.5) < 1e-9)
    np.testing.assert_allclose(np.asarray(found.projectors)[middle], [np.diag([0.0, 1, 0])], atol=1e-12)
    np.testing.assert_array_equal(found.freedom[border & ~middle], 0)  # where it meets the edges of the box
    plain = detect_constraints(Mesh(points, blocks)).freedom
    np.testing.assert_array_equal(found.freedom[~border], plain[~border])
    # one tag: the patch has no border within the plane
    labels = Labels((np.zeros(16, int),), (np.array(top),), (0 * tags,), ("quad",))
    np.testing.assert_array_equal(detect_constraints(Mesh(points, blocks, labels)).freedom, plain)


def test_embedded_surface_is_kept():
    points, blocks = meshes.grid("hexahedron", (2, 2, 2))
    faces = [f[[1, 2, 6, 5]] for f in blocks["hexahedron"] if (points[f[[1, 2, 6, 5]]][:, 0] == 0.5).all()]
    assert len(faces) == 4
    labels = Labels((np.zeros(8, int),), (np.array(faces),), (np.zeros(4, int),), ("quad",))
    found = detect_constraints(Mesh(points, blocks, labels))
    centre = (points == 0.5).all(axis=1)
    np.testing.assert_allclose(np.asarray(found.projectors)[centre], [np.diag([0.0, 1, 1])], atol=1e-12)


def test_vertices_are_held():
    points, blocks = meshes.grid("tetra")
    labels = Labels((np.zeros(48, int),), (np.array([[13], [4]]),), (np.array([0, 1]),), ("vertex",))
    found = detect_constraints(Mesh(points, blocks, labels)).freedom
    plain = detect_constraints(Mesh(points, blocks)).freedom
    np.testing.assert_array_equal(found[[13, 4]], 0)
    assert (plain[[13, 4]] > 0).all()
    np.testing.assert_array_equal(np.delete(found, [13, 4]), np.delete(plain, [13, 4]))


@pytest.mark.parametrize("name", ["triangle6", "mixed 3d", "hexahedron27"])
def test_node_renumbering(name):
    points, blocks = build(name)
    order = np.random.default_rng(0).permutation(len(points))
    number = np.argsort(order)
    found = detect_constraints(Mesh(points[order], {k: number[n][::-1] for k, n in blocks.items()}))
    expected = np.asarray(detect_constraints(Mesh(points, blocks)).projectors)[order]
    np.testing.assert_allclose(found.projectors, expected, atol=1e-12)


def test_quadratic_and_linear_elements_share_facets():
    """A face between a hexahedron20 and a hexahedron is not a boundary."""
    points, blocks = meshes.grid("hexahedron", (2, 1, 1))
    lower, upper = blocks["hexahedron"]
    points, raised = meshes.raise_order(points, {"hexahedron": lower[None]}, {"hexahedron": "hexahedron20"})
    found = detect_constraints(Mesh(points, {**raised, "hexahedron": upper[None]}))
    sides = meshes.box_normals(points)
    np.testing.assert_array_equal(found.freedom, [3 - len(s) for s in sides])


# --- Facets without a direction, and units -----------------------------------------------------


def with_doubled_corner(offset=0.0):
    """A unit square whose corner has a second boundary node on it: a side without length."""
    points = 1 / 3 + np.array([[0.0, 0], [1, 0], [1, 1], [0, 1], [offset, 0], [0.5, 0.5]])
    triangles = np.array([[0, 4, 5], [4, 1, 5], [1, 2, 5], [2, 3, 5], [3, 0, 5]])
    return Mesh(points, {"triangle": triangles})


@pytest.mark.parametrize("offset", [0.0, 1e-16])
def test_a_side_without_length_frees_nobody(offset):
    np.testing.assert_array_equal(detect_constraints(with_doubled_corner(offset)).freedom, [0, 0, 0, 0, 0, 2])
    np.testing.assert_array_equal(detect_constraints(with_doubled_corner(0.5)).freedom, [0, 0, 0, 0, 1, 2])


def test_nodes_that_coincide_on_a_flat_side_still_slide_along_it():
    points = np.array([[0.0, 0], [1, 0], [1, 1], [0, 1], [0.5, 0], [0.5, 0], [0.5, 0.5]])
    triangles = np.array([[0, 4, 6], [4, 5, 6], [5, 1, 6], [1, 2, 6], [2, 3, 6], [3, 0, 6]])
    found = detect_constraints(Mesh(points, {"triangle": triangles}))
    np.testing.assert_array_equal(np.asarray(found.projectors)[[4, 5]], [np.diag([1.0, 0.0])] * 2)


def test_a_face_without_area_frees_nobody():
    """A tetrahedron flat against the edge of a box: its boundary face has three nodes in a row."""
    points, blocks = meshes.grid("tetra", (1, 1, 1))
    edge = np.flatnonzero((points[:, 1] == 0) & (points[:, 2] == 0))
    points = np.concatenate([points, [points[edge].mean(axis=0)]])
    tetra = blocks["tetra"]
    inner = np.setdiff1d(np.arange(8), edge)
    touching = tetra[np.isin(tetra, edge).sum(axis=1) == 2]
    third = np.setdiff1d(touching[0], edge)[0]
    cells = np.concatenate([tetra, [[*edge, 8, third]]])
    freedom = detect_constraints(Mesh(points, {"tetra": cells})).freedom
    assert freedom[8] <= 1
    np.testing.assert_array_equal(freedom[edge], 0)
    assert len(inner) == 6


def turned_box():
    points, blocks = meshes.mixed_3d(0.1)
    return 3 * points @ meshes.rotation_matrix(3, 4).T + 1, blocks


def few_digits():
    points, blocks = meshes.grid("hexahedron", (4, 4, 4))
    return points * [1.0, 0.3, 2.7] + 0.1, blocks


SCALED = {
    "dyadic": lambda: meshes.grid("hexahedron", (4, 4, 4)),
    "few digits": few_digits,
    "full": turned_box,
    "pipe": lambda: pipe("hexahedron20")[1:],
    "quarters": lambda: meshes.grid("triangle", (4, 4)),
}


@pytest.mark.parametrize("name", SCALED)
@pytest.mark.parametrize("power", [-30, 20])
def test_units_that_differ_by_a_power_of_two_change_nothing(name, power):
    points, blocks = SCALED[name]()
    one = np.asarray(detect_constraints(Mesh(points, blocks), boundary="planar").projectors)
    other = np.asarray(detect_constraints(Mesh(points * 2.0**power, blocks), boundary="planar").projectors)
    assert one.dtype == np.float64
    np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("name", SCALED)
def test_projectors_are_exact(name):
    found = np.asarray(detect_constraints(Mesh(*SCALED[name]()), boundary="planar").projectors)
    np.testing.assert_array_equal(found, found.swapaxes(1, 2))
    np.testing.assert_allclose(found @ found, found, atol=1e-15)
    if name in ("dyadic", "few digits", "quarters"):  # sides normal to the axes
        assert set(np.unique(found)) == {0.0, 1.0}
