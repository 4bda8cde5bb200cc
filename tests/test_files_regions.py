"""Materials as files say them: groups that overlap, uniform tags, sections, sets; and written again."""

import importlib.util
from pathlib import Path

import jax
import meshio
import numpy as np
import pytest
from test_files_damage import anew

import jaxsmooth as js
from jaxsmooth.convert.meshfile import from_meshio
from jaxsmooth.files.io import MeshFileError, read, write

DATA = Path(__file__).parent / "data"
needs_netcdf = pytest.mark.skipif(importlib.util.find_spec("netCDF4") is None, reason="needs netCDF4")


@pytest.fixture(autouse=True)
def double_precision():
    with jax.enable_x64(True):
        yield


def regions(mesh):
    return [np.asarray(r).tolist() for r in mesh.labels.regions]


def interface(mesh):
    """Nodes of elements of two regions."""
    tags = np.concatenate(mesh.labels.regions)
    nodes = [row for c in mesh.connectivity for row in np.asarray(c)]
    sides = [
        np.unique(np.concatenate([n for n, t in zip(nodes, tags, strict=True) if t == k])) for k in set(tags)
    ]
    assert len(sides) == 2
    return np.intersect1d(*sides)


# Radius and nodes on it, as the cases were made.
CIRCLES = {
    "22_groups_first_2.2.msh": (0.25, 20, 78),
    "22_groups_first_4.1.msh": (0.25, 20, 78),
    "22_groups_last_4.1.msh": (0.25, 20, 78),
    "28_uniform.vtu": (0.25, 20, 78),
    "16_partition.inp": (0.28, 24, 36),
    "16_onlycore.inp": (0.28, 24, 36),
}


@pytest.mark.parametrize("name", CIRCLES)
def test_the_inner_material_is_found(name):
    radius, count, inside = CIRCLES[name]
    mesh = read(DATA / name).mesh
    nodes = interface(mesh)
    distance = np.linalg.norm(np.asarray(mesh.points)[nodes] - 0.5, axis=1)
    assert len(nodes) == count
    assert np.allclose(distance, radius, rtol=0, atol=1e-7)  # the .inp files have seven digits
    assert sorted(np.unique(np.concatenate(mesh.labels.regions), return_counts=True)[1])[0] == inside
    if name.startswith("16"):
        assert np.array_equal(nodes, np.flatnonzero(np.load(DATA / "16_intf.npz")["intf"]))


@pytest.mark.parametrize("name", ["22_groups_first_4.1.msh", "16_onlycore.inp"])
def test_the_interface_stays_where_it_is(name):
    mesh = read(DATA / name).mesh
    before = np.asarray(mesh.points)
    after = np.asarray(js.smooth(mesh).mesh.points)
    nodes = interface(mesh)
    assert np.array_equal(before[nodes], after[nodes])
    assert not np.array_equal(before, after)


FORMATS = ["vtu", "vtk42", "xdmf", "npz", "msh", "mesh", "inp", "e", "avs", "bdf"]


@pytest.mark.parametrize("suffix", FORMATS)
@pytest.mark.parametrize("name", ["22_groups_first_4.1.msh", "22_groups_first_2.2.msh", "16_onlycore.inp"])
def test_materials_survive_in_other_formats(tmp_path, name, suffix):
    for package, own in (("netCDF4", "e"), ("h5py", "xdmf")):
        if suffix == own:
            pytest.importorskip(package)
    file = read(DATA / name)
    path = tmp_path / ("a." + suffix.replace("42", ""))
    write(path, anew(file), file_format="vtk42" if suffix == "vtk42" else None)
    again = read(path)
    assert np.array_equal(interface(again.mesh), interface(file.mesh))
    assert not [key for key in again.source.cell_data if "bounding" in key]


def test_all_groups_of_an_entity_are_written_again(tmp_path):
    file = read(DATA / "22_groups_last_4.1.msh")
    write(tmp_path / "a.msh", anew(file))
    again = read(tmp_path / "a.msh")
    assert {k: v.tolist() for k, v in again.named_sets.items()} == {
        k: v.tolist() for k, v in file.named_sets.items()
    }
    assert again.source.info == file.source.info


# --- Rules --------------------------------------------------------------------------------


def squares(count=4, **data):
    """A square of count² quadrilaterals, row by row."""
    x, y = np.meshgrid(np.arange(count + 1.0), np.arange(count + 1.0))
    first = (np.arange(count)[:, None] * (count + 1) + np.arange(count)).ravel()
    quads = np.stack([first, first + 1, first + count + 2, first + count + 1], axis=1)
    return meshio.Mesh(np.stack([x.ravel(), y.ravel()], 1), [("quad", quads)], **data)


def test_the_first_array_that_is_not_uniform_counts():
    left = np.arange(16) % 4 < 2
    data = {"material": [np.full(16, 3)], "Part_Id": [1 + left], "group": [np.arange(16)]}
    assert regions(from_meshio(squares(cell_data=data)).mesh) == [(1 + left).tolist()]
    assert regions(from_meshio(squares(cell_data={"material": [np.full(16, 3)]})).mesh) == [[3] * 16]


