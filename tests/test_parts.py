"""The CAD parts of the benchmarks: their statistics, their validity, and the demo file made of one."""

import meshio
import numpy as np
import pytest

try:
    gmsh = pytest.importorskip("gmsh")
except OSError as error:  # the wheel is there, a system library it links to is not
    pytest.skip(f"gmsh cannot be loaded: {error}", allow_module_level=True)

from benchmarks import parts

# What the paper prints for iteration 0 (Tables 7 and 8): elements, average quality, count below 0.2.
PAPER = {"rocker_arm": (12865, 0.785, 273), "swing_frame": (32383, 0.724, 938)}
NAMES = ("rocker_arm", "swing_frame", "bracket")


@pytest.fixture(scope="module")
def meshes():
    return {name: getattr(parts, name)() for name in NAMES}


@pytest.mark.parametrize("name", NAMES)
def test_part_is_a_valid_mesh(meshes, name):
    points, tetra = meshes[name]
    assert points.dtype == np.float64
    assert points.shape[1:] == (3,)
    assert np.issubdtype(tetra.dtype, np.integer)
    np.testing.assert_array_equal(np.unique(tetra), np.arange(len(points)))  # no orphan nodes
    q = parts.quality(points, tetra)
    assert q.min() > 1e-4
    assert q.max() <= 1 + 1e-12
    faces = np.sort(tetra[:, parts.FACES].reshape(-1, 3), axis=1)
    assert np.unique(faces, axis=0, return_counts=True)[1].max() == 2


@pytest.mark.parametrize("name", PAPER)
def test_part_starts_where_the_paper_does(meshes, name):
    elements, average, poor = PAPER[name]
    points, tetra = meshes[name]
    q = parts.quality(points, tetra)
    assert len(tetra) == pytest.approx(elements, rel=0.03)
    assert q.mean() == pytest.approx(average, abs=0.02)
    assert np.sum(q < 0.2) == pytest.approx(poor, rel=0.15)


def test_bracket_is_a_worthwhile_demo(meshes):
    points, tetra = meshes["bracket"]
    assert 10_000 <= len(tetra) <= 20_000
    assert np.sum(parts.quality(points, tetra) < 0.2) >= 200


@pytest.mark.parametrize("name", NAMES)
def test_part_is_the_same_every_time(meshes, name):
    for first, second in zip(meshes[name], getattr(parts, name)(), strict=True):
        np.testing.assert_array_equal(first, second)


def test_shipped_bracket_is_the_generated_one(meshes):
    assert parts.DEMO.stat().st_size < 1_000_000
    shipped = meshio.read(parts.DEMO)
    points, tetra = meshes["bracket"]
    assert list(shipped.cells_dict) == ["tetra"]
    if gmsh.__version__ != parts.GMSH:
        pytest.skip(f"the demo was made by Gmsh {parts.GMSH}, this is {gmsh.__version__}")
    np.testing.assert_array_equal(shipped.cells_dict["tetra"], tetra)
    np.testing.assert_allclose(shipped.points, points, rtol=0, atol=1e-9)


def test_quality_of_known_tetrahedra():
    corners = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]], dtype=float)
    ideal, inverted = np.array([[0, 1, 3, 2]]), np.array([[0, 1, 2, 3]])
    # The sum is a handful of roundings.
    np.testing.assert_allclose(np.abs(parts.quality(corners, ideal)), 1, rtol=1e-14)
    np.testing.assert_allclose(parts.quality(corners, inverted), -parts.quality(corners, ideal), rtol=1e-14)
