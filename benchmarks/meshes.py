"""Smooth every mesh file of a folder, from file to file, and print one row a run.

    python -m benchmarks.meshes FOLDER [--methods elastic,elastic-extended] [--steps 3]
                                       [--boundary planar] [--precision float64] [--out TABLE.md]

Every run reads the file, smooths it, writes it in its own format to a temporary folder, reads
that again and checks that topology and data are those of the input and that nothing is worse: no
more inverted and no more poor elements, no lower q_min and scaled Jacobian than the input's (where
these are below 0.2 and 0.1), no lower q_avg unless the method is the extended one or the mesh has
become valid, and all nodes where the boundary lets them be.  What is broken is the row, and the exit
status is 1.  Surfaces in 3D are skipped.  Without a folder the demo mesh is used.
Qualities are over the elements with a node that may move, inverted elements over all.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from pathlib import Path

import jax
import numpy as np

HEAD = (
    "| file | method | nodes | elements | q_min | q_avg | q < 0.2 | sj_min | inverted | step s | status |\n"
    "|---|---|---|---|---|---|---|---|---|---|---|"
)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("folder", nargs="?", type=Path)
    parser.add_argument("--methods", default="elastic,elastic-extended")
    parser.add_argument("--steps", type=int, default=3)
    parser.add_argument("--boundary", choices=("planar", "slide", "fixed"), default="planar")
    parser.add_argument("--precision", choices=("float64", "float32"), default="float64")
    parser.add_argument("--largest", type=int, default=300_000, help="elements of a mesh, at most")
    parser.add_argument("--only", default="", help="part of the file name")
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", options.precision == "float64")
    from jaxsmooth.demo import MESH

    files = [MESH] if options.folder is None else sorted(options.folder.rglob("*.*"))
    rows, failures = [HEAD], 0
    print(HEAD, flush=True)
    for path in files:
        if path.suffix not in (".vtu", ".vtk", ".msh", ".npz", ".mesh", ".inp", ".xdmf"):
            continue
        if options.only not in path.name:
            continue
        for name in options.methods.split(","):
            try:
                row = smooth_file(path, name, options)
            except ValueError as error:
                row = None if "surface" in str(error) else f"| {path.name} | {name} | error: {error} |"
                failures += row is not None
            if row is not None:
                rows.append(row)
                print(row, flush=True)
        jax.clear_caches()
    if options.out:
        options.out.write_text("\n".join(rows) + "\n")
    return 1 if failures else 0


def smooth_file(path: Path, name: str, options: argparse.Namespace) -> str | None:
    """One row of the table, or none for too large a mesh.  Raises `ValueError` where a promise is broken."""
    from jaxsmooth.files.io import read, write
    from jaxsmooth.methods import METHODS
    from jaxsmooth.metrics.validity import inverted
    from jaxsmooth.motion.detect import detect_constraints
    from jaxsmooth.report.report import movable_elements, summarise
    from jaxsmooth.runs.driver import smooth

    file = read(path)
    if sum(map(len, file.mesh.connectivity)) > options.largest:
        return None
    start = time.perf_counter()
    constraints = detect_constraints(file.mesh, boundary=options.boundary)
    result = smooth(file, METHODS[name](), steps=options.steps, constraints=constraints, tolerance_avg=0.0)
    seconds = time.perf_counter() - start
    warm = [row.seconds for row in result.history[2:]]
    before, after = (np.concatenate([~part for part in inverted(mesh)]) for mesh in (file.mesh, result.mesh))
    if name not in ("laplacian", "weighted-laplacian"):
        not_worse(file.mesh, result.mesh, name)
    if options.boundary != "slide":
        kept(constraints, file.mesh.points, result.mesh.points)
    with tempfile.TemporaryDirectory() as folder:
        target = Path(folder) / path.name
        write(target, file, result)
        same_file(file, read(target))
    masks = movable_elements(file.mesh, constraints)
    first, last = summarise(file.mesh, masks), summarise(result.mesh, masks)
    if not first:
        return f"| {path.name} | {name} | {len(file.mesh.points)} | {len(before)} | nothing may move |"
    columns = [
        f"{first[key]:{form}} → {last[key]:{form}}"
        for key, form in (
            ("q_min", ".4f"),
            ("q_avg", ".4f"),
            ("q_below_0.2", "d"),
            ("scaled_jacobian_min", ".4f"),
        )
    ]
    return (
        f"| {path.name} | {name} | {len(file.mesh.points)} | {len(before)} | {' | '.join(columns)} "
        f"| {(~before).sum()} → {(~after).sum()} "
        f"| {np.mean(warm) if warm else seconds:.3f} | {result.status} |"
    )


def not_worse(first, last, name: str) -> None:
    """Raise `ValueError` where a mesh is worse than it was."""
    from jaxsmooth.metrics.summary import POOR, statistics

    before, after = statistics(first), statistics(last)
    rounding = 1e-9 if first.points.dtype == np.float64 else 1e-5
    freed = name == "elastic-extended" or before.inverted > after.inverted == 0
    limits = {
        "inverted": (-after.inverted, -before.inverted),
        "poor": (-after.below, -before.below),
        "q_min": (after.q_min, min(before.q_min, POOR)),
        "scaled Jacobian": (after.scaled_jacobian_min, min(before.scaled_jacobian_min, 0.1)),
        "q_avg": (after.q_avg, -1 if freed else before.q_avg),
    }
    worse = [
        f"{key} {abs(low)} → {abs(value)}"
        for key, (value, low) in limits.items()
        if not value >= low - rounding
    ]
    if worse:
        raise ValueError(f"worse: {', '.join(worse)}")


def kept(constraints, first, last) -> None:
    """Raise `ValueError` where nodes are where the boundary does not let them be."""
    move = last - first
    away = np.abs(np.asarray(move - constraints.at(first).project(move))).max() / np.ptp(first, axis=0).max()
    if away > (1e-9 if first.dtype == np.float64 else 1e-5):
        raise ValueError(f"a node left the boundary by {away:.1e} of the domain")


def same_file(file, again) -> None:
    """Raise `ValueError` unless topology and data survived."""
    if file.mesh.types != again.mesh.types:
        raise ValueError("element types changed")
    for old, new in zip(file.mesh.connectivity, again.mesh.connectivity, strict=True):
        if not np.array_equal(old, new):
            raise ValueError("connectivity changed")
    for kind in ("point_data", "cell_data", "field_data"):
        old, new = getattr(file.source, kind), getattr(again.source, kind)
        if old.keys() - new.keys():
            raise ValueError(f"{kind} lost: {', '.join(old.keys() - new.keys())}")
        for name, values in old.items():
            parts = zip(values, new[name], strict=True) if kind == "cell_data" else [(values, new[name])]
            if not all(np.array_equal(a, b, equal_nan=True) for a, b in parts):
                raise ValueError(f"{kind} {name!r} changed")


if __name__ == "__main__":
    sys.exit(main())
