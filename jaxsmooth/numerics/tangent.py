"""The plane in which an element of a surface is looked at."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

__all__ = ["STEEP", "flattened", "lifted", "tangent_frame"]

STEEP = 0.5
"""Cosine of the angle from which on an element is looked at along the reference, not along its own normal."""


def tangent_frame(corners: Float[Array, "c 3"], reference: Float[Array, "3"]) -> Float[Array, "2 3"]:
    """Two orthonormal directions in the plane of a polygon, right-handed about the reference normal.

    The plane is the element's own, so lengths and angles in it are true; one that has turned over is
    mirrored in it, its measure is negative.  An element that stands on the surface by more than 60°, or has
    no normal, is looked at along the reference: then it is flat, or nearly so.

    Args:
        corners: in the order in which they run round the element.
        reference: the unit normal of the surface there.
    """
    spokes = corners[1:] - corners[:1]
    area = jnp.cross(spokes[:-1], spokes[1:]).sum(axis=0)
    side = (area * reference).sum()
    square = (area * area).sum()
    least = (64 * jnp.finfo(corners.dtype).eps * (spokes * spokes).sum()) ** 2
    own = (side * side > STEEP**2 * square) & (square > least)
    area = jnp.where(own, jnp.where(side < 0, -area, area), reference)
    normal = area / jnp.sqrt((area * area).sum())
    axis = jnp.asarray(np.eye(3), corners.dtype)[jnp.argmin(jnp.abs(normal))]
    first = axis - (axis * normal).sum() * normal
    first = first / jnp.sqrt((first * first).sum())
    return jnp.stack([first, jnp.cross(normal, first)])


def flattened(values: Float[Array, "*e k 3"], frames: Float[Array, "*e 2 3"]) -> Float[Array, "*e k 2"]:
    """Vectors at the nodes of elements in the coordinates of their planes."""
    return (values[..., None, :] * frames[..., None, :, :]).sum(axis=-1)


def lifted(values: Float[Array, "e k *two"], frames: Float[Array, "e 2 3"]) -> Float[Array, "e k *three"]:
    """Vectors ``[e, k, 2]`` in planes, or matrices ``[e, k, 2, 2]``, as vectors or matrices in space."""
    if values.ndim == 3:
        return (values[..., None] * frames[:, None]).sum(axis=-2)
    rows = (values[..., None] * frames[:, None, None]).sum(axis=-2)  # [e, k, 2, 3]
    return (frames[:, None, :, :, None] * rows[..., :, None, :]).sum(axis=-3)
