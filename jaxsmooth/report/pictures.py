"""Pictures of meshes and their quality, with matplotlib alone: no display, no GPU needed."""

from __future__ import annotations

from typing import Any

import numpy as np

from jaxsmooth.mesh.record import Mesh
from jaxsmooth.mesh.topology import kept_facets
from jaxsmooth.metrics.summary import evaluated

try:
    from matplotlib.axes import Axes
    from matplotlib.collections import PolyCollection
    from matplotlib.colors import LinearSegmentedColormap, Normalize
    from matplotlib.figure import Figure
except ImportError as missing:
    raise ImportError("pictures need matplotlib; install it with: pip install 'jaxsmooth[viz]'") from missing

__all__ = ["before_after", "draw_mesh", "draw_poor_elements", "histogram"]

POOR = 0.2
_INK, _BEFORE, _AFTER = "#1d2b36", "#c8502d", "#1f6f8b"
_QUALITY = LinearSegmentedColormap.from_list(
    "quality", ["#a3122e", "#e8743b", "#f6d55c", "#b9dcd2", "#f4f8f7"]
)
_BINS = np.linspace(0, 1, 21).tolist()


def before_after(before: Mesh, after: Mesh, title: str = "", view: tuple[float, float] = (-55, 28)) -> Figure:
    """A figure: the mesh before and after, its worst elements visible, and both histograms.

    Args:
        before: the input mesh.
        after: the same topology, smoothed.
        title: a line above.
        view: azimuth and elevation in degrees (3D).
    """
    figure = Figure(figsize=(15, 5.2), layout="constrained")
    axes = figure.subplots(1, 3, width_ratios=(1, 1, 0.85))
    for axis, mesh, label in zip(axes, (before, after), ("before", "after"), strict=False):
        q = np.concatenate(_quality(mesh))
        if mesh.dim == 3:
            draw_poor_elements(axis, mesh, limit=POOR, view=view)
        else:
            draw_mesh(axis, mesh)
        axis.set_title(
            f"{label}:  {int((q < POOR).sum()):,} of {len(q):,} elements below q = {POOR}\n"
            f"q_min {q.min():.3f}    q_avg {q.mean():.3f}",
            color=_INK,
        )
    histogram(axes[2], before, after)
    figure.suptitle(title, color=_INK, parse_math=False)  # names of files may have a $
    return figure


def _quality(mesh: Mesh) -> list[np.ndarray]:
    return [np.asarray(part) for part in evaluated(mesh).quality]


def histogram(axis: Axes, before: Mesh, after: Mesh) -> None:
    """Elements by quality before and after, on a logarithmic scale that shows the few worst."""
    values = [np.concatenate(_quality(mesh)) for mesh in (before, after)]
    values = [np.clip(v, 1e-9, 1) for v in values]
    axis.hist(values[1], _BINS, color=_AFTER, alpha=0.75, label="after")
    axis.hist(values[0], _BINS, color=_BEFORE, histtype="step", linewidth=1.8, label="before")
    axis.set(xlabel="quality q", ylabel="elements", yscale="log", xlim=(0, 1))
    axis.axvline(POOR, color=_INK, linewidth=0.8, linestyle=":")
    axis.legend(frameon=False, loc="upper left")
    axis.spines[["top", "right"]].set_visible(False)


def draw_mesh(
    axis: Axes, mesh: Mesh, *, edges: bool = True, view: tuple[float, float] = (-55, 28)
) -> PolyCollection:
    """Draw a mesh coloured by quality: 2D elements, or the surface of a solid with shading."""
    colours = Normalize(0, 1)
    if mesh.dim == 2:
        shapes, values = [], []
        for (kind, nodes), q in zip(mesh.blocks, _quality(mesh), strict=True):
            shapes += list(np.asarray(mesh.points)[np.asarray(nodes)[:, kind.outline]])
            values.append(np.asarray(q))
        faces = _QUALITY(colours(np.concatenate(values)))
    else:
        shapes, depth, shade, values = _element_facets(mesh, None, view, outer=True)
        order = np.argsort(depth)
        faces = _QUALITY(colours(values[order])) * shade[order, None]
        faces[:, 3] = 1
        shapes = [shapes[i] for i in order]
    return _add(axis, shapes, faces, _INK if edges else "none", 0.25)


