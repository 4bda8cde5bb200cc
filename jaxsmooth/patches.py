"""Patches (the elements around a node), the evaluation of a mesh, and the patch guard."""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.ad_checkpoint import checkpoint_name
from jaxtyping import Array, Float, Int

from jaxsmooth.mesh import Mesh, gather
from jaxsmooth.metrics import min_jacobian, shape_quality

__all__ = ["Evaluation", "Guarded", "PatchGuard", "evaluate", "patch_mean", "patch_min"]

Blocks = tuple[Float[Array, " elements"], ...]
Field = Float[Array, "nodes dim"]


class Evaluation(NamedTuple):
    """Shape quality and least Jacobian determinant of every element, block by block."""

    quality: Blocks
    jacobian: Blocks


def evaluate(mesh: Mesh, beta: Float[Array, ""] | float = 2.0) -> Evaluation:
    """Quality (Eqs. 1–5) and validity of all elements."""
    found = []
    for kind, nodes in mesh.blocks:
        corners = gather(mesh.points, nodes)
        shape = jax.vmap(partial(shape_quality, kind, beta=beta))(corners)
        found.append((shape, jax.vmap(partial(min_jacobian, kind))(corners)))
    return Evaluation(*(tuple(part) for part in zip(*found, strict=True)))


def patch_min(mesh: Mesh, values: Blocks) -> Float[Array, " nodes"]:
    """Least value of each patch; +inf at nodes without elements."""
    least = jnp.full(len(mesh.points), jnp.inf, mesh.points.dtype)
    for (_, nodes), value in zip(mesh.blocks, values, strict=True):
        least = least.at[nodes].min(value[:, None], mode="promise_in_bounds")
    return least


def patch_mean(mesh: Mesh, values: Blocks) -> Float[Array, " nodes"]:
    """Mean value of each patch; 0 at nodes without elements."""
    total = jnp.zeros((len(mesh.points), 2), mesh.points.dtype)
    for (_, nodes), value in zip(mesh.blocks, values, strict=True):
        pair = jnp.stack([value, jnp.ones_like(value)], axis=-1)
        total = total.at[nodes].add(pair[:, None], mode="promise_in_bounds")
    return total[:, 0] / jnp.maximum(total[:, 1], 1)


class Guarded(NamedTuple):
    """Attributes: new points; their evaluation; nodes whose move was shortened; sweeps taken."""

    points: Field
    evaluation: Evaluation
    shortened: Int[Array, ""]
    sweeps: Int[Array, ""]


class PatchGuard(eqx.Module):
    """Eq. 34 in a form that does not depend on node numbering.

    All nodes move; where a patch ends below γ times its least quality, the move of its node is
    halved, and after `halvings` times taken back; so are those of all nodes of an element that
    turns inverted; until no patch offends.  It ends, because nodes that do not move offend
    nobody: that is the old mesh.  Beyond Eq. 34, a patch may not fall below `poor`, and one that
    is below may not get worse.

    The accepted fractions of the moves are constants for differentiation.

    Attributes:
        gamma: γ of Eq. 34.
        poor: quality below which no patch may fall or worsen; 0 is Eq. 34 alone.
        halvings: how often a move is halved before it is taken back.
    """

    gamma: Float[Array, ""] | float = 0.8
    poor: Float[Array, ""] | float = 0.2
    halvings: int = eqx.field(static=True, default=5)

    def threshold(self, least: Float[Array, " nodes"]) -> Float[Array, " nodes"]:
        """The quality that all elements around a moving node must keep."""
        return jnp.minimum(least, jnp.maximum(self.gamma * least, self.poor))

    def __call__(self, mesh: Mesh, move: Field, before: Evaluation, beta=2.0) -> Guarded:
        """Move the nodes of `mesh` by `move` ``[nodes, dim]``, as far as the patches allow."""
        stopped = jax.lax.stop_gradient
        frozen, plain, start = mesh.with_points(stopped(mesh.points)), stopped(move), stopped(before)
        floor = self.threshold(patch_min(frozen, start.quality))

        def offenders(after):
            """Nodes whose patch offends; of an element that turns inverted, all nodes."""
            least = patch_min(frozen, after.quality)
            bad = ~(least >= floor)  # so written, NaN offends
            for (_, nodes), det, old in zip(mesh.blocks, after.jacobian, start.jacobian, strict=True):
                broken = ~((det > 0) | (old <= 0))
                bad = bad.at[nodes].max(broken[:, None], mode="promise_in_bounds")
            return bad

        def sweep(state):
            count, _, bad, sweeps = state
            count = count + bad
            after = evaluate(moved(frozen, plain, self.fraction(count)), beta)
            return count, after, offenders(after), sweeps + 1

        def unfinished(state):
            count, _, bad, _ = state
            return (bad & (count <= self.halvings)).any()

        count = jnp.zeros(len(mesh.points), jnp.int32)
        after = evaluate(moved(frozen, plain, self.fraction(count)), beta)
        state = (count, after, offenders(after), jnp.int32(1))
        count, after, _, sweeps = jax.lax.while_loop(unfinished, sweep, state)
        count = checkpoint_name(count, "accepted")
        points = moved(mesh, move, self.fraction(count)).points
        return Guarded(points, after, (count > 0).sum(), sweeps)

    def fraction(self, count: Int[Array, " nodes"]) -> Float[Array, " nodes"]:
        """The part of its move that a node makes after `count` objections."""
        return jnp.where(count > self.halvings, 0.0, 0.5**count)


def moved(mesh: Mesh, move: Field, fraction: Float[Array, " nodes"]) -> Mesh:
    """The mesh with every node moved by a fraction of `move`."""
    scaled = jnp.where(fraction[:, None] > 0, move * fraction[:, None].astype(move.dtype), 0)
    return mesh.with_points(mesh.points + scaled)
