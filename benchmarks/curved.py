"""Sliding on curved boundaries against holding them: quality, distance to the input's surface, volume.

    python -m benchmarks.curved FOLDER [--only NAME,NAME] [--methods elastic,elastic-extended]
                                       [--steps 5] [--out TABLE.md]

FOLDER holds mesh files.  Every file is smoothed with its curved boundary held (``planar``) and sliding
(``slide``).  Distances are those of the nodes to the facets of the input, over the mean length of edges;
`set up` is `detect_constraints`, `step` the mean of all steps but the first, which compiles.
"""

from __future__ import annotations

import argparse
import itertools
import sys
import time
from pathlib import Path

import jax
import numpy as np

NAMES = (
    "rocker_gmsh_13k,mfem_piece,netgen_hinge,calculix_cleat,cinolib_rockerarm_hex,hexsmoothing_screw2,"
    "su2_naca0012_inv,sfepy_multi_material,mfem_indheat,dealii_sphere_r7"
)
HEAD = (
    "| file | method | boundary | poor | q_min | q_avg | sj_min | distance | volume | worst region "
    "| set up s | step s |\n"
    "|---|---|---|---|---|---|---|---|---|---|---|---|"
)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--only", default=NAMES)
    parser.add_argument("--methods", default="elastic,elastic-extended")
    parser.add_argument("--steps", type=int, default=5)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    files = {path.stem: path for path in sorted(options.folder.rglob("*.vtu"))}
    rows = [HEAD]
    print(HEAD, flush=True)
    chosen = itertools.product(options.only.split(","), options.methods.split(","), ("planar", "slide"))
    for name, method, boundary in chosen:
        if name in files:
            rows.append(row(files[name], method, boundary, options.steps))
            print(rows[-1], flush=True)
    if options.out:
        options.out.write_text("\n".join(rows) + "\n")
    return 0


def row(path: Path, name: str, boundary: str, steps: int) -> str:
    """One line of the table."""
    import jaxsmooth as js

    file = js.read(path)
    start = time.perf_counter()
    motion = js.detect_constraints(file, boundary=boundary, interfaces=boundary)
    setup = time.perf_counter() - start
    result = js.smooth(file, js.METHODS[name](), steps=steps, constraints=motion, tolerance_avg=0.0)
    first, last = (result.history[i].statistics for i in (0, -1))
    before, after = (measures(mesh) for mesh in (file.mesh, result.mesh))
    drift = np.abs(after / before - 1)
    whole = after.sum() / before.sum() - 1
    warm = [record.seconds for record in result.history[2:]]
    return (
        f"| {path.stem} | {name} | {boundary} | {first.below} → {last.below} "
        f"| {first.q_min:.4f} → {last.q_min:.4f} "
        f"| {first.q_avg:.4f} → {last.q_avg:.4f} "
        f"| {first.scaled_jacobian_min:.4f} → {last.scaled_jacobian_min:.4f} "
        f"| {distance(file.mesh, result.mesh):.4f} | {whole:+.1e} | {drift.max():.1e} "
        f"| {setup:.2f} | {np.mean(warm) if warm else np.nan:.3f} |"
    )


def measures(mesh) -> np.ndarray:
    """Area or volume of every region."""
    from jaxsmooth.mesh.topology import signed_measures

    found = [signed_measures(kind, np.asarray(mesh.points), np.asarray(n)) for kind, n in mesh.blocks]
    labels = mesh.labels
    if labels is None or not labels.regions:
        return np.array([sum(part.sum() for part in found)])
    tags = np.unique(np.concatenate(labels.regions), return_inverse=True)[1]
    return np.bincount(tags, np.concatenate(found))


def distance(before, after) -> float:
    """The largest distance of boundary nodes to the input's facets, over the mean length of edges.

    Facets are split into triangles, or segments, between their corners; those around the eight nodes of the
    input that are nearest to a node are looked at.
    """
    from scipy.spatial import cKDTree

    from jaxsmooth.mesh.topology import find_facets, lengths, node_pairs

    points, moved = np.asarray(before.points), np.asarray(after.points)
    simplices = []
    for part in find_facets(before):
        nodes = part.nodes[(part.partner < 0) | (part.partner != part.region)]
        corners = part.type.corners
        simplices += [nodes[:, [0, i, i + 1][: before.dim]] for i in range(1, max(corners - 1, 2))]
    table = np.concatenate(simplices)
    nodes = np.unique(table)
    tree = cKDTree(points[nodes])
    flat, facet = table.reshape(-1), np.repeat(np.arange(len(table)), table.shape[1])
    order = np.argsort(flat, kind="stable")
    start = np.searchsorted(flat[order], np.arange(len(points) + 1))
    worst = 0.0
    for node in nodes[np.linalg.norm(moved - points, axis=1)[nodes] > 0]:
        around = np.append(nodes[tree.query(moved[node], 8)[1]], node)
        near = np.unique(np.concatenate([facet[order[start[n] : start[n + 1]]] for n in around]))
        worst = max(worst, gap(moved[node], points[table[near]]))
    return worst / lengths(points, node_pairs(before)).mean()


def gap(x: np.ndarray, simplices: np.ndarray) -> float:
    """Distance to the nearest of segments or triangles ``[m, p + 1, dim]``."""
    best = np.inf
    for i, j in itertools.combinations(range(simplices.shape[1]), 2):
        p, way = simplices[:, i], simplices[:, j] - simplices[:, i]
        t = np.clip(((x - p) * way).sum(axis=1) / np.maximum((way**2).sum(axis=1), 1e-300), 0, 1)
        best = min(best, np.linalg.norm(p + t[:, None] * way - x, axis=1).min())
    if simplices.shape[1] == 3:
        frame = np.swapaxes(simplices[:, 1:] - simplices[:, :1], 1, 2)
        weights = (np.linalg.pinv(frame) @ (x - simplices[:, 0])[..., None])[..., 0]
        inside = (weights > 0).all(axis=1) & (weights.sum(axis=1) < 1)
        off = np.linalg.norm(simplices[:, 0] + (frame @ weights[..., None])[..., 0] - x, axis=1)
        best = min(best, off[inside].min(initial=np.inf))
    return float(best)


if __name__ == "__main__":
    sys.exit(main())
