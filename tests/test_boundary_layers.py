"""Stretched elements, and boundary layers: found in made and real meshes, held, and repairable."""

from pathlib import Path

import meshes
import meshio
import numpy as np
import pytest

import jaxsmooth as js
from jaxsmooth.cells.table import element_type, supported
from jaxsmooth.mesh.layers import aspect_ratios, boundary_layers, layer_nodes, nodes_of, stretched
from jaxsmooth.mesh.record import Mesh

SHARED = Path(__file__).parents[2] / "shared"


def counts(masks):
    return [int(mask.sum()) for mask in masks]


def read(path):
    if not (SHARED / path).exists():
        pytest.skip("needs the shared meshes")
    return js.read(SHARED / path)


# --- Aspect ratio ------------------------------------------------------------------------


@pytest.mark.parametrize("name", supported())
def test_aspect_ratio_of_a_stretched_ideal_element(name):
    """Whatever the turn and the size, it is the ratio of the largest stretch to the least."""
    kind = element_type(name)
    nodes = np.arange(kind.k)[None]
    turn = meshes.rotation_matrix(kind.dim, 3)
    for stretch in (1, 3, 9.9, 10.1, 1e4):
        factors = np.array([1, stretch**0.5, stretch])[[0, *range(4 - kind.dim, 3)]]
        points = 1e-3 * (kind.ideal @ turn.T * factors) @ turn + 5e-3
        assert aspect_ratios(kind, points, nodes) == pytest.approx([stretch], rel=1e-6)
        mesh = Mesh(points, {name: nodes})
        assert stretched(mesh)[0][0] == (stretch > 10)
        assert stretched(mesh, 2e4)[0][0] == (stretch > 2e4)


def test_aspect_ratio_without_measure_is_infinite():
    kind = element_type("tetra")
    flat = kind.ideal * [1, 1, 0]
    assert aspect_ratios(kind, flat, np.arange(4)[None]) == [np.inf]


def test_random_elements_by_singular_values():
    random = np.random.default_rng(0)
    for name in ("triangle", "tetra"):
        kind = element_type(name)
        points = random.normal(size=(500, kind.k, kind.dim)) * ([1, 0.1, 0.03][: kind.dim])
        nodes = np.arange(500 * kind.k).reshape(500, -1)
        jacobians = np.einsum("mkd,kj->mdj", points, kind.gradients[0])
        values = np.linalg.svd(jacobians, compute_uv=False)
        expected = values[:, 0] / values[:, -1]
        flat = points.reshape(-1, kind.dim)
        np.testing.assert_allclose(aspect_ratios(kind, flat, nodes), expected, rtol=1e-6)
        np.testing.assert_array_equal(stretched(Mesh(flat, {name: nodes}))[0], expected > 10)


# --- Layers ------------------------------------------------------------------------------


def layered(kind, growth=1.8, first=1e-3, turn=True, layers=8):
    """A box of 4 × (4 ×) `layers` elements whose heights grow from the bottom, with the number beyond 10."""
    dim = meshes.dim_of(kind)
    points, blocks = meshes.grid(kind, (*(4,) * (dim - 1), layers))
    level = np.concatenate([[0], np.cumsum(first * growth ** np.arange(layers))])
    points[:, -1] = np.interp(points[:, -1], np.linspace(0, 1, layers + 1), level)
    heights = np.diff(level)
    mesh = Mesh(points @ meshes.rotation_matrix(dim, 2).T if turn else points, blocks)
    return mesh, points, heights


@pytest.mark.parametrize(
    "kind", ["quad", "quad8", "quad9", "hexahedron", "hexahedron20", "wedge", "wedge15", "wedge18"]
)
def test_layers_on_a_wall(kind):
    mesh, points, heights = layered(kind)
    nodes = np.asarray(mesh.connectivity[0])
    bottom = points[nodes][..., -1].min(axis=1)
    expected = stretched(mesh)[0]
    assert 0 < expected.sum() < len(nodes)
    np.testing.assert_array_equal(boundary_layers(mesh)[0], expected)
    assert bottom[expected].max() < bottom[~expected].min()
    freedom = js.detect_constraints(mesh).freedom
    assert (freedom[nodes[expected]] == 0).all()
    loose = js.detect_constraints(mesh, layers="free").freedom
    assert (loose[nodes[expected]] > 0).any()
    others = np.setdiff1d(np.arange(len(points)), nodes[expected])
    np.testing.assert_array_equal(freedom[others], loose[others])
    assert heights.max() / heights.min() > 6


