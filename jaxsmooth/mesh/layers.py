"""Stretched elements, and the boundary layers among them, which are stretched on purpose."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from jaxsmooth.cells.table import ElementType
from jaxsmooth.mesh.record import Mesh
from jaxsmooth.mesh.topology import Facets, at_nodes, deformations, determinants, facet_keys, find_facets

__all__ = ["STRETCHED", "aspect_ratios", "boundary_layers", "layer_nodes", "nodes_of", "stretched"]

STRETCHED = 10.0  # aspect ratio from which an element counts as stretched
_SQUARE = 0.5  # least scaled Jacobian of an element of a layer: it stands upright
# Layers grow by a tenth to a third from one element to the next, in a dozen steps or two; what is merely
# squeezed against a boundary has neighbours of its own thickness (Shashkov's grid: 2 % a step).
_LEAST, _GROWTH = 3, 1.08


def aspect_ratios(kind: ElementType, points: np.ndarray, nodes: np.ndarray) -> np.ndarray:
    """Longest over shortest extent of elements ``[elements]``: 1 for the ideal element of every type.

    It is the ratio of the singular values of the mean deformation gradient from the ideal element;
    infinite for elements without measure.
    """
    mean = np.tensordot(kind.weights, kind.gradients, 1)
    frames = np.swapaxes(np.asarray(points, np.float64)[nodes], 1, 2) @ mean
    frames = frames if frames.shape[1] == kind.dim else np.linalg.qr(frames)[1]
    square = np.einsum("edi,edj->eij", frames, frames)
    det, trace = np.abs(np.linalg.det(frames)), np.trace(square, axis1=1, axis2=2)
    with np.errstate(divide="ignore", invalid="ignore"):
        if frames.shape[1] == 2:
            largest = (trace + np.sqrt(np.maximum(trace**2 - 4 * det**2, 0))) / 2
            ratio = largest / det
        else:
            largest = _largest_eigenvalue(square, trace)
            product, rest = det**2 / largest, trace - largest  # of the two other eigenvalues
            least = 2 * product / (rest + np.sqrt(np.maximum(rest**2 - 4 * product, 0)))
            ratio = np.sqrt(largest / least)
    return np.where(np.isfinite(ratio), np.maximum(ratio, 1), np.inf)


def _stretched(kind: ElementType, points: np.ndarray, nodes: np.ndarray, beyond: float) -> np.ndarray:
    """Elements beyond an aspect ratio; most are told by their determinant alone.

    det A over the mean square of A's singular values to the power of dim/2 is 1 for a cube; stretched
    by r it is at most what it is for (r, m, 1) with m² = (r² + 1)/2, in the plane for (r, 1)."""
    corners = at_nodes(np.asarray(points, np.float64), nodes)
    frames = deformations(corners, np.tensordot(kind.weights, kind.gradients, 1)[None])
    square = (frames * frames).sum(axis=(0, 1, 2)) / kind.dim
    if kind.dim == 2:
        most = 2 * beyond / (beyond**2 + 1)
    else:
        most = beyond * ((beyond**2 + 1) / 2) ** 0.5 / ((beyond**2 + 1) / 2) ** 1.5
    found = np.zeros(len(nodes), bool)
    rows = np.flatnonzero(np.abs(determinants(frames)[0]) <= 1.01 * most * square ** (kind.dim / 2))
    found[rows] = aspect_ratios(kind, points, nodes[rows]) > beyond
    return found


def _largest_eigenvalue(square: np.ndarray, trace: np.ndarray) -> np.ndarray:
    """Of symmetric matrices ``[m, 3, 3]`` with their traces, in closed form."""
    mean = trace / 3
    spread = square - mean[:, None, None] * np.eye(3)
    size = np.sqrt(np.einsum("eij,eij->e", spread, spread) / 6)
    cosine = np.linalg.det(spread / np.where(size > 0, size, 1)[:, None, None]) / 2
    return mean + 2 * size * np.cos(np.arccos(np.clip(cosine, -1, 1)) / 3)


def stretched(mesh: Mesh, beyond: float = STRETCHED) -> tuple[np.ndarray, ...]:
    """Elements whose aspect ratio is greater than `beyond`.

    Args:
        mesh: a `Mesh`.
        beyond: see `aspect_ratios`.

    Returns:
        One mask ``[elements]`` a block.
    """
    points = np.asarray(mesh.points)
    return tuple(_stretched(kind, points, np.asarray(nodes), beyond) for kind, nodes in mesh.blocks)


def boundary_layers(mesh: Mesh, facets: Sequence[Facets] | None = None) -> tuple[np.ndarray, ...]:
    """Elements of boundary layers: stacks of flat upright elements that start on the boundary.

    Quadrilaterals, wedges and hexahedra of an aspect ratio beyond 10 and a scaled Jacobian beyond
    0.5 are of a layer when they lie one upon the other with their large facets, three at least, from
    a boundary facet on, and become thicker by 8 % from one to the next, on average.  Inverted
    elements, and those that have a node of one, are to be repaired: they are passed through, but
    they are not of the layer.

    Args:
        mesh: a `Mesh`.
        facets: its facets, where they are known.

    Returns:
        One mask ``[elements]`` a block.
    """
    points, count = np.asarray(mesh.points, np.float64), len(mesh.points)
    if mesh.surface:  # they are known in plane and solid meshes only
        return tuple(np.zeros(len(nodes), bool) for nodes in mesh.connectivity)
    blocks = [(kind, np.asarray(nodes)) for kind, nodes in mesh.blocks]
    upright = [_upright(kind, points, nodes) for kind, nodes in blocks]
    if not any(rows.any() for rows in upright):
        return tuple(upright)
    broken = _broken(blocks, points, count)
    near = [np.any(broken[nodes], axis=1) for _, nodes in blocks]
    parts = [_flat(*block, points, a | b) for block, a, b in zip(blocks, upright, near, strict=True)]
    row, sides, height = (np.concatenate(part) for part in zip(*parts, strict=True))
    block = np.repeat(np.arange(len(parts)), [len(part[0]) for part in parts])
    sound = np.concatenate([~n[rows] for n, (rows, *_) in zip(near, parts, strict=True)])

    corners = [part.nodes[part.partner < 0][:, : part.type.corners] for part in facets or find_facets(mesh)]
    walls = np.concatenate([np.sort(part, axis=1)[:, :3] for part in corners])
    keys = facet_keys(np.concatenate([sides.reshape(-1, sides.shape[-1]), walls]), count)
    number, at_wall = keys[: 2 * len(sides)].reshape(-1, 2), keys[2 * len(sides) :]
    stack = _stacks(number)
    seeded = np.isin(stack, stack[np.isin(number, at_wall).any(axis=1)])
    chosen = sound & seeded & _grows(stack, height, sound)
    return tuple(
        np.isin(np.arange(len(nodes)), row[chosen & (block == index)])
        for index, (_, nodes) in enumerate(blocks)
    )


def layer_nodes(mesh: Mesh, facets: Sequence[Facets] | None = None) -> np.ndarray:
    """The nodes ``[nodes]`` that hold the boundary layers: all of theirs but those to be repaired.

    Nodes of inverted elements and of the elements around these are free to move, of a layer or not.

    Args:
        mesh: a `Mesh`.
        facets: its facets, where they are known.
    """
    held = nodes_of(mesh, boundary_layers(mesh, facets))
    if held.any():
        blocks = [(kind, np.asarray(nodes)) for kind, nodes in mesh.blocks]
        broken = _broken(blocks, np.asarray(mesh.points, np.float64), len(mesh.points))
        held &= ~nodes_of(mesh, [np.any(broken[nodes], axis=1) for _, nodes in blocks])
    return held


def nodes_of(mesh: Mesh, masks: Sequence[np.ndarray]) -> np.ndarray:
    """The nodes ``[nodes]`` of chosen elements, given by one mask a block."""
    found = np.zeros(len(mesh.points), bool)
    for nodes, mask in zip(mesh.connectivity, masks, strict=True):
        found[np.asarray(nodes)[mask]] = True
    return found


def _flat(kind: ElementType, nodes: np.ndarray, points: np.ndarray, chosen: np.ndarray):
    """Of chosen elements: their rows, the lowest corners of two large facets ``[m, 2, dim]``, thickness."""
    rows = np.flatnonzero(chosen)
    heights = np.stack([_height(kind, points[nodes[rows]], axis) for axis in range(kind.dim)], axis=1)
    thin = heights.argmin(axis=1)
    between = np.isin(thin, kind.extruded_axes)  # wedges are between their triangles only
    rows, heights, thin = rows[between], heights[between], thin[between]
    sides = np.zeros((len(rows), 2, kind.dim), np.int64)
    natural = kind.natural[: kind.corners]
    for axis in np.unique(thin):
        mine = np.flatnonzero(thin == axis)
        for side, level in enumerate((natural[:, axis].min(), natural[:, axis].max())):
            facet = nodes[rows[mine]][:, np.flatnonzero(natural[:, axis] == level)]
            sides[mine, side] = np.sort(facet, axis=1)[:, : kind.dim]
    return rows, sides, heights.min(axis=1, initial=np.inf)


def _height(kind: ElementType, nodes: np.ndarray, axis: int) -> np.ndarray:
    """Mean length of the edges along a natural direction, of elements ``[m, k, dim]``."""
    natural = kind.natural
    along = kind.edges[natural[kind.edges[:, 0], axis] != natural[kind.edges[:, 1], axis]]
    return np.linalg.norm(nodes[:, along[:, 1]] - nodes[:, along[:, 0]], axis=-1).mean(axis=1)


def _upright(kind: ElementType, points: np.ndarray, nodes: np.ndarray) -> np.ndarray:
    """Stretched elements whose corners are near to right angles ``[elements]``."""
    found = np.zeros(len(nodes), bool)
    if kind.extruded_axes:
        rows = np.flatnonzero(_stretched(kind, points, nodes, STRETCHED))
        ideal = _least_sine(kind, kind.ideal[None])
        found[rows] = _least_sine(kind, points[nodes[rows]]) > _SQUARE * ideal
    return found


def _least_sine(kind: ElementType, nodes: np.ndarray) -> np.ndarray:
    """Least determinant over lengths of the edges that leave a corner, of elements ``[m, k, dim]``."""
    frames = np.einsum("mkd,ckj->mcdj", nodes, kind.corner_frames)
    size = np.linalg.norm(frames, axis=2).prod(axis=-1)
    return (np.linalg.det(frames) / np.where(size > 0, size, 1)).min(axis=1)


def _stacks(sides: np.ndarray) -> np.ndarray:
    """Numbers of the stacks that shared sides ``[m, 2]`` make ``[m]``."""
    count = len(sides)
    number = count + np.unique(sides, return_inverse=True)[1].reshape(-1, 2)
    ends = np.stack([np.repeat(np.arange(count), 2), number.ravel()])
    size = int(number.max(initial=0)) + 1
    graph = coo_matrix((np.ones(ends.shape[1], np.int8), ends), shape=(size, size))
    return connected_components(graph, directed=False)[1][:count]


def _grows(stack: np.ndarray, height: np.ndarray, sound: np.ndarray) -> np.ndarray:
    """Elements ``[m]`` of stacks that have enough sound ones, from thin to thick."""
    count = int(stack.max(initial=-1)) + 1
    number = np.bincount(stack[sound], minlength=count)
    low, high = np.full(count, np.inf), np.zeros(count)
    np.minimum.at(low, stack[sound], height[sound])
    np.maximum.at(high, stack[sound], height[sound])
    return ((number >= _LEAST) & (high >= low * _GROWTH ** (number - 1.0)))[stack]


def _broken(blocks: Sequence[tuple[ElementType, np.ndarray]], points: np.ndarray, count: int) -> np.ndarray:
    """Nodes ``[nodes]`` of inverted elements."""
    found = np.zeros(count, bool)
    for kind, nodes in blocks:
        frames = np.einsum("ekd,qkj->eqdj", points[nodes], kind.validity_gradients)
        found[nodes[~(np.linalg.det(frames) > 0).all(axis=1)]] = True
    return found
