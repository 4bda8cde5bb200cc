"""Formats are records in a table: what each of them says is true, and users add theirs."""

import meshio
import numpy as np
import pytest
from test_files_damage import plane

import jaxsmooth as js
from jaxsmooth.files.formats.record import Format, Holds
from jaxsmooth.files.formats.table import FORMATS, detect_format, format_of_suffix, register
from jaxsmooth.files.formats.tables import patch_table
from jaxsmooth.files.io import MeshFileError, check_types


@pytest.fixture
def table():
    before = dict(FORMATS)
    yield FORMATS
    FORMATS.clear()
    FORMATS.update(before)


def read_tri(path):
    lines = path.read_text().splitlines()
    count = int(lines[0])
    points = [[float(word) for word in line.split()] for line in lines[1 : count + 1]]
    triangles = [[int(word) for word in line.split()] for line in lines[count + 1 :]]
    return meshio.Mesh(points, [("triangle", triangles)]), []


def write_tri(path, mesh, dim, variant):
    rows = [str(len(mesh.points)), *(" ".join(map(repr, p)) for p in mesh.points[:, :2].tolist())]
    rows += [" ".join(map(str, nodes)) for nodes in mesh.cells_dict["triangle"].tolist()]
    path.write_text("\n".join(rows) + "\n")
    return []


def test_a_format_of_ones_own(tmp_path, table):
    with pytest.raises(MeshFileError, match="no mesh format is known"):
        js.write(tmp_path / "a.tri", js.from_meshio(plane()))
    holds = Holds(types=frozenset({"triangle"}))
    register(Format("tri", (".tri",), read_tri, write_tri, holds))
    source = meshio.Mesh(plane().points, plane().cells[:1], point_data={"u": plane().points[:, 0]})
    notes = js.write(tmp_path / "a.tri", js.from_meshio(source))
    assert notes == ("tri files can't hold these data, which are not written: u",)
    file = js.read(tmp_path / "a.tri")
    assert file.format == "tri"
    assert np.array_equal(file.mesh.points, source.points)
    with pytest.raises(MeshFileError, match="tri files can't hold quad elements"):
        js.write(tmp_path / "b.tri", js.from_meshio(plane()))
    (tmp_path / "a.tri").write_text("3\n0 0\n1 zero\n")
    with pytest.raises(MeshFileError, match=r"a\.tri: not readable as tri: could not convert") as caught:
        js.read(tmp_path / "a.tri")
    assert "\n" not in str(caught.value)


def test_a_format_of_ones_own_that_is_copied(tmp_path, table):
    """With a way to find its coordinates, the rest of a file stays, also what its reader skips."""
    register(Format("tri", (".tri",), read_tri, write_tri, patch=patch_table(rb"\A\s*(\d+)", 0, width=2)))
    (tmp_path / "a.tri").write_text("4 \n0  0\n1  0\n1  1\n.4 .6\n0 1 3\n1 2  3\n")
    file = js.read(tmp_path / "a.tri")
    points = np.array(file.mesh.points)
    points[3] = [0.5, 0.75]
    assert js.write(tmp_path / "b.tri", file, points) == ()
    assert (tmp_path / "b.tri").read_text() == "4 \n0  0\n1  0\n1  1\n0.5 0.75\n0 1 3\n1 2  3\n"


def test_a_format_that_shares_a_suffix(tmp_path, table):
    """The first bytes decide; new files are in the format that was there before."""
    sniff = {"sniff": lambda head: "" if head.startswith(b"tri") else None}
    register(Format("tri", (".msh",), lambda path: read_tri(path), **sniff))
    (tmp_path / "a.msh").write_text("tri\n")
    assert detect_format(tmp_path / "a.msh") == "tri"
    assert format_of_suffix(tmp_path / "b.msh") == "gmsh22:binary"
    with pytest.raises(MeshFileError, match="nothing writes tri files"):
        check_types((), tmp_path / "b.msh", "tri")


def test_suffixes_have_a_dot_and_small_letters(table):
    for suffix in ("tri", ".TRI"):
        with pytest.raises(ValueError, match="must be like"):
            register(Format("tri", (suffix,), read_tri))


@pytest.mark.parametrize("name", [n for n, record in FORMATS.items() if record.suffixes])
def test_every_format_has_its_suffixes(tmp_path, name):
    """A file of a suffix is in a format that has it; one of them is the usual one for new files."""
    for suffix in FORMATS[name].suffixes:
        path = tmp_path / f"a{suffix}"
        path.write_bytes(b"?")
        for found in (detect_format(path), format_of_suffix(path)):
            assert suffix in FORMATS[found.partition(":")[0]].suffixes


@pytest.mark.parametrize("name", FORMATS)
def test_names_and_variants(name):
    record = FORMATS[name]
    assert record.name == name
    assert set(record.variants) in ({""}, {"ascii", "binary"})
    assert ":" not in name
