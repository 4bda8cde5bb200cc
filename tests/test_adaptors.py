"""Meshes to and from PyVista and scikit-fem, and results that came from no file."""

import meshes
import meshio
import numpy as np
import pytest

import jaxsmooth as js
from jaxsmooth.convert.foreign import as_source


@pytest.fixture
def pv():
    return pytest.importorskip("pyvista")


def cube(count=3, amplitude=0.25):
    points, cells = meshes.grid("tetra", (count,) * 3, amplitude)
    return np.asarray(points), cells


def vtk_grid(pv, points, cells):
    return pv.from_meshio(meshio.Mesh(points, cells))


def test_a_grid_comes_back_with_all_data(pv):
    points, cells = cube()
    grid = vtk_grid(pv, points, cells)
    grid.cell_data["my load"] = np.arange(grid.n_cells)
    grid.cell_data["names"] = np.array([f"c{i}" for i in range(grid.n_cells)])
    grid.point_data["T"] = points @ [1.0, 2, 3]
    grid.field_data["time"] = [2.5]
    before = grid.copy()
    result = js.smooth(grid, steps=2)
    assert result.history[-1].statistics.q_avg > result.history[0].statistics.q_avg
    assert grid == before
    out = js.to_pyvista(result)
    assert isinstance(out, pv.UnstructuredGrid)
    np.testing.assert_allclose(out.points, result.mesh.points, atol=1e-15)
    np.testing.assert_array_equal(out.cells, grid.cells)
    for name in ("my load", "names"):
        np.testing.assert_array_equal(out.cell_data[name], grid.cell_data[name])
    np.testing.assert_array_equal(out.point_data["T"], grid.point_data["T"])
    assert out.field_data["time"] == [2.5]
    np.testing.assert_allclose(out.cell_data["shape"], np.concatenate(result.quality), atol=1e-12)
    assert out.cell_data["inverted"].sum() == 0
    np.testing.assert_allclose(out.points - out.point_data["displacement"], points, atol=1e-12)
    np.testing.assert_allclose(js.quality(grid)[0], js.quality((points, dict(cells)))[0], atol=1e-14)


def test_vtk_agrees_on_the_cells(pv):
    """Volumes by VTK of what went through, types mixed and interleaved."""
    points, cells = meshes.mixed_3d(0.1)
    cells = dict(cells)
    grid = vtk_grid(pv, np.asarray(points), list(cells.items()))
    order = np.random.default_rng(0).permutation(grid.n_cells)
    grid = grid.extract_cells(order) if hasattr(grid, "extract_cells") else grid
    assert len(np.unique(grid.celltypes)) == len(cells) > 2
    volumes = grid.compute_cell_sizes(length=False, area=False)["Volume"]
    out = js.to_pyvista(js.smooth(grid, steps=0), metrics=("measure",))
    np.testing.assert_allclose(np.abs(out.cell_data["measure"]), np.abs(volumes), rtol=1e-6)
    np.testing.assert_array_equal(out.cells, grid.cells)


def test_plane_poly_data_and_structured_grids(pv):
    plane = pv.Plane(i_resolution=4, j_resolution=3).triangulate()
    plane.points[7] += [0.09, 0.05, 0]
    out = js.to_pyvista(js.smooth(plane, steps=3))
    assert isinstance(out, pv.PolyData)
    assert out.cell_data["shape"].min() > js.to_pyvista(plane).cell_data["shape"].min()
    np.testing.assert_array_equal(out.faces, plane.faces)
    image = pv.ImageData(dimensions=(3, 3, 3))
    image.cell_data["k"] = np.arange(8)
    image.field_data["time"] = [1.0]
    out = js.to_pyvista(image)
    assert set(out.celltypes) == {12}
    np.testing.assert_array_equal(out.cell_data["k"], np.arange(8))
    np.testing.assert_allclose(out.cell_data["shape"], 1, atol=1e-6)
    assert out.field_data["time"] == [1.0]


def test_cells_that_have_no_type_are_named(pv):
    points = np.array([[0.0, 0, 0], [1, 0, 0], [1.5, 1, 0], [0.5, 2, 0], [-0.5, 1, 0]])
    with pytest.raises(ValueError, match="VTK's type 7 with 5 nodes, which can't be smoothed"):
        js.quality(pv.PolyData(points, [5, 0, 1, 2, 3, 4]))
    with pytest.raises(ValueError, match="can't take dict for a mesh; give"):
        js.quality({})


def test_files_become_grids_and_grids_are_written(pv, tmp_path):
    points, cells = cube()
    source = meshio.Mesh(points, cells, cell_data={"E": [np.arange(len(cells["tetra"]))]})
    meshio.write(tmp_path / "in.vtu", source)
    result = js.smooth(js.read(tmp_path / "in.vtu"), steps=1)
    out = js.to_pyvista(result)
    np.testing.assert_array_equal(out.cell_data["E"], source.cell_data["E"][0])
    js.write(tmp_path / "out.vtu", js.smooth(out, steps=0))
    again = pv.read(tmp_path / "out.vtu")
    assert set(out.cell_data) <= set(again.cell_data)
    np.testing.assert_allclose(again.points, out.points)


