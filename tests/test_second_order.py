"""Second-order meshes of Gmsh, and what it makes of this package's: shape functions, node order, volumes."""

import jax.numpy as jnp
import meshes
import numpy as np
import pytest

import jaxsmooth as js
from jaxsmooth.cells.table import element_type

gmsh = pytest.importorskip("gmsh")

# Gmsh's numbers of the types, from the chapter on its file format.
CODES = {"triangle": 2, "quad": 3, "tetra": 4, "hexahedron": 5, "wedge": 6, "pyramid": 7, "triangle6": 9}
CODES |= {"quad9": 10, "tetra10": 11, "hexahedron27": 12, "wedge18": 13, "pyramid14": 14, "quad8": 16}
CODES |= {"hexahedron20": 17, "wedge15": 18, "pyramid13": 19}


@pytest.fixture
def sdk():
    gmsh.initialize(interruptible=False)
    gmsh.clear()  # forgets errors of earlier models, after which meshes keep their order
    gmsh.option.setNumber("General.Terminal", 0)
    yield gmsh.model.mesh
    gmsh.finalize()


@pytest.mark.parametrize("kind", meshes.KINDS)
def test_shape_functions_are_those_of_gmsh(sdk, kind):
    """Values and derivatives; Gmsh's nodes are found by their places."""
    row = element_type(kind)
    places = np.array(sdk.getElementProperties(CODES[kind])[4]).reshape(row.k, row.dim)
    distance = np.abs(row.natural[:, None] - places).max(axis=-1)
    order = distance.argmin(axis=1)
    assert distance.min(axis=1).max() == 0
    inside = np.random.default_rng(0).dirichlet(np.ones(row.corners), 6) @ row.natural[: row.corners]
    points = np.pad(inside, ((0, 0), (0, 3 - row.dim))).ravel()
    values = np.array(sdk.getBasisFunctions(CODES[kind], points, "Lagrange")[1]).reshape(6, row.k)
    slopes = np.array(sdk.getBasisFunctions(CODES[kind], points, "GradLagrange")[1]).reshape(6, row.k, 3)
    np.testing.assert_allclose(row.shape_functions(inside), values[:, order], atol=2e-14)
    np.testing.assert_allclose(row.slopes_at(inside), slopes[:, order, : row.dim], atol=1e-13)


def second_order(mesh, path, version):
    """Straight elements of four types, given their second order by Gmsh, in a file of Gmsh's."""
    points, blocks = meshes.mixed_3d()
    gmsh.option.setNumber("Mesh.SecondOrderIncomplete", 0)
    gmsh.option.setNumber("Mesh.MshFileVersion", version)
    tag = gmsh.model.addDiscreteEntity(3)
    mesh.addNodes(3, tag, np.arange(1, len(points) + 1), points.ravel())
    for kind, nodes in blocks.items():
        mesh.addElementsByType(tag, CODES[kind], [], (nodes + 1).ravel())
    mesh.setOrder(2)
    gmsh.write(str(path))
    return points, blocks


@pytest.mark.parametrize("version", [2.2, 4.1])
def test_files_of_gmsh_are_read_in_vtk_order(sdk, tmp_path, version):
    points, blocks = second_order(sdk, tmp_path / "a.msh", version)
    file = js.read(tmp_path / "a.msh")
    assert set(file.mesh.types) == {"tetra10", "pyramid14", "wedge18", "hexahedron27"}
    for kind, nodes in zip(file.mesh.types, file.mesh.connectivity, strict=True):
        corners = points[blocks[meshes.LINEAR[kind]]]
        expected = np.array([meshes.nodes_from_corners(kind, element) for element in corners])
        np.testing.assert_allclose(np.asarray(file.mesh.points)[np.asarray(nodes)], expected, atol=1e-12)
    # faces between types have the same nodes from both sides: nothing is hanging or loose
    assert file.notes == ()


def volumes_by_gmsh(mesh, kind):
    """Volumes of the elements of a type, from Gmsh's Jacobians and quadrature."""
    points, weights = mesh.getIntegrationPoints(CODES[kind], "Gauss8")
    determinants = np.array(mesh.getJacobians(CODES[kind], points)[1])
    return determinants.reshape(-1, len(weights)) @ np.array(weights)


def test_a_mesh_of_gmsh_is_smoothed(sdk, tmp_path):
    """Wedges, pyramids, hexahedra and tetrahedra of second order; Gmsh measures what is written."""
    second_order(sdk, tmp_path / "a.msh", 4.1)
    file = js.read(tmp_path / "a.msh")
    start = file.mesh.with_points(jnp.asarray(meshes.jiggle(np.asarray(file.mesh.points), 0.07)))
    result = js.smooth(start, steps=4)
    first, last = (result.history[k].statistics for k in (0, -1))
    assert last.q_min > first.q_min + 0.1
    assert last.inverted == 0
    normals = meshes.box_normals(np.asarray(start.points))
    moved = np.asarray(result.mesh.points - start.points)
    assert all(np.abs(move[axes]).max(initial=0) < 1e-12 for move, axes in zip(moved, normals, strict=True))
    js.write(tmp_path / "b.msh", file, result)
    gmsh.open(str(tmp_path / "b.msh"))
    kinds = result.mesh.types
    volumes = [volumes_by_gmsh(sdk, kind) for kind in kinds]
    for volume, measure in zip(volumes, js.quality(result.mesh, "measure"), strict=True):
        np.testing.assert_allclose(volume, measure, rtol=1e-9)
    assert sum(part.sum() for part in volumes) == pytest.approx(1, rel=1e-9)
    for kind in kinds:
        tags = sdk.getElementsByType(CODES[kind])[0]
        assert (sdk.getElementQualities(tags, "minDetJac") > 0).all()
