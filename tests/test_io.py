"""Files in every format and of every element type; the traps of the readers and writers; bad files."""

import importlib.util
import os
import struct
import sys
from pathlib import Path

import jax
import meshio
import numpy as np
import pytest
from test_files_damage import anew

import jaxsmooth.files.io as jsio
from jaxsmooth.cells.table import element_type, supported
from jaxsmooth.convert.meshfile import from_meshio
from jaxsmooth.files.formats.exodus import EXODUS_ORDER, extend_exodus
from jaxsmooth.files.formats.mshtypes import in_gmsh_order
from jaxsmooth.files.formats.table import FORMATS
from jaxsmooth.files.io import MeshFileError, check_output, read, write

needs_h5py = pytest.mark.skipif(importlib.util.find_spec("h5py") is None, reason="needs h5py")
needs_netcdf = pytest.mark.skipif(importlib.util.find_spec("netCDF4") is None, reason="needs netCDF4")

LINEAR = [name for name in supported() if element_type(name).linear]
ALL = supported()
# What formats have no cells for: those of VTK and XDMF no pyramids of 14 nodes, Abaqus no centres of faces.
LACKING = {"vtk": ["pyramid14"], "vtk42": ["pyramid14"], "vtu": ["pyramid14"], "xdmf": ["pyramid14"]}
LACKING["abaqus"] = ["pyramid14", "wedge18"]


@pytest.fixture(autouse=True)
def double_precision():
    with jax.enable_x64(True):
        yield


def sample(*names, copies=3):
    """Separate, slightly uneven elements of these types, with 3D points and data of all kinds."""
    random = np.random.default_rng(0)
    points, cells = [], []
    count = 0
    for name in names:
        kind = element_type(name)
        for _ in range(copies):
            own = np.zeros((kind.k, 3))
            own[:, : kind.dim] = kind.ideal + random.normal(0, 0.02, kind.ideal.shape)
            own[:, 0] += 3 * len(points)
            points.append(own)
        cells.append((name, count + np.arange(copies * kind.k).reshape(copies, kind.k)))
        count += copies * kind.k
    return meshio.Mesh(
        np.concatenate(points),
        cells,
        point_data={"u": random.random(count), "v": random.random((count, 3))},
        cell_data={
            "gmsh:physical": [np.full(copies, 4 + i) for i in range(len(cells))],
            "gmsh:geometrical": [np.full(copies, 1 + i) for i in range(len(cells))],
            "w": [random.random(copies) for _ in cells],
        },
    )


def same_cells(a, b):
    return [(x, np.asarray(p).tolist()) for x, p in zip(a.types, a.connectivity, strict=True)] == [
        (x, np.asarray(p).tolist()) for x, p in zip(b.types, b.connectivity, strict=True)
    ]


def round_trip(tmp_path, source, name, file_format=None):
    """Write a mesh with one node moved, and read it again."""
    file = from_meshio(source)
    points = np.asarray(file.mesh.points).copy()
    points[0, 0] += 0.001
    notes = write(tmp_path / name, file, points, file_format=file_format)
    again = read(tmp_path / name)
    assert np.allclose(again.mesh.points, points, rtol=0, atol=1e-15)
    assert same_cells(again.mesh, file.mesh)
    assert [p.name for p in tmp_path.iterdir()] == [name]  # no other file is left
    return file, again, notes


def same_data(a, b, points=("u", "v"), cells=("w",)):
    for name in points:
        assert np.array_equal(a.point_data[name], b.point_data[name])
    for name in cells:
        assert np.array_equal(np.concatenate(a.cell_data[name]), np.concatenate(b.cell_data[name]))


RICH = ["gmsh22:ascii", "gmsh22:binary", "gmsh:ascii", "gmsh:binary", "vtk:ascii", "vtk:binary"]
RICH += ["vtk42:ascii", "vtk42:binary", "vtu", "xdmf", "npz"]
SUFFIX = {
    "gmsh22": ".msh",
    "gmsh": ".msh",
    "vtk42": ".vtk",
    "medit": ".mesh",
    "abaqus": ".inp",
    "exodus": ".e",
}


def file_name(file_format):
    stem = file_format.partition(":")[0]
    if stem == "xdmf":
        pytest.importorskip("h5py")
    return "mesh" + SUFFIX.get(stem, f".{stem}")


