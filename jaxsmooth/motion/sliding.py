"""What each node of the boundary slides on: a plane, a line, a curved face, a curve, or nothing."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import jax.numpy as jnp
import numpy as np

from jaxsmooth.mesh.topology import lengths, pair_codes
from jaxsmooth.motion.curved import Carrier, Patches, Sliding
from jaxsmooth.motion.curves import Curves, Layout, Located, find_curves
from jaxsmooth.motion.directions import Noise, facet_normals
from jaxsmooth.motion.features import Faces, find_faces, ridges
from jaxsmooth.motion.given import given
from jaxsmooth.motion.planar import Constraints
from jaxsmooth.motion.sides import Segments, Sides, segments_of
from jaxsmooth.motion.surfaces import build_surfaces

__all__ = ["Kept", "find_sliding"]

_REACH = 4.0  # edges that a node may move in a step
_RIGID = 1e-4  # mean square of what a rigid motion of size 1 has across the surface
_ALONG = np.cos(0.05)  # an edge that is off a straight line by more is not on it


@dataclass(frozen=True)
class Kept:
    """What is kept of a mesh while nodes slide.

    Attributes:
        points: ``[nodes, dim]``.
        noise: of the points.
        projectors: the planar rule's, for all nodes ``[nodes, dim, dim]``.
        flat: nodes whose facets all lie in one plane ``[nodes]``.
        sides: the facets whose shape is kept.
        lines: tagged lines.
        held: nodes that stay ``[nodes]``.
        bound: nodes that keep what the planar rule says ``[nodes]``.
        surfaces: a mask ``[nodes]`` and a function for each given surface.
    """

    points: np.ndarray
    noise: Noise
    projectors: np.ndarray
    flat: np.ndarray
    sides: list[Sides]
    lines: list[Segments]
    held: np.ndarray
    bound: np.ndarray
    surfaces: list[tuple[np.ndarray, Callable[[Any], Any]]]


def find_sliding(
    kept: Kept, feature_angle: float, tolerance: float, flatness: float | None, dtype: Any
) -> Constraints | Sliding:
    """The motion of all nodes: `Constraints` where nothing is curved.

    Args:
        kept: what is kept.
        feature_angle: in degrees.
        tolerance: how far curved surfaces may be off the facets, over the local length of edges.
        flatness: angle below which facets lie in one plane; None for what the noise says.
        dtype: of the motion.
    """
    points, dim = kept.points, kept.points.shape[1]
    quads = any(part.type.linear and part.type.corners == 4 for part in kept.sides)
    share = (0.5 if quads else 0.75) if dim == 3 else 1.0  # bulges of the edges of a facet add up inside
    faces = None
    known = [facet_normals(p.type, points[p.nodes], kept.noise.at(p.nodes), flatness) for p in kept.sides]
    bound = kept.bound.copy()
    for part, normals in zip(kept.sides, known, strict=True):
        bound[part.nodes[~normals.known]] = True  # those of facets without a normal
    kept = replace(kept, bound=bound)
    if dim == 3 and kept.sides:
        lines = np.concatenate([np.zeros((0, 2), int), *(part.ends for part in kept.lines)])
        precise = np.concatenate([part.tolerance for part in known])
        faces = find_faces(kept.sides, points, kept.flat, precise, lines, feature_angle)
        parts = [faces.edges.segments.select(faces.feature), *kept.lines]
    elif dim == 2:
        parts = [*(segments_of(p.type, p.nodes, points) for p in kept.sides), *kept.lines]
    else:
        parts = list(kept.lines)
    if not sum(len(part.ends) for part in parts):
        curves, straight, on_line = None, np.zeros(len(points), bool), np.zeros(len(points), bool)
    else:
        segments = Segments.join(parts).once(len(points))
        straight, on_line = _straight(kept, segments)
        curves = find_curves(segments, points, straight, feature_angle, tolerance * share)
    roles = _roles(kept, faces, curves, straight, on_line)
    return _motion(kept, faces, curves, roles, (feature_angle, tolerance * share), dtype)


def _straight(kept: Kept, segments: Segments) -> tuple[np.ndarray, np.ndarray]:
    """Nodes that the planar rule lets slide along all segments at them, and nodes of segments."""
    count = len(kept.points)
    one = np.rint(np.trace(kept.projectors, axis1=1, axis2=2)) == 1
    nodes = np.concatenate([segments.ends, segments.inner], axis=1)
    chord = kept.points[segments.ends[:, 1]] - kept.points[segments.ends[:, 0]]
    ways = np.stack([segments.leave[:, 0], segments.leave[:, 1], *[chord] * segments.inner.shape[1]], axis=1)
    there, nodes = nodes >= 0, np.maximum(nodes, 0)
    square = np.einsum("mnd,mnd->mn", ways, ways)
    along = np.einsum("mni,mnij,mnj->mn", ways, kept.projectors[nodes], ways) >= _ALONG**2 * square
    on_line, crooked = np.zeros(count, bool), np.zeros(count, bool)
    on_line[nodes[there]] = True
    crooked[nodes[there & ~along]] = True
    ends = np.bincount(segments.ends.reshape(-1), minlength=count)
    inner = np.zeros(count, bool)
    inner[segments.inner[segments.inner >= 0]] = True
    return one & on_line & ~crooked & ((ends >= 2) | inner), on_line


@dataclass(frozen=True)
class _Roles:
    """Masks ``[nodes]``: what slides along curves, on curved faces, and on each given surface."""

    along: np.ndarray
    on: np.ndarray
    given: list[np.ndarray]
    alone: np.ndarray  # nodes of given surfaces of which nothing else is known
    lost: np.ndarray  # nodes of edges that are neither straight nor curves


def _roles(
    kept: Kept, faces: Faces | None, curves: Curves | None, straight: np.ndarray, on_line: np.ndarray
) -> _Roles:
    count = len(kept.points)
    none = np.zeros(count, bool)
    free = ~kept.held & ~kept.bound
    free_along = none if curves is None else curves.smooth & ~straight & free
    touched, curved, beside, fans = none.copy(), none.copy(), none.copy(), none.copy()
    whose = [none.copy() for _ in kept.surfaces]
    facet = 0
    for part in kept.sides:
        touched[part.nodes] = True
        beside[part.nodes[part.given < 0]] = True
        for index, mask in enumerate(whose):
            mask[part.nodes[part.given == index]] = True
        if faces is not None:
            here = slice(facet, facet + len(part.nodes))
            curved[part.nodes[~faces.flat[here] & (part.given < 0)]] = True
        facet += len(part.nodes)
    if faces is not None:
        pairs = np.unique(np.c_[faces.edges.node, faces.vertex], axis=0)
        fans = np.bincount(pairs[:, 0], minlength=count) > 1
    # in the plane the line itself may be given
    on_feature = on_line if faces is not None else on_line & beside
    several = sum(mask.astype(int) for mask in whose) > 1 if whose else none
    inside = [
        (mask & ~on_feature & ~fans & ~several) | (named & ~touched & ~on_line)
        for mask, (named, _) in zip(whose, kept.surfaces, strict=True)
    ]
    alone = np.any(inside, axis=0) & free if inside else none
    along = free_along & ~alone
    tied = along | (straight & free)
    given_nodes = [
        (one & free) | (mask & tied & (faces is not None)) for one, mask in zip(inside, whose, strict=True)
    ]
    on = curved & ~on_feature & ~kept.flat & ~fans & free & ~alone
    lost = (on_line & ~straight & ~along & ~alone) | (fans & ~on_line)
    return _Roles(along, on, given_nodes, alone, lost & ~kept.bound)


def _motion(
    kept: Kept,
    faces: Faces | None,
    curves: Curves | None,
    roles: _Roles,
    bounds: tuple[float, float],
    dtype: Any,
) -> Constraints | Sliding:
    points, dim = kept.points, kept.points.shape[1]
    projectors = kept.projectors.copy()
    projectors[roles.lost | kept.held] = 0
    projectors[roles.along | roles.on | roles.alone] = np.eye(dim)
    layouts: list[tuple[Layout, Located, np.ndarray]] = []
    if curves is not None and roles.along.any():
        located = curves.layout.located.select(roles.along, curves.layout.corners.mean(axis=1))
        layouts.append((curves.layout, located, curves.segments.ends))
    if faces is not None and roles.on.any():
        rims = np.zeros(0, int), np.zeros((0, 3))
        if curves is not None:
            rims = pair_codes(curves.segments.ends, len(points)), curves.bulge
        angle, bound = bounds
        layout = build_surfaces(kept.sides, faces, points, rims, bound, np.deg2rad(angle))
        located = layout.located.select(roles.on, layout.corners.mean(axis=1))
        layouts.append((layout, located, faces.edges.segments.ends))
        projectors[roles.on] = ridges(faces, points)[roles.on]
    surfaces = [
        given(np.flatnonzero(mask), nearest)
        for mask, (_, nearest) in zip(roles.given, kept.surfaces, strict=True)
        if mask.any()
    ]
    if not layouts and not surfaces:
        return Constraints(jnp.asarray(projectors, dtype))
    tangents = projectors.copy()
    for layout, located, _ in layouts:
        normal = np.eye(dim) - layout.tangents(located)
        both = projectors[located.nodes]  # a ridge takes one direction from the tangents
        tangents[located.nodes] = layout.tangents(located) if dim == 2 else both - normal
    for carrier in surfaces:
        nodes = np.asarray(carrier.nodes)
        only = nodes[roles.alone[nodes]]
        tangents[only] = np.asarray(carrier.tangents(jnp.asarray(points[nodes], dtype)))[roles.alone[nodes]]
    stays = np.zeros(len(points), bool)
    stays[anchors(points, tangents)] = True
    projectors[stays] = 0
    carriers: list[Carrier] = [
        _patches(layout, located.without(stays), _reach(points, pairs), dtype)
        for layout, located, pairs in layouts
    ]
    for carrier in surfaces:
        nodes = np.asarray(carrier.nodes)
        carriers.append(given(nodes[~stays[nodes]], carrier.nearest))
    return Sliding(jnp.asarray(projectors, dtype), tuple(carriers))


def anchors(points: np.ndarray, projectors: np.ndarray) -> list[int]:
    """Nodes to hold, one for each rigid motion that the boundary would allow.

    A ball may turn within its own surface: elasticity has nothing against it, and nothing says how far.
    """
    count, dim = points.shape
    away = points - points.mean(axis=0)
    away = away / max(np.abs(away).max(), np.finfo(float).tiny)
    pairs = [(0, 1)] if dim == 2 else [(1, 2), (2, 0), (0, 1)]
    rigid = np.zeros((count, dim, dim + len(pairs)))
    rigid[:, np.arange(dim), np.arange(dim)] = 1
    for mode, (i, j) in enumerate(pairs):
        rigid[:, i, dim + mode], rigid[:, j, dim + mode] = -away[:, j], away[:, i]
    rest = np.einsum("nij,njm->nim", np.eye(dim) - projectors, rigid)
    bound = (np.abs(projectors - np.eye(dim)) > 1e-9).any(axis=(1, 2))
    held: list[int] = []
    for _ in range(dim + len(pairs)):
        matrix = np.einsum("nim,nik->mk", rest, rest) / max(bound.sum(), 1)
        value, vector = np.linalg.eigh(matrix)
        if value[0] > _RIGID or not bound.any():
            break
        loose = vector[:, value <= _RIGID]  # all of them: which is the first is chance
        size = np.where(bound, np.linalg.norm(np.einsum("nim,mk->nik", rigid, loose), axis=(1, 2)), 0)
        most = np.flatnonzero(size > size.max() - 1e-6)
        held.append(int(most[np.lexsort(np.round(away[most], 6).T)[0]]))
        rest[held[-1]] = rigid[held[-1]] * np.sqrt(bound.sum())
    return held


def _reach(points: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    """The longest move of each node ``[nodes]``: some edges."""
    total = np.bincount(pairs.reshape(-1), np.repeat(lengths(points, pairs), 2), len(points))
    number = np.bincount(pairs.reshape(-1), minlength=len(points))
    mean = total.sum() / max(number.sum(), 1)
    return _REACH * np.where(number > 0, total / np.maximum(number, 1), mean)


def _patches(layout: Layout, located: Located, reach: np.ndarray, dtype: Any) -> Patches:
    start, longest, *shape = (
        jnp.asarray(part, dtype)
        for part in (
            located.start,
            reach[located.nodes],
            layout.corners,
            layout.bulges,
            layout.directions,
        )
    )
    nodes, home, vertices, neighbours = (
        jnp.asarray(part, jnp.int32)
        for part in (located.nodes, located.home, layout.vertices, layout.neighbours)
    )
    return Patches(nodes, home, start, longest, vertices, neighbours, *shape)
