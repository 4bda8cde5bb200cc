"""States of a mesh as the viewer of a report takes them: numbers in base64, facets as rings of nodes."""

from __future__ import annotations

import base64
from collections.abc import Mapping
from typing import Any

import numpy as np

from jaxsmooth.cells.table import ElementType
from jaxsmooth.mesh.record import Mesh
from jaxsmooth.mesh.topology import kept_facets
from jaxsmooth.metrics.summary import evaluated
from jaxsmooth.report.holding import REASONS, Holding

__all__ = ["COLOURS", "scene"]

COLOURS = (
    *("#dfe6ea", "#7db8d3", "#2f6fb3", "#8a63c7"),
    *("#111827", "#0f8a6a", "#b3203c", "#e07a1f", "#c9a227", "#7a4b2a", "#d1479b"),
)
"""Colours of `REASONS`."""

_BUDGET = 1_000_000  # node numbers in a file: 4 MB, 5.3 in base64
_QUALITY = 32_000  # what q = 1 is stored as


def scene(states: Mapping[str, Mesh], held: Holding) -> dict[str, Any]:
    """What the viewer draws.

    Meshes of up to a quarter of a million tetrahedra are there as a whole; of larger ones the boundary and
    the poorest elements.

    Args:
        states: by name, meshes of one topology, the input first.
        held: what its nodes may do.
    """
    before, *_ = states.values()
    q = [[np.asarray(part) for part in evaluated(mesh).quality] for mesh in states.values()]
    kept = _kept(before, q)
    blocks, rows = [], []
    for b, (kind, nodes) in enumerate(before.blocks):
        chosen = np.flatnonzero(kept[b])
        if len(chosen):
            blocks.append(_block(kind, np.asarray(nodes)[chosen]))
            rows.append((b, chosen))
    values = [[side[b][chosen] for b, chosen in rows] for side in q]
    if not all(mask.all() for mask in kept):
        for block, owners in _skin(before, kept):
            blocks.append(block)
            for side, parts in zip(values, q, strict=True):
                side.append(np.concatenate(parts)[owners])
    wide = len(before.points) > 2**16 - 1
    for block in blocks:
        block["nodes"] = _text(block["nodes"], np.uint32 if wide else np.uint16)
    moved = [np.linalg.norm(_space(mesh) - _space(before), axis=1) for mesh in states.values()]
    farthest = float(max(part.max(initial=0.0) for part in moved))
    numbers = np.bincount(held.reason, minlength=len(REASONS))
    return {
        "dim": before.dim,
        "flat": all(kind.dim == 2 for kind, _ in before.blocks),
        "wide": wide,
        "states": [
            {
                "name": name,
                "points": _text(_space(mesh), np.float32),
                "quality": _text(_stored(np.concatenate(side)), np.int16),
                "moved": _text(np.rint(65535 * part / (farthest or 1)), np.uint16),
            }
            for (name, mesh), side, part in zip(states.items(), values, moved, strict=True)
        ],
        "blocks": blocks,
        "ids": None if all(mask.all() for mask in kept) else [int(i) for _, part in rows for i in part],
        "reason": _text(held.reason, np.uint8),
        "reasons": [
            {"name": name, "colour": colour, "count": int(number)}
            for name, colour, number in zip(REASONS, COLOURS, numbers, strict=True)
        ],
        "farthest": f"{farthest:.3g}",
        "rows": rows,
    }


def _kept(mesh: Mesh, q: list[list[np.ndarray]]) -> list[np.ndarray]:
    """Masks of the elements that are there as such: all, or the poorest."""
    cost = np.concatenate([np.full(len(nodes), kind.k) for kind, nodes in mesh.blocks])
    poorest = np.minimum.reduce([np.concatenate(side) for side in q])
    order = np.argsort(poorest, kind="stable")
    total = np.cumsum(cost[order])
    most = _BUDGET if total[-1] <= _BUDGET else _BUDGET // 4
    kept = np.zeros(len(cost), bool)
    kept[order[total <= most]] = True
    return np.split(kept, np.cumsum([len(nodes) for _, nodes in mesh.blocks])[:-1])


def _rings(kind: ElementType) -> tuple[list[list[int]], bool]:
    """Of every facet the nodes around it, and whether every second one is in the middle of a side."""
    if kind.dim == 2:
        return [kind.outline.tolist()], not kind.linear
    rings = [nodes[group.type.outline].tolist() for group in kind.facets for nodes in group.nodes]
    return rings, not kind.linear


def _block(kind: ElementType, nodes: np.ndarray) -> dict[str, Any]:
    rings, curved = _rings(kind)
    used = sorted({node for ring in rings for node in ring})
    place = {node: index for index, node in enumerate(used)}
    return {
        "name": kind.name,
        "count": len(nodes),
        "k": len(used),
        "curved": curved,
        "facets": [[place[node] for node in ring] for ring in rings],
        "nodes": nodes[:, used].ravel(),
    }


def _skin(mesh: Mesh, kept: list[np.ndarray]) -> list[tuple[dict[str, Any], np.ndarray]]:
    """Boundary facets of the elements that are not there, as blocks, with the numbers of these."""
    found, sides = [], {}
    start = 0
    for (kind, nodes), mask in zip(mesh.blocks, kept, strict=True):
        for group in kind.facets:
            owner = np.repeat(np.arange(start, start + len(nodes)), len(group.nodes))
            sides.setdefault(group.type, []).append((owner, np.repeat(~mask, len(group.nodes))))
        start += len(nodes)
    for part in kept_facets(mesh):
        owner, absent = (np.concatenate(column) for column in zip(*sides[part.type], strict=True))
        chosen = absent & (part.partner < 0)
        if chosen.any() and part.type.dim == 2:
            found.append((_block(part.type, part.nodes[chosen]), owner[chosen]))
    return found


def _space(mesh: Mesh) -> np.ndarray:
    points = np.asarray(mesh.points, np.float64)
    return np.pad(points, ((0, 0), (0, 3 - points.shape[1])))


def _stored(q: np.ndarray) -> np.ndarray:
    return np.rint(np.clip(np.nan_to_num(q, nan=-1), -1, 1) * _QUALITY)


def _text(values: np.ndarray, dtype: Any) -> str:
    return base64.b64encode(np.asarray(values).astype(np.dtype(dtype).newbyteorder("<")).tobytes()).decode()
