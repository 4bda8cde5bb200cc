"""Surface meshes: quality against distance to the input, beside PyVista's two smoothers.

    python -m benchmarks.surfaces FOLDER [--methods elastic,optimize] [--out TABLE.md]

Every file of FOLDER with a surface is smoothed with the default settings.  PyVista's ``smooth`` and
``smooth_taubin`` get the same surface, their own defaults, feature edges and borders held.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pyvista as pv

import jaxsmooth as js
from jaxsmooth.mesh.topology import lengths, node_pairs
from jaxsmooth.metrics.summary import statistics

TITLE = """# Surfaces

Made by `python -m benchmarks.surfaces FOLDER`.  *Off*: the largest distance of new nodes to the facets of the
input; *cut*: that of the input's nodes to the new facets; *edges*: that of nodes on feature edges and borders
of the input to these; all over the mean length of edges.  PyVista's smoothers hold the edges that they find.

"""
HEAD = (
    "| file | by | inverted | below 0.2 | q_min | q_avg | sj_min | off | cut | edges |\n"
    "|---|---|---|---|---|---|---|---|---|---|"
)


def main() -> int:
    """Print and write the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--methods", default="elastic,optimize")
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    rows = [HEAD]
    print(HEAD, flush=True)
    for path in sorted(options.folder.glob("*.vtu")):
        for row in _rows(path, options.methods.split(",")):
            rows.append(row)
            print(row, flush=True)
    if options.out:
        options.out.write_text(TITLE + "\n".join(rows) + "\n")
    return 0


def _rows(path: Path, methods: list[str]) -> Iterator[str]:
    mesh = js.read(path).mesh
    before = np.asarray(mesh.points)
    yield _row(path.stem, "input", mesh, before)
    for name in methods:
        result = js.smooth(mesh, js.METHODS[name]())
        yield _row(
            path.stem, f"{name}, {len(result.history) - 1} steps", mesh, np.asarray(result.mesh.points)
        )
    surface = _poly_data(mesh, before)
    if surface is None:
        return
    held = {"feature_smoothing": False, "boundary_smoothing": False, "feature_angle": 50.0}
    for name in ("smooth", "smooth_taubin"):
        moved = getattr(surface, name)(**held)
        yield _row(path.stem, f"PyVista's {name}", mesh, np.asarray(moved.points))


def _poly_data(mesh: js.Mesh, points: np.ndarray) -> pv.PolyData | None:
    """The surface of the corners, for PyVista; None for quadratic elements."""
    if not all(kind.linear for kind, _ in mesh.blocks):
        return None
    return _facets(mesh, points)


def _facets(mesh: js.Mesh, points: np.ndarray) -> pv.PolyData:
    faces = [
        np.insert(np.asarray(nodes)[:, : kind.corners], 0, kind.corners, axis=1).ravel()
        for kind, nodes in mesh.blocks
    ]
    return pv.PolyData(points, np.concatenate(faces))


def _row(name: str, by: str, mesh: js.Mesh, points: np.ndarray) -> str:
    state = statistics(mesh.with_points(points))
    scale = lengths(np.asarray(mesh.points), node_pairs(mesh)).mean()
    old, new = _facets(mesh, np.asarray(mesh.points)), _facets(mesh, points)
    corners = _corners(mesh)
    off, cut = _away(old, points[corners]) / scale, _away(new, np.asarray(mesh.points)[corners]) / scale
    edges = _off_edges(mesh, old, points) / scale
    return (
        f"| {name} | {by} | {state.inverted} | {state.below} | {state.q_min:.4f} | {state.q_avg:.4f} "
        f"| {state.scaled_jacobian_min:.4f} | {off:.4f} | {cut:.4f} | {edges:.1e} |"
    )


def _corners(mesh: js.Mesh) -> np.ndarray:
    return np.unique(
        np.concatenate([np.asarray(nodes)[:, : kind.corners].ravel() for kind, nodes in mesh.blocks])
    )


def _away(surface: Any, points: np.ndarray) -> float:
    """The largest distance of points to a surface."""
    _, nearest = surface.find_closest_cell(points, return_closest_point=True)
    return float(np.linalg.norm(nearest - points, axis=1).max())


def _off_edges(mesh: js.Mesh, old: pv.PolyData, points: np.ndarray) -> float:
    """How far nodes on feature edges and borders of the input are off these; 0 where there are none."""
    edges = old.extract_feature_edges(50.0, manifold_edges=False)
    if not edges.n_cells:
        return 0.0
    before = np.asarray(mesh.points)
    corners = _corners(mesh)
    _, nearest = edges.find_closest_cell(before[corners], return_closest_point=True)
    on = corners[np.linalg.norm(nearest - before[corners], axis=1) < 1e-9 * np.ptp(before, axis=0).max()]
    return _away(edges, points[on])


if __name__ == "__main__":
    raise SystemExit(main())
