"""Derivatives within JAX's own transformations, and under its checks."""

import os
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from meshes import grid

import jaxsmooth as js

STEPS = 3


@pytest.fixture(scope="module")
def square():
    mesh = js.Mesh(*grid("triangle", (3, 3), 0.08))
    weights = jnp.asarray(np.random.default_rng(3).normal(size=mesh.points.shape))
    return mesh, js.detect_constraints(mesh), weights


def test_checkpointed_steps_in_a_scan_of_ones_own(square):
    mesh, constraints, weights = square

    @jax.checkpoint
    def one(points, _):
        return js.step(mesh.with_points(points), js.Elastic(), constraints).points, None

    def looped(points):
        return (jax.lax.scan(one, points, length=STEPS)[0] * weights).sum()

    def function(points):
        done = js.run(mesh.with_points(points), constraints=constraints, steps=STEPS)
        return (done.points * weights).sum()

    value, expected = jax.jit(jax.value_and_grad(function))(mesh.points)
    found, gradient = jax.jit(jax.value_and_grad(looped))(mesh.points)
    np.testing.assert_allclose(found, value, rtol=1e-12)
    np.testing.assert_allclose(gradient, expected, atol=1e-8 * np.abs(expected).max())


@pytest.mark.parametrize("what", ["run", "energy"])
def test_nothing_on_the_way_is_nan(square, what):
    """JAX looks at the results of every compiled part, also of those that are thrown away."""
    mesh, constraints, weights = square

    def after(points):
        done = js.run(mesh.with_points(points), constraints=constraints, steps=1)
        return (done.points * weights).sum() + js.quality_mean(done)

    functions = {
        "run": after,
        "energy": lambda points: js.energy(mesh.with_points(points), motion=constraints),
    }
    with jax.debug_nans(True):
        gradient = jax.grad(functions[what])(mesh.points)
    assert np.isfinite(gradient).all()
    assert np.abs(gradient).max() > 1e-3


def test_cotangents_of_the_energy_and_of_a_fixed_point_may_be_tiny(square):
    mesh, constraints, weights = square

    def energy(points):
        return js.energy(mesh.with_points(points), motion=constraints)[None, None]

    def fixed(points):
        return js.fixed_point(mesh.with_points(points), constraints=constraints).points

    for function, cotangent in ((energy, jnp.ones((1, 1))), (fixed, weights)):
        pull = jax.jit(lambda c, f=function: jax.vjp(f, mesh.points)[1](c)[0])
        expected = pull(cotangent)
        for scale in (1e-10, 1e-30):
            error = np.abs(pull(scale * cotangent) / scale - expected)
            assert error.max() <= 1e-7 * np.abs(expected).max()


DEVICES = """
import jax, jax.numpy as jnp, numpy as np
jax.config.update("jax_num_cpu_devices", 2)
jax.config.update("jax_enable_x64", True)
jax.config.update("jax_disable_most_optimizations", True)
from jax.sharding import AxisType, NamedSharding, PartitionSpec as P
import jaxsmooth as js
from meshes import grid

mesh = js.Mesh(*grid("triangle", (2, 2), 0.08))
constraints = js.detect_constraints(mesh)
devices = jax.make_mesh((2,), ("d",), axis_types=(AxisType.Auto,))
split = NamedSharding(devices, P("d"))
points = jnp.stack([mesh.points, 0.5 + mesh.points])

def value(points):
    done = js.run(mesh.with_points(points), constraints=constraints, steps=1)
    return (done.points ** 2).sum() + js.quality_mean(done)

slope = jax.vmap(jax.grad(value))
checked = jax.shard_map(slope, mesh=devices, in_specs=P("d"), out_specs=P("d"))
plain, mapped = (jax.jit(f)(jax.device_put(points, split)) for f in (slope, checked))
assert np.abs(plain).max() > 0.1
np.testing.assert_allclose(plain, mapped, atol=1e-9)
"""


def test_gradients_are_split_among_devices():
    """Of an input that is split over a device mesh, and under `shard_map` with its checks on."""
    here = Path(__file__).parent
    env = os.environ | {"PYTHONPATH": f"{here}{os.pathsep}{here.parent}"}
    done = subprocess.run(
        [sys.executable, "-c", DEVICES], env=env, capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stdout + done.stderr[-3000:]
