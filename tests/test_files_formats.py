"""What single formats know: Gmsh's entities, SU2's boxes, Medit's required nodes, Abaqus' parts; refusals."""

import sys
from pathlib import Path

import jax
import meshio
import numpy as np
import pytest
from test_files_damage import FORMATS, anew, content, plane, solid

from jaxsmooth.convert.meshfile import from_meshio
from jaxsmooth.files.io import MeshFileError, read, write
from jaxsmooth.files.writing import check_types, check_writable

DATA = Path(__file__).parent / "data"


@pytest.fixture(autouse=True)
def double_precision():
    with jax.enable_x64(True):
        yield


# --- Gmsh 4.1 -----------------------------------------------------------------------------


@pytest.mark.parametrize("name", [n for n in FORMATS if n not in ("meditb", "gmsh:ascii", "gmsh:binary")])
@pytest.mark.parametrize("source", ["sq41.msh", "rect41.msh"])
def test_private_sets_of_gmsh_stay_there(tmp_path, name, source):
    for package, own in (("netCDF4", "exodus"), ("h5py", "xdmf")):
        if name == own:
            pytest.importorskip(package)
    file = read(DATA / source)
    path = tmp_path / ("a" + FORMATS[name])
    write(path, anew(file), file_format=name)
    again = read(path)
    assert [len(c) for c in again.mesh.connectivity] == [len(c) for c in file.mesh.connectivity]
    keys = [*again.source.cell_data, *again.source.cell_sets, *again.source.point_sets]
    assert not [key for key in keys if "bounding" in key]


def test_gmsh_keeps_its_entities(tmp_path):
    file = read(DATA / "rect41.msh")
    write(tmp_path / "a.msh", anew(file))
    again = read(tmp_path / "a.msh")
    assert again.format == file.format == "gmsh:ascii"
    bounds = [None if b is None else list(b) for b in again.source.cell_sets["gmsh:bounding_entities"]]
    assert bounds == [None] * 4 + [[1, -2], [2, -3], [3, -4], [4, -1], [1, 2, 3, 4]]


# --- SU2 ----------------------------------------------------------------------------------


def test_the_free_form_box_is_one_note_and_survives(tmp_path):
    file = read(DATA / "ffd.su2")
    assert len(file.notes) == 1
    assert "FFD_NBOX, FFD_TAG, FFD_CORNER_POINTS" in file.notes[0]
    notes = write(tmp_path / "b.su2", anew(file))
    assert notes == ()
    box = (DATA / "ffd.su2").read_text().partition("FFD_NBOX")[2]
    assert (tmp_path / "b.su2").read_text().partition("FFD_NBOX")[2] == box
    again = read(tmp_path / "b.su2")
    assert content(again)[1] == content(file)[1]
    assert list(again.named_sets) == ["b"]
    assert any("other sections of the SU2 file" in note for note in write(tmp_path / "c.vtu", file))


def test_su2_with_indices_comments_and_numbered_markers(tmp_path):
    """As other programs write it: an index behind each row, comments, blanks, small letters."""
    text = """% made by hand
NDIME=2
NELEM=3  % of two types
5 0 1 2 0
9 0 2 3 4 1

5 1 5 2 2
NPOIN=6 6
0 0 0
1 0 1
1 1 2
0 1 3
-1 .5 4
2 0 5
NMARK=3
MARKER_TAG= 2
MARKER_ELEMS= 1
3 0 1
MARKER_TAG= wall
MARKER_ELEMS= 1
3 1 5
MARKER_TAG= 3
MARKER_ELEMS= 1
3 5 2
"""
    (tmp_path / "a.su2").write_text(text)
    file = read(tmp_path / "a.su2")
    assert file.mesh.types == ("triangle", "quad")
    assert np.asarray(file.mesh.points)[4].tolist() == [-1, 0.5]
    assert {k: np.flatnonzero(v).tolist() for k, v in file.named_sets.items()} == {
        "2": [0, 1],
        "wall": [1, 5],
        "3": [2, 5],
    }
    assert len(set(file.mesh.labels.feature_tags[0].tolist())) == 3
    (tmp_path / "b.su2").write_text("NZONE= 2\n" + text)
    with pytest.raises(MeshFileError, match="several zones"):
        read(tmp_path / "b.su2")


# --- Medit --------------------------------------------------------------------------------

MEDIT = """MeshVersionFormatted 2
Dimension 2
Vertices 5
0 0 0 1 0 0 1 1 0 0 1 0 .5 .5 0
Triangles 4
1 2 5 1 2 3 5 1 3 4 5 2 4 1 5 2
Edges 2
1 2 1 3 4 1
{}
End
"""


