"""From format to format: nothing is lost without a note that names it."""

import dataclasses
import importlib.util

import jax
import meshio
import numpy as np
import pytest

from benchmarks.files.facts import items, missing
from benchmarks.files.pairs import convert, targets
from jaxsmooth.convert.meshfile import from_meshio
from jaxsmooth.files.formats.table import FORMATS
from jaxsmooth.files.io import MeshFileError, read, write


@pytest.fixture(autouse=True)
def double_precision():
    with jax.enable_x64(True):
        yield


def block():
    """Six tetrahedra of two materials in a unit cube about the origin, with tagged faces, sets and data."""
    points = np.stack(np.meshgrid(*3 * [np.array([-0.5, 0.5])], indexing="ij"), -1).reshape(-1, 3) / 0.7
    paths = [[0, a, a + b, 7] for a in (1, 2, 4) for b in (1, 2, 4) if a != b]
    tetra = np.array([row if k % 2 else row[::-1] for k, row in enumerate(paths)])
    triangles = np.array([[0, 1, 3], [0, 2, 3], [0, 4, 6]])
    return meshio.Mesh(
        points,
        [("tetra", tetra), ("triangle", triangles)],
        point_data={"heat": points[:, 0] / 7, "flow": points / 3},
        cell_data={"gmsh:physical": [np.array([1, 1, 1, 2, 2, 2]), np.array([7, 7, 8])]},
        point_sets={"edge": np.array([0, 7])},
        cell_sets={"some": [np.array([0, 5]), np.zeros(0, int)]},
    )


def usable(name):
    needs = FORMATS[name].needs
    return needs is None or importlib.util.find_spec(needs) is not None


@pytest.mark.parametrize(
    "name",
    ["gmsh22", "gmsh", "vtu", "xdmf", "abaqus", "medit", "su2", "exodus", "med", "nastran", "unv", "npz"],
)
def test_losses_are_said(tmp_path, name):
    if not usable(name):
        pytest.skip(f"needs {FORMATS[name].needs}")
    path = tmp_path / f"mesh{FORMATS[name].suffixes[0]}"
    write(path, from_meshio(block()), file_format=name)
    file = read(path)
    for other in filter(usable, targets()):
        result = convert(file, other, tmp_path)
        assert isinstance(result, str) or all(lost.said for lost in result), (other, result)


def test_what_is_lost_is_found():
    """The comparison itself: each kind of thing is missed."""
    before = items(from_meshio(block()))
    assert not list(missing(before, before, ()))
    bare = block()
    bare.point_data, bare.cell_data, bare.point_sets, bare.cell_sets = {}, {}, {}, {}
    lost = list(missing(before, items(from_meshio(bare)), ("data not written: heat",)))
    kinds = ["materials", "boundary tags", "sets", "sets", "point data", "point data"]
    assert [entry.kind for entry in lost] == kinds
    assert [entry.name for entry in lost if entry.said] == ["heat"]
    bare.cells = bare.cells[:1]
    lost = missing(before, items(from_meshio(bare)), ())
    assert [entry.kind for entry in lost][:3] == ["materials", "boundary cells", "boundary tags"]


def anew(path):
    return dataclasses.replace(read(path), original=None)


def test_groups_of_gmsh_and_med(tmp_path):
    """Names become families and sets again, overlapping ones too."""
    pytest.importorskip("h5py")
    source = block()
    source.field_data = {"left": np.array([7, 2]), "core": np.array([2, 3])}
    source.cell_sets = {"some": [np.array([0, 5]), np.zeros(0, int)], "a/b": [np.array([5]), np.array([1])]}
    notes = write(tmp_path / "a.med", from_meshio(source))
    assert notes == ("names in med files have no slash; written with underscores: a/b",)
    before, file = from_meshio(source).named_sets, read(tmp_path / "a.med")
    assert {name: mask.tolist() for name, mask in file.named_sets.items() if name != "point_tags"} == {
        name.replace("/", "_"): mask.tolist() for name, mask in before.items()
    }
    assert not write(tmp_path / "b.med", anew(tmp_path / "a.med"))
    assert "left" in " ".join(write(tmp_path / "b.vtu", file))
    for name in ("b.med", "b.vtu"):
        again = read(tmp_path / name).named_sets
        assert all(np.array_equal(again[key], mask) for key, mask in file.named_sets.items())


def test_nastran_holds_any_number(tmp_path):
    points = np.array(
        [[-1 / 3, -1e-9 / 3, -2e5 / 3], [1, 0, 0], [0, 1, 0], [0, 0, 1e7 / 3], [-0.1, 1e-300, 5]]
    )
    write(tmp_path / "a.bdf", (points, {"tetra": np.array([[0, 1, 2, 3], [1, 2, 3, 4]])}))
    assert np.allclose(read(tmp_path / "a.bdf").source.points, points, rtol=1e-8, atol=1e-12)


def test_boundary_tags_without_materials(tmp_path):
    source = block()
    source.cell_data = {"ugrid:ref": [np.zeros(6, int), np.array([7, 7, 8])]}
    for name in ("a.mesh", "a.msh", "a.bdf", "a.unv"):
        assert not [n for n in write(tmp_path / name, from_meshio(source)) if "ugrid" in n]
        (tags,) = read(tmp_path / name).mesh.labels.feature_tags
        assert tags.tolist() == [7, 7, 8]


def test_mixed_types_in_avs(tmp_path):
    notes = write(tmp_path / "a.avs", from_meshio(block()))
    assert "edge, some" in " ".join(notes)
    assert sum(map(len, read(tmp_path / "a.avs").source.cells)) == 9


def test_tetgen_is_for_tetrahedra(tmp_path):
    square = [[0.0, 0], [1, 0], [1, 1], [0, 1]]
    points = np.array([[*corner, z] for z in (0.0, 1.0) for corner in square])
    mesh = (points, {"hexahedron": np.arange(8)[None]})
    with pytest.raises(MeshFileError, match="tetgen files can't hold hexahedron"):
        write(tmp_path / "a.ele", mesh)
