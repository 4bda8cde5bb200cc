"""The paper's figures, with matplotlib alone and without a display."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import PolyCollection
from matplotlib.colors import LinearSegmentedColormap, Normalize
from matplotlib.figure import Figure

from benchmarks.paper.examples import Outcome, quality_values
from jaxsmooth.assembly import gather, scatter_add
from jaxsmooth.mesh.record import Mesh
from jaxsmooth.methods.elastic.elasticity import Material, element_force, linearise
from jaxsmooth.methods.elastic.fitting import target_element
from jaxsmooth.motion.detect import detect_constraints
from jaxsmooth.numerics.small import Frame
from jaxsmooth.targets import OwnSize

__all__ = ["box_plot", "draw", "forces", "histogram", "mesh_row", "paper_figures"]

VIEW = (-60.0, 25.0)  # azimuth and elevation in degrees
_MAP = LinearSegmentedColormap.from_list("quality", ["#a3122e", "#e8743b", "#f6d55c", "#b9dcd2", "#fbfdfc"])
_INK = "#1d2b36"
_COLOURS = ("#9aa5ad", "#c8502d", "#e2a33c", "#1f6f8b", "#5b3f8c", "#3b7d3b")

View = tuple[float, float]


def draw(axis: Axes, mesh: Mesh, *, low: float = 0.0, view: View = VIEW, arrows: float = 0.0) -> None:
    """Draw a mesh coloured by quality, from `low` to 1.

    Args:
        axis: where.
        mesh: 2D elements, or solids seen from outside by orthographic projection.
        low: quality of the darkest red.
        view: azimuth and elevation in degrees (3D).
        arrows: length of the arrow of a unit nodal force of the elastic method (2D), 0 for none.
    """
    q = quality_values(mesh)
    polygons, values, shade = _plane(mesh, q) if mesh.dim == 2 else _solid(mesh, q, view)
    colours = ScalarMappable(Normalize(low, 1), _MAP).to_rgba(values) * shade[:, None]
    colours[:, 3] = 1
    width = 0.5 if len(polygons) < 3000 else 0.15
    axis.add_collection(PolyCollection(polygons, facecolors=colours, edgecolors=_INK, linewidths=width))
    if arrows:
        points, pull = np.asarray(mesh.points), forces(mesh)
        unit = {"angles": "xy", "scale_units": "xy", "scale": 1 / arrows}
        axis.quiver(*points.T, *pull.T, color="#0b2a6b", width=0.003, zorder=3, **unit)
    axis.set_aspect("equal")
    axis.autoscale_view()
    axis.set_axis_off()


def forces(mesh: Mesh) -> np.ndarray:
    """Assembled nodal forces ``[nodes, dim]`` of Eq. 31, without what the constraints take up."""
    return np.asarray(_forces(mesh, detect_constraints(mesh).projectors))


@jax.jit
def _forces(mesh: Mesh, projectors: jax.Array) -> jax.Array:
    total = jnp.zeros_like(mesh.points)
    for (kind, nodes), size in zip(mesh.blocks, OwnSize().measures(mesh, Frame.of(mesh.points)), strict=True):
        corners = gather(mesh.points, nodes)
        ideal = jnp.asarray(kind.ideal, corners.dtype)
        target = jax.vmap(target_element, in_axes=(None, 0, 0))(ideal, corners, size ** (1 / kind.dim))
        elements = jax.vmap(partial(linearise, kind))(corners, size)
        pull = jax.vmap(element_force, in_axes=(0, 0, None))(elements, target - corners, Material())
        total = total + scatter_add(pull, nodes, len(mesh.points))
    return jnp.einsum("nij,nj->ni", projectors, total)


def _plane(mesh: Mesh, q: np.ndarray) -> tuple[list[np.ndarray], np.ndarray, np.ndarray]:
    polygons: list[np.ndarray] = []
    for kind, nodes in mesh.blocks:
        polygons += list(np.asarray(mesh.points)[np.asarray(nodes)[:, kind.outline]])
    return polygons, q, np.ones(len(q))


def _solid(mesh: Mesh, q: np.ndarray, view: View) -> tuple[list[np.ndarray], np.ndarray, np.ndarray]:
    """Boundary faces that look at the viewer, far ones first (painter's algorithm)."""
    azimuth, elevation = np.deg2rad(view)
    flat = np.array([np.cos(azimuth), np.sin(azimuth), 0])
    towards = np.cos(elevation) * flat + np.array([0, 0, np.sin(elevation)])
    right = np.array([-np.sin(azimuth), np.cos(azimuth), 0])
    screen = np.stack([right, np.cross(towards, right)], axis=1)
    points = np.asarray(mesh.points, float)
    polygons, depths, values, shades = [], [], [], []
    for faces, of_face in _boundary(mesh, q):
        corners = points[faces]
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, -1] - corners[:, 0])
        cosine = normal @ towards / np.linalg.norm(normal, axis=1)
        seen = cosine > 0
        polygons += list(corners[seen] @ screen)
        depths.append((corners[seen] @ towards).mean(axis=1))
        values.append(of_face[seen])
        shades.append(0.75 + 0.25 * cosine[seen])
    order = np.argsort(np.concatenate(depths))
    return [polygons[i] for i in order], np.concatenate(values)[order], np.concatenate(shades)[order]


