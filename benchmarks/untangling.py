"""Every tangled mesh of a folder, one row a mesh: what stays inverted by each method.

    python -m benchmarks.untangling FOLDER [--methods untangle,optimize,elastic] [--steps 3] [--out TABLE.md]

Without a folder a cube of tetrahedra is tangled at random.  The boundary
slides on its flat faces and is held elsewhere.  "Can't be" counts elements that are inverted where all
nodes are held.  Seconds are those of the whole run, with compilation.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import meshio
import numpy as np

import jaxsmooth as js
from benchmarks.gradients import cube
from jaxsmooth.metrics.validity import inverted
from jaxsmooth.report.advice import still_inverted
from jaxsmooth.report.holding import holding


def inputs(folder: str | None) -> Iterator[tuple[str, Any]]:
    """Names and meshes."""
    if folder is None:
        points, tetrahedra = cube(6, amplitude=1.2)
        yield "cube of tetrahedra", js.from_meshio(meshio.Mesh(points, [("tetra", tetrahedra)]))
        return
    for path in sorted(Path(folder).rglob("*")):
        if path.is_file() and path.suffix != ".md":
            file = js.read(path)
            if not file.mesh.surface:
                yield path.name, file


def row(name: str, file: Any, methods: list[str], steps: int) -> str | None:
    """The row of a mesh, if it is tangled."""
    mesh = js.as_mesh(file)
    before = sum(int(part.sum()) for part in inverted(mesh))
    if not before:
        return None
    constraints = js.detect_constraints(mesh)
    cells = [name, f"{sum(map(len, mesh.connectivity)):,}", f"{before:,}"]
    hopeless = None
    for method in methods:
        start = time.perf_counter()
        done = js.smooth(mesh, js.METHODS[method](), steps=steps, constraints=constraints)
        seconds, last = time.perf_counter() - start, done.history[-1].statistics
        cells.append(f"{last.inverted:,} / {last.below:,} / {seconds:.1f}")
        if hopeless is None:
            held = holding(mesh, constraints, np.zeros(len(mesh.points), bool))
            left = still_inverted(file, done.mesh, constraints, held) if last.inverted else []
            hopeless = sum(not each["repairable"] for each in left)
    cells.insert(3, f"{hopeless:,}")
    return f"| {' | '.join(cells)} |"


def main(arguments: list[str] | None = None) -> None:
    """Print the table, and write it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("folder", nargs="?")
    parser.add_argument("--methods", default="untangle,optimize,elastic")
    parser.add_argument("--steps", type=int, default=3)
    parser.add_argument("--out")
    options = parser.parse_args(arguments)
    jax.config.update("jax_enable_x64", True)
    methods = options.methods.split(",")
    heads = ["mesh", "elements", "inverted", "can't be repaired", *methods]
    lines = [
        "# Tangled meshes",
        "",
        f"After {options.steps} steps: inverted / below 0.2 / seconds with compilation, in one process.",
        "Made by `python -m benchmarks.untangling FOLDER`.",
        "",
        f"| {' | '.join(heads)} |",
        f"|{'---|' * len(heads)}",
    ]
    print("\n".join(lines))
    for name, file in inputs(options.folder):
        found = row(name, file, methods, options.steps)
        if found is not None:
            lines.append(found)
            print(found, flush=True)
    if options.out:
        Path(options.out).write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
