"""Curved surfaces through the nodes of smooth faces, from vertex normals, on the host.

Every facet becomes a quadratic patch: quadratic facets are taken as they are; the edges of linear ones are
arcs whose ends are normal to the vertex normals, as in point-normal triangles and Nagata's patches.
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_matrix

from jaxsmooth.cells.table import ElementType, element_type
from jaxsmooth.mesh.topology import pair_codes
from jaxsmooth.motion.curves import Layout, Located, arc_bulge
from jaxsmooth.motion.features import Faces
from jaxsmooth.motion.sides import Sides

__all__ = ["build_surfaces"]

_ENOUGH = 7  # neighbours that a fit of five coefficients needs
_SOUND = 1e-3  # ratio of the eigenvalues of its normal matrix
_FAR = np.deg2rad(30)  # a fitted normal that is off the mean one by more is not believed


def build_surfaces(
    sides: list[Sides],
    faces: Faces,
    points: np.ndarray,
    rims: tuple[np.ndarray, np.ndarray],
    bound: float,
    join_angle: float,
) -> Layout:
    """The patches of all facets that are neither flat nor on a given surface.

    Args:
        sides: the facets.
        faces: which of them belong together.
        points: ``[nodes, 3]``.
        rims: codes (`pair_codes`) of the feature edges, and their bulges ``[m, 3]``.
        bound: the largest bulge of an edge over the local length of edges.
        join_angle: radians: a face joins a flat one smoothly where the fold is less.
    """
    edges = faces.edges
    chosen = ~faces.flat & (faces.given < 0)
    normals = _vertex_normals(faces, points, chosen, join_angle)
    bulge = _edge_bulges(faces, points, normals, chosen, rims, bound)
    parts, row, facet, centre = [], 0, 0, faces.vertices
    for part in sides:
        m, many = len(part.nodes), len(part.type.edges)
        here = np.flatnonzero(chosen[facet : facet + m])
        rows = row + here[:, None] + m * np.arange(many)
        kind = part.type
        places = points[part.nodes[here]]
        if kind.linear:
            kind = element_type("triangle6" if kind.corners == 3 else "quad8")
            middles = places[:, part.type.edges].mean(axis=2) + bulge[rows]
            places = np.concatenate([places, middles], axis=1)
        corner = np.zeros((len(here), kind.corners), int)
        for local, pair in enumerate(part.type.edges):
            corner[:, pair] = faces.vertex[edges.corner[rows[:, local]]]
        parts.append(_patches(part.type, kind, part.nodes[here], places, corner, centre))
        centre += len(here)
        row, facet = row + m * many, facet + m
    return _joined(parts, faces, len(points), centre)


def _patches(
    own: ElementType,
    kind: ElementType,
    nodes: np.ndarray,
    places: np.ndarray,
    corner: np.ndarray,
    centre: int,
) -> Layout:
    """Triangles of facets ``[m, k]``: one, or four around the centre; yet without neighbours."""
    natural = kind.natural[: kind.corners]
    number, ring = np.arange(len(nodes)), np.arange(kind.corners)
    if kind.corners == 3:
        local = ring[None]
    else:
        natural = np.concatenate([natural, natural.mean(axis=0)[None]])
        corner = np.c_[corner, centre + number]
        local = np.stack([ring, np.roll(ring, -1), np.full(len(ring), len(ring))], axis=1)
    ends = natural[local]  # [t, 3, 2]
    middle = (np.roll(ends, -1, axis=1) + np.roll(ends, -2, axis=1)) / 2
    many = len(local)
    at = np.einsum(
        "tck,mkd->mtcd", kind.shape_functions(ends.reshape(-1, 2)).reshape(many, 3, kind.k), places
    )
    half = np.einsum(
        "tck,mkd->mtcd", kind.shape_functions(middle.reshape(-1, 2)).reshape(many, 3, kind.k), places
    )
    bulge = half - (np.roll(at, -1, axis=2) + np.roll(at, -2, axis=2)) / 2
    # where the nodes of a facet lie
    gaps = own.natural[:, None, None] - ends[None, :, :1]
    frame = np.linalg.inv(np.stack([ends[:, 1] - ends[:, 0], ends[:, 2] - ends[:, 0]], axis=1))
    two = np.einsum("ktca,tab->ktb", gaps, frame)
    inside = np.concatenate([1 - two.sum(axis=-1, keepdims=True), two], axis=-1)
    piece = inside.min(axis=-1).argmax(axis=1)
    where = np.clip(inside[np.arange(own.k), piece], 0, 1)
    located = Located(
        nodes.reshape(-1), (number[:, None] * many + piece).reshape(-1), np.tile(where, (len(nodes), 1))
    )
    flat = len(nodes) * many
    vertices = corner[:, local].reshape(flat, 3)
    return Layout(vertices, vertices, at.reshape(flat, 3, 3), bulge.reshape(flat, 3, 3), located)


def _joined(parts: list[Layout], faces: Faces, count: int, vertices: int) -> Layout:
    """All patches, each with its neighbours."""
    start = np.cumsum([0, *(len(part.vertices) for part in parts)])
    located = Located(
        np.concatenate([part.located.nodes for part in parts]),
        np.concatenate([part.located.home + s for part, s in zip(parts, start, strict=False)]),
        np.concatenate([part.located.start for part in parts]),
    )
    table = np.concatenate([part.vertices for part in parts])
    sides = np.stack([np.roll(table, -1, axis=1), np.roll(table, -2, axis=1)], axis=-1).reshape(-1, 2)
    node = np.full(vertices, -1)
    node[faces.vertex] = faces.edges.node
    edge = np.unique(pair_codes(faces.edges.segments.ends[faces.feature], count))
    cut = np.isin(pair_codes(node[sides], count), edge) & (node[sides] >= 0).all(axis=1)
    codes = pair_codes(sides, vertices)
    _, same, number = np.unique(codes, return_inverse=True, return_counts=True)
    order = np.argsort(same.reshape(-1), kind="stable")
    pairs = order[number[same.reshape(-1)[order]] == 2].reshape(-1, 2)
    pairs = pairs[~cut[pairs[:, 0]]]
    neighbour = np.full(len(sides), -1)
    neighbour[pairs[:, 0]], neighbour[pairs[:, 1]] = pairs[:, 1] // 3, pairs[:, 0] // 3
    corners, bulges = (np.concatenate([getattr(p, name) for p in parts]) for name in ("corners", "bulges"))
    return Layout(table, neighbour.reshape(-1, 3), corners, bulges, located)


def _edge_bulges(
    faces: Faces,
    points: np.ndarray,
    normals: np.ndarray,
    chosen: np.ndarray,
    rims: tuple[np.ndarray, np.ndarray],
    bound: float,
) -> np.ndarray:
    """Bulge of every row of the edges ``[rows, 3]``: an arc between the tangent planes at its ends."""
    edges = faces.edges
    ends = edges.segments.ends
    chord = points[ends[:, 1]] - points[ends[:, 0]]
    size = np.linalg.norm(chord, axis=1)
    one, two = np.moveaxis(normals[faces.vertex[edges.corner]], 1, 0)
    mean = one + two
    mean /= np.maximum(np.linalg.norm(mean, axis=1), 1e-30)[:, None]
    sines = [np.einsum("rd,rd->r", chord, n) / np.where(size > 0, size, 1) for n in (one, two)]
    bend, swing = sines[1] - sines[0], sines[1] + sines[0]  # an arc has no swing; noise has as much as bend
    sine = bend / 2 * bend**2 / np.where(bend == 0, 1, bend**2 + swing**2)
    local = np.bincount(ends.reshape(-1), np.repeat(size, 2), len(points))
    local /= np.maximum(np.bincount(ends.reshape(-1), minlength=len(points)), 1)
    limit = bound * np.minimum(size, local[ends].min(axis=1))
    bulge = np.clip(arc_bulge(size, sine), -limit, limit)[:, None] * mean
    bent = edges.segments.bent
    bulge[bent] = edges.segments.bulge[bent]
    borrowed = ~bent & (edges.other >= 0) & bent[edges.other]
    bulge[borrowed] = edges.segments.bulge[edges.other[borrowed]]
    rim = faces.feature & chosen[edges.facet] & ~bent
    order = np.argsort(rims[0])
    place = order[np.searchsorted(rims[0][order], pair_codes(ends[rim], len(points)))]
    bulge[rim] = rims[1][place]
    return bulge


def _vertex_normals(faces: Faces, points: np.ndarray, chosen: np.ndarray, join_angle: float) -> np.ndarray:
    """Unit normals ``[vertices, 3]``, from facets that are chosen."""
    edges = faces.edges
    mine = chosen[edges.facet]
    vertex = faces.vertex[edges.corner]
    place = np.zeros((faces.vertices, 3))
    place[faces.vertex] = points[edges.node]
    first = _mean_normals(faces, points, chosen)
    found = _fitted_normals(np.unique(np.sort(vertex[mine], axis=1), axis=0), place, first)
    flat = mine & faces.feature & (edges.other >= 0)
    flat &= faces.flat[edges.facet[edges.other]] & (edges.angle < join_angle)
    plane = np.zeros_like(found)
    for end in range(2):
        np.add.at(plane, vertex[flat, end], edges.normal[edges.other[flat]])
    size = np.linalg.norm(plane, axis=1, keepdims=True)
    return np.where(size > 0, plane / np.where(size > 0, size, 1), found)


def _mean_normals(faces: Faces, points: np.ndarray, chosen: np.ndarray) -> np.ndarray:
    """Normals weighted as N. Max does (1999): those of a sphere are exact."""
    edges = faces.edges
    ends, corner = edges.segments.ends, edges.corner
    # the two edges at each corner, in the order in which they run round the facet
    after, before = np.zeros(len(edges.node), int), np.zeros(len(edges.node), int)
    after[corner[:, 0]], before[corner[:, 1]] = ends[:, 1], ends[:, 0]
    used = chosen[edges.of]
    here = points[edges.node[used]]
    a, b = points[after[used]] - here, points[before[used]] - here
    weight = np.einsum("cd,cd->c", a, a) * np.einsum("cd,cd->c", b, b)
    part = np.cross(a, b) / np.where(weight > 0, weight, 1)[:, None]
    total = np.stack([np.bincount(faces.vertex[used], part[:, i], faces.vertices) for i in range(3)], axis=1)
    size = np.linalg.norm(total, axis=1, keepdims=True)
    return total / np.where(size > 0, size, 1)


def _fitted_normals(pairs: np.ndarray, place: np.ndarray, first: np.ndarray) -> np.ndarray:
    """Normals of quadrics through each vertex, fitted to two rings; `first` where these are too few."""
    count = len(place)
    ones = np.ones(len(pairs), np.int32)
    graph = coo_matrix((ones, pairs.T), shape=(count, count)).tocsr()
    graph = graph + graph.T
    two = (graph + graph @ graph).tocoo()
    apart = two.row != two.col
    i, j = two.row[apart], two.col[apart]
    number = np.bincount(i, minlength=count)
    gap = place[j] - place[i]
    size = np.linalg.norm(gap, axis=1)
    scale = np.bincount(i, size, count) / np.maximum(number, 1)
    scale[scale == 0] = 1
    axis = np.eye(3)[np.abs(first).argmin(axis=1)]
    one = np.cross(first, axis)
    one /= np.maximum(np.linalg.norm(one, axis=1), 1e-30)[:, None]
    frame = np.stack([one, np.cross(first, one), first], axis=1)
    x, y, z = (np.einsum("mij,mj->mi", frame[i], gap) / scale[i][:, None]).T
    weight = 1 / ((size / scale[i]) ** 2 + 0.25)
    terms = np.stack([x, y, x * x / 2, x * y, y * y / 2, z])
    matrix = np.zeros((count, 6, 6))
    for a in range(6):
        for b in range(a + 1):
            matrix[:, a, b] = matrix[:, b, a] = np.bincount(i, weight * terms[a] * terms[b], count)
    value, vector = np.linalg.eigh(matrix[:, :5, :5])
    sound = (number >= _ENOUGH) & (value[:, 0] > _SOUND * value[:, -1])
    part = np.einsum("vji,vj->vi", vector, matrix[:, :5, 5]) / np.where(sound[:, None], value, 1)
    slope = np.einsum("vij,vj->vi", vector[:, :2], part)
    found = first - slope[:, :1] * frame[:, 0] - slope[:, 1:] * frame[:, 1]
    found /= np.maximum(np.linalg.norm(found, axis=1), 1e-30)[:, None]
    near = np.einsum("vd,vd->v", found, first) > np.cos(_FAR)
    return np.where((sound & near)[:, None], found, first)