def _boundary(mesh: Mesh, q: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Corners of the faces that one element has alone, and its quality; by number of corners."""
    sides: dict[int, list[tuple[np.ndarray, np.ndarray]]] = {}
    start = 0
    for kind, nodes in mesh.blocks:
        own = q[start : start + len(nodes)]
        start += len(nodes)
        for group in kind.facets:
            count = group.type.corners
            faces = np.asarray(nodes)[:, group.nodes[:, :count]].reshape(-1, count)
            sides.setdefault(count, []).append((faces, np.repeat(own, len(group.nodes))))
    found = []
    for parts in sides.values():
        faces, values = (np.concatenate(part) for part in zip(*parts, strict=True))
        _, which, times = np.unique(np.sort(faces, axis=1), axis=0, return_inverse=True, return_counts=True)
        alone = times[which.reshape(-1)] == 1
        found.append((faces[alone], values[alone]))
    return found


def mesh_row(
    panels: list[tuple[str, Mesh]], *, low: float = 0.0, view: View = VIEW, arrows: bool = False
) -> Figure:
    """Meshes side by side, with one colour bar; forces to the scale of the first mesh."""
    length = 0.0
    if arrows:
        first = panels[0][1]
        large = np.quantile(np.linalg.norm(forces(first), axis=1), 0.95)
        length = 0.07 * float(np.ptp(np.asarray(first.points), axis=0).max() / large)
    figure = Figure(figsize=(5.2 * len(panels) + 0.6, 5.0), layout="constrained")
    axes = figure.subplots(1, len(panels), squeeze=False)[0]
    for axis, (title, mesh) in zip(axes, panels, strict=True):
        draw(axis, mesh, low=low, view=view, arrows=length)
        axis.set_title(title, color=_INK)
    bar = figure.colorbar(ScalarMappable(Normalize(low, 1), _MAP), ax=list(axes), shrink=0.7)
    bar.set_label("quality q")
    return figure


def box_plot(outcome: Outcome) -> Figure:
    """Median, quartiles and limits of the quality along the iterations."""
    figure = Figure(figsize=(5.5, 3.6), layout="constrained")
    axis = figure.subplots()
    values = [quality_values(mesh) for mesh in outcome.meshes]
    axis.boxplot(values, whis=(0, 100), tick_labels=[str(i) for i in range(len(values))])
    axis.set(xlabel="iteration", ylabel="quality q")
    return figure


def histogram(series: dict[str, Mesh]) -> Figure:
    """Share of elements by quality, in bins of 0.05 closed on the right."""
    figure = Figure(figsize=(8, 3.6), layout="constrained")
    axis = figure.subplots()
    edges = np.linspace(0, 1, 21)
    width = 0.9 * 0.05 / len(series)
    lowest = 20
    for index, (label, mesh) in enumerate(series.items()):
        q = quality_values(mesh)
        counts = np.bincount(np.clip(np.ceil(q / 0.05 - 1e-9).astype(int) - 1, 0, 19), minlength=20)
        places = edges[:-1] + 0.0025 + (index + 0.5) * width
        axis.bar(places, 100 * counts / len(q), width, label=label, color=_COLOURS[index % len(_COLOURS)])
        lowest = min(lowest, int(np.flatnonzero(counts)[0]))
    axis.set(xlabel="quality q", ylabel="elements, %", xlim=(edges[lowest], 1))
    axis.legend(frameon=False)
    return figure


def paper_figures(key: str, outcomes: list[Outcome], folder: Path) -> list[str]:
    """Write the figures of an example; returns their file names."""
    written = []

    def save(name: str, figure: Figure) -> None:
        figure.savefig(folder / f"{name}.png", dpi=110)
        written.append(f"{name}.png")

    main = outcomes[0]
    steps = main.meshes
    named = {"initial": steps[0]} | {f"iteration {i}": mesh for i, mesh in enumerate(steps) if i}
    first_three = {label: named[label] for label in list(named)[:4]}
    compared = {"initial": steps[0]} | {o.label: o.meshes[-1] for o in outcomes if o.label != "laplacian"}

    def row(*labels: str) -> list[tuple[str, Mesh]]:
        return [(label, named[label]) for label in labels]

    if key == "1":
        save("fig05-example1-initial", mesh_row(row("initial")))
        save("fig06-example1", mesh_row(row("initial", "iteration 1", "iteration 3"), arrows=True))
        save("fig07-example1-boxes", box_plot(main))
        save("fig08-example1-histogram", histogram(first_three))
    elif key == "2":
        save("fig10-example2", mesh_row(row("initial", "iteration 1", "iteration 3"), arrows=True))
        save("fig11-example2-boxes", box_plot(main))
        save("fig12-example2-histogram", histogram(first_three))
    elif key == "2-quadratic":
        save("fig13-example2-quadratic", mesh_row(row("initial", "iteration 1", "iteration 3")))
    elif key == "3":
        save("fig14-example3", mesh_row(row("initial", "iteration 3"), low=0.5, arrows=True))
        save("fig15-example3-boxes", box_plot(main))
        save("fig16-example3-histogram", histogram(first_three))
    elif key == "3-extruded":
        save("fig17-example3-extruded", mesh_row(row("initial", "iteration 2"), low=0.5))
        save("fig18-example3-extruded-histogram", histogram(first_three))
    elif key == "4":
        save("fig19-example4", mesh_row(row("initial", "iteration 2"), low=0.5))
        save("fig20-example4-extended", mesh_row(row("iteration 2", "iteration 3"), low=0.5))
        save("fig21-example4-rear", mesh_row(row("iteration 3"), low=0.5, view=(120, 25)))
        save("fig22-example4-boxes", box_plot(main))
        save("fig23-example4-histogram", histogram(first_three))
        save("fig24-example4-methods", histogram({o.label: o.meshes[-1] for o in outcomes}))
    else:
        number = {"5": (25, 26), "6": (27, 28)}[key]
        save(f"fig{number[0]}-example{key}", mesh_row(row("initial", "iteration 3")))
        save(f"fig{number[1]}-example{key}-methods", histogram(compared))
    return written