PAIRS = [(name, file_format) for file_format in RICH for name in ALL]


@pytest.mark.parametrize(
    ("name", "file_format"), [pair for pair in PAIRS if pair[0] not in LACKING.get(pair[1].split(":")[0], [])]
)
def test_every_type_in_every_format(tmp_path, name, file_format):
    file, again, notes = round_trip(tmp_path, sample(name), file_name(file_format), file_format)
    same_data(file.source, again.source, cells=("w", "gmsh:physical"))
    assert again.format == file_format
    assert notes == ()


@pytest.mark.parametrize("file_format", RICH)
@pytest.mark.parametrize(
    "names", [("triangle", "quad"), ("tetra", "pyramid", "wedge", "hexahedron"), ("wedge15", "hexahedron20")]
)
@pytest.mark.parametrize("copies", [1, 3])  # gmsh22 with one cell a block
def test_mixed_types(tmp_path, names, file_format, copies):
    source = sample(*names, copies=copies)
    file, again, _ = round_trip(tmp_path, source, file_name(file_format), file_format)
    same_data(file.source, again.source, cells=("w", "gmsh:physical"))


@pytest.mark.parametrize("name", [name for name in ALL if name not in LACKING["abaqus"]])
def test_abaqus(tmp_path, name):
    source = sample(name)
    source.point_sets = {"support": np.array([0, 2])}
    source.cell_sets = {"steel": [np.array([0, 2])]}
    file, again, notes = round_trip(tmp_path, source, "mesh.inp")
    assert "not written: u, v, w" in notes[0]
    assert np.array_equal(again.named_sets["support"], file.named_sets["support"])
    assert np.array_equal(again.named_sets["steel"], file.named_sets["steel"])


@pytest.mark.parametrize("suffix", ["mesh", "meshb", "su2"])
@pytest.mark.parametrize("name", LINEAR)
def test_formats_of_linear_elements(tmp_path, name, suffix):
    source = sample(name)
    _, again, notes = round_trip(tmp_path, source, f"mesh.{suffix}")
    assert "not written" in notes[-1]
    if suffix != "su2":
        assert np.array_equal(again.source.cell_data["medit:ref"][0], [4, 4, 4])
        assert np.array_equal(again.mesh.labels.regions[0], [4, 4, 4])


@pytest.mark.parametrize("name", [n for n in ALL if n in FORMATS["unv"].holds.types])
def test_universal_files(tmp_path, name):
    source = sample(name)
    source.cell_data = {"material": [np.array([4, 5, 4])]}
    source.point_sets = {"support": np.array([0, 2])}
    source.cell_sets = {"steel": [np.array([0, 2])]}
    file, again, notes = round_trip(tmp_path, source, "a.unv")
    assert "not written: u, v" in notes[0]
    assert list(again.mesh.labels.regions[0]) == [4, 5, 4]
    for key in ("support", "steel"):
        assert np.array_equal(again.named_sets[key], file.named_sets[key])
    gmsh = pytest.importorskip("gmsh")
    gmsh.initialize(interruptible=False)
    try:
        gmsh.option.setNumber("General.Terminal", 0)
        gmsh.merge(str(tmp_path / "a.unv"))
        _, _, (nodes,) = gmsh.model.mesh.getElements()
        expected = in_gmsh_order(name, source.cells[0].data) + 1
        assert sorted(nodes.reshape(expected.shape).tolist()) == sorted(expected.tolist())
    finally:
        gmsh.finalize()


@needs_netcdf
@pytest.mark.parametrize("name", ALL)
def test_exodus(tmp_path, name):
    round_trip(tmp_path, sample(name), "mesh.e")


@needs_netcdf
@pytest.mark.parametrize("name", list(EXODUS_ORDER))
def test_exodus_order_of_mid_side_nodes(tmp_path, name):
    source = sample(name)
    file = from_meshio(source)
    write(tmp_path / "a.e", file)
    raw = meshio.read(tmp_path / "a.e").cells[0].data
    assert np.array_equal(raw, source.cells[0].data[:, EXODUS_ORDER[name]])
    extend_exodus()
    meshio.write(tmp_path / "b.e", source)  # meshio's own files are in VTK's order
    assert same_cells(read(tmp_path / "b.e").mesh, file.mesh)


