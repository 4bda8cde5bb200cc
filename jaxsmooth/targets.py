"""Target elements: how large the ideal element is that an element is compared with."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsmooth.assembly import gather, patch_mean
from jaxsmooth.mesh.record import Mesh
from jaxsmooth.metrics.table import measure

__all__ = ["target_measures"]

_LEAST_MEASURE = 1e-2  # of a target element, relative to the mean of its patches


def target_measures(mesh: Mesh) -> tuple[Float[Array, " _"], ...]:
    """Measure of every target element: its own (Eq. 22), made useful where it says nothing.

    The absolute value, bounded below by a fraction of the mean of its patches, so that inverted
    and flat elements have a target to grow into.
    """
    own = tuple(
        jnp.abs(jax.vmap(partial(measure, kind))(gather(mesh.points, nodes))) for kind, nodes in mesh.blocks
    )
    around = patch_mean(mesh, own)
    return tuple(
        jnp.maximum(size, _LEAST_MEASURE * gather(around, nodes).mean(axis=1))
        for (_, nodes), size in zip(mesh.blocks, own, strict=True)
    )