@pytest.mark.parametrize(
    ("section", "held"),
    [
        ("RequiredVertices 1\n5", [4]),
        ("Corners 2\n1 3", [0, 2]),
        ("RequiredEdges 1\n2", [2, 3]),
        ("RequiredTriangles 1\n1", [0, 1, 4]),
        ("Ridges 1\n1", []),
    ],
)
def test_required_nodes_of_medit_are_held(tmp_path, section, held):
    (tmp_path / "a.mesh").write_text(MEDIT.format(section))
    assert np.flatnonzero(read(tmp_path / "a.mesh").fixed).tolist() == held


def test_required_nodes_of_binary_medit_are_held(tmp_path):
    """A file of version 2 by its description: keyword, place of the next, count, rows."""
    sections = [(4, np.zeros(5, "f8,f8,i4")), (6, np.array([[1, 2, 5, 1], [2, 3, 5, 1]], "<i4"))]
    sections += [(15, np.array([5], "<i4")), (13, np.array([1, 3], "<i4"))]
    sections[0][1]["f0"], sections[0][1]["f1"] = [0, 1, 1, 0, 0.5], [0, 0, 1, 1, 0.5]
    out = np.array([1, 2, 3, 20, 2], "<i4").tobytes()
    for key, rows in sections:
        body = np.array([len(rows)], "<i4").tobytes() + rows.tobytes()
        out += np.array([key, len(out) + 8 + len(body)], "<i4").tobytes() + body
    (tmp_path / "a.meshb").write_bytes(out + np.array([54, 0], "<i4").tobytes())
    file = read(tmp_path / "a.meshb")
    assert np.flatnonzero(file.named_sets["Corners"]).tolist() == [0, 2]
    assert np.flatnonzero(file.named_sets["RequiredVertices"]).tolist() == [4]
    assert np.flatnonzero(file.fixed).tolist() == [0, 2, 4]


# --- Abaqus -------------------------------------------------------------------------------


def test_several_node_cards():
    file = read(DATA / "03_nodecards.inp")
    sizes = {name: int(mask.sum()) for name, mask in file.named_sets.items()}
    assert sizes == {"LOWER": 64, "UPPER": 64, "BOTH": 128, "E_LOW": 64, "E_UP": 64, "ALL_E": 128}


def test_one_part_is_where_its_instance_is(tmp_path):
    file = read(DATA / "03_onepart.inp")
    assert np.asarray(file.mesh.points)[0].tolist() == [5, 0, 0]
    sets = {name: np.flatnonzero(mask).tolist() for name, mask in file.named_sets.items()}
    assert sets == {"N1": list(range(16)), "BASE": [0, 1, 2]}
    write(tmp_path / "b.inp", anew(file))
    again = read(tmp_path / "b.inp")
    assert np.array_equal(again.mesh.points, file.mesh.points)
    assert again.named_sets.keys() == file.named_sets.keys()


def test_several_parts_are_placed():
    file = read(DATA / "03_parts.inp")
    points = np.asarray(file.mesh.points)
    assert len(points) == 128
    assert points[[0, 64]].tolist() == [[0, 0, 0], [0, 0, 1]]
    assert len(file.mesh.connectivity[0]) == 54
    sets = {name: np.flatnonzero(mask).tolist() for name, mask in file.named_sets.items()}
    assert sets == {"P1-1_N1": list(range(16)), "BASE": [0, 1, 2]}


PART = """*PART, NAME=p
*NODE
1, 0., 0., 0.
2, 1., 0., 0.
3, 1., 1., 0.
*ELEMENT, TYPE=CPS3, ELSET=Set-1
1, 1, 2, 3
*SOLID SECTION, ELSET=Set-1, MATERIAL=M
*END PART
*ASSEMBLY, NAME=A
*INSTANCE, NAME=a, PART=P
*END INSTANCE
*INSTANCE, NAME=b, PART=p
1., 0., 0.
1., 0., 0., 1., 0., 1., 90.
*END INSTANCE
*NSET, NSET=Set-1, INSTANCE=a
2
*NSET, NSET=Set-1, INSTANCE=B
3
*NSET, NSET=All
Set-1, a.1
*END ASSEMBLY
"""


def test_instances_are_shifted_then_turned(tmp_path):
    path = tmp_path / "a.inp"
    path.write_text(PART)
    file = read(path)
    # shifted by 1 in x, then turned by 90° about the line x = 1, y = 0
    expected = [[0, 0], [1, 0], [1, 1], [1, 0], [1, 1], [0, 1]]
    assert np.allclose(file.mesh.points, expected, rtol=0, atol=1e-15)
    sets = {name: np.flatnonzero(mask).tolist() for name, mask in file.named_sets.items()}
    assert sets == {"Set-1": [1, 5], "All": [0, 1, 5], "a_Set-1": [0, 1, 2], "b_Set-1": [3, 4, 5]}
    assert list(file.mesh.labels.regions[0]) == [1, 1]


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        ("PART=P\n", "PART=Q\n", r"of the \*PART 'Q', which isn't there"),
        ("*NODE\n", "*NGEN\n1, 3\n*NODE\n", r"card \*NGEN"),
        ("*NODE\n", "*NODE, SYSTEM=C\n", r"card \*NODE"),
        ("*NODE\n", "*NODE, INPUT=none.txt\n", r"'none.txt' of its \*NODE isn't there"),
        ("3, 1., 1., 0.\n", "3, 1., 1., 0.\n3, 1., 2., 0.\n", "node 3 is given twice"),
        (", 90.\n", "\n", "two points and an angle"),
    ],
)
def test_assemblies_that_do_not_work(tmp_path, old, new, sentence):
    path = tmp_path / "a.inp"
    assert old in PART
    path.write_text(PART.replace(old, new))
    with pytest.raises(MeshFileError, match=sentence):
        read(path)


