"""The Laplacian family: classical, weighted, and the smart form of either (Sec. 3)."""

from __future__ import annotations

from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxsmooth.assembly import gather, local_nodes, scatter_add, tangents
from jaxsmooth.cells.table import ElementType
from jaxsmooth.guards.base import Guard
from jaxsmooth.guards.smart import SmartGuard
from jaxsmooth.mesh.record import Mesh
from jaxsmooth.mesh.topology import node_pairs
from jaxsmooth.methods.base import Method, Proposal
from jaxsmooth.metrics.evaluation import Evaluation
from jaxsmooth.motion.base import Motion
from jaxsmooth.numerics.small import contract, determinant

__all__ = ["Laplacian"]

Field = Float[Array, "nodes dim"]


class Laplacian(Method):
    """Every node goes to the mean of what surrounds it, within its constraints.

    Connected nodes share an edge of an element; with mid-side nodes, half an edge.  Nodes at the
    centre of faces and cells have no edge: only the weighted forms move them.

    Attributes:
        smart: a node moves only if the least quality of its patch rises (see `SmartGuard`).
        weighted: centroids of the attached elements, weighted by their measure (Eq. 38), in
            place of the connected nodes (Eq. 37).
        guard: the rule of the smart forms; the plain ones take every move.
    """

    smart: bool = eqx.field(static=True, default=False)
    weighted: bool = eqx.field(static=True, default=False)
    guard: Guard | None = eqx.field(init=False)

    def __post_init__(self):
        self.guard = SmartGuard() if self.smart else None

    def init(self, mesh: Mesh) -> Int[Array, "*batch pairs 2"] | None:
        """The connected nodes, every pair once: elements share edges, and Eq. 37 counts a neighbour once.

        Those of a `Batch` are filled up by its last node, which is a ghost, with itself.
        """
        if self.weighted:
            return None
        if mesh.connectivity[0].ndim == 2:
            return jnp.asarray(node_pairs(mesh), jnp.int32)
        each = [node_pairs(jax.tree.map(lambda leaf, i=i: leaf[i], mesh)) for i in range(len(mesh.points))]
        most, last = max(map(len, each)), mesh.points.shape[1] - 1
        filled = [np.pad(p, ((0, most - len(p)), (0, 0)), constant_values=last) for p in each]
        return jnp.asarray(np.stack(filled), jnp.int32)

    def propose(self, mesh: Mesh, motion: Motion, before: Evaluation, state: Any = None) -> Proposal:
        """The displacement of Eq. 37 or 38, projected onto the free directions of each node."""
        move = self._to_centroids(mesh) if self.weighted else self._to_neighbours(mesh, state)
        move = motion.at(mesh.points).project(move)
        return Proposal(move, jnp.int32(0), jnp.zeros((), move.dtype))

    def _to_neighbours(self, mesh: Mesh, pairs: Int[Array, "pairs 2"] | None) -> Field:
        if pairs is None:
            raise ValueError("the connected nodes are not known; pass the state that init(mesh) has made")
        ends = jnp.flip(gather(mesh.points, pairs), axis=1)
        ones = jnp.ones((*pairs.shape, 1), ends.dtype)
        total = scatter_add(jnp.concatenate([ends, ones], axis=-1), pairs, len(mesh.points))
        return _mean(total, mesh.points)

    def _to_centroids(self, mesh: Mesh) -> Field:
        total = jnp.zeros((len(mesh.points), mesh.dim + 1), mesh.points.dtype)
        for (kind, nodes), frames in zip(mesh.blocks, tangents(mesh), strict=True):
            places = gather(mesh.points, nodes)
            flat = local_nodes(mesh.points, nodes, frames)
            moments = jax.vmap(partial(_moments, kind))(places, flat)
            spread = jnp.broadcast_to(moments[:, None], (*nodes.shape, mesh.dim + 1))
            total = total + scatter_add(spread, nodes, len(mesh.points))
        return _mean(total, mesh.points)


def _mean(total: Float[Array, "nodes _"], points: Field) -> Field:
    """Displacement to the mean of summed positions and, last, their weights; 0 without weight."""
    weight = total[:, -1:]
    known = weight > 0
    return jnp.where(known, total[:, :-1] / jnp.where(known, weight, 1) - points, 0)


def _moments(
    kind: ElementType, nodes: Float[Array, "k dim"], local: Float[Array, "k local"]
) -> Float[Array, " _"]:
    """Integrals ``(∫ x |dV|, ∫ |dV|)`` of an element: V C and V of Eq. 38.

    Not C itself, which a flat element does not have.  `local` are its nodes in its own plane, if it has one.
    """
    frames = contract(local, jnp.asarray(kind.gradients, nodes.dtype))
    parts = jnp.abs(determinant(frames)) * jnp.asarray(kind.weights, nodes.dtype)
    places = jnp.asarray(kind.values, nodes.dtype) @ nodes
    return jnp.append(parts @ places, parts.sum())