def test_the_accessor(pv):
    if not hasattr(pv, "register_dataset_accessor"):
        pytest.skip("this PyVista has no accessors")
    import jaxsmooth.adaptors.accessor  # noqa: F401  what the entry point does

    points, cells = cube()
    grid = vtk_grid(pv, points, cells)
    expected = js.quality((points, cells), "mean_ratio")[0]
    np.testing.assert_allclose(grid.jaxsmooth.quality("mean_ratio")["mean_ratio"], expected, atol=1e-14)
    assert grid.jaxsmooth.smooth(steps=1)["displacement"].any()


def test_results_of_no_file_are_written_with_their_data(tmp_path):
    points, cells = cube()
    source = meshio.Mesh(points, cells, cell_data={"E": [np.arange(len(cells["tetra"]))]})
    result = js.smooth(source, steps=1)
    for name in ("a.vtu", "b.msh", "c.inp"):
        js.write(tmp_path / name, result)
        np.testing.assert_allclose(js.read(tmp_path / name).mesh.points, result.mesh.points, rtol=1e-12)
    np.testing.assert_array_equal(meshio.read(tmp_path / "a.vtu").cell_data["E"][0], source.cell_data["E"][0])
    js.write(tmp_path / "d.vtu", js.smooth(js.as_mesh(source), steps=1))
    np.testing.assert_allclose(js.read(tmp_path / "d.vtu").mesh.points, result.mesh.points, rtol=1e-12)
    np.testing.assert_allclose(js.to_meshio(result).points, result.mesh.points)
    np.testing.assert_array_equal(source.points, points)


def test_a_bare_mesh_keeps_its_regions_and_is_not_turned(tmp_path):
    points, cells = cube(2, 0)
    half = (np.arange(len(cells["tetra"])) % 2).astype(int)
    mesh = js.as_mesh(meshio.Mesh(points, cells, cell_data={"material": [half]}))
    upside = mesh.with_points(mesh.points.at[13].add(2.0))  # some elements inverted
    tangled = js.statistics(upside).inverted
    assert tangled > 0
    js.write(tmp_path / "out.vtu", upside)
    again = meshio.read(tmp_path / "out.vtu")
    np.testing.assert_array_equal(again.cells[0].data, mesh.connectivity[0])
    np.testing.assert_array_equal(again.cell_data["region"][0], half)


SKFEM = ("MeshTri1", "MeshTri2", "MeshQuad1", "MeshQuad2", "MeshTet1", "MeshTet2", "MeshHex1", "MeshHex2")


@pytest.mark.parametrize("name", SKFEM)
def test_meshes_of_scikit_fem(name):
    skfem = pytest.importorskip("skfem")
    mesh = getattr(skfem, name)()
    mesh = mesh.refined(1) if mesh.dim() == 3 else mesh.refined(2)
    mesh = mesh.with_subdomains({"left": lambda x: x[0] < 0.5}).with_boundaries({"foot": lambda x: x[1] == 0})
    file = js.as_mesh(mesh)
    measures = np.abs(np.asarray(js.quality(file, "measure")[0]))
    np.testing.assert_allclose(measures.sum(), 1, rtol=1e-9)
    np.testing.assert_array_equal(js.statistics(file).inverted, 0)
    source = as_source(mesh)
    assert set(source.cell_sets) == {"left"}
    assert set(source.point_sets) == {"foot"}
    doflocs = mesh.doflocs.copy()
    inner = ((doflocs > 1e-9) & (doflocs < 1 - 1e-9) & (np.abs(doflocs - 0.5) > 1e-9)).all(axis=0)
    doflocs[:, inner] += 0.02 * np.random.default_rng(0).normal(size=(mesh.dim(), inner.sum()))
    mesh = type(mesh)(doflocs, mesh.t, _boundaries=mesh.boundaries, _subdomains=mesh.subdomains)
    result = js.smooth(mesh, steps=1)
    out = js.to_skfem(result)
    assert type(out) is type(mesh)
    np.testing.assert_array_equal(out.t, mesh.t)
    np.testing.assert_array_equal(out.subdomains["left"], mesh.subdomains["left"])
    np.testing.assert_array_equal(out.boundaries["foot"], mesh.boundaries["foot"])
    assert out.doflocs.shape == mesh.doflocs.shape
    np.testing.assert_allclose(js.statistics(out).q_avg, result.history[-1].statistics.q_avg, rtol=1e-9)
    basis = skfem.Basis(out, skfem.MeshQuad.elem() if name == "MeshQuad1" else out.elem())
    assert skfem.Functional(lambda w: 1.0 + 0 * w.x[0]).assemble(basis) == pytest.approx(1)


def test_files_become_meshes_of_scikit_fem():
    pytest.importorskip("skfem")
    points, cells = cube(2)
    out = js.to_skfem((points, cells))
    np.testing.assert_allclose(out.p.T, points)
    points, cells = meshes.mixed_2d()
    with pytest.raises(ValueError, match="meshes of one type; this one has"):
        js.to_skfem((points, cells))
