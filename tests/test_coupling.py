"""Nodes that belong together: found when a mesh is read, linked or held, and said."""

from pathlib import Path

import meshes
import meshio
import numpy as np
import pytest

import jaxsmooth as js
from jaxsmooth.cells.table import element_type
from jaxsmooth.convert.meshfile import MeshFileError, to_meshio
from jaxsmooth.mesh.topology import find_facets

CASES = Path(__file__).parents[2] / "shared" / "cases"


def case(name):
    if not (CASES / name).exists():
        pytest.skip("needs the shared cases")
    return js.read(CASES / name) if not name.endswith(".npz") else np.load(CASES / name)


def held(file):
    mask = file.mesh.labels.held
    return np.zeros(len(file.mesh.points), bool) if mask is None else mask


def linked(file):
    links = file.mesh.labels.links
    return np.zeros(len(file.mesh.points), bool) if links is None else links.members(len(file.mesh.points))


# --- Cohesive cells and contacts ---------------------------------------------------------


@pytest.mark.parametrize("name", ["13_cohesive_straight", "14_contact_straight", "14_contact_wavy"])
def test_pairs_stay_together(name):
    file, pairs = case(f"{name}.vtu"), case(f"{name}_pairs.npz")["pairs"]
    np.testing.assert_array_equal(np.flatnonzero(linked(file)), np.unique(pairs))
    assert not held(file).any()
    result = js.smooth(file, steps=3)
    points = np.asarray(result.mesh.points)
    assert not np.array_equal(points, np.asarray(file.mesh.points))
    np.testing.assert_array_equal(points[pairs[:, 0]], points[pairs[:, 1]])
    assert result.history[-1].statistics.inverted == 0
    assert len(file.notes) == 1
    assert ("move in pairs" if "cohesive" in name else "(parts in contact); they move tog") in file.notes[0]


def test_cohesive_cells_are_written_as_they_were():
    file = case("13_cohesive_straight.vtu")
    assert file.mesh.types == ("triangle",)
    out = to_meshio(file, cell_data={"q": {"triangle": np.ones(128)}})
    assert [c.type for c in out.cells] == ["triangle", "quad"]
    np.testing.assert_array_equal(out.cells[1].data, file.source.cells[1].data)
    assert np.isnan(out.cell_data["q"][1]).all()


@pytest.mark.parametrize(
    "name",
    ["quad", "quad8", "quad9", "wedge", "wedge15", "wedge18", "hexahedron", "hexahedron20", "hexahedron27"],
)
def test_elements_without_thickness_in_every_direction(name):
    """Two blocks of elements, and between them copies of the common nodes with an element of no height."""
    kind = element_type(name)
    axes = [2] if name.startswith("wedge") else range(kind.dim)
    for axis in axes:
        low = kind.natural.copy()
        low[:, axis] = np.where(low[:, axis] == low[:, axis].min(), -1.0, low[:, axis])
        high, closed = low.copy(), low.copy()
        high[:, axis] += 2  # beside the first
        closed[:, axis] = 1  # the facets between the two
        mine = np.flatnonzero(low[:, axis] == 1)
        partner = np.flatnonzero(high[:, axis] == 1)
        order = [int(partner[np.abs(high[partner] - low[i]).sum(axis=1).argmin()]) for i in mine]
        between = np.arange(kind.k) + 2 * kind.k
        for i, j in zip(mine, order, strict=True):
            place = kind.natural.copy()
            target = low[i].copy()
            target[axis] = -1
            between[np.abs(place - target).sum(axis=1).argmin()] = i
            target[axis] = 1
            between[np.abs(place - target).sum(axis=1).argmin()] = kind.k + j
        points = np.concatenate([low, high, closed])
        cells = np.array([np.arange(kind.k), kind.k + np.arange(kind.k), between])
        file = js.from_meshio(meshio.Mesh(points, [(name, cells)]))
        np.testing.assert_array_equal(file.mesh.connectivity[0], cells[:2])
        np.testing.assert_array_equal(file.placement[0][1], [0, 1, -1])
        np.testing.assert_array_equal(np.flatnonzero(linked(file)), np.unique(between))
        links = file.mesh.labels.links
        assert links.rigid.all()
        np.testing.assert_array_equal(points[links.nodes], points[links.parents[:, 0]])
        data = to_meshio(file, cell_data={"q": {name: np.array([3, 4])}}).cell_data["q"][0]
        np.testing.assert_array_equal(data, [3, 4, np.nan])


