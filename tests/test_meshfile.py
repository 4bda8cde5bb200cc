"""From `meshio.Mesh` and back: what is taken, what is kept, what is refused."""

from pathlib import Path

import jax
import meshio
import numpy as np
import pytest

from jaxsmooth.cells.table import TYPES, element_type, supported
from jaxsmooth.convert.meshfile import MeshFileError, as_mesh, from_meshio, to_meshio
from jaxsmooth.mesh.orientation import orient
from jaxsmooth.mesh.record import Mesh

MESHES = Path(__file__).parents[2] / "shared" / "meshes"


def grid(n=4):
    """A plane grid of n × n quads in 3D points."""
    axis = np.linspace(0.0, 1.0, n + 1)
    x, y = np.meshgrid(axis, axis, indexing="ij")
    points = np.stack([x.ravel(), y.ravel(), np.full(x.size, 0.25)], axis=1)
    node = np.arange(x.size).reshape(n + 1, n + 1)
    quads = np.stack([node[:-1, :-1], node[1:, :-1], node[1:, 1:], node[:-1, 1:]], axis=-1)
    return points, quads.reshape(-1, 4)


def box(name="tetra", n=2):
    """A box of n³ cells, of hexahedra or of six tetrahedra each."""
    axis = np.linspace(0.0, 1.0, n + 1)
    points = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    node = np.arange(len(points)).reshape(n + 1, n + 1, n + 1)
    corner = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1)]
    hexahedra = np.stack(
        [node[i : n + i, j : n + j, k : n + k].ravel() for i, j, k in corner],
        axis=1,
    )
    if name == "hexahedron":
        return points, hexahedra
    split = [(0, 1, 2, 6), (0, 2, 3, 6), (0, 3, 7, 6), (0, 7, 4, 6), (0, 4, 5, 6), (0, 5, 1, 6)]
    return points, hexahedra[:, split].reshape(-1, 4)


def mirrored(name, nodes):
    return nodes[:, element_type(name).mirror]


# --- Orientation -------------------------------------------------------------------------


@pytest.mark.parametrize("name", supported())
def test_a_block_numbered_the_other_way_round_is_turned(name):
    kind = element_type(name)
    source = meshio.Mesh(kind.ideal, [(name, kind.mirror[None])])
    file = from_meshio(source)
    assert np.array_equal(file.mesh.connectivity[0][0], np.arange(kind.k))
    assert "other way round" in file.notes[0]
    assert np.array_equal(source.cells[0].data, kind.mirror[None])  # the source stays


@pytest.mark.parametrize("name", ["quad", "hexahedron", "tetra"])
def test_mixed_numbering_is_told_from_tangling(name):
    points, nodes = grid() if name == "quad" else box(name)
    kind = element_type(name)
    tangled = points.copy()
    inner = 12 if name == "quad" else 13  # the middle node, pushed through the far side
    tangled[inner, : kind.dim] += 0.9 if name == "quad" else 1.2
    random = np.random.default_rng(1).random(len(nodes)) < 0.4
    numbering = np.where(random[:, None], mirrored(name, nodes), nodes)

    found = orient(tangled[:, : kind.dim], [(kind, numbering)])
    assert np.array_equal(found.reverse[0], random)
    assert (found.measures[0] < 0).any()  # still tangled, and not touched

    file = from_meshio(meshio.Mesh(tangled, [(name, nodes)]))
    assert np.array_equal(file.mesh.connectivity[0], nodes)
    assert any("tangled" in note for note in file.notes)


def test_separate_components_and_types_are_oriented_each():
    points, nodes = box("hexahedron")
    far = points + np.array([5, 0, 0])
    source = meshio.Mesh(
        np.concatenate([points, far]),
        [("hexahedron", mirrored("hexahedron", nodes)), ("hexahedron", nodes + len(points))],
    )
    file = from_meshio(source)
    expected = np.concatenate([nodes, nodes + len(points)])
    assert np.array_equal(file.mesh.connectivity[0], expected)


