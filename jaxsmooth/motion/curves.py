"""Curves through nodes: the boundary of plane meshes and the feature edges of solids, on the host."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from jaxsmooth.mesh.topology import lengths
from jaxsmooth.motion.sides import Segments

__all__ = ["Curves", "Layout", "Located", "arc_bulge", "find_curves"]

_TINY = np.finfo(float).tiny


class Located(NamedTuple):
    """Nodes ``[s]``, a patch that each lies on ``[s]``, and where: barycentric coordinates ``[s, p + 1]``."""

    nodes: np.ndarray
    home: np.ndarray
    start: np.ndarray

    def select(self, mask: np.ndarray, places: np.ndarray) -> Located:
        """The nodes of a mask ``[nodes]``, each once, on a patch that no numbering decides.

        It is the first by the coordinates of their centres, `places` ``[f, dim]``, but for rounding."""
        size = np.abs(places).max(initial=0) or 1.0
        rank = np.zeros(len(places), int)
        rank[np.lexsort(np.round(places / size, 9).T)] = np.arange(len(places))
        chosen = np.argsort(rank[self.home], kind="stable")
        chosen = chosen[mask[self.nodes[chosen]]]
        chosen = chosen[np.unique(self.nodes[chosen], return_index=True)[1]]
        return Located(*(part[chosen] for part in self))

    def without(self, mask: np.ndarray) -> Located:
        """All but the nodes of a mask ``[nodes]``."""
        return Located(*(part[~mask[self.nodes]] for part in self))


@dataclass(frozen=True)
class Layout:
    """Quadratic simplices ``S(λ) = Σ λᵢ xᵢ + Σ 4 λⱼ λₖ bᵢ``, edge i being the one that vertex i is not on.

    Attributes:
        vertices: numbers of the vertices ``[f, p + 1]``.
        neighbours: the simplex behind the side that vertex i is not on ``[f, p + 1]``; −1 for none.
        corners: x, ``[f, p + 1, dim]``.
        bulges: b, ``[f, edges, dim]``; of a curve the only one.
        located: the nodes on them.
    """

    vertices: np.ndarray
    neighbours: np.ndarray
    corners: np.ndarray
    bulges: np.ndarray
    located: Located

    @cached_property
    def directions(self) -> np.ndarray:
        """Unit tangents of a curve, or normals of a surface, at the vertices ``[f, p + 1, dim]``.

        Means over the patches at a vertex, by their angles there: they do not jump where patches meet.
        """
        many = self.vertices.shape[1]
        slopes = np.repeat(self.corners[:, None], many, axis=1)  # at each vertex, by each weight
        for i in range(many):
            for k in range(many):
                if i != k:
                    slopes[:, i, k] += 4 * self.bulges[:, 0 if many == 2 else 3 - i - k]
        frame = slopes[:, :, 1:] - slopes[:, :, :1]
        if many == 2:
            found = frame[:, :, 0] / np.maximum(np.linalg.norm(frame[:, :, 0], axis=-1), _TINY)[..., None]
            # curves may run either way on both sides of a vertex
            sign = np.array([1.0, -1.0])[:, None]
            return found if len(found) == 0 else _aligned(found, self, sign)
        found = np.cross(frame[:, :, 0], frame[:, :, 1])
        found /= np.maximum(np.linalg.norm(found, axis=-1), _TINY)[..., None]
        one = np.roll(self.corners, -1, axis=1) - self.corners
        two = np.roll(self.corners, -2, axis=1) - self.corners
        sine = np.linalg.norm(np.cross(one, two), axis=-1)
        angle = np.arctan2(sine, (one * two).sum(axis=-1))
        total = np.zeros((int(self.vertices.max(initial=-1)) + 1, 3))
        np.add.at(total, self.vertices, found * angle[..., None])
        size = np.linalg.norm(total, axis=1, keepdims=True)
        return (total / np.where(size > 0, size, 1))[self.vertices]

    def tangents(self, located: Located) -> np.ndarray:
        """Projectors onto the tangents at nodes ``[s, dim, dim]``."""
        along = (self.directions[located.home] * located.start[..., None]).sum(axis=1)
        square = np.einsum("si,sj->sij", along, along)
        square = square / np.maximum((along**2).sum(axis=1), _TINY)[:, None, None]
        return square if self.vertices.shape[1] == 2 else np.eye(along.shape[1]) - square


def _aligned(found: np.ndarray, layout: Layout, sign: np.ndarray) -> np.ndarray:
    """Mean tangents ``[f, 2, dim]``: at each end of a segment that with the next one's, if there is one."""
    mean = found.copy()
    for end in range(2):
        other = layout.neighbours[:, 1 - end]  # behind the side that the other vertex is not on
        near = np.maximum(other, 0)
        same = layout.vertices[near] == layout.vertices[:, end : end + 1]
        its = np.where(same[:, :1], found[near, 0] * sign[0], found[near, 1] * sign[1])
        into = found[:, end] * sign[end]  # both leave the vertex
        long = np.linalg.norm(layout.corners[:, 1] - layout.corners[:, 0], axis=1)
        joint = (into * long[near][:, None] - its * long[:, None]) * sign[end]
        size = np.linalg.norm(joint, axis=1, keepdims=True)
        chosen = (other >= 0)[:, None] & (size > 0)
        mean[:, end] = np.where(chosen, joint / np.where(size > 0, size, 1), found[:, end])
    return mean


@dataclass(frozen=True)
class Curves:
    """Curves along segments.

    Attributes:
        segments: each once.
        bulge: of each segment ``[m, dim]``.
        layout: the curves.
        smooth: nodes at which a curve goes on smoothly, and inner nodes of segments ``[nodes]``.
    """

    segments: Segments
    bulge: np.ndarray
    layout: Layout
    smooth: np.ndarray


