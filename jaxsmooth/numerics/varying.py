"""What loops carry through `jax.shard_map`: constants become values that differ from device to device."""

from __future__ import annotations

from functools import reduce
from typing import Any

import jax
import jax.numpy as jnp

__all__ = ["varying_like"]


def varying_like(tree: Any, others: Any) -> Any:
    """A pytree whose leaves vary over the axes of a device mesh that leaves of `others` vary over.

    Loops must be given what they return; outside `shard_map` nothing varies, and nothing is done.
    Not by `jax.lax.pcast`, which derivatives of checkpointed functions do not get through.
    """
    leaves = [leaf for leaf in jax.tree.leaves((tree, others)) if _axes(leaf)]
    if not leaves:
        return tree
    axes = frozenset().union(*map(_axes, leaves))
    marks = [jnp.ravel(jax.lax.stop_gradient(leaf))[0] == 0 for leaf in leaves]
    mark = reduce(jnp.logical_or, marks)
    return jax.tree.map(lambda leaf: leaf if axes <= _axes(leaf) else jnp.where(mark, leaf, leaf), tree)


def _axes(leaf: Any) -> frozenset:
    kind = getattr(jax.typeof(leaf), "manual_axis_type", None)
    return frozenset() if kind is None else frozenset(kind.varying)
