"""Surfaces in space: smoothed within themselves, by the functions of plane elements."""

import jax
import meshes
import meshio
import numpy as np
import pytest

import jaxsmooth as js
from jaxsmooth.assembly import tangents
from jaxsmooth.mesh.normals import reference_normals
from jaxsmooth.mesh.topology import lengths, node_pairs


def sphere_of_triangles(rough=0.0225):
    """An octahedron divided four times over, its nodes moved about on the sphere."""
    points = [*np.eye(3), *-np.eye(3)]
    faces = [(0, 1, 2), (1, 3, 2), (3, 4, 2), (4, 0, 2), (1, 0, 5), (3, 1, 5), (4, 3, 5), (0, 4, 5)]
    for _ in range(4):
        middle, finer = {}, []
        for face in faces:
            ring = []
            for a, b in zip(face, face[1:] + face[:1], strict=True):
                key = min(a, b), max(a, b)
                if key not in middle:
                    middle[key] = len(points)
                    points.append((points[a] + points[b]) / np.linalg.norm(points[a] + points[b]))
                ring.append(middle[key])
            a, b, c = ring
            finer += [(face[0], a, c), (a, face[1], b), (c, b, face[2]), (a, b, c)]
        faces = finer
    return on_sphere(np.array(points), rough), {"triangle": np.array(faces)}


def sphere_of_quads(n=8, rough=0.05):
    """A cube whose faces are grids, blown up."""
    flat, quads = meshes.grid("quad", (n, n), 0)
    flat, quads = 2 * flat / flat.max() - 1, quads["quad"]
    x, y, one = *np.tan(np.pi / 4 * flat).T, np.ones(len(flat))
    sides = [(x, y, one), (y, x, -one), (one, x, y), (-one, y, x), (y, one, x), (x, -one, y)]
    every = np.concatenate([np.stack(side, axis=1) for side in sides])
    number = np.concatenate([quads + len(flat) * i for i in range(6)])
    _, first, same = np.unique(np.round(every, 9), axis=0, return_index=True, return_inverse=True)
    return on_sphere(every[first], rough), {"quad": same.reshape(-1)[number]}


def on_sphere(points, rough):
    points = points + rough * np.random.default_rng(3).uniform(-1, 1, points.shape)
    return points / np.linalg.norm(points, axis=1, keepdims=True)


def bent(kind, shape=(5, 5), amount=0.04, curve=0.3):
    """A saddle over a rough grid."""
    flat, blocks = meshes.grid(kind, shape, amount)
    flat = np.asarray(flat) / np.max(flat)
    return np.c_[flat, curve * flat[:, 0] * (flat[:, 1] - 0.4)], blocks


def box(n=5):
    """The surface of a box of triangles, rough inside its faces."""
    rng, parts, cells, start = np.random.default_rng(5), [], [], 0
    flat, blocks = meshes.grid("triangle", (n, n), 0)
    flat, rows = flat / flat.max(), blocks["triangle"]
    inside = ((flat > 1e-9) & (flat < 1 - 1e-9)).all(axis=1)
    for axis in range(3):
        for side in (0.0, 1.0):
            moved = flat + inside[:, None] * rng.uniform(-0.07, 0.07, flat.shape)
            place = np.insert(moved, axis, side, axis=1)
            parts.append(place)
            cells.append((rows if (side == 1.0) != (axis == 1) else rows[:, ::-1]) + start)
            start += len(flat)
    every = np.concatenate(parts)
    _, first, same = np.unique(np.round(every, 9), axis=0, return_index=True, return_inverse=True)
    return every[first], {"triangle": same.reshape(-1)[np.concatenate(cells)]}


def ends(result):
    return result.history[0].statistics, result.history[-1].statistics