@pytest.mark.parametrize(
    ("path", "turned", "tangled"),
    [
        ("tri/skfem_ex28_orientation.vtu", [543], 0),
        ("mixed3d/su2_knowles_orientation.vtu", [3680, 4128, 2624], 0),
        ("tet/armadillo_598_init.vtu", [0], 817),
        ("quad/mesquite_inverted_hole_2.vtu", [0], 40),
        ("tet/mesquite_tet_4_tangled.vtu", [0], 9),
        ("hex/mesquite_par_untangle_hex.vtu", [0], 9),
    ],
)
def test_orientation_of_real_meshes(path, turned, tangled):
    if not (MESHES / path).exists():
        pytest.skip("needs the shared meshes")
    source = meshio.read(MESHES / path)
    dim = 2 if path.startswith(("tri", "quad")) else 3
    blocks = [(element_type(c.type), c.data.astype(np.int64)) for c in source.cells]
    found = orient(source.points[:, :dim], blocks)
    assert [int(r.sum()) for r in found.reverse] == turned
    assert sum(int((m < 0).sum()) for m in found.measures) == tangled


# --- What is taken -----------------------------------------------------------------------


def test_blocks_of_one_type_are_merged_and_all_nodes_kept():
    points, quads = grid()
    points = np.concatenate([points, [[9.0, 9.0, 9.0]]])  # an orphan, off the plane
    file = from_meshio(meshio.Mesh(points, [("quad", quads[:5]), ("line", [[0, 1]]), ("quad", quads[5:])]))
    assert file.mesh.types == ("quad",)
    assert file.mesh.dim == 2
    assert file.mesh.points.shape == (26, 2)
    assert np.array_equal(file.mesh.connectivity[0], quads)
    assert [(block, list(rows)) for block, rows in file.placement] == [
        (0, [0, 1, 2, 3, 4]),
        (-1, []),
        (0, list(range(5, 16))),
    ]
    assert any("1 of the 26 nodes belong to no cell" in note for note in file.notes)


def test_repeated_elements_are_used_once():
    """Gmsh 2.2 writes an element once for each of its physical groups."""
    points, quads = grid()
    again = np.roll(quads[[2, 0]], 1, axis=1)
    cells = [("quad", quads[:3]), ("quad", again), ("quad", quads[3:])]
    data = {"gmsh:physical": [np.full(3, 1), np.full(2, 9), np.full(13, 1)]}
    file = from_meshio(meshio.Mesh(points, cells, cell_data=data))
    assert np.array_equal(file.mesh.connectivity[0], quads)
    # elements in groups 1 and 9 are a region of their own
    regions = file.mesh.labels.regions[0]
    assert np.flatnonzero(regions != 1).tolist() == [0, 2]
    assert len(set(regions.tolist())) == 2
    assert any("2 of the 18 quad cells repeat" in note for note in file.notes)
    out = to_meshio(file, cell_data={"q": {"quad": np.arange(16)}}).cell_data["q"]
    assert [list(part) for part in out] == [[0, 1, 2], [2, 0], list(range(3, 16))]


def test_zero_measure_is_a_note():
    points, quads = grid()
    points = points.copy()
    points[quads[3]] = points[quads[3][0]]
    notes = " ".join(from_meshio(meshio.Mesh(points, [("quad", quads)])).notes)
    assert "zero measure, the first is quad 3" in notes


def test_precision_follows_the_points():
    points, quads = grid()
    assert (
        from_meshio(meshio.Mesh(points.astype(np.float32), {"quad": quads})).mesh.points.dtype == np.float32
    )
    with jax.enable_x64(True):
        source = meshio.Mesh(points.astype(">f8"), {"quad": quads.astype(">i4")})
        assert from_meshio(source).mesh.points.dtype == np.float64
        assert from_meshio(source, dtype=np.float32).mesh.points.dtype == np.float32
    with jax.enable_x64(False):
        file = from_meshio(source, dtype="float64")
        assert file.mesh.points.dtype == np.float32
        assert "jax_enable_x64" in file.notes[-1]


def test_fixed_nodes_come_from_point_and_cell_data():
    points, quads = grid()
    mask = np.zeros(len(points))
    mask[[3, 4]] = 1
    marked = np.zeros(len(quads), int)
    marked[0] = 1
    source = meshio.Mesh(points, {"quad": quads}, point_data={"Fixed": mask}, cell_data={"fixed": [marked]})
    assert set(np.flatnonzero(from_meshio(source).fixed)) == {3, 4, *quads[0]}
    source = meshio.Mesh(points, {"quad": quads}, point_sets={"FIXED": [7]})  # an NSET of Abaqus
    assert set(np.flatnonzero(from_meshio(source).fixed)) == {7}