@needs_netcdf
def test_exodus_blocks_are_materials(tmp_path):
    source = sample("tetra")
    source.cells = [meshio.CellBlock("tetra", source.cells[0].data[k]) for k in ([0, 1], [2])]
    source.cell_data = {"ElementBlockIds": [np.array([1, 1]), np.array([2])]}
    _, again, notes = round_trip(tmp_path, source, "a.e")
    assert list(again.mesh.labels.regions[0]) == [1, 1, 2]
    assert notes == ()


def test_missing_packages_are_named(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "netCDF4", None)
    with pytest.raises(MeshFileError, match=r"writing exodus files needs netCDF4; install it with: pip"):
        write(tmp_path / "a.e", from_meshio(sample("tetra")))
    (tmp_path / "a.e").write_text("x")
    with pytest.raises(MeshFileError, match=r"reading exodus files needs netCDF4; install it with: pip"):
        read(tmp_path / "a.e")


def test_exodus_order_is_the_manuals():
    """Nodes 13–16 (from 1) of Exodus' hexahedra lie on the upright edges, 21 is the centre."""
    kind = element_type("hexahedron27")
    natural = kind.natural[EXODUS_ORDER["hexahedron27"]]
    assert np.array_equal(natural[12:16, 2], [0] * 4)
    assert np.array_equal(natural[16:20, 2], [1] * 4)
    expected = [[0, 0, 0], [0, 0, -1], [0, 0, 1], [-1, 0, 0], [1, 0, 0], [0, -1, 0], [0, 1, 0]]
    assert np.array_equal(natural[20:], expected)


# --- Format and version ------------------------------------------------------------------


@pytest.mark.parametrize("file_format", [f for f in RICH if ":" in f])
def test_format_and_version_stay(tmp_path, file_format):
    name = file_name(file_format)
    write(tmp_path / name, from_meshio(sample("tetra")), file_format=file_format)
    file = read(tmp_path / name)
    assert file.format == file_format
    write(tmp_path / f"again-{name}", anew(file))
    assert read(tmp_path / f"again-{name}").format == file_format


def test_msh_from_another_format_is_not_ansys(tmp_path):
    write(tmp_path / "a.msh", from_meshio(sample("tetra")))
    assert (tmp_path / "a.msh").read_bytes().startswith(b"$MeshFormat\n2.2 1 8")


def test_unknown_suffix(tmp_path):
    with pytest.raises(MeshFileError, match=r"no mesh format is known for the suffix '.xyz'"):
        write(tmp_path / "a.xyz", from_meshio(sample("tetra")))
    (tmp_path / "b.xyz").write_text("?")
    with pytest.raises(MeshFileError, match=r"no mesh format is known for the suffix '.xyz'"):
        read(tmp_path / "b.xyz")


def test_types_that_a_format_lacks_are_refused(tmp_path):
    for name, suffix in (("tetra10", "mesh"), ("tetra", "stl"), ("hexahedron27", "su2")):
        with pytest.raises(MeshFileError, match=r"write \.vtu"):
            write(tmp_path / f"a.{suffix}", from_meshio(sample(name)))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("file_format", "name"), [(f, name) for f in LACKING for name in LACKING[f]])
def test_a_refusal_recommends_formats_that_hold_the_type(tmp_path, file_format, name):
    hint = {"pyramid14": r"write \.msh instead", "wedge18": r"write \.vtu, \.msh or \.xdmf instead"}[name]
    with pytest.raises(MeshFileError, match=rf"files can't hold {name} elements; {hint}"):
        write(tmp_path / "a", from_meshio(sample(name)), file_format=file_format)
    assert list(tmp_path.iterdir()) == []


# --- Gmsh --------------------------------------------------------------------------------

GMSH41 = """$MeshFormat
4.1 0 8
$EndMeshFormat
$PhysicalNames
2
1 9 "rim"
2 5 "plate"
$EndPhysicalNames
$Entities
1 1 2 0
1 0 0 0 0
1 0 0 0 1 0 0 1 9 0
1 0 0 0 1 1 0 1 5 1 1
2 1 0 0 2 1 0 0 0
$EndEntities
$Nodes
2 6 1 6
0 1 0 1
1
0 0 0
2 1 0 5
2
3
4
5
6
1 0 0
1 1 0
0 1 0
2 0 0
2 1 0
$EndNodes
$Elements
4 5 1 5
1 1 1 1
1 1 2
2 1 2 2
2 1 2 3
3 1 3 4
2 2 3 1
4 2 5 6 3
0 1 15 1
5 1
$EndElements
"""