def test_a_mesh_of_cohesive_cells_alone_is_refused():
    points = np.array([[0.0, 0], [1, 0], [1, 0], [0, 0]])
    with pytest.raises(MeshFileError, match="none of the 1 elements has a thickness"):
        js.as_mesh((points, {"quad": np.array([[0, 1, 2, 3]])}))


def test_a_collapsed_element_is_not_cohesive():
    """Its edges of no length belong to its neighbours too: it has to open."""
    points, blocks = meshes.grid("quad", (4, 4))
    inner = blocks["quad"][5]
    points[inner[[3, 2]]] = points[inner[[0, 1]]]
    file = js.from_meshio(meshio.Mesh(points, blocks))
    assert len(file.mesh.connectivity[0]) == 16
    assert not linked(file).any()


def test_thin_elements_of_few_digits_are_not_cohesive():
    """Five digits say nothing about a height of 1e-5 that was written as such."""
    y = np.array([0, 1e-5, 2e-5, 0.5, 1.0])
    x = np.linspace(0, 1, 5)
    points = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)
    node = np.arange(25).reshape(5, 5)
    quads = np.stack([node[:-1, :-1], node[1:, :-1], node[1:, 1:], node[:-1, 1:]], axis=-1).reshape(-1, 4)
    file = js.from_meshio(meshio.Mesh(points, {"quad": quads}))
    assert len(file.mesh.connectivity[0]) == 16
    assert not linked(file).any()


def test_boundaries_that_come_close_are_left_alone():
    points, blocks = meshes.grid("triangle", (3, 3))
    gap = 1e-3 * np.sin(np.linspace(0, np.pi, len(points)))
    both = np.concatenate([points, points + np.c_[np.full(len(points), 1 + 1e-6), gap]])
    cells = np.concatenate([blocks["triangle"], blocks["triangle"] + len(points)])
    assert not linked(js.from_meshio(meshio.Mesh(both, {"triangle": cells}))).any()


# --- Periodic pairs ----------------------------------------------------------------------


@pytest.mark.parametrize("file_format", ["gmsh", "gmsh22"])
def test_periodic_links_of_gmsh(tmp_path, file_format):
    """A square whose left and right sides Gmsh itself linked."""
    gmsh = pytest.importorskip("gmsh")
    gmsh.initialize(interruptible=False)
    try:
        gmsh.option.setNumber("General.Terminal", 0)
        gmsh.option.setNumber("Mesh.MeshSizeMax", 0.3)
        gmsh.option.setNumber("Mesh.MshFileVersion", {"gmsh": 4.1, "gmsh22": 2.2}[file_format])
        gmsh.model.occ.addRectangle(0, 0, 0, 1, 1)
        gmsh.model.occ.synchronize()
        gmsh.model.mesh.setPeriodic(1, [2], [4], [1, 0, 0, 1, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1])
        gmsh.model.mesh.generate(2)
        gmsh.write(str(tmp_path / "square.msh"))
    finally:
        gmsh.finalize()
    file = js.read(tmp_path / "square.msh")
    x, y = np.asarray(file.mesh.points).T
    sides = (x == 0) | (np.abs(x - 1) < 1e-12)
    assert sides.sum() >= 10
    np.testing.assert_array_equal(linked(file), sides)
    assert (js.detect_constraints(file.mesh).freedom[~sides & (y > 1e-9) & (y < 1 - 1e-9)] == 2).all()


def periodic(links):
    points, blocks = meshes.grid("triangle", (3, 3))
    return js.from_meshio(meshio.Mesh(points, blocks, gmsh_periodic=links(points)))


def sides(points):
    return [np.flatnonzero(points[:, 0] == x) for x in (0, 1)]


@pytest.mark.parametrize("affine", [None, np.zeros(0)])
def test_periodic_pairs_without_a_map(affine):
    file = periodic(lambda points: [[1, (1, 2), affine, np.c_[tuple(sides(points))].astype(np.uint64)]])
    left, right = sides(np.asarray(file.mesh.points))
    np.testing.assert_array_equal(np.flatnonzero(linked(file)), np.union1d(left, right))
    assert file.notes == ("8 nodes are linked in periodic pairs; they move together",)
    np.testing.assert_array_equal(file.mesh.labels.links.rotations, np.tile(np.eye(2), (4, 1, 1)))


