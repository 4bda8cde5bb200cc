"""Element stiffness and the matrix-free operator against a NumPy code in Voigt notation."""

from functools import partial

import jax
import jax.numpy as jnp
import meshes
import numpy as np
import pytest
import reference

from jaxsmooth import assembly
from jaxsmooth.cells.table import element_type
from jaxsmooth.mesh.execution import Execution
from jaxsmooth.methods.elastic import elasticity
from jaxsmooth.methods.elastic.elasticity import (
    Material,
    Operator,
    element_force,
    linearise,
    node_blocks,
    stiffness,
)


@pytest.fixture(scope="module", params=meshes.KINDS)
def kind(request):
    """Module scope groups the tests by type."""
    return request.param


@partial(jax.jit, static_argnames="kind")
def analysed(kind, nodes, material, displacement):
    """K_e, its node blocks and K_e u for a batch of elements."""

    def one(x, u):
        size = jnp.abs(elasticity.determinant(jnp.einsum("kd,qke->qde", x, kind.gradients)) @ kind.weights)
        element = linearise(kind, x, size)
        return (
            stiffness(element, material),
            node_blocks(element, material),
            element_force(element, u, material),
        )

    return jax.vmap(one)(nodes, displacement)


def analyse(kind, nodes, young=1.0, nu=0.0, seed=0):
    nodes = np.asarray(nodes)
    u = np.random.default_rng(seed).normal(size=nodes.shape)
    k, blocks, force = analysed(element_type(kind), nodes, Material(jnp.asarray(young), jnp.asarray(nu)), u)
    return np.asarray(k), np.asarray(blocks), np.asarray(force), u


def three(kind):
    """A distorted element, an inverted one, and the ideal one, turned."""
    nodes = meshes.distorted(kind)
    turn = meshes.rotation_matrix(meshes.dim_of(kind))
    return np.stack([nodes, nodes * np.r_[-1, np.ones(nodes.shape[1] - 1)], meshes.ideal(kind) @ turn.T])


@pytest.mark.parametrize(("young", "nu"), [(1.0, 0.0), (7.0, 0.3)])
def test_stiffness_equals_the_voigt_form(kind, young, nu):
    elements = three(kind)
    k, blocks, force, u = analyse(kind, elements, young, nu)
    dim = elements.shape[-1]
    for found, block, f, nodes, shift in zip(k, blocks, force, elements, u, strict=True):
        expected = reference.stiffness(kind, nodes, young, nu)
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12 * np.abs(expected).max())
        np.testing.assert_allclose(f.ravel(), expected @ shift.ravel(), atol=1e-11 * np.abs(expected).max())
        for node in range(len(nodes)):
            part = slice(node * dim, (node + 1) * dim)
            np.testing.assert_allclose(block[node], expected[part, part], atol=1e-12 * np.abs(expected).max())


def test_stiffness_is_semidefinite_with_the_rigid_bodies_as_null_space(kind):
    elements = three(kind)
    k, *_ = analyse(kind, elements, 1.0, 0.3)
    dim = elements.shape[-1]
    for found, nodes in zip(k, elements, strict=True):
        np.testing.assert_allclose(found, found.T, atol=1e-13)
        largest = np.linalg.eigvalsh(found)[-1]
        assert np.linalg.eigvalsh(found)[0] > -1e-13 * largest
        rigid = [np.tile(axis, (len(nodes), 1)) for axis in np.eye(dim)]
        for i in range(dim):
            for j in range(i):
                spin = np.zeros((dim, dim))
                spin[i, j], spin[j, i] = 1, -1
                rigid.append(nodes @ spin)
        for mode in rigid:
            np.testing.assert_allclose(found @ mode.ravel(), 0, atol=1e-12 * largest)
        # reduced rules of linear elements are not used: no other mode is free of energy
        zeros = (np.linalg.eigvalsh(found) < 1e-10 * largest).sum()
        assert zeros == len(rigid) or meshes.LINEAR[kind] == "pyramid"