def test_named_sets():
    points, quads = grid()
    source = meshio.Mesh(
        points,
        [("quad", quads), ("line", [[0, 1], [1, 2]])],
        point_sets={"corner": [0], "both": [2]},
        cell_sets={"both": [[1], []], "left": [None, [0]]},
        cell_data={
            "gmsh:physical": [np.full(16, 7), np.array([3, 4])],
            "on": [np.eye(1, 16, 2, dtype=int)[0], [0, 0]],
        },
        field_data={"edge": np.array([4, 1]), "plate": np.array([7, 2])},
    )
    sets = {k: set(np.flatnonzero(v)) for k, v in from_meshio(source).named_sets.items()}
    assert sets == {
        "corner": {0},
        "both": {2, *quads[1]},
        "left": {0, 1},
        "edge": {1, 2},
        "plate": set(range(25)),
        "on": set(quads[2]),
    }


@pytest.mark.parametrize("name", ["gmsh:physical", "medit:ref", "MaterialIDs", "Region_ID", "cell_tags"])
def test_regions_from_material_data(name):
    points, quads = grid()
    tags = np.repeat([1.0, 2.0], 8)  # VTK and Gmsh store integers as floats
    labels = from_meshio(meshio.Mesh(points, {"quad": quads}, cell_data={name: [tags]})).mesh.labels
    assert np.array_equal(labels.regions[0], tags)


def test_a_tag_of_zero_everywhere_says_nothing():
    points, quads = grid()
    data = {"gmsh:physical": [np.zeros(16, int)], "gmsh:geometrical": [np.repeat([1, 2], 8)]}
    labels = from_meshio(meshio.Mesh(points, {"quad": quads}, cell_data=data)).mesh.labels
    assert np.array_equal(labels.regions[0], np.repeat([1, 2], 8))


def test_regions_from_cell_sets_that_divide_the_elements():
    points, quads = grid()
    sets = {
        "all": [np.arange(16)],
        "steel": [np.arange(10)],
        "rubber": [np.arange(10, 16)],
        "load": [[0, 11]],
    }
    labels = from_meshio(meshio.Mesh(points, {"quad": quads}, cell_sets=sets)).mesh.labels
    assert np.array_equal(labels.regions[0], [0] * 10 + [1] * 6)


def test_features_are_the_lower_dimensional_cells():
    points, tetra = box()
    data = {"gmsh:physical": [np.ones(48, int), np.array([5, 6]), np.array([0])]}
    cells = [("tetra", tetra), ("triangle", [[0, 1, 3], [1, 4, 3]]), ("vertex", [[0]])]
    labels = from_meshio(meshio.Mesh(points, cells, cell_data=data)).mesh.labels
    assert labels.feature_types == ("triangle", "vertex")
    assert [list(tags) for tags in labels.feature_tags] == [[5, 6], [0]]
    assert np.array_equal(labels.features[0], [[0, 1, 3], [1, 4, 3]])


# --- Back --------------------------------------------------------------------------------


def test_only_coordinates_change():
    points, quads = grid()
    points = np.concatenate([points, [[9.0, 9.0, 9.0], [0.3, 0.3, 0.25]]])
    source = meshio.Mesh(
        points,
        [("vertex", [[26]]), ("quad", mirrored("quad", quads))],
        point_data={"u": np.arange(27.0)},
        cell_data={"c": [np.array([0]), np.arange(16)]},
        point_sets={"p": [1]},
        cell_sets={"s": [[0], [1]]},
        field_data={"n": np.array([1, 2])},
    )
    file = from_meshio(source)
    moved = np.asarray(file.mesh.points).copy()
    moved[12] += 0.01
    moved[25:] += 1.0  # outside of all elements: stays
    out = to_meshio(file, moved, cell_data={"q": {"quad": np.arange(16.0)}}, point_data={"d": np.ones(27)})
    expected = points.copy()
    expected[12, :2] = moved[12]
    assert np.array_equal(out.points, expected)
    assert np.array_equal(out.cells[1].data, source.cells[1].data)
    assert np.isnan(out.cell_data["q"][0]).all()
    assert np.array_equal(out.cell_data["q"][1], np.arange(16.0))
    assert (out.point_sets, out.cell_sets) == (source.point_sets, source.cell_sets)
    out.cell_data["c"][0] = None  # as writers do
    assert np.array_equal(source.cell_data["c"][0], [0])
    assert set(source.cell_data) == {"c"}
    assert np.array_equal(source.points, points)


