"""What a user can do: what holds the nodes, which elements stay worst, what would help."""

from __future__ import annotations

from textwrap import wrap
from typing import Any

import jax.numpy as jnp
import numpy as np
from rich.console import Console

from jaxsmooth.convert.meshfile import MeshFile
from jaxsmooth.mesh.record import Mesh
from jaxsmooth.methods.optimize.problem import Aggregation, movable, problem
from jaxsmooth.metrics.shape import MEAN_RATIO
from jaxsmooth.metrics.summary import POOR, evaluated
from jaxsmooth.metrics.validity import inverted
from jaxsmooth.motion.base import Motion
from jaxsmooth.report.holding import Holding
from jaxsmooth.report.quality import centroids

__all__ = [
    "advice",
    "print_held",
    "print_inverted",
    "print_worst",
    "still_inverted",
    "worst_elements",
]

_MOSTLY = 0.5  # part of the nodes that are held, from which on advice is given
_HINTS = {
    "held: by the file": "the file marks them; take the mark off there",
    "held: boundary layer": "--layers free lets them move",
    "held: curved boundary": "--boundary slide lets them slide on their curved faces",
    "held: edge or corner": "--feature-angle DEG decides what is an edge",
    "held: flat boundary": "--boundary planar lets them slide on their flat faces",
    "held: between regions": "--interfaces slide lets them slide between the materials",
    "held: by an option": "leave out --fix, --freeze-aspect or --boundary fixed",
}
_LISTED = 5


def held_counts(held: Holding) -> dict[str, int]:
    """Numbers of held nodes by reason, the most frequent first."""
    counts = {name: number for name, number in held.counts() if name in _HINTS}
    return dict(sorted(counts.items(), key=lambda item: -item[1]))


def advice(held: Holding) -> list[str]:
    """Where most nodes are held: a line for each reason, the most frequent first, on how to free them."""
    counts = held_counts(held)
    if sum(counts.values()) <= _MOSTLY * len(held.reason):
        return []
    return [f"{n:,} {name.removeprefix('held: ')}: {_HINTS[name]}" for name, n in counts.items()]


def print_held(out: Console, held: Holding) -> None:
    """What holds the nodes; where that is most of them, how to free them."""
    counts = held_counts(held)
    if not counts:
        return
    parts = [f"{number:,} {name.removeprefix('held: ')}" for name, number in counts.items()]
    out.print(f"held: {', '.join(parts)}")
    if sum(counts.values()) > _MOSTLY * len(held.reason):
        out.print("  most nodes are held:", style="yellow")
    for line in advice(held):
        out.print(f"  {line}", style="yellow")


def worst_elements(file: MeshFile, mesh: Mesh, held: Holding, count: int = _LISTED) -> list[dict[str, Any]]:
    """The elements of least quality that are poor, with their place and what their nodes may do.

    Args:
        file: what was read.
        mesh: the mesh now, in the order of the file.
        held: of its nodes.
        count: of elements at the most.
    """
    rows = []
    for kind, q, nodes, places in zip(
        mesh.types, evaluated(mesh).quality, mesh.connectivity, centroids(file, mesh), strict=True
    ):
        q = np.asarray(q, np.float64)
        for element in np.argsort(q, kind="stable")[:count]:
            if q[element] < POOR:
                row = {"type": kind, "element": int(element), "q": float(q[element])}
                place = [float(x) for x in places[element]]
                rows.append({**row, "place": place, "nodes": held.of(np.asarray(nodes)[element])})
    return sorted(rows, key=lambda row: row["q"])[:count]


def still_inverted(file: MeshFile, mesh: Mesh, motion: Motion, held: Holding) -> list[dict[str, Any]]:
    """The inverted elements, those first that can't be repaired: inverted where all nodes are held.

    Args:
        file: what was read.
        mesh: the mesh now, in the order of the file.
        motion: what its nodes may do.
        held: in words.
    """
    tangled = [np.asarray(part) for part in inverted(mesh)]
    if not any(part.any() for part in tangled):
        return []
    sizes = tuple(jnp.ones(len(part), mesh.points.dtype) for part in tangled)
    task = problem(mesh.bare, motion, sizes, Aggregation(0.0, 1.0, 1.0), MEAN_RATIO)
    hopeless, free = task.hopeless(mesh.points), np.asarray(movable(motion.at(mesh.points)))
    rows = []
    for kind, now, out, nodes, places in zip(
        mesh.types, tangled, hopeless, mesh.connectivity, centroids(file, mesh), strict=True
    ):
        nodes = np.asarray(nodes)
        out = np.asarray(out).reshape(-1)[: len(nodes)] | ~free[nodes].any(axis=1)
        rows += [
            {
                "type": kind,
                "element": int(element),
                "place": [float(x) for x in places[element]],
                "nodes": held.of(nodes[element]),
                "repairable": not out[element],
            }
            for element in np.flatnonzero(now)
        ]
    return sorted(rows, key=lambda row: row["repairable"])


def print_inverted(out: Console, rows: list[dict[str, Any]]) -> None:
    """How many, how many of them can't be repaired, and the first of both."""
    for repairable, why in (
        (False, "can't be repaired, for all nodes on which that depends are held"),
        (True, "were not repaired"),
    ):
        some = [row for row in rows if row["repairable"] is repairable]
        if some:
            names = ", ".join(f"{row['type']} {row['element']}" for row in some[:_LISTED])
            more = ", …" if len(some) > _LISTED else ""
            out.print(f"{len(some):,} inverted elements {why}:", style="yellow")
            out.print(f"  {names}{more}", style="yellow")


def print_worst(out: Console, rows: list[dict[str, Any]]) -> None:
    """Two lines an element, if there are any."""
    if rows:
        out.print("worst elements (numbered from 0 in their type), and their nodes:")
    for row in rows:
        place = ", ".join(f"{x:.4g}" for x in row["place"])
        out.print(f"{row['type']:>12} {row['element']:>9}  q {row['q']:7.4f}  at ({place})")
        for line in wrap(f"nodes: {row['nodes']}", 64):
            out.print(f"{'':>12} {line}", style="dim")
