"""How the cost of a guarded step grows with the mesh.

    python -m benchmarks.scaling [--largest 300000] [--check]

Cubes of tetrahedra whose nodes are displaced at random: microseconds an element for one guarded elastic step
(linear system to 0.1), for its guard and for one evaluation, in float64 and float32, and the ratio of the
step to 20 products of SciPy's assembled stiffness matrix of the same mesh, taken in the same run.  Prints
the exponent of the growth and the peak memory.  ``benchmarks/scaling.json`` has the last stored measurement.
"""

from __future__ import annotations

import resource
from pathlib import Path
from typing import Any

import jax
import numpy as np
from scipy.sparse import coo_matrix, csr_matrix

import jaxsmooth as js
from benchmarks.gradients import cube, seconds
from benchmarks.ratios import parser, settle
from jaxsmooth.metrics.evaluation import evaluate

STORED = Path(__file__).with_suffix(".json")
SIZES = (12, 17, 24, 37, 54, 70)  # cells of a side


def main() -> int:
    """Measure, print, and store or compare."""
    arguments = parser(__doc__)
    arguments.add_argument("--largest", type=int, default=300_000, help="number of tetrahedra")
    options = arguments.parse_args()
    jax.config.update("jax_enable_x64", True)
    rows: dict[str, dict[str, Any]] = {}
    for dtype in ("float64", "float32"):
        known = []
        for cells in SIZES:
            if 6 * cells**3 > options.largest:
                continue
            row = _row(cells, dtype)
            rows[f"{row['elements']} tetrahedra, {dtype}"] = row
            known.append((row["elements"], row["elements"] * row["step"]))
            shown = "  ".join(f"{name} {row[name]:.2f}" for name in ("step", "guard", "evaluation", "ratio"))
            print(f"{row['elements']:8d} {dtype}  {shown}", flush=True)
        if len(known) > 1:
            print(f"growth: N^{np.polyfit(*np.log(known).T, 1)[0]:.2f}")
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(f"peak memory {memory:.0f} MB")
    return settle(STORED, rows, options.check)


def _row(cells: int, dtype: str) -> dict[str, Any]:
    """Microseconds an element."""
    points, tetra = cube(cells, amplitude=0.3)
    mesh = js.Mesh(points.astype(dtype), {"tetra": tetra})
    motion = js.detect_constraints(mesh)
    method = js.Elastic(tolerance=0.1)
    before = jax.jit(evaluate)(mesh)
    proposal = jax.jit(lambda mesh, before: method.propose(mesh, motion, before))(mesh, before)
    guard = jax.jit(lambda mesh, move, before: method.guard(mesh, motion, move, before))
    step = jax.jit(lambda mesh, before: method.step(mesh, motion, before))
    matrix, vector = _stiffness_pattern(mesh), np.ones(points.size, dtype)
    times = {
        "step": seconds(step, mesh, before),
        "guard": seconds(guard, mesh, proposal.move, before),
        "evaluation": seconds(jax.jit(evaluate), mesh),
    }
    reference = 20 * seconds(lambda x: matrix @ x, vector)
    return {
        "elements": len(tetra),
        **{name: value / len(tetra) * 1e6 for name, value in times.items()},
        "sweeps": int(guard(mesh, proposal.move, before).sweeps),
        "ratio": times["step"] / reference,
    }


def _stiffness_pattern(mesh: js.Mesh) -> csr_matrix:
    """A matrix with the entries of the stiffness; their values do not matter to the time of a product."""
    nodes = np.asarray(mesh.connectivity[0])
    rows = (3 * nodes[:, :, None] + np.arange(3)).reshape(len(nodes), -1)
    a, b = np.repeat(rows, rows.shape[1], axis=1).ravel(), np.tile(rows, rows.shape[1]).ravel()
    shape = (mesh.points.size, mesh.points.size)
    return coo_matrix((np.ones(len(a), mesh.points.dtype), (a, b)), shape=shape).tocsr()


if __name__ == "__main__":
    raise SystemExit(main())
