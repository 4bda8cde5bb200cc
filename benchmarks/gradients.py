"""What derivatives of whole runs cost: time, memory, batches.

    python -m benchmarks.gradients [--cells 17]

Prints ratios taken in one process: value and gradient of a three-step run over the value alone
(at the same solver tolerance), temporary memory of 20 steps over that of one, and the
throughput of `jax.vmap` over 64 small meshes against a loop over jitted single runs: on one
device, and spread over as many CPU devices as there are cores, for one call of `jax.vmap` hardly
uses more than one.
"""

from __future__ import annotations

import argparse
import os
import time

import jax
import numpy as np


def cube(cells: int, amplitude: float = 0.2, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """A cube of cells³ × 6 tetrahedra with displaced interior nodes."""
    axis = np.arange(cells + 1)
    points = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3) / cells
    number = np.arange(len(points)).reshape((cells + 1,) * 3)
    corner = [
        number[i : i + cells, j : j + cells, k : k + cells].ravel()
        for i, j, k in (
            (0, 0, 0),
            (1, 0, 0),
            (1, 1, 0),
            (0, 1, 0),
            (0, 0, 1),
            (1, 0, 1),
            (1, 1, 1),
            (0, 1, 1),
        )
    ]
    paths = ((1, 2), (2, 3), (3, 7), (7, 4), (4, 5), (5, 1))  # around the diagonal from 0 to 6
    tetra = np.concatenate([np.stack([corner[c] for c in (0, a, b, 6)], axis=1) for a, b in paths])
    inner = ((points > 0) & (points < 1)).all(axis=1)
    move = np.random.default_rng(seed).uniform(-amplitude, amplitude, points.shape) / cells
    return points + move * inner[:, None], tetra


def square(cells: int, amplitude: float = 0.2, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """A square of cells² × 2 triangles with displaced interior nodes."""
    axis = np.arange(cells + 1)
    points = np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1).reshape(-1, 2) / cells
    a = np.arange(len(points)).reshape(cells + 1, -1)[:-1, :-1].reshape(-1, 1)
    row = cells + 1
    triangles = np.concatenate([a + np.array(c) for c in ((0, row, row + 1), (0, row + 1, 1))])
    inner = ((points > 0) & (points < 1)).all(axis=1)
    move = np.random.default_rng(seed).uniform(-amplitude, amplitude, points.shape) / cells
    return points + move * inner[:, None], triangles


def seconds(function, *arguments, repeats: int = 5) -> float:
    jax.block_until_ready(function(*arguments))
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        jax.block_until_ready(function(*arguments))
        times.append(time.perf_counter() - start)
    return float(np.median(times))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--cells", type=int, default=17)
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    jax.config.update("jax_num_cpu_devices", os.cpu_count())
    import jaxsmooth as js
    from jaxsmooth.numerics.solve import gradient_tolerance

    points, tetra = cube(options.cells)
    mesh = js.Mesh(points, {"tetra": tetra})
    constraints = js.detect_constraints(mesh)
    method = js.Elastic(tolerance=gradient_tolerance(points.dtype))

    def value(steps: int):
        def function(p):
            smooth = js.run(mesh.with_points(p), method, constraints=constraints, steps=steps)
            return js.quality_mean(smooth)

        return function

    alone = seconds(jax.jit(value(3)), mesh.points)
    both = seconds(jax.jit(jax.value_and_grad(value(3))), mesh.points)
    print(f"{len(tetra)} tetrahedra, 3 guarded steps, relative residual {method.tolerance:.0e}")
    print(f"value {alone:.3f} s, value and gradient {both:.3f} s, ratio {both / alone:.2f}")

    memory = {}
    for steps in (1, 20):
        compiled = jax.jit(jax.value_and_grad(value(steps))).lower(mesh.points).compile()
        memory[steps] = compiled.memory_analysis().temp_size_in_bytes / 2**20
    print(
        f"memory of 1 step {memory[1]:.0f} MiB, of 20 steps {memory[20]:.0f} MiB, "
        f"ratio {memory[20] / memory[1]:.2f}"
    )

    small_meshes = (
        ("triangle", square, 2),
        ("triangle", square, 3),
        ("tetra", cube, 1),
        ("triangle", square, 5),
        ("tetra", cube, 2),
    )
    for kind, make, cells in small_meshes:
        points, nodes = make(cells)
        small = js.Mesh(points, {kind: nodes})
        sliding = js.detect_constraints(small)
        batch = np.stack([make(cells, seed=seed)[0] for seed in range(64)])
        for name, wrap in (("run", lambda f: f), ("gradient", jax.grad)):
            compare_batch(f"{len(nodes)} {kind}, {name}", wrap(small_run(js, small, sliding)), batch)


def small_run(js, mesh, constraints):
    """The mean quality after three steps, as a function of the points."""
    return lambda p: js.quality_mean(js.run(mesh.with_points(p), constraints=constraints, steps=3))


def compare_batch(name: str, function, batch: np.ndarray) -> None:
    """One line: a loop over jitted single runs against one vmapped call, on one device and on all."""
    single, many = jax.jit(function), jax.jit(jax.vmap(function))
    devices = jax.make_mesh((jax.device_count(),), ("batch",))
    part = jax.sharding.PartitionSpec("batch")
    specs = {"mesh": devices, "in_specs": part, "out_specs": part}
    spread = jax.jit(jax.shard_map(jax.vmap(function), **specs))
    placed = jax.device_put(batch, jax.NamedSharding(devices, part))
    loop = seconds(lambda points: [single(p) for p in points], batch, repeats=15)
    waiting = seconds(lambda points: [jax.block_until_ready(single(p)) for p in points], batch, repeats=15)
    one, every = (seconds(f, points, repeats=15) for f, points in ((many, batch), (spread, placed)))
    once = single._cache_size() == many._cache_size() == 1
    print(
        f"64 × {name}: loop {loop * 1e3:.1f} ms, waiting for each {waiting * 1e3:.1f} ms, "
        f"vmap {one * 1e3:.1f} ms, on {jax.device_count()} devices {every * 1e3:.1f} ms; throughput "
        f"× {loop / one:.1f} and × {loop / every:.1f}; compiled once each: {once}",
        flush=True,
    )


if __name__ == "__main__":
    main()