def binary_gmsh41(tmp_path):
    """The same mesh as a binary file with an entity without physical group."""
    out = b"$MeshFormat\n4.1 1 8\n" + struct.pack("<i", 1) + b"\n$EndMeshFormat\n$Entities\n"
    out += struct.pack("<4Q", 0, 0, 2, 0)
    out += struct.pack("<i6dQiQ", 1, *[0.0] * 6, 1, 5, 0)
    out += struct.pack("<i6dQQ", 2, *[0.0] * 6, 0, 0)
    out += b"\n$EndEntities\n$Nodes\n" + struct.pack("<4Q3iQ6Q", 1, 6, 1, 6, 2, 1, 0, 6, *range(1, 7))
    points = [0, 0, 0, 1, 0, 0, 1, 1, 0, 0, 1, 0, 2, 0, 0, 2, 1, 0]
    out += struct.pack("<18d", *points) + b"\n$EndNodes\n$Elements\n" + struct.pack("<4Q", 2, 3, 1, 3)
    out += struct.pack("<3iQ8Q", 2, 1, 2, 2, 1, 1, 2, 3, 2, 1, 3, 4)
    out += struct.pack("<3iQ5Q", 2, 2, 3, 1, 3, 2, 5, 6, 3) + b"\n$EndElements\n"
    path = tmp_path / "binary.msh"
    path.write_bytes(out)
    return path


def test_gmsh41_entities_without_physical_group(tmp_path):
    path = tmp_path / "a.msh"
    path.write_text(GMSH41)
    for file in (read(path), read(binary_gmsh41(tmp_path))):
        assert file.mesh.types == ("triangle", "quad")
        assert [list(r) for r in file.mesh.labels.regions] == [[5, 5], [0]]


@pytest.mark.parametrize("mode", ["ascii", "binary"])
def test_gmsh41_keeps_entities_groups_and_names(tmp_path, mode):
    path = tmp_path / "a.msh"
    path.write_text(GMSH41)
    file = read(path)
    write(tmp_path / "b.msh", anew(file), file_format=f"gmsh:{mode}")
    again = read(tmp_path / "b.msh")
    assert same_cells(file.mesh, again.mesh)
    assert {k: set(np.flatnonzero(v)) for k, v in again.named_sets.items()} == {
        "rim": {0, 1},
        "plate": {0, 1, 2, 3},
    }
    assert again.mesh.labels.feature_types == file.mesh.labels.feature_types == ("line", "vertex")
    for name in ("gmsh:physical", "gmsh:geometrical"):
        for a, b in zip(file.source.cell_data[name], again.source.cell_data[name], strict=True):
            assert np.array_equal(a, b)
    assert np.array_equal(file.source.point_data["gmsh:dim_tags"], again.source.point_data["gmsh:dim_tags"])
    bounds = again.source.cell_sets["gmsh:bounding_entities"]
    assert [list(b) if b is not None else None for b in bounds] == [[], [1], [], None]


def test_gmsh41_from_a_mesh_without_entities(tmp_path):
    source = sample("tetra", "hexahedron")
    source.cell_data = {"material": [np.array([1, 2, 1]), np.array([2, 2, 3])]}
    write(tmp_path / "a.msh", from_meshio(source), file_format="gmsh")
    again = read(tmp_path / "a.msh")
    assert [sorted(r) for r in again.mesh.labels.regions] == [[1, 1, 2], [2, 2, 3]]
    gmsh = pytest.importorskip("gmsh")  # and Gmsh itself reads it
    gmsh.initialize(interruptible=False)
    try:
        gmsh.option.setNumber("General.Terminal", 0)
        gmsh.open(str(tmp_path / "a.msh"))
        assert len(gmsh.model.mesh.getNodes()[0]) == len(source.points)
        assert sum(len(tags) for tags in gmsh.model.mesh.getElements()[1]) == 6
        assert sorted(tag for _, tag in gmsh.model.getPhysicalGroups(3)) == [1, 2, 3]
    finally:
        gmsh.finalize()