def test_energy_of_a_uniform_strain(kind):
    """½ uᵀ K u = ½ V (λ tr² + 2 μ ε:ε), with the volume from the corners."""
    dim = meshes.dim_of(kind)
    nodes = meshes.ideal(kind) @ (np.eye(dim) + 0.2 * np.random.default_rng(1).normal(size=(dim, dim)))
    slope = np.random.default_rng(2).normal(size=(dim, dim))
    strain, nu, young = (slope + slope.T) / 2, 0.3, 2.0
    lam, mu = young * nu / ((1 + nu) * (1 - 2 * nu)), young / (2 * (1 + nu))
    base = np.linalg.lstsq(meshes.ideal(kind) - meshes.ideal(kind)[0], nodes - nodes[0], rcond=None)[0]
    volume = meshes.UNIT_MEASURE[meshes.LINEAR[kind]] * abs(np.linalg.det(base))
    k, *_ = analyse(kind, np.stack([nodes] * 3), young, nu)
    u = (nodes @ slope.T).ravel()
    expected = volume * (lam * np.trace(strain) ** 2 + 2 * mu * (strain**2).sum())
    assert u @ k[0] @ u == pytest.approx(expected, rel=1e-12)


def test_triangle_by_hand():
    # right triangle with unit legs, E = 1, ν = 0: D = diag(1, 1, ½), area ½
    k, *_ = analyse("triangle", np.stack([[(0.0, 0), (1, 0), (0, 1)]] * 3))
    np.testing.assert_allclose(k[0][:2, :2], [[0.75, 0.25], [0.25, 0.75]], atol=1e-15)
    np.testing.assert_allclose(k[0][:2, 2:4], [[-0.5, -0.25], [0, -0.25]], atol=1e-15)
    np.testing.assert_allclose(k[0][2:4, 2:4], [[0.5, 0], [0, 0.25]], atol=1e-15)


def test_flat_and_collapsed_elements_have_finite_stiffness():
    flat = meshes.distorted("tetra")
    flat[:, 2] = 0
    for nodes in (flat, np.zeros_like(flat)):
        element = linearise(element_type("tetra"), jnp.asarray(nodes), jnp.asarray(0.1))
        k = np.asarray(stiffness(element, Material()))
        assert np.isfinite(k).all()
        assert np.linalg.eigvalsh(k)[0] >= -1e-12 * np.abs(k).max()


def operator(points, blocks, material, execution=None):
    cut = []
    for kind, nodes in blocks.items():
        row = element_type(kind)
        size = jnp.asarray([abs(reference.measure(kind, points[element])) for element in nodes])
        elements = jax.jit(jax.vmap(partial(linearise, row)))(points[nodes], size)
        cut.append(assembly.cut(jnp.asarray(nodes, jnp.int32), elements, execution or Execution()))
    return Operator(tuple(cut), material)


MIXED = {
    "2d": lambda: meshes.mixed_2d(0.08),
    "2d quadratic": lambda: meshes.mixed_2d(0.08, order=2),
    "3d": lambda: meshes.mixed_3d(0.08),
}


@pytest.mark.parametrize("mesh", MIXED)
@pytest.mark.parametrize("chunk", [4096, 3])
def test_operator_equals_the_assembled_matrix(mesh, chunk):
    points, blocks = MIXED[mesh]()
    found = operator(points, blocks, Material(2.0, 0.3), Execution(chunk))
    if chunk == 3:
        assert (
            max(block.nodes.shape[0] for block in found.blocks) > 2
        )  # several chunks, the last one filled up
    expected = reference.assemble(points, blocks, 2.0, 0.3)
    field = np.random.default_rng(0).normal(size=points.shape)
    result, diagonal = map(np.asarray, jax.jit(lambda op, u: (op(u), op.diagonal(len(u))))(found, field))
    np.testing.assert_allclose(result.ravel(), expected @ field.ravel(), atol=1e-12)
    dim = points.shape[1]
    for node in range(len(points)):
        part = slice(node * dim, (node + 1) * dim)
        np.testing.assert_allclose(diagonal[node], expected[part, part].toarray(), atol=1e-12)