def test_pairs_that_no_rigid_map_explains_are_held():
    def mixed(points):
        left, right = sides(points)
        return [[1, (1, 2), None, np.c_[left, right[[0, 2, 1, 3]]]]]

    file = periodic(mixed)
    assert not linked(file).any()
    assert held(file).sum() == 8
    assert "no translation or rotation explains; they are held" in file.notes[0]


@pytest.mark.parametrize("given", [True, False])
def test_the_rotation_of_a_sector(given):
    """Left and lower side of a square, linked by a quarter turn; the file may name the map or not."""
    turn = np.array([[0.0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])

    def quarter(points):
        low = np.flatnonzero(points[:, 1] == 0)
        low = low[np.argsort(points[low, 0])]
        left = np.flatnonzero(points[:, 0] == 0)
        left = left[np.argsort(points[left, 1])]
        return [
            [0, (4, 2), turn.ravel() if given else None, np.c_[left, low][-1:]],
            [1, (1, 2), turn.ravel() if given else None, np.c_[left, low]],
        ]

    file = periodic(quarter)
    links = file.mesh.labels.links
    np.testing.assert_array_equal(links.rotations, np.tile(turn[:2, :2], (len(links.nodes), 1, 1)))
    corner = np.flatnonzero((np.asarray(file.mesh.points) == 0).all(axis=1))
    assert corner in links.nodes[links.nodes == links.parents[:, 0]]  # it is linked to itself


def test_the_map_of_a_plane_mesh_in_space():
    """The affine map is one of space; the links are between coordinates in the plane."""
    points, blocks = meshes.grid("triangle", (3, 3))
    turn, shift = meshes.rotation_matrix(3, seed=3), np.array([3.0, 1, -2])
    quarter = turn @ np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]) @ turn.T
    affine = np.eye(4)
    affine[:3, :3], affine[:3, 3] = quarter, shift - quarter @ shift
    low, left = (np.flatnonzero(points[:, k] == 0) for k in (1, 0))
    low, left = low[np.argsort(points[low, 0])], left[np.argsort(points[left, 1])]
    space = np.c_[points, np.zeros(len(points))] @ turn.T + shift
    pairs = np.c_[left, low]
    np.testing.assert_allclose(space[left], space[low] @ quarter.T + affine[:3, 3], atol=1e-12)
    links = [[0, (1, 2), affine.ravel(), pairs[-1:]]]  # one pair says nothing of the rotation by itself
    file = js.from_meshio(meshio.Mesh(space, blocks, gmsh_periodic=links))
    assert file.plane is not None
    found = file.mesh.labels.links.rotations[0]
    flat = np.asarray(file.mesh.points)
    corner = np.flatnonzero((points == 0).all(axis=1))[0]
    np.testing.assert_allclose(
        flat[left] - flat[corner], (flat[low] - flat[corner]) @ found.T, rtol=0, atol=1e-12
    )


# --- Hanging nodes -----------------------------------------------------------------------


def test_hanging_nodes_of_a_plane_mesh():
    file, meta = case("02_hanging.vtu"), case("02_hang_meta.npz")
    np.testing.assert_array_equal(np.flatnonzero(linked(file)), np.union1d(meta["hang"], meta["par"]))
    assert "they move with its nodes" in file.notes[0]
    points = np.asarray(js.smooth(file, steps=3).mesh.points)
    np.testing.assert_allclose(points[meta["hang"]], points[meta["par"]].mean(axis=1), atol=1e-14)


def refined(parts, turn=False):
    """Two unit cubes side by side, the second cut into `parts` a side: points, hexahedra, hanging nodes."""
    grid, cells = meshes.grid("hexahedron", (parts,) * 3)
    corners, one = meshes.grid("hexahedron", (1, 1, 1))
    grid = grid + np.array([1, 0, 0])
    points = np.concatenate([corners, grid])
    number = np.arange(len(points))
    for node, place in enumerate(corners):
        match = np.flatnonzero((np.abs(grid - place) < 1e-12).all(axis=1))
        number[len(corners) + match] = node  # shared
    nodes = np.concatenate([one["hexahedron"], number[cells["hexahedron"] + len(corners)]])
    used, nodes = np.unique(nodes, return_inverse=True)
    points = points[used]
    face = np.abs(points[:, 0] - 1) < 1e-12
    ends = (np.abs(points[:, 1:] - 0.5) > 0.5 - 1e-12).all(axis=1)
    if turn:
        points = points @ meshes.rotation_matrix(3).T
    return points, nodes.reshape(-1, 8), face & ~ends, face & ends


