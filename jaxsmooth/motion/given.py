"""Surfaces that the user gives: a function from places to the nearest points."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxsmooth.mesh.record import Mesh
from jaxsmooth.motion.curved import Carrier, Sliding
from jaxsmooth.motion.planar import node_mask
from jaxsmooth.numerics.small import Frame

__all__ = ["Given", "host_nearest", "on_surface"]

Places = Float[Array, "sliding dim"]


class Given(Carrier):
    """What a function says: a surface or a curve.

    Attributes:
        nodes: that slide on it.
        nearest: the nearest points of places, ``[m, dim] -> [m, dim]``, each by itself.
        frame: of the coordinates of the nodes; None for those of the function.
    """

    nodes: Int[Array, " sliding"]
    nearest: Any
    frame: Frame | None = None

    def foot(self, points: Places) -> Places:
        """What the function says."""
        if self.frame is None:
            return self.nearest(points)
        frame = jax.lax.stop_gradient(self.frame)
        return frame.into(self.nearest(points / frame.scale + frame.origin))

    def tangents(self, points: Places) -> Float[Array, "sliding dim dim"]:
        """Projectors onto what the Jacobian keeps at the nearest points, where it is one."""
        points, dim = self.foot(points), points.shape[1]

        def along(axis: Float[Array, " dim"]) -> Places:
            return jax.jvp(self.foot, (points,), (jnp.broadcast_to(axis, points.shape),))[1]

        found = jnp.stack([along(axis) for axis in jnp.eye(dim, dtype=points.dtype)], axis=-1)
        found = (found + jnp.swapaxes(found, -1, -2)) / 2
        for _ in range(_ROUNDS):
            square = found @ found
            found = 3 * square - 2 * square @ found
        return found

    def within(self, frame: Frame) -> Given:
        """The same in the frame."""
        if self.frame is not None:  # frames one after the other
            origin = self.frame.origin + frame.origin / self.frame.scale
            frame = Frame(origin, self.frame.scale * frame.scale)
        return Given(self.nodes, self.nearest, frame)


_ROUNDS = 3  # each squares what the eigenvalues of a projector are off 0 and 1 (McWeeny)


def on_surface(mesh: Mesh, nodes: Any, nearest: Callable[[Any], Any]) -> Sliding:
    """The nodes of a mask ``[nodes]`` or an index array slide on a given surface; all others are free.

    Join it by ``&`` with what else binds nodes, or give it to `detect_constraints` as one of its `surfaces`.

    Args:
        mesh: the mesh.
        nodes: which nodes.
        nearest: the nearest points of the surface, ``[m, dim] -> [m, dim]``, in JAX; `host_nearest` makes
            one of a function that is not.  Its Jacobian at the surface says what is tangent.  Where it
            is a pytree (an `equinox.Module`, a `jax.tree_util.Partial`), runs are differentiable in its
            parameters.
    """
    count = len(mesh.points)
    eye = jnp.broadcast_to(jnp.eye(mesh.dim, dtype=mesh.points.dtype), (count, mesh.dim, mesh.dim))
    return Sliding(eye, (given(np.flatnonzero(node_mask(nodes, count)), nearest),))


def given(nodes: np.ndarray, nearest: Callable[[Any], Any]) -> Given:
    """The carrier of nodes ``[s]``."""
    if not callable(nearest):
        raise ValueError(f"a surface is given by a function of points [m, dim], got {nearest!r}")
    if not isinstance(nearest, (eqx.Module, jax.tree_util.Partial)):
        nearest = jax.tree_util.Partial(nearest)
    return Given(jnp.asarray(nodes, jnp.int32), nearest)


def host_nearest(function: Callable[[np.ndarray], Any], step: float) -> Callable[[Places], Places]:
    """A function of NumPy arrays, such as a CAD kernel's nearest point, as one of JAX.

    Args:
        function: nearest points, ``[m, dim] -> [m, dim]``.
        step: the length of the central differences that stand for its derivative; about 1e-5 of the size of
            the mesh is right for exact functions.
    """
    return jax.tree_util.Partial(partial(_on_host, function, float(step)))


@partial(jax.custom_jvp, nondiff_argnums=(0, 1))
def _on_host(function: Callable[[np.ndarray], Any], step: float, points: Places) -> Places:
    def call(places):
        places = np.asarray(places)
        found = np.asarray(function(places), places.dtype)
        if found.shape != places.shape:
            raise ValueError(f"the nearest points have shape {found.shape}, the places {places.shape}")
        return found

    shape = jax.ShapeDtypeStruct(points.shape, points.dtype)
    return jax.pure_callback(call, shape, points, vmap_method="sequential")


@_on_host.defjvp
def _on_host_jvp(function, step, primals, tangents):
    (points,), (change,) = primals, tangents
    total = jnp.zeros_like(points)
    for i, axis in enumerate(np.eye(points.shape[1]) * step):
        shift = jnp.asarray(axis, points.dtype)
        slope = (_on_host(function, step, points + shift) - _on_host(function, step, points - shift)) / (
            2 * step
        )
        total = total + slope * change[:, i : i + 1]
    return _on_host(function, step, points), total