@pytest.mark.parametrize(("make", "bound"), [(sphere_of_triangles, 1e-3), (sphere_of_quads, 5e-3)])
def test_a_sphere_stays_one(make, bound):
    mesh = js.as_mesh(make())
    assert mesh.surface
    # a coarse sphere is farther from its facets than the usual tolerance
    motion = js.detect_constraints(mesh, surface_tolerance=0.1)
    result = js.smooth(mesh, steps=10, tolerance_avg=0.0, constraints=motion)
    before, after = ends(result)
    assert after.q_min > before.q_min + 0.05
    assert after.q_avg > before.q_avg + 0.005
    points = np.asarray(result.mesh.points)
    pairs = node_pairs(mesh)
    local = np.bincount(pairs.ravel(), np.repeat(lengths(points, pairs), 2)) / np.bincount(pairs.ravel())
    off = np.abs(np.linalg.norm(points, axis=1) - 1)
    assert (off < bound * local).all(), (off / local).max()
    assert (points != np.asarray(mesh.points)).any(axis=1).sum() > 0.9 * len(points)


def test_a_box_keeps_its_edges():
    points, blocks = box()
    mesh = js.as_mesh((points, blocks))
    motion = js.detect_constraints(mesh)
    on = np.isclose(points, 0) | np.isclose(points, 1)
    np.testing.assert_array_equal(motion.at(mesh.points).freedom, 3 - on.sum(axis=1))
    result = js.smooth(mesh, steps=3)
    np.testing.assert_array_equal(np.asarray(result.mesh.points)[on], points[on])
    before, after = ends(result)
    assert after.q_min > before.q_min
    assert after.q_avg > before.q_avg


def test_an_open_patch_keeps_its_border():
    points, blocks = bent("quad")
    mesh = js.as_mesh((points, blocks))
    freedom = js.detect_constraints(mesh).at(mesh.points).freedom
    x, y = points[:, :2].T
    side = np.isclose(x, 0).astype(int) + np.isclose(x, 1) + np.isclose(y, 0) + np.isclose(y, 1)
    assert (freedom[side == 2] == 0).all()
    assert (freedom[side == 1] == 1).all()
    assert (freedom[side == 0] == 2).all()
    result = js.smooth(mesh, steps=4)
    moved = np.asarray(result.mesh.points)
    for axis, end in ((0, 0), (0, 1), (1, 0), (1, 1)):  # a saddle is ruled: its borders are straight
        there = np.isclose(points[:, axis], end)
        np.testing.assert_allclose(moved[there, axis], end, atol=1e-9)
    np.testing.assert_allclose(moved[:, 2], 0.3 * moved[:, 0] * (moved[:, 1] - 0.4), atol=3e-3)
    before, after = ends(result)
    assert after.q_avg > before.q_avg


@pytest.mark.parametrize("kind", ["triangle", "quad"])
def test_a_flat_patch_is_the_plane_problem(kind):
    """A surface that is flat takes the steps of the plane mesh, turned into space."""
    flat, blocks = meshes.grid(kind, (4, 4), 0.06)
    turn = meshes.rotation_matrix(3, 2)
    plane, space = js.Mesh(flat, blocks), js.Mesh(np.c_[flat, 0 * flat[:, 0]] @ turn.T + 0.3, blocks)
    motion, bound = js.detect_constraints(plane), js.detect_constraints(space, boundary="planar")
    moves = turn[:, :2] @ np.asarray(motion.projectors) @ turn[:, :2].T
    np.testing.assert_allclose(bound.projectors, moves, atol=1e-9)
    for metric in ("shape", "scaled_jacobian", "measure"):
        np.testing.assert_allclose(js.quality(space, metric)[0], js.quality(plane, metric)[0], rtol=1e-9)
    for method in (js.Elastic(extended=True), *[js.Laplacian(smart=True, weighted=True)] * (kind == "quad")):
        one = js.run(plane, method, constraints=motion, steps=2)
        two = js.run(space, method, constraints=bound, steps=2)
        places = np.c_[one.points, np.zeros(len(flat))] @ turn.T + 0.3
        np.testing.assert_allclose(two.points, places, atol=1e-7)