def test_data_lines_in_another_file(tmp_path):
    (tmp_path / "nodes.txt").write_text("1, 0., 0.\n2, 1., 0.\n3, 1., 1.\n")
    (tmp_path / "a.inp").write_text("*NODE, INPUT=nodes.txt\n*ELEMENT, TYPE=CPS3\n1, 1, 2, 3\n")
    assert np.asarray(read(tmp_path / "a.inp").mesh.points).tolist() == [[0, 0], [1, 0], [1, 1]]


def test_cohesive_elements_keep_their_type(tmp_path):
    file = read(DATA / "13_cohesive_abq.inp")
    assert [(c.type, len(c)) for c in file.source.cells] == [("triangle", 128), ("quad", 8)]
    write(tmp_path / "b.inp", anew(file))
    text = (tmp_path / "b.inp").read_text()
    assert "*ELEMENT, TYPE=COH2D4\n" in text
    assert "*ELEMENT, TYPE=CPE3\n" in text
    assert content(read(tmp_path / "b.inp"))[1] == content(file)[1]


def test_members_of_sets_that_are_missing_are_counted(tmp_path):
    path = tmp_path / "a.inp"
    path.write_text(
        PART.replace("*NSET, NSET=Set-1, INSTANCE=a\n2\n", "*NSET, NSET=X, INSTANCE=a\n2, 8, 9\n")
    )
    assert "2 members of the Abaqus set X are not in the file" in read(path).notes


# --- Refusals -----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "sentence"),
    [
        (
            "05_collapsed.inp",
            r"has node 30 twice, 26 such cells in this block; split the degenerate elements",
        ),
        (
            "05_collapsed.vtu",
            r"has node 30 twice, 26 such cells in this block; split the degenerate elements",
        ),
        (
            "18_polygons.vtu",
            r"cell type not supported: polygon \(16 cells\); convert these cells to triangle",
        ),
    ],
)
def test_cells_that_are_no_elements(name, sentence):
    with pytest.raises(MeshFileError, match=sentence):
        read(DATA / name)


def test_a_format_without_room_for_data_is_refused(tmp_path):
    with pytest.raises(MeshFileError, match=r"dolfin-xml .*write \.xdmf instead"):
        write(tmp_path / "a.xml", from_meshio(plane()))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("format", "package"), [("exodus", "netCDF4"), ("med", "h5py"), ("h5m", "h5py"), ("xdmf", "h5py")]
)
def test_missing_packages_are_said_before_the_work(monkeypatch, format, package):
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(MeshFileError, match=rf"writing {format} files needs {package}; install it with: pip"):
        check_writable(format)
    with pytest.raises(MeshFileError, match=rf"^out: writing {format} files needs {package}"):
        check_types(["tetra"], Path("out"), format)


def test_unknown_formats_are_refused():
    with pytest.raises(MeshFileError, match="nothing writes nothing files"):
        check_writable("nothing")


@pytest.mark.parametrize("source", [plane, solid])
def test_ugrid_is_read_again(tmp_path, source):
    file = from_meshio(source())
    write(tmp_path / "a.ugrid", file)
    again = read(tmp_path / "a.ugrid")
    shown = [cells for cells in content(file)[1] if cells[0] != "line"]
    assert content(again)[1] == shown
    assert np.array_equal(again.mesh.points, file.mesh.points)  # in double precision
    with pytest.raises(MeshFileError, match="name says binary"):
        write(tmp_path / "a.lb8.ugrid", file)


def test_pyramids_in_ugrid(tmp_path):
    """The top is the third node of the file's pyramids; the base runs 1, 0, …"""
    points = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0.5, 0.5, 1]], float)
    write(tmp_path / "a.ugrid", from_meshio(meshio.Mesh(points, [("pyramid", [[0, 1, 2, 3, 4]])])))
    assert (tmp_path / "a.ugrid").read_text().splitlines()[-1].split() == ["2", "1", "5", "3", "4"]
    assert read(tmp_path / "a.ugrid").source.cells[0].data.tolist() == [[0, 1, 2, 3, 4]]


def test_writers_that_leave_out_cells_are_caught(tmp_path):
    with pytest.raises(MeshFileError, match=r"it would have .* instead of .*hexahedron"):
        write(tmp_path / "a.h5m", from_meshio(solid()))
    assert list(tmp_path.iterdir()) == []
