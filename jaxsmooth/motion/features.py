"""Feature edges of surfaces: where a face ends, found on the host from folds, labels and flat parts."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from jaxsmooth.mesh.topology import pair_codes
from jaxsmooth.motion.sides import Edges, Sides

__all__ = ["FEATURE_ANGLE", "Faces", "find_faces", "ridges"]

FEATURE_ANGLE = 50.0  # degrees: a fold that is an edge by itself
_WEAK = 0.5  # part of that angle to which an edge goes on
_BRANCH = 2  # edges that fade, and are too few to be an edge of their own
_CHAIN = 3  # edges that a chain of folds needs, if it does not start at other features
_CONTRAST, _SHALLOW = 4.0, np.deg2rad(8.0)  # a fold so many times sharper than all around it is an edge
_RIDGE = 25.0  # degrees
_LEVEL = 4.0  # tolerances by which a facet may be off the plane of its flat face


@dataclass(frozen=True)
class Faces:
    """Smooth faces: facets that only feature edges separate.

    Attributes:
        edges: the edges of all facets.
        feature: rows of `edges` at which a face ends ``[rows]``.
        flat: facets of flat faces ``[facets]``.
        given: number of the given surface a facet lies on ``[facets]``; −1 for none.
        vertex: number of the vertex at every corner ``[corners]``.  A node is one vertex in each fan of
            facets that no feature edge cuts.
        vertices: their number.
    """

    edges: Edges
    feature: np.ndarray
    flat: np.ndarray
    given: np.ndarray
    vertex: np.ndarray
    vertices: int


def find_faces(
    sides: list[Sides],
    points: np.ndarray,
    flat_nodes: np.ndarray,
    tolerance: np.ndarray,
    lines: np.ndarray,
    feature_angle: float,
) -> Faces:
    """Split facets into smooth faces.

    A feature edge is one with other than two facets, or facets of different labels; a tagged line; the
    border of a flat face; a fold sharper than the feature angle, and the folds that continue it down
    to a part of that angle (hysteresis), if together they are a chain and not a single facet askew; or a
    fold much sharper than all others of its two facets, however shallow.

    Args:
        sides: the facets.
        points: ``[nodes, 3]``.
        flat_nodes: nodes all of whose facets lie in one plane ``[nodes]``.
        tolerance: angle to which the normal of each facet is known ``[facets]``.
        lines: pairs of nodes of tagged lines ``[m, 2]``.
        feature_angle: in degrees.
    """
    edges = Edges.of_sides(sides, points)
    label = np.concatenate([part.label for part in sides])
    given = np.concatenate([part.given for part in sides])
    angle = edges.angle
    one, two = edges.facet, edges.facet[np.maximum(edges.other, 0)]
    within = (given[one] == given[two]) & (given[one] >= 0) & (edges.other >= 0)
    flat = _flat_facets(edges, angle, flat_nodes, tolerance) & (given < 0)
    either = flat[one] | flat[two]
    level = np.maximum(tolerance[one], tolerance[two])
    apart = either & ((flat[one] != flat[two]) | (angle > _LEVEL * level))
    codes = pair_codes(edges.segments.ends, len(points))
    sure = (edges.other < 0) | (np.isinf(angle) & ~within) | (label[one] != label[two])
    sure |= (given[one] != given[two]) | np.isin(codes, pair_codes(lines, len(points)))
    sure |= apart & ~within
    fold = np.where(sure | within | (angle <= level), 0, angle)
    strong, weak = _folds(edges, fold, np.deg2rad(feature_angle))
    feature = _pruned(edges, sure | _chains(edges, sure, strong, weak), sure, strong, fold)
    return Faces(edges, feature, flat, given, *_vertices(edges, ~feature))


def ridges(faces: Faces, points: np.ndarray) -> np.ndarray:
    """Projectors onto the directions in which normals change little around nodes ``[nodes, 3, 3]``.

    The root mean square of what facet normals have along a direction is half the fold of a ridge across
    it.  A node that left a ridge as sharp as `_RIDGE` would take it along, even on a smooth surface.
    """
    edges, count = faces.edges, len(points)
    corner = np.zeros((len(edges.node), 3))
    corner[edges.corner[:, 0]] = edges.normal
    total, weight = np.zeros((count, 3, 3)), np.bincount(edges.node, minlength=count)
    np.add.at(total, edges.node, np.einsum("ci,cj->cij", corner, corner))
    value, vector = np.linalg.eigh(total / np.maximum(weight, 1)[:, None, None])
    free = value <= np.sin(np.deg2rad(_RIDGE) / 2) ** 2
    free[:, 2] = True  # the normal itself is left to the surface
    return np.einsum("nij,nj,nkj->nik", vector, free, vector)


def _flat_facets(
    edges: Edges, angle: np.ndarray, flat_nodes: np.ndarray, tolerance: np.ndarray
) -> np.ndarray:
    """Facets that continue those around a flat node in its plane ``[facets]``."""
    count = len(tolerance)
    seed = np.zeros(count, bool)
    seed[edges.of[flat_nodes[edges.node]]] = True
    if not seed.any():
        return seed
    one, two = edges.facet, edges.facet[np.maximum(edges.other, 0)]
    level = angle <= np.maximum(tolerance[one], tolerance[two])
    face = _components(np.c_[one, two][level], count)
    size = np.bincount(one, minlength=count)[:, None]
    normal = np.stack([np.bincount(one, edges.normal[:, i], count) for i in range(3)], axis=1) / size
    mean = np.stack([np.bincount(face[seed], normal[seed, i], count) for i in range(3)], axis=1)[face]
    off = np.linalg.norm(np.cross(mean, normal), axis=1)
    near = off <= np.sin(np.minimum(_LEVEL * tolerance, 0.1)) * np.linalg.norm(mean, axis=1)
    return seed | (near & (np.bincount(face[seed], minlength=count) > 0)[face])


def _folds(edges: Edges, fold: np.ndarray, sharp: float) -> tuple[np.ndarray, np.ndarray]:
    """Rows whose fold is an edge by itself, and those that may continue one."""
    ends = edges.segments.ends
    sharpest = np.zeros(int(edges.node.max()) + 1)
    np.maximum.at(sharpest, ends, fold[:, None])
    # at the corners of the facets on both sides that are not on the edge
    others = np.zeros(len(fold))
    for corner in edges.corners.T:
        node = corner[edges.facet]
        away = (node >= 0) & (node[:, None] != ends).all(axis=1)
        others = np.maximum(others, np.where(away, sharpest[node], 0))
    others = np.maximum(others, np.where(edges.other >= 0, others[edges.other], 0))
    contrast = (fold > _SHALLOW) & (fold > _CONTRAST * others)
    return (fold > sharp) | contrast, (fold > _WEAK * sharp) | contrast


def _chains(edges: Edges, sure: np.ndarray, strong: np.ndarray, weak: np.ndarray) -> np.ndarray:
    """Rows of weak folds that a strong one belongs to, in chains long enough or tied to sure features."""
    ends, count = edges.segments.ends, int(edges.node.max()) + 1
    chain = _components(ends[weak], count)[ends[:, 0]]
    has = np.bincount(chain[strong], minlength=count) > 0
    tied = np.zeros(count, bool)
    tied[ends[sure]] = True
    held = np.bincount(chain[weak], tied[ends[weak]].any(axis=1), count) > 0
    length = np.bincount(chain[weak], minlength=count) / 2  # both facets of an edge have a row
    return weak & (has & (held | (length >= _CHAIN)))[chain]


def _pruned(
    edges: Edges, feature: np.ndarray, sure: np.ndarray, strong: np.ndarray, fold: np.ndarray
) -> np.ndarray:
    """Features without the weakest side of facets that are all edges, and without short side branches."""
    sides, count = np.bincount(edges.facet), int(edges.node.max()) + 1
    closed = (np.bincount(edges.facet, feature) == sides)[edges.facet] & feature & ~sure & ~strong
    least = np.full(len(sides), np.inf)
    np.minimum.at(least, edges.facet[closed], fold[closed])
    drop = closed & (fold <= least[edges.facet])
    feature = feature & ~drop & ~(drop[edges.other] & (edges.other >= 0))
    for _ in range(_BRANCH):
        once = np.flatnonzero(feature)[np.unique(edges.same[feature], return_index=True)[1]]
        number = np.bincount(edges.segments.ends[once].reshape(-1), minlength=count)
        loose = feature & ~sure & ~strong & (number[edges.segments.ends] == 1).any(axis=1)
        feature = feature & ~loose
    return feature


def _vertices(edges: Edges, joined: np.ndarray) -> tuple[np.ndarray, int]:
    """Corners that the facets on both sides of joined edges share."""
    one = np.flatnonzero(joined & (edges.other > np.arange(len(edges.other))))
    other = edges.other[one]
    # rows may run either way
    turned = edges.segments.ends[one, 0] != edges.segments.ends[other, 0]
    corner = np.where(turned[:, None], edges.corner[other][:, ::-1], edges.corner[other])
    pairs = np.stack([edges.corner[one], corner], axis=-1).reshape(-1, 2)
    vertex = _components(pairs, len(edges.node))
    return vertex, int(vertex.max(initial=-1)) + 1


def _components(pairs: np.ndarray, count: int) -> np.ndarray:
    """Number of the part ``[count]`` that pairs ``[m, 2]`` join each item to."""
    graph = coo_matrix((np.ones(len(pairs), np.int8), pairs.T), shape=(count, count))
    return connected_components(graph, directed=False)[1]