def test_gmsh22_keeps_names_of_lower_dimensional_groups(tmp_path):
    source = sample("triangle")
    source.cells.append(meshio.CellBlock("line", [[0, 1]]))
    source.cell_data = {
        "gmsh:physical": [np.full(3, 2), np.array([8])],
        "gmsh:geometrical": [np.ones(3, int), [1]],
    }
    source.field_data = {"rim": np.array([8, 1]), "plate": np.array([2, 2])}
    write(tmp_path / "a.msh", from_meshio(source))
    again = read(tmp_path / "a.msh")
    assert set(np.flatnonzero(again.named_sets["rim"])) == {0, 1}
    assert again.mesh.labels.feature_types == ("line",)


@pytest.mark.parametrize("mode", ["ascii", "binary"])
@pytest.mark.parametrize("width", [2, 4, 6, 12])
def test_gmsh_data_of_any_width(tmp_path, mode, width):
    source = sample("tetra")
    values = np.random.default_rng(0).random((12, width))
    source.point_data = {"t": values}
    write(tmp_path / "a.msh", from_meshio(source), file_format=f"gmsh22:{mode}")
    data = read(tmp_path / "a.msh").source.point_data
    again = data["t"][:, :width] if "t" in data else np.stack([data[f"t_{k}"] for k in range(width)], axis=1)
    assert np.array_equal(again, values)


# --- VTK, XDMF ---------------------------------------------------------------------------


@pytest.mark.parametrize("file_format", ["vtk:binary", "vtk42:binary", "vtu", "xdmf", "npz", "gmsh22:binary"])
def test_sets_become_data_with_their_names(tmp_path, file_format):
    source = sample("tetra", "hexahedron")
    source.point_sets = {"left": np.array([0, 5])}
    source.cell_sets = {"steel": [np.array([0, 1]), np.array([2])], "load": [[0], None]}
    name = file_name(file_format)
    file, again, notes = round_trip(tmp_path, source, name, file_format)
    assert "left, steel, load" in notes[0]
    for key in ("left", "steel", "load"):
        assert np.array_equal(again.named_sets[key], file.named_sets[key])
    assert set(source.cell_sets) == {"steel", "load"}


def test_physical_names_survive_in_vtu(tmp_path):
    source = sample("tetra", "hexahedron")
    source.field_data = {"steel": np.array([4, 3])}
    _, again, notes = round_trip(tmp_path, source, "a.vtu")
    assert set(np.flatnonzero(again.named_sets["steel"])) == set(range(12))
    assert "steel" in notes[0]


def test_big_endian_vtk(tmp_path):
    meshio.write(tmp_path / "a.vtk", sample("wedge"), file_format="vtk42", binary=True)
    assert meshio.read(tmp_path / "a.vtk").points.dtype.byteorder == ">"
    file = read(tmp_path / "a.vtk")
    write(tmp_path / "a.vtu", file)
    write(tmp_path / "a.msh", file)
    assert same_cells(read(tmp_path / "a.vtu").mesh, file.mesh)


def test_names_with_blanks_and_odd_shapes_in_vtk(tmp_path):
    source = sample("tetra")
    source.point_data = {
        "a b": np.ones(12, bool),
        "t": np.arange(108.0).reshape(12, 3, 3),
        "s": np.ones((12, 1)),
    }
    write(tmp_path / "a.vtk", from_meshio(source), file_format="vtk42")
    data = read(tmp_path / "a.vtk").source.point_data
    assert data["a_b"].tolist() == [1] * 12
    assert np.array_equal(data["t"].ravel(), np.arange(108.0))


def test_unknown_vtk_cells_are_named(tmp_path):
    write(tmp_path / "a.vtk", from_meshio(sample("hexahedron")), file_format="vtk42:ascii")
    text = (tmp_path / "a.vtk").read_text()
    (tmp_path / "a.vtk").write_text(text.replace("CELL_TYPES 3\n12\n12\n12", "CELL_TYPES 3\n12\n11\n12"))
    with pytest.raises(MeshFileError, match=r"a\.vtk: .*cells that meshio cannot handle"):
        read(tmp_path / "a.vtk")


@needs_h5py
def test_xdmf_with_small_integers(tmp_path):
    source = sample("tetra")
    source.point_data = {"fixed": np.ones(12, np.int8)}
    _, again, _ = round_trip(tmp_path, source, "a.xdmf")
    assert again.fixed.all()


