"""The current model of Gmsh, smoothed in place: on its CAD, with groups, high order and periodic links."""

import jax
import numpy as np
import pytest

import jaxsmooth as js

gmsh = pytest.importorskip("gmsh")


@pytest.fixture
def model():
    gmsh.initialize(interruptible=False)
    gmsh.clear()  # forgets errors of earlier models, after which meshes keep their order
    gmsh.option.setNumber("General.Terminal", 0)
    gmsh.model.add("test")
    yield gmsh.model
    gmsh.finalize()


def nodes(*entity, border=False):
    return gmsh.model.mesh.getNodes(*entity, includeBoundary=border)[1].reshape(-1, 3)


def pierced(model, order=1):
    """A block with a round hole."""
    block = model.occ.addBox(0, 0, 0, 2, 2, 1)
    hole = model.occ.addCylinder(1, 1, -1, 0, 0, 3, 0.5)
    model.occ.cut([(3, block)], [(3, hole)])
    model.occ.synchronize()
    model.addPhysicalGroup(3, [1], name="solid")
    round_ = [tag for dim, tag in model.getEntities(2) if model.getType(dim, tag) == "Cylinder"]
    model.addPhysicalGroup(2, round_, name="hole")
    gmsh.option.setNumber("Mesh.MeshSizeMax", 0.5)
    model.mesh.generate(3)
    model.mesh.setOrder(order)
    return round_


def test_a_quadratic_solid_slides_on_its_cad(model):
    faces = pierced(model, order=2)
    file = js.gmsh.read_model()
    before = nodes()
    elements = [part.copy() for part in gmsh.model.mesh.getElements()[2]]
    result = js.gmsh.smooth_model(steps=2)
    assert result.history[-1].statistics.q_min > file_quality(file)
    np.testing.assert_allclose(nodes(), result.mesh.points, atol=1e-14)
    for old, new in zip(elements, gmsh.model.mesh.getElements()[2], strict=True):
        np.testing.assert_array_equal(old, new)
    hole = nodes(2, faces[0], border=True)
    np.testing.assert_allclose(np.hypot(hole[:, 0] - 1, hole[:, 1] - 1), 0.5, atol=1e-13)
    np.testing.assert_allclose(nodes()[:, 2].min(), 0, atol=1e-14)
    moved = np.abs(nodes() - before).max(axis=1) > 1e-4
    freedom = result.constraints.at(result.mesh.points).freedom
    for value in (1, 2, 3):  # along curves, on faces, inside
        assert moved[freedom == value].any()
    assert not moved[freedom == 0].any()
    assert (freedom == 0).sum() == len(gmsh.model.getEntities(0))
    for entity in [(2, faces[0]), *gmsh.model.getEntities(1)]:
        _, place, parameters = gmsh.model.mesh.getNodes(*entity, returnParametricCoord=True)
        there = gmsh.model.getValue(*entity, parameters)
        np.testing.assert_allclose(there, place, atol=1e-12)


def file_quality(file):
    return js.statistics(file).q_min


def test_groups_hold_nodes(model):
    pierced(model)
    motion = js.gmsh.model_constraints(js.gmsh.read_model(), fixed="hole")
    held = motion.at(js.gmsh.read_model().mesh.points).freedom == 0
    assert held[js.gmsh.read_model().named_sets["hole"]].all()
    with pytest.raises(ValueError, match="unknown group 'bolt'; the model has"):
        js.gmsh.smooth_model(fixed="bolt")


def test_a_tilted_disc_keeps_its_rim(model):
    disc = model.occ.addDisk(0, 0, 0, 1, 1)
    model.occ.rotate([(2, disc)], 0, 0, 0, 1, 0.3, 0, 0.7)
    model.occ.translate([(2, disc)], 1, 2, 3)
    model.occ.synchronize()
    gmsh.option.setNumber("Mesh.MeshSizeMax", 0.4)
    model.mesh.generate(2)
    before = nodes()
    inner = nodes(2, disc)
    tags = model.mesh.getNodes(2, disc)[0]
    for tag, place in zip(tags, inner, strict=True):
        model.mesh.setNode(tag, place + 0.15 * (before[0] - place), [])
    result = js.gmsh.smooth_model()
    assert result.mesh.dim == 2
    assert result.history[-1].statistics.q_min > result.history[0].statistics.q_min
    rim = nodes(1, 1)
    np.testing.assert_allclose(np.linalg.norm(rim - [1, 2, 3], axis=1), 1, atol=1e-12)
    axis = np.linalg.svd(before - before.mean(axis=0))[2][2]
    np.testing.assert_allclose((nodes() - [1, 2, 3]) @ axis, 0, atol=1e-12)
    assert np.abs(nodes(1, 1) - before[1 : len(rim) + 1]).max() > 1e-4


def test_periodic_curves_stay_so(model):
    square = model.occ.addRectangle(0, 0, 0, 1, 1)
    model.occ.synchronize()
    shift = [1, 0, 0, 1, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]
    model.mesh.setPeriodic(1, [2], [4], shift)
    gmsh.option.setNumber("Mesh.MeshSizeMax", 0.25)
    model.mesh.generate(2)
    slave = nodes(1, 2)
    tags = model.mesh.getNodes(1, 2)[0], model.mesh.getNodes(1, 4)[0]
    for tag in np.concatenate(tags):  # uneven, alike on both sides
        place = model.mesh.getNode(tag)[0]
        place[1] += 0.1 * np.sin(np.pi * place[1])
        model.mesh.setNode(tag, place, [])
    result = js.gmsh.smooth_model(steps=3)
    assert result.mesh.labels.links is not None
    other, master, mapped, _ = model.mesh.getPeriodicNodes(1, 2)
    assert other == 4 or len(master)
    for one, two in zip(master, mapped, strict=True):
        here, there = model.mesh.getNode(one)[0], model.mesh.getNode(two)[0]
        np.testing.assert_allclose(here - there, [1, 0, 0], atol=1e-12)
    assert np.abs(nodes(1, 2) - slave).max() > 1e-3
    assert square == 1


def test_derivatives_of_the_nearest_points_are_those_of_the_surface(model):
    faces = pierced(model)
    file = js.gmsh.read_model()
    carrier = js.gmsh.model_constraints(file).carriers[0]
    points = file.mesh.points[carrier.nodes]
    rng = np.random.default_rng(0)
    way = np.asarray(rng.normal(size=points.shape))
    _, slope = jax.jvp(carrier.foot, (points,), (way,))
    step = 1e-5
    differences = (carrier.foot(points + step * way) - carrier.foot(points - step * way)) / (2 * step)
    np.testing.assert_allclose(slope, differences, atol=1e-6)
    assert len(faces) == 1


def test_what_is_missing_is_said(model):
    with pytest.raises(ValueError, match="has no mesh; call"):
        js.gmsh.smooth_model()
    gmsh.finalize()
    with pytest.raises(ValueError, match=r"call gmsh.initialize\(\)"):
        js.gmsh.smooth_model()
    gmsh.initialize(interruptible=False)