def test_one_group_over_two_surfaces_leaves_the_surfaces():
    entity = 1 + (np.arange(16) % 4 < 2)
    data = {"gmsh:physical": [np.ones(16, int)], "gmsh:geometrical": [entity]}
    assert regions(from_meshio(squares(cell_data=data)).mesh) == [entity.tolist()]


@pytest.mark.parametrize("order", [1, -1])
def test_combinations_of_groups_in_any_order(order):
    """Groups of Gmsh 2.2: all, the lower half, the left half: four regions."""
    source = squares()
    quads = source.cells[0].data
    lower, left = np.arange(16) < 8, np.arange(16) % 4 < 2
    groups = [(7, np.ones(16, bool)), (8, lower), (9, left)][::order]
    cells = [("quad", quads[rows]) for _, rows in groups]
    tags = [np.full(rows.sum(), tag) for tag, rows in groups]
    file = from_meshio(meshio.Mesh(source.points, cells, cell_data={"gmsh:physical": tags}))
    # elements are numbered by their first appearance
    points = np.asarray(file.mesh.points)[np.asarray(file.mesh.connectivity[0])].mean(axis=1)
    expected = {(True, True), (True, False), (False, True), (False, False)}
    found = {}
    for centre, region in zip(points, file.mesh.labels.regions[0], strict=True):
        found.setdefault(int(region), set()).add((bool(centre[0] < 2), bool(centre[1] < 2)))
    assert sorted(map(len, found.values())) == [1, 1, 1, 1]
    assert set.union(*found.values()) == expected


def rows(mask):
    return [np.flatnonzero(mask)]