@needs_h5py
def test_xdmf_with_lines_and_points(tmp_path):
    source = sample("tetra", "hexahedron20")
    source.cells += [meshio.CellBlock("vertex", [[3], [4]]), meshio.CellBlock("line", [[0, 1]])]
    source.cell_data = {}
    _, again, _ = round_trip(tmp_path, source, "a.xdmf")
    assert [c.type for c in again.source.cells] == ["tetra", "hexahedron20", "vertex", "line"]
    assert np.array_equal(again.source.cells[2].data, [[3], [4]])


@needs_h5py
def test_xdmf_with_its_data_in_hdf5(tmp_path):
    meshio.write(tmp_path / "a.xdmf", sample("tetra", "hexahedron"))
    file = read(tmp_path / "a.xdmf")
    os.remove(tmp_path / "a.h5")
    write(tmp_path / "b.xdmf", anew(file))
    assert same_cells(read(tmp_path / "b.xdmf").mesh, file.mesh)
    assert not (tmp_path / "b.h5").exists()


# --- Abaqus, Medit, SU2, npz -------------------------------------------------------------

ABAQUS = """*Heading
** a comment
*Node, nset=All
10, 0., 0., 0.
20, 1., 0., 0.
30, 1., 1., 0.
40, 0., 1., 0.
50, .5, .5, 1.D0
60, 0., 0., 2.,
70, 5, 5, 5
*Element, type=c3d5, elset=Pyramids
1, 10, 20, 30,
40, 50
*Element, type=C3D4T, elset=Solid
7, 10, 20, 40, 60
*Element, type=C3D4, elset=Solid
8, 20, 30, 40, 60
*Nset, nset=Some, generate
10, 30, 10
*Elset, elset=Everything
Pyramids, Solid
*Elset, elset=Top
7
*Nset, nset=Named
Some, 60
*Material, name=steel
*Element Output
S
"""


def test_abaqus_sets_types_and_numbers(tmp_path):
    path = tmp_path / "a.inp"
    path.write_text(ABAQUS)
    file = read(path)
    assert file.mesh.types == ("pyramid", "tetra")
    assert np.asarray(file.mesh.points)[4].tolist() == [0.5, 0.5, 1.0]
    sets = {name: list(np.flatnonzero(mask)) for name, mask in file.named_sets.items()}
    assert sets == {
        "All": [0, 1, 2, 3, 4, 5, 6],
        "Pyramids": [0, 1, 2, 3, 4],
        "Solid": [0, 1, 2, 3, 5],
        "Some": [0, 1, 2],
        "Everything": [0, 1, 2, 3, 4, 5],
        "Top": [0, 1, 3, 5],
        "Named": [0, 1, 2, 5],
    }
    assert [list(r) for r in file.mesh.labels.regions] == [[1], [0, 0]]
    assert any("*MATERIAL" in note for note in file.notes)
    write(tmp_path / "b.inp", anew(file))
    again = {name: list(np.flatnonzero(mask)) for name, mask in read(tmp_path / "b.inp").named_sets.items()}
    assert again == sets


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        ("type=c3d5", "type=COH3D8P", "element type COH3D8P"),
        ("*Heading", "*Part, name=a\n*Part, name=b", r"more than one \*PART"),
        ("40, 50\n", "40\n", "don't have 5 nodes"),
        ("7, 10, 20, 40, 60", "7, 10, 20, 40, 99", "cell 1 .*node -1.*out of range"),
        ("Pyramids, Solid", "Pyramids, Fluid", "names the set 'Fluid'"),
        ("*Heading", "*Include, input=none.inp", "'none.inp' isn't there"),
    ],
)
def test_bad_abaqus_files(tmp_path, old, new, sentence):
    path = tmp_path / "a.inp"
    path.write_text(ABAQUS.replace(old, new))
    with pytest.raises(MeshFileError, match=sentence):
        read(path)


def test_material_data_become_abaqus_sets(tmp_path):
    source = sample("tetra", "hexahedron")
    source.point_data = {"fixed": np.arange(36) < 2}
    write(tmp_path / "a.inp", from_meshio(source))
    again = read(tmp_path / "a.inp")
    assert again.fixed.sum() == 2
    assert set(np.flatnonzero(again.named_sets["fixed"])) == {0, 1}
    assert set(np.flatnonzero(again.named_sets["gmsh_physical_4"])) == set(range(12))
    assert len(np.unique(np.concatenate(again.mesh.labels.regions))) == 2


