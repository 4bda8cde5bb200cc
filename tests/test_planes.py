"""Plane meshes wherever they lie in space: smoothed in their plane, written back in space."""

from pathlib import Path

import meshes
import meshio
import numpy as np
import pytest

import jaxsmooth as js
from jaxsmooth.convert.meshfile import MeshFileError, to_meshio
from jaxsmooth.convert.planes import find_plane

CASES = Path(__file__).parents[2] / "shared" / "cases"
FLAT, BLOCKS = meshes.grid("triangle", (5, 5), 0.12)
NODES = BLOCKS["triangle"]


def in_space(flat=FLAT, turn=None, normal=0.0):
    points = np.c_[flat, np.broadcast_to(normal, len(flat))]
    return points if turn is None else points @ np.asarray(turn).T


def qualities(mesh):
    return np.sort(np.asarray(js.quality(mesh)[0]))


@pytest.mark.parametrize("order", [[0, 1, 2], [0, 2, 1], [2, 0, 1], [2, 1, 0]])
def test_planes_normal_to_an_axis_are_exact(order):
    points = in_space(normal=0.3)[:, order]
    file = js.from_meshio(meshio.Mesh(points, BLOCKS))
    columns = [k for k in range(3) if order[k] != 2]
    assert file.plane.columns == tuple(columns)
    np.testing.assert_array_equal(file.mesh.points, points[:, columns])
    np.testing.assert_allclose(qualities(file), qualities(js.Mesh(FLAT, BLOCKS)), rtol=1e-12)
    result = js.smooth(file, steps=2)
    out = to_meshio(file, result.mesh.points).points
    np.testing.assert_array_equal(out[:, columns], result.mesh.points)
    np.testing.assert_array_equal(out[:, 3 - sum(columns)], 0.3)


@pytest.mark.parametrize("seed", [1, 2, 3])
@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e5])
def test_any_plane(seed, scale):
    turn, noise = meshes.rotation_matrix(3, seed), 1e-7 * np.sin(np.arange(len(FLAT)))
    points = scale * (in_space(turn=turn, normal=noise) + 0.7)
    file = js.from_meshio(meshio.Mesh(points, BLOCKS))
    assert file.mesh.dim == 2
    np.testing.assert_allclose(qualities(file), qualities(js.Mesh(FLAT, BLOCKS)), rtol=1e-6)
    np.testing.assert_array_equal(to_meshio(file).points, points)
    moved = np.asarray(file.mesh.points).copy()
    moved[7] += scale * np.array([0.03, -0.01])
    out = to_meshio(file, moved).points
    others = np.arange(len(points)) != 7
    np.testing.assert_array_equal(out[others], points[others])
    assert np.linalg.norm(out[7] - points[7]) == pytest.approx(scale * 0.001**0.5, rel=1e-6)
    height = (out / scale - 0.7) @ turn[:, 2]  # what is normal to the plane stays
    np.testing.assert_allclose(height, noise, atol=1e-8)
    straight = np.isclose(FLAT[:, 0], 0) & ~np.isclose(FLAT[:, 1] % 1, 0)
    assert (js.detect_constraints(file).freedom[straight] == 1).all()


@pytest.mark.parametrize("noise", [5e-8, 4e-6])
def test_noise_off_the_plane_is_kept(noise):
    off = noise * np.cos(np.arange(len(FLAT)))
    file = js.from_meshio(meshio.Mesh(in_space(normal=off), BLOCKS))
    np.testing.assert_array_equal(file.mesh.points, FLAT)
    out = to_meshio(file, js.smooth(file, steps=1).mesh.points).points
    np.testing.assert_array_equal(out[:, 2], off)


@pytest.mark.parametrize("bow", [1e-4, 0.1])
@pytest.mark.parametrize("turn", [None, meshes.rotation_matrix(3, 5)])
def test_surfaces_are_no_planes(bow, turn):
    points = in_space(normal=bow * FLAT[:, 0] ** 2, turn=turn)
    file = js.from_meshio(meshio.Mesh(points, BLOCKS))
    assert file.plane is None
    assert file.mesh.surface
    np.testing.assert_array_equal(file.mesh.points, points)


def test_points_in_the_plane_have_no_plane():
    assert js.from_meshio(meshio.Mesh(FLAT, BLOCKS)).plane is None
    plane = find_plane(in_space())
    assert plane.columns == (0, 1)
    np.testing.assert_array_equal(plane.axes, np.eye(3)[:2])


def test_float32_stays_float32():
    points = in_space(turn=meshes.rotation_matrix(3, 1)).astype(np.float32)
    file = js.from_meshio(meshio.Mesh(points, BLOCKS))
    assert file.mesh.points.dtype == np.float32
    out = to_meshio(file, file.mesh.points + np.float32(0.25)).points
    assert out.dtype == np.float32
    assert np.linalg.norm(out - points, axis=1) == pytest.approx(0.25 * 2**0.5, rel=1e-5)


@pytest.mark.parametrize("name", ["26_xz.vtu", "26_noise.vtu"])
def test_cases(name):
    if not (CASES / name).exists():
        pytest.skip("needs the shared cases")
    file = js.read(CASES / name)
    result = js.smooth(file, steps=3)
    first, last = (result.history[k].statistics for k in (0, -1))
    assert last.q_avg > first.q_avg
    assert last.inverted == 0
    normal = 3 - sum(file.plane.columns)
    out = to_meshio(file, result.mesh.points).points
    np.testing.assert_array_equal(out[:, normal], file.source.points[:, normal])


def test_a_format_without_z_refuses_other_planes(tmp_path):
    standing = js.from_meshio(meshio.Mesh(in_space()[:, [0, 2, 1]], BLOCKS))
    with pytest.raises(MeshFileError, match="lies in another plane"):
        js.write(tmp_path / "a.su2", standing)
    assert list(tmp_path.iterdir()) == []
    lying = js.from_meshio(meshio.Mesh(in_space(normal=4e-6 * np.cos(np.arange(len(FLAT)))), BLOCKS))
    js.write(tmp_path / "a.su2", lying)
    np.testing.assert_allclose(js.read(tmp_path / "a.su2").mesh.points, FLAT, atol=1e-12)
