"""Many meshes on several devices, in a process of its own."""

import os
import subprocess
import sys
from pathlib import Path

PROGRAM = """
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
points = jnp.stack([mesh.points, 0.5 + mesh.points])
split = jax.device_put(points, NamedSharding(devices, P("d")))

def run(points):
    return js.run(mesh.with_points(points), constraints=constraints, steps=1).points

expected = jax.jit(jax.vmap(run))(points)
checked = jax.shard_map(jax.vmap(run), mesh=devices, in_specs=P("d"), out_specs=P("d"))
np.testing.assert_allclose(jax.jit(checked)(split), expected, atol=1e-15)

def value(points):
    done = js.run(mesh.with_points(points), js.Laplacian(weighted=True), constraints=constraints, steps=1)
    return (done.points ** 2).sum()

slope = jax.vmap(jax.grad(value))
np.testing.assert_allclose(jax.jit(slope)(split), jax.jit(slope)(points), atol=1e-13)
"""


def test_batches_are_split_among_devices():
    """Runs under `shard_map` with its checks, and gradients of an input that is split."""
    here = Path(__file__).parent
    env = os.environ | {"PYTHONPATH": f"{here}{os.pathsep}{here.parent}"}
    program = [sys.executable, "-c", PROGRAM]
    done = subprocess.run(program, env=env, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr[-2000:]