def test_avs_files_called_inp(tmp_path):
    meshio.write(tmp_path / "a.inp", meshio.Mesh(*sample_cells("tetra")), file_format="avsucd")
    file = read(tmp_path / "a.inp")
    assert file.format == "avsucd"
    write(tmp_path / "b.inp", anew(file))
    assert read(tmp_path / "b.inp").format == "avsucd"


def sample_cells(name):
    source = sample(name)
    return source.points, source.cells


MEDIT = """MeshVersionFormatted 3
Dimension
3
# a comment
Vertices 4
0 0 0 1
1 0 0 1
0 1 0 1
0 0 1e-0 2
Tetrahedra 1
1 2 3 4 6
Corners 2
1 2
RequiredTriangles 1
1
RequiredVertices
1
4
End
"""


def test_medit_counts_on_the_line_of_the_keyword(tmp_path):
    path = tmp_path / "a.mesh"
    for text in (
        MEDIT,
        MEDIT.replace("Vertices 4", "Vertices\n4").replace("Tetrahedra 1", "\nTetrahedra\n\n1"),
    ):
        path.write_text(text)
        file = read(path)
        assert list(file.mesh.labels.regions[0]) == [6]
        assert {k: list(np.flatnonzero(v)) for k, v in file.named_sets.items()} == {
            "Corners": [0, 1],
            "RequiredVertices": [3],
        }
        assert any("RequiredTriangles" in note for note in file.notes)
        write(tmp_path / "b.mesh", anew(file))
        assert read(tmp_path / "b.mesh").named_sets.keys() == file.named_sets.keys()


def test_medit_says_what_is_not_finite(tmp_path):
    (tmp_path / "a.mesh").write_text(MEDIT.replace("1e-0", "nan"))
    with pytest.raises(MeshFileError, match=r"a\.mesh: node 3 .*not finite"):
        read(tmp_path / "a.mesh")


def test_su2_with_crlf(tmp_path):
    source = sample("triangle")
    source.cells.append(meshio.CellBlock("line", [[0, 1], [1, 2]]))
    source.cell_data = {"su2:tag": [np.zeros(3, int), np.array([1, 2])]}
    write(tmp_path / "a.su2", from_meshio(source))
    file = read(tmp_path / "a.su2")
    assert file.mesh.dim == 2
    content = (tmp_path / "a.su2").read_bytes()
    (tmp_path / "a.su2").write_bytes(content.replace(b"\n", b"\r\n"))
    again = read(tmp_path / "a.su2")
    assert same_cells(file.mesh, again.mesh)
    assert np.array_equal(file.mesh.points, again.mesh.points)
    assert [list(t) for t in again.mesh.labels.feature_tags] == [[1, 2]]


def test_su2_keeps_the_names_of_markers(tmp_path):
    source = sample("triangle")
    source.cells += [meshio.CellBlock("line", [[0, 1], [1, 2], [3, 4]])]
    source.cell_data = {}
    source.cell_sets = {"wall": [[], [0, 2]], "far": [[], [1]]}
    _, again, notes = round_trip(tmp_path, source, "a.su2")
    sets = {name: list(np.flatnonzero(mask)) for name, mask in again.named_sets.items()}
    assert sets == {"wall": [0, 1, 3, 4], "far": [1, 2]}
    assert [len(set(tags)) for tags in again.mesh.labels.feature_tags] == [2]
    assert "wall" not in " ".join(notes)


def test_npz(tmp_path):
    points, cells = sample_cells("wedge15")
    arrays = {
        "points": points,
        "wedge15": cells[0].data,
        "fixed": np.arange(45) < 3,
        "wedge15/q": np.arange(3.0),
    }
    np.savez(tmp_path / "a.npz", **arrays)
    file = read(tmp_path / "a.npz")
    assert file.fixed.sum() == 3
    write(tmp_path / "b.npz", file)
    with np.load(tmp_path / "b.npz") as again:
        assert set(again) == set(arrays)
        assert np.array_equal(again["wedge15/q"], np.arange(3.0))