@pytest.mark.parametrize(("parts", "turn"), [(2, False), (2, True), (3, True), (4, False)])
def test_hanging_nodes_of_hexahedra(parts, turn):
    points, nodes, hanging, corners = refined(parts, turn)
    assert hanging.sum() == (parts + 1) ** 2 - 4
    file = js.from_meshio(meshio.Mesh(points, {"hexahedron": nodes}))
    links = file.mesh.labels.links
    np.testing.assert_array_equal(np.unique(links.nodes), np.flatnonzero(hanging))
    np.testing.assert_array_equal(linked(file), hanging | corners)
    np.testing.assert_allclose(links.weights.sum(axis=1), 1, atol=1e-14)
    led = (links.weights[..., None] * points[links.parents]).sum(axis=1)
    np.testing.assert_allclose(led, points[links.nodes], atol=1e-14)
    # the face between the two is no boundary: what hangs there has no constraint of its own
    outer = sum(int((part.partner < 0).sum()) for part in find_facets(file.mesh))
    assert outer == 5 + 5 * parts**2
    assert any(f"{hanging.sum()} nodes hang on an edge or a face" in note for note in file.notes)


@pytest.mark.parametrize("name", ["triangle", "quad8", "tetra", "wedge15", "hexahedron27"])
def test_conforming_meshes_have_no_coupled_nodes(name):
    points, blocks = meshes.grid(name, amplitude=0.1)
    file = js.from_meshio(meshio.Mesh(points, blocks))
    assert file.mesh.labels.held is None
    assert file.mesh.labels.links is None
    assert file.notes == ()


# --- Shells and other cells ----------------------------------------------------------------


@pytest.mark.parametrize(("name", "count"), [("15_shellfin2.vtu", 9), ("15_web.vtu", 15)])
def test_shells_keep_their_shape(name, count):
    file = case(name)
    assert held(file).sum() == count
    shell = file.source.cells[1].data
    moved = to_meshio(file, js.smooth(file, steps=3).mesh.points).points
    np.testing.assert_array_equal(moved[shell], file.source.points[shell])


def test_boundary_faces_and_interfaces_still_slide():
    points, blocks = meshes.grid("hexahedron", (2, 2, 2))
    nodes = blocks["hexahedron"]
    faces = np.concatenate([nodes[:, f] for f in element_type("hexahedron").facets[0].nodes])
    top = faces[(points[faces][..., 2] == 1).all(axis=1)]
    middle = faces[(points[faces][..., 0] == 0.5).all(axis=1)]
    regions = (points[nodes].mean(axis=1)[:, 0] > 0.5).astype(int)
    for inner, same in ((middle, False), (middle, True)):
        data = {"material": [1 + (0 if same else 1) * regions, np.zeros(len(top) + len(inner), int)]}
        cells = [("hexahedron", nodes), ("quad", np.concatenate([top, inner]))]
        file = js.from_meshio(meshio.Mesh(points, cells, cell_data=data))
        expected = np.unique(inner) if same else []
        np.testing.assert_array_equal(np.flatnonzero(held(file)), expected)


def test_lines_inside_a_material_stay_on_their_line_and_others_are_held():
    points, blocks = meshes.grid("quad", (3, 3))
    rows = np.lexsort(points.T)
    line = rows[4:8]  # along y = 1/3
    on_edges = np.c_[line[:-1], line[1:]]
    file = js.from_meshio(meshio.Mesh(points, [*blocks.items(), ("line", on_edges)]))
    assert file.mesh.labels.held is None
    across = np.array([[rows[5], rows[10]]])  # a truss across an element
    file = js.from_meshio(meshio.Mesh(points, [*blocks.items(), ("line", across)]))
    np.testing.assert_array_equal(np.flatnonzero(held(file)), np.sort(across[0]))
    assert "1 cells of lower dimension are no edges" in file.notes[0]


def test_marks_of_the_file_hold_without_being_passed_on():
    points, blocks = meshes.grid("quad", (3, 3), 0.1)
    mark = np.zeros(16, int)
    inner = np.flatnonzero((np.abs(points - 0.5) < 0.4).all(axis=1))[:2]
    mark[inner] = 1
    file = js.from_meshio(meshio.Mesh(points, blocks, point_data={"fixed": mark}))
    assert (js.detect_constraints(file.mesh).freedom[inner] == 0).all()
