"""Plane meshes in space: their plane, their coordinates in it, and the way back."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

__all__ = ["Plane", "find_plane"]

# Of the size of a mesh.  Six digits, as text files have them, round to 5e-6 of the largest coordinate,
# up and down; float32 to 6e-8.  A surface that is meant is further from every plane.
_FLAT = 1e-5


@dataclass(frozen=True)
class Plane:
    """Where a plane mesh lies in space.

    Attributes:
        origin: a point of the plane ``[3]``, in units of length.
        axes: orthonormal directions of the two coordinates in it ``[2, 3]``.
        columns: the two coordinates that are kept where the plane is normal to an axis (then the
            coordinates in the plane are these, as they are); None for any other plane.
    """

    origin: np.ndarray
    axes: np.ndarray
    columns: tuple[int, int] | None

    def flatten(self, points: np.ndarray) -> np.ndarray:
        """Coordinates in the plane ``[nodes, 2]`` of points ``[nodes, 3]``."""
        if self.columns is not None:
            return points[:, list(self.columns)]
        flat = (points.astype(np.float64) - self.origin) @ self.axes.T
        return flat.astype(points.dtype if points.dtype.kind == "f" else np.float64)

    def move(self, points: np.ndarray, old: np.ndarray, new: np.ndarray, moved: np.ndarray) -> np.ndarray:
        """Points in space whose coordinates in the plane change; what is normal to it stays.

        Args:
            points: in space ``[nodes, 3]``.
            old: their coordinates in the plane ``[nodes, 2]``.
            new: other ones.
            moved: which of these differ ``[nodes, 2]``; points where none does stay as they are.
        """
        out = points.copy()
        if self.columns is not None:
            columns = list(self.columns)
            out[:, columns] = np.where(moved, new, out[:, columns])
            return out
        rows = moved.any(axis=1)
        step = np.where(moved, new.astype(np.float64) - old, 0.0)[rows]
        out[rows] = points[rows] + step @ self.axes
        return out


def find_plane(points: np.ndarray) -> Plane | None:
    """The plane in which points ``[nodes, 3]`` lie but for noise (1e-5 of their size); None if in none."""
    points = np.asarray(points, np.float64)
    extent = np.ptp(points, axis=0)
    normal = 2 if extent[2] <= _FLAT * extent[:2].max() else int(extent.argmin())
    others = [k for k in range(3) if k != normal]
    if extent[normal] <= _FLAT * extent[others].max():
        origin = np.zeros(3)
        origin[normal] = points[0, normal]
        return Plane(origin, np.eye(3)[others], (others[0], others[1]))
    origin = points.mean(axis=0)
    _, directions = np.linalg.eigh((points - origin).T @ (points - origin))
    away = directions[:, 0]
    if np.ptp((points - origin) @ away) > _FLAT * extent.max():
        return None
    return Plane(origin, _axes(away), None)


def _axes(normal: np.ndarray) -> np.ndarray:
    """Two directions normal to a third, the first as near as may be to a coordinate axis."""
    least = np.abs(normal).argmin()
    first = np.eye(3)[least] - normal[least] * normal
    first /= np.linalg.norm(first)
    upward = normal * np.sign(normal[np.abs(normal).argmax()])
    return np.stack([first, np.cross(upward, first)])