def test_float32_leaves_unmoved_coordinates_as_they_were_read():
    points, quads = grid()
    points = points + 1 / 3
    file = from_meshio(meshio.Mesh(points, {"quad": quads}), dtype=np.float32)
    moved = np.asarray(file.mesh.points).copy()
    moved[12, 0] += 0.01
    out = to_meshio(file, moved).points
    assert out.dtype == np.float64
    same = np.ones(out.shape, bool)
    same[12, 0] = False
    assert np.array_equal(out[same], points[same])
    assert out[12, 0] == moved[12, 0]


def test_data_that_do_not_fit_are_refused():
    points, quads = grid()
    file = from_meshio(meshio.Mesh(points, {"quad": quads}))
    with pytest.raises(ValueError, match=r"shape \[3, 2\]"):
        to_meshio(file, np.zeros((3, 2)))
    with pytest.raises(ValueError, match="cell data 'q'"):
        to_meshio(file, cell_data={"q": {"quad": np.zeros(3)}})
    with pytest.raises(ValueError, match="point data 'd'"):
        to_meshio(file, point_data={"d": np.zeros(3)})


def test_as_mesh_takes_whatever_is_a_mesh():
    points, quads = grid()
    source = meshio.Mesh(points, {"quad": quads})
    file = from_meshio(source)
    pair = (points[:, :2], {"quad": quads})
    for anything in (file, file.mesh, source, pair):
        assert isinstance(as_mesh(anything), Mesh)
    with pytest.raises(ValueError, match="can't take dict for a mesh"):
        as_mesh({})


# --- Bad input ---------------------------------------------------------------------------


def changed(array, at, value):
    array = array.copy()
    array[at] = value
    return array


POINTS, QUADS = grid()


@pytest.mark.parametrize(
    ("points", "cells", "sentence"),
    [
        (POINTS, [("line", [[0, 1]]), ("vertex", [[3]])], r"no volume elements.*1 line, 1 vertex"),
        (POINTS, [], "no volume elements.*no cells"),
        (POINTS, [("triangle10", np.arange(20).reshape(2, 10))], r"not supported: triangle10 \(2 cells\)"),
        (
            POINTS,
            [("quad", QUADS), ("polyhedron4", [[[0, 1, 2]]])],
            r"not supported: polyhedron4 \(1 cells\)",
        ),
        (POINTS[:, :2], [("tetra", [[0, 1, 5, 6]])], "only two coordinates"),
        (changed(POINTS, (4, 1), np.inf), [("quad", QUADS)], "node 4 .*not finite.* 1 such nodes"),
        (changed(POINTS, (4, 2), np.nan), [("quad", QUADS)], "node 4 .*not finite"),
        (
            POINTS,
            [("line", [[0, 1]]), ("quad", changed(QUADS, (3, 2), 99))],
            r"cell 4 of the file \(quad 3 of cell block 1.*node 99",
        ),
        (POINTS, [("quad", changed(QUADS, (3, 2), -1))], r"cell 3 .*node -1"),
        (POINTS, [("quad", changed(QUADS, (3, 2), QUADS[3, 1]))], r"cell 3 .*twice"),
    ],
)
def test_bad_input_is_one_sentence(points, cells, sentence):
    with pytest.raises(MeshFileError, match=sentence) as caught:
        from_meshio(meshio.Mesh(points, cells))
    assert "\n" not in str(caught.value)


def test_every_type_has_a_dimension_in_meshio():
    for name in TYPES:
        assert meshio.CellBlock(name, np.zeros((0, TYPES[name].k), int)).dim == TYPES[name].dim
