"""The least-squares fit against SciPy's, against the SVD, and by differences."""

from functools import lru_cache

import jax
import jax.numpy as jnp
import meshes
import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from jaxsmooth.cells.table import element_type
from jaxsmooth.methods.elastic.fitting import target_element
from jaxsmooth.numerics.rotation import rotation, rotation_svd

COUNT = 40  # all batches have this size, so that everything compiles once a dimension and dtype


@lru_cache
def batched(function):
    return jax.jit(jax.vmap(function))


slope = jax.jacfwd(rotation)
backward_slope = jax.jacrev(rotation)
bend = jax.jacfwd(slope)


def rotations(moments, function=rotation):
    moments = np.asarray(moments)
    batch = np.repeat(moments[:1], COUNT, axis=0)
    batch[: len(moments)] = moments
    return np.asarray(batched(function)(batch))[: len(moments)]


def best_trace(moments):
    """max tr(R H) over proper rotations: σ₁ + … ± σ_d (NumPy, in float64)."""
    moments = np.asarray(moments, float)
    sigma = np.linalg.svd(moments, compute_uv=False)
    sigma[:, -1] *= np.where(np.linalg.det(moments) < 0, -1, 1)
    return sigma.sum(axis=1), sigma


def proper(r, tolerance):
    eye = np.einsum("nij,nkj->nik", r, r)
    np.testing.assert_allclose(eye, np.broadcast_to(np.eye(r.shape[-1]), eye.shape), atol=tolerance)
    np.testing.assert_allclose(np.linalg.det(r), 1, atol=tolerance)


def families(dim):
    """Moments of every kind: generic, inverted, ideal, flat, needle, zero, nearly so."""
    rng = np.random.default_rng(0)
    generic = rng.normal(size=(10, dim, dim))
    q = np.stack([meshes.rotation_matrix(dim, seed) for seed in range(6)])
    p = np.stack([meshes.rotation_matrix(dim, seed + 50) for seed in range(6)])

    def with_singular_values(*sigma):
        return q @ np.diag(sigma)[:dim, :dim] @ p

    def of(*sigma):  # drops the middle value in 2D
        return with_singular_values(*(sigma if dim == 3 else (sigma[0], sigma[2])))

    return {
        "generic": generic,
        "ideal": np.concatenate([2.5 * np.eye(dim)[None], 2.5 * q]),
        "inverted": of(3, 2, -1),
        "nearly flat": of(3, 2, 1e-9),
        "flat": of(3, 2, 0) if dim == 3 else of(3, 2, 0.5),
        "two equal": of(2, 2, 1),
        "needle": of(1, 0, 0),
        "nearly a needle": of(1, 1e-7, 1e-8),
        "not unique": of(3, 1, -1) if dim == 3 else of(1, 1, -1),
        "reflection": of(1, 1, -1),
        "zero": np.zeros((1, dim, dim)),
    }


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("dtype", [np.float64, np.float32])
@pytest.mark.parametrize("function", [rotation, rotation_svd])
def test_a_proper_rotation_of_the_largest_trace(dim, dtype, function):
    eps = np.finfo(dtype).eps
    for name, moments in families(dim).items():
        moments = moments.astype(dtype)
        r = rotations(moments, function)
        assert r.dtype == dtype
        proper(r, 20 * eps)
        best, sigma = best_trace(moments)
        found = np.einsum("nij,nji->n", r.astype(float), moments.astype(float))
        np.testing.assert_allclose(found, best, rtol=0, atol=30 * eps * (1 + sigma.max()), err_msg=name)


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_equal_to_the_svd_where_unique(dim, dtype):
    eps = np.finfo(dtype).eps
    for name, moments in families(dim).items():
        moments = moments.astype(dtype)
        _, sigma = best_trace(moments)
        gap = sigma[:, -1] + sigma[:, -2]  # what makes the rotation unique
        unique = gap > 1e3 * eps * sigma[:, 0]
        assert unique.all() or name in ("needle", "nearly a needle", "not unique", "reflection", "zero")
        gap = np.where(unique, gap / np.where(unique, sigma[:, 0], 1), 1)[:, None, None]
        a, b = rotations(moments), rotations(moments, rotation_svd)
        error = np.where(unique[:, None, None], np.abs(a - b) * gap, 0)
        assert error.max() < 30 * eps, name


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
@pytest.mark.parametrize("dim", [2, 3])
def test_independent_of_scale(dim, dtype):
    moments = np.random.default_rng(1).normal(size=(10, dim, dim)).astype(dtype)
    reference = rotations(moments)
    small, large = (1e-200, 1e200) if dtype == np.float64 else (1e-30, 1e30)
    for scale in (small, 1e-12, 1e12, large):
        r = rotations(moments * dtype(scale))
        np.testing.assert_allclose(r, reference, rtol=0, atol=100 * np.finfo(dtype).eps, err_msg=str(scale))