def find_curves(
    segments: Segments,
    points: np.ndarray,
    straight: np.ndarray,
    corner_angle: float,
    tolerance: float,
) -> Curves:
    """Join segments to curves, which go on where two of them meet at less than the corner angle.

    Tangents at nodes are those of the circle through three nodes; at the ends of a curve, those of an arc
    that has the right tangent at the other end of the segment.

    Args:
        segments: each once.
        points: ``[nodes, dim]``.
        straight: nodes on straight lines, which have no need of a curve ``[nodes]``.
        corner_angle: in degrees.
        tolerance: the largest deviation from straight segments, over the length of the segment.
    """
    count, ends = len(points), segments.ends
    # both segments at each node
    flat = ends.reshape(-1)
    order = np.argsort(flat, kind="stable")
    number = np.bincount(flat, minlength=count)
    first = np.cumsum(number) - number
    two = np.flatnonzero(number == 2)
    pair = order[first[two][:, None] + [0, 1]]  # positions in `flat`: 2 segment + end
    leave = segments.leave.reshape(len(flat), -1)
    turn = _angle(leave[pair[:, 0]], -leave[pair[:, 1]])
    on_line = np.any(straight[ends], axis=1)
    junction = on_line[pair // 2].sum(axis=1) == 1
    goes_on = (turn < np.deg2rad(corner_angle)) & ~straight[two]
    tangent, known = _tangents(segments, points, two[goes_on], pair[goes_on], on_line)
    going = goes_on & ~junction
    nodes, pair = two[going], pair[going]
    neighbour = np.full(len(flat), -1)
    neighbour[pair[:, 0]], neighbour[pair[:, 1]] = pair[:, 1] // 2, pair[:, 0] // 2
    bulge = np.where(
        segments.bent[:, None], segments.bulge, _bulges(segments, points, tangent, known, tolerance)
    )
    bulge[on_line & ~segments.bent] = 0
    smooth = np.zeros(count, bool)
    smooth[nodes] = True
    inner = segments.inner[segments.inner >= 0]
    smooth[inner] = ~straight[inner]
    # the side that end 0 is not on is end 1
    layout = Layout(ends, neighbour.reshape(-1, 2)[:, ::-1], points[ends], bulge[:, None], _located(segments))
    return Curves(segments, bulge, layout, smooth)


def _located(segments: Segments) -> Located:
    many, places = segments.inner.shape[1], np.eye(2)
    nodes = np.concatenate([segments.ends, segments.inner], axis=1)
    inside = (np.arange(many) + 1) / (many + 1)
    where = np.concatenate([places, np.c_[1 - inside, inside]])
    home = np.repeat(np.arange(len(nodes)), nodes.shape[1])
    start, nodes = np.tile(where, (len(segments.ends), 1)), nodes.reshape(-1)
    return Located(nodes[nodes >= 0], home[nodes >= 0], start[nodes >= 0])


def _tangents(
    segments: Segments, points: np.ndarray, nodes: np.ndarray, pair: np.ndarray, on_line: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Tangents into the segments at both ends ``[m, 2, dim]``, where they follow from the next segment."""
    tangent = np.zeros((len(segments.ends) * 2, points.shape[1]))
    known = np.zeros(len(tangent), bool)
    long = np.repeat(lengths(points, segments.ends), 2)
    leave = segments.leave.reshape(len(tangent), -1)
    for mine, other in (pair.T, pair.T[::-1]):
        mean = leave[mine] * long[other][:, None] - leave[other] * long[mine][:, None]
        mean = np.where(on_line[other // 2][:, None], -leave[other], mean)
        size = np.linalg.norm(mean, axis=1, keepdims=True)
        tangent[mine] = mean / np.where(size > 0, size, 1)
        known[mine] = size[:, 0] > 0
    return tangent.reshape(-1, 2, points.shape[1]), known.reshape(-1, 2)


def _bulges(
    segments: Segments, points: np.ndarray, tangent: np.ndarray, known: np.ndarray, tolerance: float
) -> np.ndarray:
    chord = points[segments.ends[:, 1]] - points[segments.ends[:, 0]]
    size = np.linalg.norm(chord, axis=1)
    along = chord / np.where(size > 0, size, 1)[:, None]
    ahead = tangent * np.array([1.0, -1.0])[:, None]  # both from the first end to the second
    mirrored = 2 * np.einsum("med,md->me", ahead, along)[..., None] * along[:, None] - ahead
    ahead = np.where(
        known[..., None], ahead, np.where(known[:, ::-1, None], mirrored[:, ::-1], along[:, None])
    )
    change = (ahead[:, 0] - ahead[:, 1]) / 2
    across = change - np.einsum("md,md->m", change, along)[:, None] * along
    sine = np.linalg.norm(across, axis=1)
    found = arc_bulge(size, sine)[:, None] * across / np.where(sine > 0, sine, 1)[:, None]
    return _clipped(found, tolerance * size)


def arc_bulge(chord: np.ndarray, sine: np.ndarray) -> np.ndarray:
    """Height of an arc over its chord, from the sine of the angle between them: ``c/2 · tan(θ/2)``."""
    sine = np.clip(sine, -1, 1)
    return chord / 2 * sine / (1 + np.sqrt(1 - sine**2))


def _clipped(vectors: np.ndarray, bound: np.ndarray) -> np.ndarray:
    """Vectors ``[m, dim]`` no longer than a bound ``[m]``."""
    size = np.linalg.norm(vectors, axis=1)
    return vectors * np.minimum(1, bound / np.where(size > 0, size, 1))[:, None]


def _angle(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    dot = np.einsum("md,md->m", one, other)
    return np.arctan2(np.sqrt(np.maximum(1 - dot**2, 0)), dot)
