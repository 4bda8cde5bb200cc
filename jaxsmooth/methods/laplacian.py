"""The Laplacian family: classical, weighted, and the smart form of either (Sec. 3)."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxsmooth.constraints import Constraints
from jaxsmooth.elements import ElementType
from jaxsmooth.mesh import Mesh, gather, scatter_add
from jaxsmooth.methods.base import Method, Proposal
from jaxsmooth.metrics import min_jacobian, shape_quality
from jaxsmooth.patches import Evaluation, Guarded, PatchGuard, patch_min
from jaxsmooth.small import canonical, contract, determinant
from jaxsmooth.topology import node_pairs

__all__ = ["Laplacian", "SmartGuard"]

Field = Float[Array, "nodes dim"]


class Laplacian(Method):
    """Every node goes to the mean of what surrounds it, within its constraints.

    Connected nodes share an edge of an element; with mid-side nodes, half an edge.  Nodes at the
    centre of faces and cells have no edge: only the weighted forms move them.

    Attributes:
        smart: a node moves only if the least quality of its patch rises (see `SmartGuard`).
        weighted: centroids of the attached elements, weighted by their measure (Eq. 38), in
            place of the connected nodes (Eq. 37).
        pairs: connected nodes ``[pairs, 2]``, every pair once; `prepare` finds them.
        guard: the rule of the smart forms; the plain ones take every move.
    """

    smart: bool = eqx.field(static=True, default=False)
    weighted: bool = eqx.field(static=True, default=False)
    pairs: Int[Array, "pairs 2"] | None = None
    guard: SmartGuard | None = eqx.field(init=False)

    def __post_init__(self):
        self.guard = SmartGuard() if self.smart else None

    def prepare(self, mesh: Mesh) -> Laplacian:
        """Find the connected nodes: elements share edges, and Eq. 37 counts a neighbour once."""
        if self.weighted:
            return self
        return replace(self, pairs=jnp.asarray(node_pairs(mesh), jnp.int32))

    def propose(self, mesh: Mesh, constraints: Constraints, before: Evaluation) -> Proposal:
        """The displacement of Eq. 37 or 38, projected onto the free directions of each node."""
        move = self._to_centroids(mesh) if self.weighted else self._to_neighbours(mesh)
        move = jnp.einsum("nij,nj->ni", constraints.projectors, move)
        return Proposal(move, jnp.int32(0), jnp.zeros((), move.dtype))

    def _to_neighbours(self, mesh: Mesh) -> Field:
        if self.pairs is None:
            raise ValueError("the connected nodes are not known yet; use Laplacian(...).prepare(mesh)")
        ends = jnp.flip(gather(mesh.points, self.pairs), axis=1)
        ones = jnp.ones((*self.pairs.shape, 1), ends.dtype)
        total = scatter_add(jnp.concatenate([ends, ones], axis=-1), self.pairs, len(mesh.points))
        return _mean(total, mesh.points)

    def _to_centroids(self, mesh: Mesh) -> Field:
        total = jnp.zeros((len(mesh.points), mesh.dim + 1), mesh.points.dtype)
        for kind, nodes in mesh.blocks:
            moments = jax.vmap(partial(_moments, kind))(gather(mesh.points, nodes))
            spread = jnp.broadcast_to(moments[:, None], (*nodes.shape, mesh.dim + 1))
            total = total + scatter_add(spread, nodes, len(mesh.points))
        return _mean(total, mesh.points)


def _mean(total: Float[Array, "nodes _"], points: Field) -> Field:
    """Displacement to the mean of summed positions and, last, their weights; 0 without weight."""
    weight = total[:, -1:]
    known = weight > 0
    return jnp.where(known, total[:, :-1] / jnp.where(known, weight, 1) - points, 0)


def _moments(kind: ElementType, nodes: Float[Array, "k dim"]) -> Float[Array, " _"]:
    """Integrals ``(∫ x |dV|, ∫ |dV|)`` of an element: V C and V of Eq. 38.

    Not C itself, which a flat element does not have.
    """
    frames = contract(nodes, jnp.asarray(kind.gradients, nodes.dtype))
    parts = jnp.abs(determinant(frames)) * jnp.asarray(kind.weights, nodes.dtype)
    places = jnp.asarray(kind.values, nodes.dtype) @ nodes
    return jnp.append(parts @ places, parts.sum())


class RisingGuard(PatchGuard):
    """Take back the move of every node whose patch has not risen by more than `noise`."""

    noise: Float[Array, ""] | float = 0.0
    halvings: int = eqx.field(static=True, default=0)

    def threshold(self, least: Float[Array, " nodes"], floor: Float[Array, ""]) -> Float[Array, " nodes"]:
        """Above the least quality by more than the noise, of which a part is forgiven later."""
        return least + 2 * self.noise


class SmartGuard(eqx.Module):
    """A node moves only if that raises the least quality of its patch; each moves once or not.

    Independent of node numbering and still as good as a sweep from node to node: in every round
    each waiting node asks what its move alone would gain, and moves if no node that shares an
    element with it gains more.  So patches do not interfere, and nodes that lost ask again on
    the changed mesh, as later nodes of a sweep do.  Rounds end when no waiting node gains.
    Nodes with equal gain (a symmetric mesh) move together, under the rule that all their
    patches rise.

    Simultaneous moves with take-back alone are cheaper but reject what a sweep accepts: on the
    rocker arm of the benchmarks they leave 194 of 252 poor elements after three steps, these
    rounds 112, a sweep in index order 115 (weighted: 188, 121 and 124).
    """

    def __call__(self, mesh: Mesh, move: Field, before: Evaluation, beta=2.0) -> Guarded:
        """Move the nodes of `mesh` by `move` ``[nodes, dim]`` where the patches profit."""
        stopped = jax.lax.stop_gradient
        points, scale = canonical(stopped(mesh.points))
        frozen, plain, start = mesh.with_points(points), stopped(move) * scale, stopped(before)
        noise = rounding(mesh.points) * jnp.maximum(1, scale * jnp.abs(stopped(mesh.points)).max())
        together = RisingGuard(noise=noise)

        def best(points: Field, evaluation: Evaluation, waiting: Array) -> Bool[Array, " nodes"]:
            """Waiting nodes that gain, and no less than any node they share an element with."""
            current = frozen.with_points(points)
            gain = jnp.where(waiting, gains(current, plain, evaluation, noise, beta), -jnp.inf)
            rival = gain
            for _, nodes in frozen.blocks:
                most = gather(gain, nodes).max(axis=1, keepdims=True)
                rival = rival.at[nodes].max(most, mode="promise_in_bounds")
            return (gain > 0) & (gain >= rival)

        def round_(state):
            points, evaluation, waiting, going, rounds = state
            chosen = jnp.where(going[:, None], plain, 0)
            points, evaluation, _, _ = together(frozen.with_points(points), chosen, evaluation, beta)
            waiting &= ~going
            return points, evaluation, waiting, best(points, evaluation, waiting), rounds + 1

        waiting = (plain != 0).any(axis=1)
        state = frozen.points, start, waiting, best(frozen.points, start, waiting), jnp.int32(0)
        points, after, _, _, rounds = jax.lax.while_loop(lambda s: s[3].any(), round_, state)
        accepted = (points != frozen.points).any(axis=1)
        points = mesh.points + jnp.where(accepted[:, None], move, 0)
        return Guarded(points, after, (waiting & ~accepted).sum(), rounds)


def gains(mesh: Mesh, move: Field, before: Evaluation, noise, beta) -> Float[Array, " nodes"]:
    """By how much the least quality of each patch rises if its node alone moves.

    −∞ where that is noise, or where a valid element would turn inverted.
    """
    after = jnp.full(len(mesh.points), jnp.inf, mesh.points.dtype)
    for (kind, nodes), det in zip(mesh.blocks, before.jacobian, strict=True):
        alone = jnp.eye(kind.k, dtype=mesh.points.dtype)[:, :, None]
        variants = gather(mesh.points, nodes)[:, None] + alone * gather(move, nodes)[:, None]
        each = jax.vmap(jax.vmap(partial(shape_quality, kind, beta=beta)))(variants)
        turned = ~(jax.vmap(jax.vmap(partial(min_jacobian, kind)))(variants) > 0) & (det > 0)[:, None]
        after = after.at[nodes].min(jnp.where(turned, -jnp.inf, each), mode="promise_in_bounds")
    risen = after - patch_min(mesh, before.quality)
    return jnp.where(risen > noise, risen, -jnp.inf)  # so written, NaN gains nothing


def rounding(points: Field) -> float:
    """A difference of qualities, which are of order 1, that means nothing, in a mesh at the origin.

    A mid-side node that slides along its straight side changes the quality by as much; by more where
    coordinates far from the origin are rounded to fewer digits of the mesh.
    """
    return 32 * float(jnp.finfo(points.dtype).eps)
