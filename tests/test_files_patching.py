"""What goes in comes out: output in the input's format is the input with other coordinates in it."""

import dataclasses
import json
import os
import re
from pathlib import Path

import jax.numpy as jnp
import meshio
import numpy as np
import pytest
from test_files_layouts import FLAT, MEDIT, PLATE

import jaxsmooth as js
from benchmarks.files.checking import check, moved
from benchmarks.files.making import ABAQUS, MAKERS, make
from jaxsmooth.convert import original
from jaxsmooth.files.formats.record import Patched
from jaxsmooth.files.formats.table import FORMATS, register
from jaxsmooth.files.io import MeshFileError

DATA = Path(__file__).parent / "data"
ANEW = "is written anew"


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Makes each file once."""
    folder, paths = tmp_path_factory.mktemp("made"), {}

    def get(name):
        if name not in paths:
            paths[name] = make(name, folder)
        if paths[name] is None:
            pytest.skip("a package to make the file is missing")
        return paths[name]

    return get


# --- Every format ------------------------------------------------------------------------

ERROR = {"gmsh.bdf": 1e-6, "hand-fields.nas": 1e-7}
NOTES = {"hand-fields.nas": "fields of 8 columns round", "gmsh.bdf": "fields of 8 columns round"}
NOTES |= {f"gmsh-4.1-parametric-{mode}.msh": "80 nodes that move are kept" for mode in ("ascii", "binary")}
ALONE = {
    "numpy.npz",
    "hand-assembly.inp",
    "hand-crlf.inp",
    "meshio-series.xdmf",
}  # others know no instances, no time


@pytest.mark.parametrize("name", MAKERS)
def test_only_coordinates_change(made, tmp_path, name):
    row = check(made(name), tmp_path)
    assert row.same
    assert row.error <= ERROR.get(name, 1e-15)
    assert bool(row.readers) == (name not in ALONE)
    if name in NOTES:
        assert NOTES[name] in row.notes[0]
    assert len(row.notes) == (name in NOTES)


@pytest.mark.parametrize("name", MAKERS)
def test_without_other_coordinates_it_is_the_same_file(made, tmp_path, name):
    path, output = made(name), tmp_path / name
    js.write(output, js.read(path))
    if path.suffix == ".npz":  # it tells the time
        one, other = (dict(np.load(p)) for p in (path, output))
        assert one.keys() == other.keys()
        assert all(np.array_equal(one[key], other[key]) for key in one)
    else:
        assert output.read_bytes() == path.read_bytes()


@pytest.mark.parametrize(
    "name", ["gmsh-2.2-ascii.msh", "gmsh-4.1-ascii.msh", "gmsh.inp", "gmsh.mesh", "gmsh.su2"]
)
def test_nodes_that_stay_keep_their_lines(made, tmp_path, name):
    file = js.read(made(name))
    points = moved(file)
    js.write(tmp_path / name, file, points)
    lines = [path.read_bytes().splitlines() for path in (made(name), tmp_path / name)]
    differ = sum(one != other for one, other in zip(*lines, strict=True))
    assert differ == (points != np.asarray(file.mesh.points)).any(axis=1).sum() > 0


@pytest.mark.parametrize(
    "name", [*sorted(path.name for path in DATA.glob("*.msh")), "ffd.su2", "16_onlycore.inp"]
)
def test_files_that_went_wrong_elsewhere(tmp_path, name):
    row = check(DATA / name, tmp_path)
    assert (row.same, row.error, row.notes) == (True, 0, ())


# --- What the file was, and what became of it ---------------------------------------------


def test_the_input_may_be_the_output(made, tmp_path):
    path = tmp_path / "a.msh"
    path.write_bytes(made("gmsh-4.1-ascii.msh").read_bytes())
    file = js.read(path)
    points = moved(file)
    assert js.write(path, file, points, force=True) == ()
    assert np.array_equal(js.read(path).mesh.points, points)
    assert js.write(path, file, force=True) == ()  # the bytes are still known
    assert path.read_bytes() == made("gmsh-4.1-ascii.msh").read_bytes()


def test_large_files_are_read_again_if_they_are_the_same(made, tmp_path, monkeypatch):
    monkeypatch.setattr(original, "KEPT", 1000)
    path, output = tmp_path / "a.msh", tmp_path / "b.msh"
    path.write_bytes(made("gmsh-4.1-ascii.msh").read_bytes())
    file = js.read(path)
    assert file.original.content is None
    points = moved(file)
    assert js.write(output, file, points) == ()
    path.write_bytes(path.read_bytes() + b"$Comments\n$EndComments\n")
    for change in (lambda: None, path.unlink):
        change()
        (note,) = js.write(output, file, points)
        assert ANEW in note
        assert "the input is gone, or was changed after it had been read" in note
        assert np.array_equal(js.read(output).mesh.points, points)


def test_arrays_that_users_add_are_written(made, tmp_path):
    file = js.read(made("meshio-zlib.vtu"))
    file.source.point_data["mine"] = np.arange(64.0)
    js.write(tmp_path / "a.vtu", file)
    assert np.array_equal(js.read(tmp_path / "a.vtu").source.point_data["mine"], np.arange(64.0))
    file = js.read(made("meshio-zlib.vtu"))
    js.write(tmp_path / "b.vtu", file, cell_data={"q": {"hexahedron": np.arange(27.0)}})
    assert "q" in js.read(tmp_path / "b.vtu").source.cell_data


@pytest.fixture
def table():
    before = dict(FORMATS)
    yield FORMATS
    FORMATS.update(before)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (
            lambda content: re.sub(rb"0(\.\d+ \S+ \S+\s*\$EndNodes)", rb"1\1", content),
            "its coordinates are others",
        ),
        (lambda content: content.replace(b"$Elements\n", b"$Elements", 1), "the copy can't be read"),
        (
            lambda content: re.sub(
                rb"(\n\d+ )(\d+) (\d+) (\d+)(?= *\n\$EndElements)", rb"\1\3 \2 \4", content
            ),
            "its cells",
        ),
    ],
)
def test_a_copy_that_is_not_right_is_not_used(made, tmp_path, table, change, reason):
    """The last case turns the last triangle round."""
    right = FORMATS["gmsh"]

    def wrong(source, old, new):
        content = right.patch(source, old, new).content
        assert change(content) != content
        return Patched(change(content))

    file = js.read(made("gmsh-4.1-plane.msh"))
    register(dataclasses.replace(right, patch=wrong))
    points = moved(file)
    (note,) = js.write(tmp_path / "a.msh", file, points)
    assert ANEW in note
    assert reason in note
    assert np.array_equal(js.read(tmp_path / "a.msh").mesh.points, points)


def test_errors_of_the_program_are_not_hidden(made, tmp_path, table):
    def broken(source, old, new):
        raise TypeError("a bug")

    register(dataclasses.replace(FORMATS["vtu"], patch=broken))
    with pytest.raises(TypeError, match="a bug"):
        js.write(tmp_path / "a.vtu", js.read(made("meshio-zlib.vtu")))


def test_the_command_line_copies_too(tmp_path, capsys):
    from jaxsmooth.cli import main

    for name in ("16_onlycore.inp", "ffd.su2", "rect41.msh"):
        output = tmp_path / name
        assert main(["smooth", str(DATA / name), str(output), "--steps", "0"]) in (0, 3)  # some are inverted
        assert output.read_bytes() == (DATA / name).read_bytes()


def test_what_is_said_on_the_coordinates_is_said_at_the_end(made, tmp_path, capsys, monkeypatch):
    """The trial before the work changes no coordinate, so it rounds none."""
    from jaxsmooth import choices, cli

    def run(file, *args):
        result = smooth(file, *args)
        return dataclasses.replace(result, mesh=file.mesh.with_points(jnp.asarray(moved(file))))

    smooth = choices.run_method
    monkeypatch.setattr(choices, "run_method", run)
    words = ["smooth", str(made("hand-fields.nas")), str(tmp_path / "a.nas"), "--steps", "0", "-q"]
    assert cli.main([*words, "--json", str(tmp_path / "a.json")]) == 0
    assert capsys.readouterr().err.count("fields of 8 columns round coordinates by at most") == 1
    assert "fields of 8 columns" in json.loads((tmp_path / "a.json").read_text())["notes"][-1]


# --- Single formats ------------------------------------------------------------------------


def test_an_instance_moves_in_its_part(tmp_path):
    (tmp_path / "a.inp").write_text(ABAQUS)
    file = js.read(tmp_path / "a.inp")
    points = np.array(file.mesh.points)
    points[1] += [0.1, 0.2]
    assert js.write(tmp_path / "b.inp", file, points) == ()
    again = js.read(tmp_path / "b.inp")
    assert np.allclose(again.mesh.points, points, rtol=0, atol=1e-15)
    line = (tmp_path / "b.inp").read_text().splitlines()[6]
    turn = np.radians(-30)
    expected = [1 + 0.1 * np.cos(turn) - 0.2 * np.sin(turn), 0.1 * np.sin(turn) + 0.2 * np.cos(turn)]
    assert np.allclose([float(word) for word in line.split(",")[1:3]], expected, rtol=0, atol=1e-15)


def test_a_part_in_two_places_moves_in_both_or_not_at_all(tmp_path):
    second = "*INSTANCE, NAME=I2, PART=BLADE\n 9., 0., 0.\n*END INSTANCE\n*SURFACE"
    (tmp_path / "a.inp").write_text(
        ABAQUS.replace(" 3., 0., 0., 3., 0., 1., 30.\n", "").replace("*SURFACE", second)
    )
    file = js.read(tmp_path / "a.inp")
    points = np.array(file.mesh.points)
    assert len(points) == 8
    points[[1, 5]] += 0.125
    assert js.write(tmp_path / "b.inp", file, points) == ()
    assert np.array_equal(js.read(tmp_path / "b.inp").mesh.points, points)
    points[1] += 0.125
    (note, *_) = js.write(tmp_path / "b.inp", file, points)
    assert "moves in one instance as it does not in another" in note
    assert np.array_equal(js.read(tmp_path / "b.inp").mesh.points, points)


def test_included_files_stay_where_they_are(tmp_path):
    (tmp_path / "steel.txt").write_text("*MATERIAL, NAME=STEEL\n")
    (tmp_path / "part").mkdir()
    (tmp_path / "part" / "a.inp").write_text(FLAT + PLATE + "*INCLUDE, INPUT=../steel.txt\n")
    file = js.read(tmp_path / "part" / "a.inp")
    points = moved(file)
    assert js.write(tmp_path / "part" / "b.inp", file, points) == ()
    assert np.array_equal(js.read(tmp_path / "part" / "b.inp").mesh.points, points)
    assert (tmp_path / "part" / "b.inp").read_text().endswith("*INCLUDE, INPUT=../steel.txt\n")
    (tmp_path / "out").mkdir()
    (note,) = js.write(tmp_path / "out" / "b.inp", file, points)
    assert "b.inp refers to ../steel.txt beside it; copy from" in note
    assert sorted(os.listdir(tmp_path)) == ["out", "part", "steel.txt"]


@pytest.mark.parametrize("card", ["*INCLUDE, INPUT=nodes.txt\n", "*NODE, INPUT=nodes.txt\n"])
def test_nodes_in_an_included_file(tmp_path, card):
    (tmp_path / "nodes.txt").write_text(FLAT if "INCLUDE" in card else FLAT.removeprefix("*NODE\n"))
    (tmp_path / "a.inp").write_text(card + PLATE)
    file = js.read(tmp_path / "a.inp")
    (note, *_) = js.write(tmp_path / "b.inp", file, moved(file))
    assert (
        "because the input can't be copied with other coordinates: its nodes are in other files (nodes.txt)"
        in note
    )
    assert np.array_equal(js.read(tmp_path / "b.inp").mesh.points, moved(file))


def test_cards_that_are_lost_are_said(tmp_path):
    (tmp_path / "a.inp").write_text(FLAT + PLATE + "*STEP\n*STATIC\n*END STEP\n")
    file = js.read(tmp_path / "a.inp")
    kept = "cards of the Abaqus file that are not mesh are kept in Abaqus files only"
    assert file.notes == (f"{kept} (*END STEP, *STATIC, *STEP)",)
    lost = "no place for the other cards of the Abaqus file (*END STEP, *STATIC, *STEP); they are not written"
    assert lost in js.write(tmp_path / "b.vtu", file)[0]
    assert lost in js.write(tmp_path / "b.inp", dataclasses.replace(file, original=None))[0]


def test_sections_and_cards_that_are_lost_elsewhere(made, tmp_path):
    file = js.read(made("hand-fields.nas"))
    assert file.notes[0] == (
        "cards of the Nastran file that are not mesh are kept in Nastran files only (FORCE, MAT1)"
    )
    assert "the other cards of the Nastran file (FORCE, MAT1)" in js.write(tmp_path / "a.vtu", file)[0]
    (tmp_path / "a.mesh").write_text(MEDIT.replace("RequiredVertices", "Ridges 1 1 RequiredVertices"))
    file = js.read(tmp_path / "a.mesh")
    assert file.notes == ("the section Ridges of the Medit file is kept in Medit files only",)
    assert "sections of the Medit file (Ridges)" in js.write(tmp_path / "a.vtu", file)[0]


def test_files_beside_an_xdmf_file(made, tmp_path):
    pytest.importorskip("h5py")
    for name in ("meshio-hdf5.xdmf", "meshio-hdf5.h5"):
        (tmp_path / name).write_bytes((made("meshio-hdf5.xdmf").parent / name).read_bytes())
    path = tmp_path / "meshio-hdf5.xdmf"
    before = (tmp_path / "meshio-hdf5.h5").read_bytes()
    file = js.read(path)
    points = moved(file)
    assert js.write(tmp_path / "b.xdmf", file, points) == ()
    assert sorted(os.listdir(tmp_path)) == ["b.h5", "b.xdmf", "meshio-hdf5.h5", "meshio-hdf5.xdmf"]
    assert (tmp_path / "meshio-hdf5.h5").read_bytes() == before
    path.rename(tmp_path / "hidden.xdmf")
    os.remove(tmp_path / "meshio-hdf5.h5")
    assert np.array_equal(js.read(tmp_path / "b.xdmf").mesh.points, points)
    assert np.array_equal(meshio.read(tmp_path / "b.xdmf").points, points)
    (tmp_path / "c.h5").write_bytes(b"precious")
    with pytest.raises(MeshFileError, match=r"c\.h5: .*would be replaced"):
        js.write(tmp_path / "c.xdmf", js.read(tmp_path / "b.xdmf"))
    assert (tmp_path / "c.h5").read_bytes() == b"precious"
    again = js.read(tmp_path / "b.xdmf")
    assert js.write(tmp_path / "b.xdmf", again, np.asarray(file.mesh.points), force=True) == ()
    assert np.array_equal(js.read(tmp_path / "b.xdmf").mesh.points, file.mesh.points)
    (tmp_path / "b.h5").unlink()
    (note,) = js.write(tmp_path / "d.xdmf", again)
    assert ANEW in note


def test_the_grids_of_a_series(made, tmp_path):
    pytest.importorskip("h5py")
    path = made("meshio-series.xdmf")
    file = js.read(path)
    assert "first grid of the XDMF file (mesh)" in file.notes[0]
    js.write(tmp_path / "a.xdmf", file, moved(file))
    with meshio.xdmf.TimeSeriesReader(tmp_path / "a.xdmf") as reader:
        points, _ = reader.read_points_cells()
        assert reader.num_steps == 3
        time, data, _ = reader.read_data(1)
    assert np.array_equal(points, moved(file))
    assert time == 0.5
    assert np.array_equal(data["heat"], 0.5 * np.asarray(file.source.points)[:, 0])


def test_text_of_vtk_survives(made, tmp_path):
    vtk = pytest.importorskip("vtk")
    for name in (
        *("vtk-ascii.vtu", "vtk-raw-zlib.vtu", "vtk-appended-base64.vtu"),
        *("vtk-legacy-ascii.vtk", "vtk-legacy-binary.vtk"),
    ):
        file, kind = js.read(made(name)), name[-3:]
        assert file.notes[0] == f"data of text or bits are kept in {kind.upper()} files only (label, flag)"
        assert list(file.source.point_data) == ["heat", "flow"]
        for data in ("material", "kind"):
            assert np.array_equal(np.concatenate(file.source.cell_data[data]).ravel(), np.arange(36) % 3)
        js.write(tmp_path / name, file, moved(file))
        reader = vtk.vtkXMLUnstructuredGridReader() if kind == "vtu" else vtk.vtkUnstructuredGridReader()
        reader.ReadAllFieldsOn() if kind == "vtk" else None
        reader.SetFileName(str(tmp_path / name))
        reader.Update()
        data = reader.GetOutput().GetCellData()
        assert data.GetAbstractArray("label").GetValue(35) == "cell 35"
        assert [data.GetArray("flag").GetValue(k) for k in range(4)] == [0, 1, 0, 1]
        assert reader.GetOutput().GetFieldData().GetArray("TimeValue").GetValue(0) == 0.25
        assert "data of text or bits (label, flag)" in js.write(tmp_path / "a.msh", file)[0]


def test_versions_of_gmsh_say_the_same(made):
    files = [js.read(made(f"gmsh-{name}.msh")) for name in ("4.1-ascii", "4.0-ascii", "4.1-parametric-ascii")]
    files.append(js.read(made("gmsh-4.1-parametric-binary.msh")))
    for file in files[1:]:
        assert np.allclose(file.mesh.points, files[0].mesh.points, rtol=0, atol=1e-15)  # 16 digits
        assert np.array_equal(file.mesh.connectivity[0], files[0].mesh.connectivity[0])
        assert np.array_equal(file.mesh.labels.regions[0], files[0].mesh.labels.regions[0])


def test_partitions_of_gmsh(made):
    """Nodes and elements are in another order; the groups are those of the entities they are parts of."""
    whole, parts = (js.read(made(f"gmsh-4.1-{name}.msh")) for name in ("ascii", "partitioned"))
    assert len(parts.mesh.points) == len(whole.mesh.points)
    for name in ("material 0", "material 1", "left"):
        assert parts.named_sets[name].sum() == whole.named_sets[name].sum() > 0
    tags = [np.unique(np.concatenate(file.source.cell_data["gmsh:geometrical"])) for file in (whole, parts)]
    assert np.array_equal(*tags)  # no borders between partitions


def test_a_plane_mesh_with_its_plane_in_space(made, tmp_path):
    """Two coordinates change, the third keeps its text."""
    file = js.read(made("gmsh-plane.su2"))
    js.write(tmp_path / "a.msh", file, file_format="gmsh22:ascii")
    text = re.sub(r"(?m)^(\d+ \S+ \S+) \S+$", r"\1 0.250", (tmp_path / "a.msh").read_text())
    (tmp_path / "a.msh").write_text(text)
    file = js.read(tmp_path / "a.msh")
    assert js.write(tmp_path / "b.msh", file, moved(file)) == ()
    assert (tmp_path / "b.msh").read_text().count(" 0.250\n") == len(file.mesh.points)