def draw_poor_elements(
    axis: Axes, mesh: Mesh, *, limit: float = 0.3, view: tuple[float, float] = (-55, 28)
) -> None:
    """Draw a solid as a pale shape with its elements below `limit` visible inside."""
    shapes, depth, shade, _ = _element_facets(mesh, None, view, outer=True)
    order = np.argsort(depth)
    grey = np.ones((len(order), 4)) * np.array([0.80, 0.84, 0.87, 1]) * shade[order, None]
    grey[:, 3] = 1
    _add(axis, [shapes[i] for i in order], grey, "#9fb0bb", 0.15)
    shapes, depth, shade, values = _element_facets(mesh, limit, view, outer=False)
    order = np.argsort(depth)
    faces = _QUALITY(Normalize(0, 1.6 * limit)(values[order])) * (0.6 + 0.4 * shade[order, None])
    faces[:, 3] = 0.9
    _add(axis, [shapes[i] for i in order], np.clip(faces, 0, 1), "#7a1026", 0.2)


def _add(axis: Axes, shapes: list[np.ndarray], faces: Any, edge: str, width: float) -> PolyCollection:
    drawn = PolyCollection(shapes, facecolors=faces, edgecolors=edge, linewidths=width)
    axis.add_collection(drawn)
    axis.set_aspect("equal")
    axis.autoscale_view()
    axis.set_axis_off()
    return drawn


def _element_facets(
    mesh: Mesh, limit: float | None, view: tuple[float, float], outer: bool
) -> tuple[list[np.ndarray], np.ndarray, np.ndarray, np.ndarray]:
    """Facets towards the viewer: polygons, depths, shades, and the quality of their elements."""
    azimuth, elevation = np.deg2rad(view)
    towards = np.array(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
    )
    right = np.array([-np.sin(azimuth), np.cos(azimuth), 0])
    plane = np.stack([right, np.cross(towards, right)], axis=1)
    light = towards + 0.6 * plane[:, 1] - 0.5 * plane[:, 0]
    light /= np.linalg.norm(light)
    points = np.asarray(mesh.points, np.float64)

    groups: list[tuple[np.ndarray, np.ndarray]] = []
    if outer:
        for facets in kept_facets(mesh):
            chosen = facets.nodes[facets.partner < 0][:, : facets.type.corners]
            groups.append((chosen, np.ones(len(chosen))))
    else:
        for (kind, nodes), q in zip(mesh.blocks, _quality(mesh), strict=True):
            q = np.asarray(q)
            chosen = np.asarray(nodes)[q < limit]
            if kind.dim == 2:
                groups.append((chosen[:, : kind.corners], q[q < limit]))
                continue
            for group in kind.facets:
                sides = chosen[:, group.nodes[:, : group.type.corners]]
                groups.append((sides.reshape(-1, sides.shape[-1]), np.repeat(q[q < limit], sides.shape[1])))
    shapes, depth, shade, values = [], [], [], []
    for nodes, q in groups:
        corners = points[nodes]
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, -1] - corners[:, 0])
        size = np.linalg.norm(normal, axis=1, keepdims=True)
        normal = normal / np.where(size > 0, size, 1)
        seen = (normal @ towards > 0) if outer else np.ones(len(nodes), bool)
        shapes += list(corners[seen] @ plane)
        depth.append((corners[seen] @ towards).mean(axis=1))
        shade.append(0.72 + 0.28 * np.abs(normal[seen] @ light))
        values.append(q[seen])
    empty = np.zeros(0)
    joined = [np.concatenate(part) if part else empty for part in (depth, shade, values)]
    return shapes, joined[0], joined[1], joined[2]