@pytest.mark.parametrize("kind", ["tetra", "hexahedron"])
def test_against_scipy(kind):
    reference = element_type(kind).ideal
    centred = reference - reference.mean(axis=0)
    rng = np.random.default_rng(2)
    elements = [
        reference @ q.T + 0.3 * rng.normal(size=reference.shape) for q in (np.eye(3), np.diag([1, 1, -1]))
    ]
    elements += [meshes.distorted(kind) @ meshes.rotation_matrix(3).T, reference * [1, 1, 0]]
    moments = np.stack([centred.T @ (x - x.mean(axis=0)) for x in elements])
    for x, r in zip(elements, rotations(moments), strict=True):
        expected, _ = Rotation.align_vectors(x - x.mean(axis=0), centred)
        np.testing.assert_allclose(r, expected.as_matrix(), atol=1e-12)


def derivative_points(dim):
    f = families(dim)
    return [
        *f["generic"][:3],
        f["inverted"][0],
        f["ideal"][0],
        f["ideal"][2],
        f["two equal"][0],
        f["flat"][0],
    ]


@pytest.mark.parametrize("dim", [2, 3])
def test_first_and_second_derivatives(dim):
    moments = np.stack(derivative_points(dim))
    first, backward, second = (rotations(moments, f) for f in (slope, backward_slope, bend))
    np.testing.assert_allclose(backward, first, atol=1e-13)
    h = 1e-5
    for i in range(dim):
        for j in range(dim):
            step = np.zeros((dim, dim))
            step[i, j] = h
            up, down = rotations(moments + step, rotation_svd), rotations(moments - step, rotation_svd)
            np.testing.assert_allclose(first[..., i, j], (up - down) / (2 * h), atol=2e-8)
            up, down = (rotations(moments + s, slope) for s in (step, -step))
            np.testing.assert_allclose(second[..., i, j], (up - down) / (2 * h), atol=2e-7)


@pytest.mark.parametrize("dim", [2, 3])
def test_derivatives_are_finite_everywhere(dim):
    for name, moments in families(dim).items():
        for scale in (1.0, 1e-30):
            assert np.isfinite(rotations(moments * scale, slope)).all(), name


def test_derivative_at_the_ideal_in_closed_form():
    """At H = c I: dR = (dHᵀ − dH) / (2 c), the antisymmetric part."""
    for dim in (2, 3):
        change = np.random.default_rng(3).normal(size=(dim, dim))
        _, found = jax.jvp(rotation, (jnp.asarray(2.5 * np.eye(dim)),), (jnp.asarray(change),))
        np.testing.assert_allclose(found, (change.T - change) / 5, atol=1e-14)


@pytest.mark.parametrize("kind", ["triangle6", "quad", "tetra", "wedge18", "pyramid14"])
@pytest.mark.parametrize("inverted", [False, True])
def test_fit_minimises_eq_7(kind, inverted):
    reference, nodes = element_type(kind).ideal, meshes.distorted(kind, 0.3) + 2
    dim = nodes.shape[1]
    if inverted:
        nodes[:, 0] *= -1
    target = target_element(jnp.asarray(reference), jnp.asarray(nodes), jnp.asarray(1.0))
    found = ((nodes - np.asarray(target)) ** 2).sum()

    def distance(p):
        angles = [0, 0, p[0]] if dim == 2 else p[:3]
        turn = Rotation.from_rotvec(angles).as_matrix()[:dim, :dim]
        return ((nodes - (reference @ turn.T + p[-dim:])) ** 2).sum()

    starts = np.random.default_rng(0).normal(size=(6, 3 if dim == 2 else 6)) * 1.5
    best = min(minimize(distance, start, tol=1e-12).fun for start in starts)
    assert found == pytest.approx(best, rel=1e-6)
    assert found <= best * (1 + 1e-9)


@pytest.mark.parametrize("kind", meshes.KINDS)
@pytest.mark.parametrize("rotate", [rotation, rotation_svd])
def test_target_of_a_moved_ideal_element_is_itself(kind, rotate):
    row = element_type(kind)
    turn, scale = meshes.rotation_matrix(row.dim), 0.37
    nodes = scale * meshes.ideal(kind, row.ideal[1, 0]) @ turn.T + 5
    target = jax.vmap(lambda x: target_element(jnp.asarray(row.ideal), x, jnp.asarray(scale), rotate))(
        nodes[None]
    )[0]
    np.testing.assert_allclose(target, nodes, rtol=0, atol=1e-14 * 10)


@pytest.mark.parametrize("kind", ["quad", "tetra"])
def test_target_has_the_ideal_shape_and_the_scale(kind):
    row, nodes = element_type(kind), meshes.distorted(kind, 0.3)
    target = np.asarray(target_element(jnp.asarray(row.ideal), jnp.asarray(nodes), jnp.asarray(0.5)))
    a, b = np.asarray(row.edges).T
    np.testing.assert_allclose(
        np.linalg.norm(target[a] - target[b], axis=1), 0.5 * row.ideal[1, 0], rtol=1e-13
    )
    np.testing.assert_allclose(target.mean(axis=0), nodes.mean(axis=0), atol=1e-14)  # Eq. 28
