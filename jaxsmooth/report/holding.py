"""Why nodes may not go everywhere: one reason a node, for reports."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from jaxsmooth.mesh.layers import layer_nodes
from jaxsmooth.mesh.record import Mesh
from jaxsmooth.mesh.topology import Facets, kept_facets
from jaxsmooth.motion.base import Motion

__all__ = ["REASONS", "Holding", "holding"]

REASONS = (
    "free",
    "slides on a face",
    "slides along an edge",
    "follows other nodes",
    "held: by the file",
    "held: boundary layer",
    "held: edge or corner",
    "held: curved boundary",
    "held: flat boundary",
    "held: between regions",
    "held: by an option",
)
"""What a node may do, and why not more; of several that hold it the first counts."""

_FOLD = np.cos(np.deg2rad(25))  # of normals about their mean: half of the 50° that make an edge
_FLAT = np.cos(np.deg2rad(0.1))


@dataclass(frozen=True)
class Holding:
    """Attributes: for each node the place of its reason in `REASONS` ``[nodes]``."""

    reason: np.ndarray

    def counts(self) -> list[tuple[str, int]]:
        """Reasons that occur, and how many nodes have them."""
        found = np.bincount(self.reason, minlength=len(REASONS))
        return [(name, int(number)) for name, number in zip(REASONS, found, strict=True) if number]

    def of(self, nodes: np.ndarray) -> str:
        """What holds an element, in words: of nodes ``[k]``."""
        names, numbers = np.unique(self.reason[nodes], return_counts=True)
        order = np.argsort(-numbers, kind="stable")
        parts = [f"{numbers[i]} {REASONS[names[i]].removeprefix('held: ')}" for i in order]
        return ", ".join(parts)


def holding(mesh: Mesh, motion: Motion, asked: np.ndarray | None = None) -> Holding:
    """The reasons of all nodes of a mesh at its points; an option holds those `asked` for ``[nodes]``."""
    admissible = motion.at(mesh.points)
    freedom, facets = admissible.freedom, kept_facets(mesh)
    dim, count = mesh.dim, len(mesh.points)
    reason = np.zeros(count, np.uint8)
    reason[freedom == dim - 1] = 1 if dim == 3 else 2
    reason[freedom == dim - 2] = 2
    held = freedom == 0
    outer, between = np.zeros(count, bool), np.zeros(count, bool)
    for part in facets:
        outer[part.nodes[part.partner < 0]] = True
        between[part.nodes[(part.partner >= 0) & (part.partner != part.region)]] = True
    edge, flat = _folds(np.asarray(mesh.points, np.float64), facets)
    marked = np.zeros(count, bool)
    if mesh.labels is not None and mesh.labels.held is not None:
        marked = np.asarray(mesh.labels.held)
    layers = layer_nodes(mesh, facets) if held.any() else held
    asked = np.zeros(count, bool) if asked is None else asked
    chain = (
        (asked, 10),
        (marked, 4),
        (layers, 5),
        (outer & edge, 6),
        (outer & flat, 8),
        (outer, 7),
        (between, 9),
    )
    rest = held.copy()
    for mask, code in chain:
        reason[rest & mask] = code
        rest &= ~mask
    reason[rest] = 10
    if admissible.links is not None:
        reason[np.asarray(admissible.links.dependent)] = 3
    return Holding(reason)


def _folds(points: np.ndarray, facets: list[Facets]) -> tuple[np.ndarray, np.ndarray]:
    """Nodes where the boundary has an edge or a corner, and where it is flat ``[nodes]``."""
    count, dim = points.shape
    total, parts = np.zeros((count, dim)), []
    for part in facets:
        nodes = part.nodes[part.partner < 0]
        corners = points[nodes[:, : part.type.corners]]
        if dim == 2:
            way = corners[:, 1] - corners[:, 0]
            normal = np.stack([way[:, 1], -way[:, 0]], axis=1)
        else:
            normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, -1] - corners[:, 0])
        size = np.linalg.norm(normal, axis=1, keepdims=True)
        normal = normal / np.where(size > 0, size, 1)
        parts.append((nodes, normal))
        for column in nodes.T:
            np.add.at(total, column, normal)
    size = np.linalg.norm(total, axis=1, keepdims=True)
    mean = total / np.where(size > 0, size, 1)
    least = np.ones(count)
    for nodes, normal in parts:
        for column in nodes.T:
            np.minimum.at(least, column, (mean[column] * normal).sum(axis=1))
    return least < _FOLD, least > _FLAT