# --- Bad files, bad outputs --------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "content", "sentence"),
    [
        ("a.vtu", b"<VTKFile", r"a\.vtu: not readable as vtu: "),
        ("a.vtk", b"", "not readable as vtk42"),
        ("a.vtk", b"# vtk DataFile Version 3.0\nx\nASCII\nDATASET POLYDATA\n", "POLYDATA"),
        ("a.msh", b"$MeshFormat\n4.1 0 8\n$EndMeshFormat\n", "not readable as gmsh"),
        ("a.msh", b"$MeshFormat\n2.2 0 8\n$EndMeshFormat\n$Nodes\n3\n1 0 0\n", "not readable as gmsh22"),
        ("a.msh", b"garbage", "not readable as ansys"),
        ("a.inp", b"garbage", "not readable as avsucd"),
        ("a.mesh", b"garbage", "not readable as medit"),
        ("a.npz", b"garbage", "not readable as npz"),
        ("a.su2", b"NDIME= 7\n", "not readable as su2"),
        ("a.stl", b"solid x\nendsolid x\n", r"a\.stl: "),
        ("a.xdmf", b"<Xdmf></Xdmf>", "not readable as xdmf"),
    ],
)
def test_broken_files_are_one_sentence(tmp_path, capfd, name, content, sentence):
    if name.endswith("xdmf"):
        pytest.importorskip("h5py")
    (tmp_path / name).write_bytes(content)
    with pytest.raises(MeshFileError, match=sentence) as caught:
        read(tmp_path / name)
    assert "\n" not in str(caught.value)
    assert capfd.readouterr() == ("", "")


def test_missing_files_and_folders(tmp_path):
    with pytest.raises(FileNotFoundError, match="no such file") as caught:
        read(tmp_path / "none.vtu")
    assert str(caught.value).startswith(str(tmp_path))
    assert isinstance(caught.value, MeshFileError)
    with pytest.raises(MeshFileError, match="a folder"):
        read(tmp_path)
    with pytest.raises(MeshFileError, match="there is no folder"):
        check_output(tmp_path / "none" / "a.vtu")
    (tmp_path / "folder.vtu").mkdir()
    with pytest.raises(MeshFileError, match="this is a folder"):
        check_output(tmp_path / "folder.vtu")
    check_output(tmp_path / "report.json")


def test_errors_of_the_mesh_name_the_file(tmp_path):
    source = sample("tetra")
    source.points[5, 1] = np.nan
    meshio.write(tmp_path / "a.vtu", source)
    with pytest.raises(MeshFileError, match=r"a\.vtu: node 5 .*not finite"):
        read(tmp_path / "a.vtu")


def test_unwritable_folder(tmp_path, monkeypatch):
    def refuse(*args, **kwargs):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(jsio.tempfile, "TemporaryFile", refuse)
    with pytest.raises(MeshFileError, match=r"can't be written \(Permission denied\)"):
        check_output(tmp_path / "a.vtu")


def test_the_input_is_replaced_by_force_only(tmp_path):
    path = tmp_path / "a.vtu"
    write(path, from_meshio(sample("tetra")))
    before = path.read_bytes()
    file = read(path)
    (tmp_path / "link.vtu").symlink_to(path)
    for other in (path, tmp_path / "link.vtu", tmp_path / "." / "a.vtu"):
        with pytest.raises(MeshFileError, match="this is the input"):
            write(other, file)
    assert path.read_bytes() == before
    write(path, file, np.asarray(file.mesh.points) + 1, force=True)
    assert np.allclose(read(path).mesh.points, file.mesh.points + 1)


def test_a_failed_write_leaves_nothing(tmp_path, monkeypatch):
    path = tmp_path / "a.vtu"
    path.write_text("precious")

    def fail(target, *args, **kwargs):
        Path(target).write_text("half")
        raise RuntimeError("disk full")

    monkeypatch.setattr(meshio, "write", fail)
    with pytest.raises(MeshFileError, match=r"a\.vtu: this mesh can't be written as vtu: disk full"):
        write(path, from_meshio(sample("tetra")))
    assert path.read_text() == "precious"
    assert [p.name for p in tmp_path.iterdir()] == ["a.vtu"]


def test_write_takes_results_and_meshes(tmp_path):
    file = from_meshio(sample("tetra"))
    moved = file.mesh.with_points(file.mesh.points + 1.0)

    class Result:
        mesh = moved

    for thing in (Result(), moved, moved.points, np.asarray(moved.points)):
        write(tmp_path / "a.vtu", file, thing, cell_data={"q": {"tetra": np.arange(3.0)}})
        again = read(tmp_path / "a.vtu")
        assert np.allclose(again.mesh.points, moved.points)
        assert np.array_equal(again.source.cell_data["q"][0], np.arange(3.0))
