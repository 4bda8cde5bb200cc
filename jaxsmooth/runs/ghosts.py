"""Meshes of `smooth` in sizes that others have too, so that they share what is compiled."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxsmooth.guards.patch import PatchGuard
from jaxsmooth.mesh.padding import Padded, padded
from jaxsmooth.mesh.record import Mesh
from jaxsmooth.methods import Elastic, Method, Optimize
from jaxsmooth.methods.elastic.elasticity import Material
from jaxsmooth.methods.optimize.minimise import Newton
from jaxsmooth.motion.base import Motion
from jaxsmooth.motion.planar import Constraints
from jaxsmooth.targets import FreeSize, OwnSize

__all__ = ["with_ghosts"]

_LOCAL = (Elastic, Optimize, PatchGuard, OwnSize, FreeSize, Newton, Material)
"""What acts on elements one by one, or by sums over those that can move: ghosts make no difference."""


def with_ghosts(mesh: Mesh, method: Method, motion: Motion) -> tuple[Padded, Motion]:
    """The mesh with ghosts, which the motion holds; as it is, where ghosts might make a difference."""
    if type(motion) is not Constraints or not _local(method):
        return Padded.as_it_is(mesh), motion
    whole = padded(mesh)
    projectors = np.zeros((len(whole.mesh.points), mesh.dim, mesh.dim), motion.projectors.dtype)
    projectors[: whole.nodes] = motion.projectors
    return whole, Constraints(jnp.asarray(projectors))


def _local(part: Any) -> bool:
    """Whether a record and its parts are of those kinds, and nothing in it is given for each element."""
    if isinstance(part, eqx.Module):
        return type(part) in _LOCAL and all(_local(getattr(part, f.name)) for f in fields(part))
    if isinstance(part, jax.Array | np.ndarray):
        return part.ndim == 0
    return not isinstance(part, tuple | list)
