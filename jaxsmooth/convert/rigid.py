"""Rigid maps between sets of points, and what the periodic links of a file say."""

from __future__ import annotations

from typing import Any

import numpy as np

from jaxsmooth.mesh.links import NodeLinks
from jaxsmooth.mesh.topology import pair_codes
from jaxsmooth.numerics.rounding import ROUNDINGS, coordinate_error

__all__ = ["linked_pairs", "rigid_rotation", "rotation_about"]

_RIGID = 1e-6  # of the size of a mesh, by which linked nodes may miss the places of each other
_SNAP = 1e-12  # entries of a rotation so near to 0 or ±1 are meant to be that


def rotation_about(axis: Any, degrees: float, dim: int) -> np.ndarray:
    """The rotation matrix ``[dim, dim]`` (Rodrigues' formula); in the plane it needs no axis."""
    if not np.isfinite(degrees) or degrees % 360 == 0:
        raise ValueError(f"the angle must be a number of degrees, no multiple of 360, got {degrees}")
    if isinstance(axis, str) and axis not in ("x", "y", "z"):
        raise ValueError(f"the axis must be x, y, z or a vector, got {axis!r}")
    vector = np.eye(3)["xyz".index(axis)] if isinstance(axis, str) else np.asarray(axis, np.float64)
    if vector.shape != (3,) or not np.isfinite(vector).all() or not vector.any():
        raise ValueError(f"the axis must have three components, not all 0, got {vector.tolist()}")
    x, y, z = vector / np.linalg.norm(vector) if dim == 3 else (0.0, 0.0, 1.0)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    angle = np.deg2rad(degrees)
    turn = np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
    return _snapped(turn[:dim, :dim])


def rigid_rotation(one: np.ndarray, other: np.ndarray, allowed: float) -> np.ndarray | None:
    """The rotation R ``[dim, dim]`` that takes `other` points ``[m, dim]`` to `one`, but for a translation.

    Found by least squares (Kabsch); the identity where that does.  None where no rotation does, or
    where several do, as for points of a line in space.
    """
    dim = one.shape[1]
    a, b = one - one.mean(axis=0), other - other.mean(axis=0)
    if np.abs(a - b).max(initial=0.0) <= allowed:
        return np.eye(dim)
    u, size, vt = np.linalg.svd(b.T @ a)
    if not size[dim - 2] > len(one) * (10 * allowed) ** 2:  # too narrow to tell
        return None
    flip = np.ones(dim)
    flip[-1] = np.sign(np.linalg.det(u @ vt))
    turn = (vt.T * flip) @ u.T
    return _snapped(turn) if np.abs(a - b @ turn.T).max() <= allowed else None


def linked_pairs(points: np.ndarray, links: Any, axes: np.ndarray) -> tuple[list[NodeLinks], np.ndarray]:
    """The periodic links of a file.

    Args:
        points: coordinates ``[nodes, dim]``.
        links: as meshio has them, ``[dim, tags, affine, pairs [n, 2]]`` each: the first node of a pair
            lies where the affine map of space (16 numbers, or none) takes the second.
        axes: directions of the coordinates in space ``[dim, 3]``.

    Returns:
        The links, and a mask ``[nodes]`` of nodes linked by something else than a rigid map.
    """
    allowed = ROUNDINGS * float(coordinate_error(points).max(initial=0.0))
    points, found, lost = points.astype(np.float64), [], np.zeros(len(points), bool)
    allowed = max(allowed, _RIGID * float(np.ptp(points, axis=0).max()))
    known, open_ = np.zeros(0, np.int64), []
    for _, _, affine, pairs in links or ():
        pairs = np.asarray(pairs).astype(np.int64).reshape(-1, 2)
        pairs = pairs[((pairs >= 0) & (pairs < len(points))).all(axis=1)]
        if len(pairs) == 0:
            continue
        one, other = points[pairs.T]
        turn = _of_affine(affine, axes)
        if turn is not None and not _fits(one, other, turn, allowed):
            turn = None
        if turn is None and len(pairs) > 1:
            turn = rigid_rotation(one, other, allowed)
        if turn is None:
            open_.append(pairs)
            continue
        found.append(NodeLinks.pairs(pairs, turn))
        known = np.concatenate([known, pair_codes(pairs, len(points))])
    for pairs in open_:  # those of a vertex or of a straight edge are known from the faces around, as a rule
        pairs = pairs[~np.isin(pair_codes(pairs, len(points)), known)]
        if len(pairs) == 1:
            found.append(NodeLinks.pairs(pairs, np.eye(points.shape[1])))
        else:
            lost[pairs] = True
    return found, lost


def _of_affine(affine: Any, axes: np.ndarray) -> np.ndarray | None:
    """The rotation (or reflection) of an affine map, if it is one."""
    if affine is None or np.size(affine) != 16:
        return None
    turn = axes @ np.reshape(np.asarray(affine, np.float64), (4, 4))[:3, :3] @ axes.T
    if np.abs(turn @ turn.T - np.eye(len(turn))).max() > _RIGID:
        return None
    u, _, vt = np.linalg.svd(turn)
    return _snapped(u @ vt)


def _fits(one: np.ndarray, other: np.ndarray, turn: np.ndarray, allowed: float) -> bool:
    a, b = one - one.mean(axis=0), other - other.mean(axis=0)
    return bool(np.abs(a - b @ turn.T).max() <= allowed)


def _snapped(turn: np.ndarray) -> np.ndarray:
    whole = np.round(turn)
    return np.where(np.abs(turn - whole) < _SNAP, whole, turn)