CENTRE = np.isin(np.arange(36), [14, 15, 20, 21])  # of 6 × 6
RIM = np.isin(np.arange(36) // 6, [0]) | (np.arange(36) % 6 == 0)
SETS = [
    ("a division", {"a": ~CENTRE, "b": CENTRE}, CENTRE),
    ("everything beside it", {"all": np.ones(36, bool), "b": CENTRE, "a": ~CENTRE}, CENTRE),
    ("a large load set beside it", {"load": np.arange(36) < 30, "a": ~CENTRE, "b": CENTRE}, CENTRE),
    ("an inclusion only", {"b": CENTRE}, CENTRE),
    ("an inclusion and a load set", {"load": RIM, "b": CENTRE}, CENTRE),
    ("a load set only", {"load": RIM}, np.zeros(36, bool)),
    ("sets for surfaces", {"_s": CENTRE}, np.zeros(36, bool)),
]


@pytest.mark.parametrize(("sets", "expected"), [case[1:] for case in SETS], ids=[case[0] for case in SETS])
def test_sets_as_materials(sets, expected):
    source = squares(6, cell_sets={name: rows(mask) for name, mask in sets.items()})
    found = np.array(regions(from_meshio(source).mesh)[0])
    assert np.array_equal(found != found[0], expected != expected[0])


def test_the_finest_division_is_taken():
    third = np.arange(36) % 3
    sets = {"ab": third < 2, "c": third == 2, "a": third == 0, "b": third == 1}
    source = squares(6, cell_sets={name: rows(mask) for name, mask in sets.items()})
    found = np.array(regions(from_meshio(source).mesh)[0])
    assert len(np.unique(np.stack([found, third]), axis=1).T) == 3


def test_sets_of_types_are_materials_only_without_others():
    source = squares(6)
    quads = source.cells[0].data
    triangles = np.concatenate([quads[18:, :3], quads[18:, [0, 2, 3]]])
    cells = [("quad", quads[:18]), ("triangle", triangles)]
    types = {"q": [np.arange(18), []], "t": [[], np.arange(36)]}
    halves = {"l": [np.arange(9), np.arange(9)], "r": [np.arange(9, 18), np.arange(9, 36)]}
    both = from_meshio(meshio.Mesh(source.points, cells, cell_sets={**types, **halves})).mesh
    assert [sorted(set(r)) for r in regions(both)] == [[0, 1], [0, 1]]
    alone = from_meshio(meshio.Mesh(source.points, cells, cell_sets=types)).mesh
    assert len({*regions(alone)[0]} | {*regions(alone)[1]}) == 2


HALVES = [[1, 2], [1, 1, 2, 2]]
INP = """*NODE
1, 0., 0.
2, 1., 0.
3, 2., 0.
4, 0., 1.
5, 1., 1.
6, 2., 1.
7, 0., 2.
8, 1., 2.
9, 2., 2.
*ELEMENT, TYPE=CPE4, ELSET=Quads
1, 1, 2, 5, 4
2, 2, 3, 6, 5
*ELEMENT, TYPE=CPE3, ELSET=Tris
3, 4, 5, 8
4, 4, 8, 7
5, 5, 6, 9
6, 5, 9, 8
*ELSET, ELSET=Left
1, 3, 4
*ELSET, ELSET=right
2, 5, 6
*ELSET, ELSET=Load, GENERATE
1, 5, 1
"""


@pytest.mark.parametrize(
    ("sections", "expected"),
    [
        (["SOLID SECTION, ELSET=LEFT, MATERIAL=A", "SOLID SECTION, ELSET=RIGHT, MATERIAL=B"], HALVES),
        (["SOLID SECTION, ELSET=LEFT, MATERIAL=A"], [[1, 0], [1, 1, 0, 0]]),
        (
            [
                "MEMBRANE SECTION, MATERIAL=A, ELSET=Quads\n.1,",
                "MEMBRANE SECTION, MATERIAL=a, ELSET=Tris\n.1",
            ],
            [[1, 1], [1] * 4],
        ),
        (
            ["SHELL SECTION, MATERIAL=A, ELSET=Quads\n.1,", "SHELL SECTION, MATERIAL=A, ELSET=Tris\n.2"],
            [[1, 1], [2] * 4],
        ),
        ([], [[0, 1], [0, 0, 1, 1]]),
    ],
)
def test_sections_say_the_materials(tmp_path, sections, expected):
    path = tmp_path / "a.inp"
    path.write_text(INP + "".join(f"*{card}\n" for card in sections))
    file = read(path)
    assert regions(file.mesh) == expected
    write(tmp_path / "b.inp", anew(file))
    assert regions(read(tmp_path / "b.inp").mesh) == expected
    text = (tmp_path / "b.inp").read_text()
    assert text.count(" SECTION") == len(sections)
    assert text.count("TYPE=CPE4\n") == text.count("TYPE=CPE3\n") == 1


def test_a_section_of_a_missing_set(tmp_path):
    path = tmp_path / "a.inp"
    path.write_text(INP + "*SOLID SECTION, ELSET=Middle, MATERIAL=A\n")
    with pytest.raises(MeshFileError, match=r"\*SOLID SECTION is for the set 'Middle'"):
        read(path)


# --- Names of tags, writing ----------------------------------------------------------------


@pytest.mark.parametrize("key", ["mat_id", "MaterialIds", "matid", "Mat-ID", "Region Id"])
@pytest.mark.parametrize("suffix", ["mesh", "msh", "inp", "e"])
def test_tags_are_known_by_any_spelling(tmp_path, key, suffix):
    if suffix == "e":
        pytest.importorskip("netCDF4")
    tags = 4.0 + (np.arange(16) % 4 < 2)  # VTK's writers like floats
    write(tmp_path / "a.vtu", from_meshio(squares(cell_data={key: [tags], "other": [np.arange(16)]})))
    file = read(tmp_path / "a.vtu")
    write(tmp_path / f"a.{suffix}", anew(file))
    again = np.concatenate(read(tmp_path / f"a.{suffix}").mesh.labels.regions)
    assert len(np.unique(again)) == 2
    if suffix in ("mesh", "msh"):
        assert np.array_equal(again, tags)


def test_tags_of_boundary_cells_become_markers(tmp_path):
    source = squares()
    source.cells.append(meshio.CellBlock("line", [[0, 1], [1, 2], [2, 3]]))
    source.cell_data = {"mat_id": [np.zeros(16, int), np.array([5, 5, 8])]}
    write(tmp_path / "a.su2", from_meshio(source))
    assert sorted(read(tmp_path / "a.su2").named_sets) == ["5", "8"]


@needs_netcdf
def test_exodus_has_a_block_for_each_type_and_material(tmp_path):
    source = squares()
    quads = source.cells[0].data
    tags = 1 + np.arange(16) % 2
    cells = [("quad", quads[k : k + 1]) for k in range(16)]
    file = from_meshio(
        meshio.Mesh(source.points, cells, cell_data={"material": [tags[k : k + 1] for k in range(16)]})
    )
    write(tmp_path / "a.e", file)
    again = read(tmp_path / "a.e")
    assert [len(c) for c in again.source.cells] == [8, 8]
    assert len(np.unique(again.mesh.labels.regions[0])) == 2
    write(tmp_path / "b.e", anew(again))
    assert [len(c) for c in read(tmp_path / "b.e").source.cells] == [8, 8]


@needs_netcdf
def test_exodus_keeps_a_material_of_two_types(tmp_path):
    source = squares()
    quads = source.cells[0].data
    triangles = np.concatenate([quads[8:, :3], quads[8:, [0, 2, 3]]])
    tags = [np.arange(8) % 4 // 2, np.arange(16) % 4 // 2]
    cells = [("quad", quads[:8]), ("triangle", triangles)]
    file = from_meshio(meshio.Mesh(source.points, cells, cell_data={"material": tags}))
    write(tmp_path / "a.e", file)
    again = read(tmp_path / "a.e").mesh
    assert [sorted(r) for r in regions(again)] == [sorted(t) for t in map(np.ndarray.tolist, tags)]