def test_optimisation_of_a_flat_patch_is_that_of_the_plane():
    flat, blocks = meshes.grid("triangle", (4, 4), 0.06)
    turn = meshes.rotation_matrix(3, 2)
    plane, space = js.Mesh(flat, blocks), js.Mesh(np.c_[flat, 0 * flat[:, 0]] @ turn.T, blocks)
    energy = js.Energy()
    np.testing.assert_allclose(energy(space), energy(plane), rtol=1e-9)
    there = jax.grad(lambda x: energy(space.with_points(x)))(space.points)
    here = jax.grad(lambda x: energy(plane.with_points(x)))(plane.points)
    np.testing.assert_allclose(there, np.asarray(here) @ turn[:, :2].T, atol=1e-9)
    one, two = (
        js.smooth(mesh, js.Optimize(), steps=1, constraints=js.detect_constraints(mesh, boundary="planar"))
        for mesh in (plane, space)
    )
    np.testing.assert_allclose(ends(two)[1].q_avg, ends(one)[1].q_avg, atol=1e-6)
    assert ends(two)[1].q_avg > ends(two)[0].q_avg


def test_quality_is_that_of_each_element_in_its_own_plane():
    """And it does not depend on the place, the unit, or the order of nodes and elements."""
    points, blocks = bent("triangle")
    mesh = js.Mesh(points, blocks)
    corners = points[blocks["triangle"]]
    area = np.linalg.norm(np.cross(*np.moveaxis(corners[:, 1:] - corners[:, :1], 1, 0)), axis=1) / 2
    square = ((corners - np.roll(corners, 1, axis=1)) ** 2).sum(axis=(1, 2))
    np.testing.assert_allclose(js.quality(mesh, "measure")[0], area, rtol=1e-9)
    np.testing.assert_allclose(js.quality(mesh, "mean_ratio")[0], 4 * 3**0.5 * area / square, rtol=1e-9)
    turned = js.Mesh(1e3 * points @ meshes.rotation_matrix(3, 4).T - 7, blocks)
    np.testing.assert_allclose(js.quality(turned)[0], js.quality(mesh)[0], rtol=1e-9)
    order = np.random.default_rng(0).permutation(len(points))
    other = js.Mesh(points[order], {"triangle": np.argsort(order)[blocks["triangle"]]})
    np.testing.assert_allclose(js.quality(other)[0], js.quality(mesh)[0], rtol=1e-9)


def test_moves_turn_with_the_surface():
    points, blocks = bent("quad")
    turn = meshes.rotation_matrix(3, 4)
    order = np.random.default_rng(0).permutation(len(points))
    variants = (
        (points, blocks),
        (1e3 * points @ turn.T - 7, blocks),
        (points[order], {"quad": np.argsort(order)[blocks["quad"]][::-1]}),
    )
    found = []
    for variant in variants:
        mesh = js.as_mesh(variant)
        motion = js.detect_constraints(mesh)
        method = js.Elastic(tolerance=1e-10)
        found.append(np.asarray(js.run(mesh, method, constraints=motion, steps=2).points))
    plain, turned, renumbered = found
    assert np.abs(plain - points).max() > 0.01
    np.testing.assert_allclose((turned + 7) @ turn / 1e3, plain, atol=1e-6)
    np.testing.assert_allclose(renumbered[np.argsort(order)], plain, atol=1e-6)


def test_neighbours_orient_a_surface():
    points, blocks = bent("triangle")
    nodes = blocks["triangle"].copy()
    nodes[::3] = nodes[::3, ::-1]
    file = js.from_meshio(meshio.Mesh(points, {"triangle": nodes}))
    assert any("numbered the other way round" in note for note in file.notes)
    up = np.asarray(file.mesh.normals[0])[:, 2]
    assert (up > 0).all() | (up < 0).all()
    np.testing.assert_allclose(
        np.sort(js.quality(file)[0]), np.sort(js.quality(js.Mesh(points, blocks))[0]), rtol=1e-9
    )


