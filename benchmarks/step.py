"""What one elastic step costs, and what its parts are worth.

    python -m benchmarks.step [FILE] [--precision float64]

Prints the time of the rotation against the SVD, of the operator and of the evaluation, in
microseconds an element; then three guarded steps for several tolerances of the linear solve,
with the quality they reach.  Without a file, a cube of about 30 thousand tetrahedra.
"""

from __future__ import annotations

import argparse
import time

import jax
import numpy as np

from benchmarks.gradients import cube, seconds


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("file", nargs="?")
    parser.add_argument("--precision", choices=("float64", "float32"), default="float64")
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", options.precision == "float64")
    import jaxsmooth as js
    from jaxsmooth.metrics.evaluation import evaluate
    from jaxsmooth.numerics.rotation import rotation, rotation_svd

    if options.file:
        file = js.read(options.file)
        mesh, fixed = file.mesh, file.fixed
    else:
        points, tetra = cube(17, amplitude=0.35)
        mesh, fixed = js.Mesh(points, {"tetra": tetra}), None
    count = sum(len(nodes) for nodes in mesh.connectivity)
    start = time.perf_counter()
    constraints = js.detect_constraints(mesh, fixed=fixed)
    print(f"{count} elements, {len(mesh.points)} nodes, {mesh.points.dtype}")
    print(f"constraints {time.perf_counter() - start:.2f} s")

    moments = np.random.default_rng(0).normal(size=(count, mesh.dim, mesh.dim)).astype(mesh.points.dtype)
    times = {f.__name__: seconds(jax.jit(jax.vmap(f)), moments) for f in (rotation, rotation_svd)}
    for name, value in times.items():
        print(f"{name:13s} {value / count * 1e6:.3f} µs an element")
    print(f"SVD over closed form: {times['rotation_svd'] / times['rotation']:.1f}")
    print(f"evaluation    {seconds(jax.jit(evaluate), mesh) / count * 1e6:.3f} µs an element")

    step = jax.jit(lambda method, mesh, before: method.step(mesh, constraints, before))
    for tolerance in (1e-1, 1e-2, 1e-4, 1e-8):
        method, current, before = js.Elastic(tolerance=tolerance), mesh, jax.jit(evaluate)(mesh)
        once = seconds(step, method, mesh, before, repeats=3)
        iterations = []
        for _ in range(3):
            result = step(method, current, before)
            current, before = current.with_points(result.points), result.evaluation
            iterations.append(int(result.iterations))
        q = np.concatenate(before.quality)
        print(
            f"tolerance {tolerance:.0e}: {once / count * 1e6:5.2f} µs an element and step, iterations "
            f"{iterations}; after three steps q_min {q.min():.4f}, q_avg {q.mean():.4f}, "
            f"below 0.2 {(q < 0.2).sum()}"
        )


if __name__ == "__main__":
    main()