def test_what_is_no_layer():
    squeezed, *_ = layered("quad", growth=1.0)  # as thick everywhere
    assert counts(boundary_layers(squeezed)) == [0]
    two, *_ = layered("quad", growth=20.0, layers=3)  # but two elements are stretched
    assert counts(stretched(two)) == [4 * 2]
    assert counts(boundary_layers(two)) == [0]
    mesh, points, _ = layered("quad", turn=False)
    sheared = Mesh(
        points + np.c_[200 * points[:, 1], np.zeros(len(points))],
        dict(zip(mesh.types, mesh.connectivity, strict=True)),
    )
    assert counts(boundary_layers(sheared)) == [0]
    split, *_ = layered("triangle")
    assert counts(stretched(split))[0] > 0
    assert counts(boundary_layers(split)) == [0]


def test_a_layer_off_the_boundary_is_none():
    """Between thick elements on both sides."""
    level = np.cumsum([0, 0.5, *(1e-3 * 1.3 ** np.arange(5)), 0.5])
    points, blocks = meshes.grid("quad", (4, 7))
    points[:, 1] = np.interp(points[:, 1], np.linspace(0, 1, 8), level)
    mesh = Mesh(points, blocks)
    assert counts(stretched(mesh)) == [20]
    assert counts(boundary_layers(mesh)) == [0]


def test_freeze_aspect_holds_what_is_stretched_further():
    mesh, *_ = layered("triangle")
    free = js.detect_constraints(mesh).freedom
    for limit in (10.0, 50.0):
        chosen = nodes_of(mesh, stretched(mesh, limit))
        assert 0 < chosen.sum() < len(chosen)
        found = js.detect_constraints(mesh, freeze_aspect=limit).freedom
        np.testing.assert_array_equal(found, np.where(chosen, 0, free))
    with pytest.raises(ValueError, match=r"freeze_aspect must be 1 or more, got 0\.5"):
        js.detect_constraints(mesh, freeze_aspect=0.5)
    with pytest.raises(ValueError, match="layers must be 'hold' or 'free', got 'keep'"):
        js.detect_constraints(mesh, layers="keep")


def test_notes_say_what_is_stretched():
    mesh, points, _ = layered("quad", turn=False)
    number = counts(stretched(mesh))[0]
    file = js.from_meshio(meshio.Mesh(points, {"quad": np.asarray(mesh.connectivity[0])}))
    assert file.notes == (
        f"{number} elements are stretched beyond 10, {number} of them in boundary layers, whose nodes are "
        "held; --freeze-aspect A (freeze_aspect=A) holds all those beyond A",
    )


@pytest.mark.parametrize(
    ("path", "least", "most"),
    [
        ("cases/04_bl_before.vtu", 736, 736),
        ("meshes/mixed2d/su2_rae2822_hybrid.vtu", 2258, 2258),
        ("meshes/quad/mesquite_shashkov_quad.vtu", 0, 50),  # of 4096
        ("meshes/hex/mesquite_cub_fru.vtu", 0, 0),
        ("meshes/hex/mesquite_hex_bias.vtu", 0, 0),
        ("meshes/hex/su2_axial_stage.vtu", 0, 340),  # of 9744
        ("meshes/peers/hexbend24.vtu", 0, 0),
        ("meshes/peers/quad100.vtu", 0, 0),
    ],
)
def test_layers_of_real_meshes(path, least, most):
    found = sum(counts(boundary_layers(read(path).mesh)))
    assert least <= found <= most


def test_a_layer_keeps_its_heights():
    file = read("cases/04_bl_before.vtu")
    layer = layer_nodes(file.mesh)
    moved = np.asarray(js.smooth(file, steps=2).mesh.points) != np.asarray(file.mesh.points)
    assert not moved[layer].any()
    assert moved.any()


def test_a_damaged_layer_is_free_where_it_is_damaged():
    whole, file = read("cases/04_bl_before.vtu"), read("cases/04_bl_moved.vtu")
    assert js.statistics(file).inverted == 12
    inverted = np.asarray(js.quality(file, "min_jacobian")[0]) <= 0
    nodes = np.asarray(file.mesh.connectivity[0])
    around = np.isin(nodes, nodes[inverted]).any(axis=1)
    expected = layer_nodes(whole.mesh)
    expected[nodes[around]] = False
    np.testing.assert_array_equal(layer_nodes(file.mesh), expected)
    np.testing.assert_array_equal(boundary_layers(file.mesh)[0], boundary_layers(whole.mesh)[0] & ~around)