def test_a_fold_is_inverted():
    flat, blocks = meshes.grid("triangle", (5, 5), 0.0)
    flat = flat / flat.max()
    moved = flat.copy()
    inner = np.argmin(np.abs(flat - 0.4).sum(axis=1))
    moved[inner] += (0.27, 0.02)  # beyond the neighbour
    mesh = js.as_mesh((np.c_[moved, 0.2 * moved[:, 0] ** 2], blocks))
    before = js.statistics(mesh)
    assert before.inverted > 0
    assert before.q_min < 0


def test_reference_normals_of_slivers_and_folds_are_those_around():
    points, blocks = bent("triangle", amount=0.0)
    kind, nodes = js.element_type("triangle"), blocks["triangle"]
    plain = reference_normals(points, [(kind, nodes)])[0]
    up = plain[:, 2] > 0
    assert up.all() | (~up).all()
    turned = nodes.copy()
    middle = len(nodes) // 2
    turned[middle] = turned[middle, ::-1]
    found = reference_normals(points, [(kind, turned)])[0]
    assert found[middle] @ plain[middle] > 0.9  # though its own is the opposite


def test_frames_are_orthonormal_and_see_areas():
    for dtype in (np.float32, np.float64):
        points, blocks = bent("quad")
        mesh = js.Mesh(points.astype(dtype), blocks)
        (frames,) = tangents(mesh)
        assert frames.dtype == dtype
        tolerance = 1e-5 if dtype == np.float32 else 1e-12
        products = np.einsum("eia,eja->eij", frames, frames)
        np.testing.assert_allclose(products, np.broadcast_to(np.eye(2), products.shape), atol=tolerance)
        normal = np.cross(frames[:, 0], frames[:, 1])
        np.testing.assert_allclose(normal, mesh.normals[0], atol=1e-4 if dtype == np.float32 else 1e-9)


@pytest.mark.parametrize("suffix", ["stl", "obj", "off", "ply", "vtk", "msh"])
def test_formats_of_surfaces(tmp_path, suffix):
    points, blocks = bent("triangle")
    path = tmp_path / f"a.{suffix}"
    js.write(path, js.Mesh(points, blocks))
    file = js.read(path)
    assert file.mesh.surface
    tolerance = 1e-7 if suffix == "stl" else 1e-14
    order = np.lexsort(np.round(np.asarray(file.mesh.points), 6).T)
    mine = np.lexsort(np.round(points, 6).T)
    np.testing.assert_allclose(np.asarray(file.mesh.points)[order], points[mine], atol=tolerance)
    moved = np.asarray(file.mesh.points) + np.array([0.25, 0, 0.5])
    js.write(tmp_path / f"b.{suffix}", file, points=moved)
    again = js.read(tmp_path / f"b.{suffix}")
    np.testing.assert_allclose(again.mesh.points, moved, atol=1e-6 if suffix == "stl" else 1e-12)


def test_obj_keeps_all_but_coordinates(tmp_path):
    lines = [b"# part", b"mtllib a.mtl", b"o one", b"v 0 0 0", b"v 1 0 0.5 ", b"v 1 1 0", b"v 0 1 0.25"]
    lines += [b"vt 0 0", b"vn 0 0 1", b"usemtl red", b"f 1/1/1 2/1/1 -2/1/1", b"f 1//1 3//1 4//1", b""]
    (tmp_path / "a.obj").write_bytes(b"\n".join(lines))
    file = js.read(tmp_path / "a.obj")
    np.testing.assert_array_equal(file.mesh.connectivity[0], [[0, 1, 2], [0, 2, 3]])
    moved = np.asarray(file.mesh.points).copy()
    moved[2] = (1, 1.5, 0)
    notes = js.write(tmp_path / "b.obj", file, points=moved)
    assert any("vn" in note for note in notes)
    new = (tmp_path / "b.obj").read_bytes().split(b"\n")
    assert [line for line in new if line not in lines] == [b"v 1 1.5 0"]


def test_dimensions_do_not_mix():
    points, blocks = bent("triangle")
    with pytest.raises(ValueError, match="different dimensions"):
        js.Mesh(points, {**blocks, "tetra": [[0, 1, 2, 5]]})
