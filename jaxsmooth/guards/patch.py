"""The patch guard (Eq. 34): no patch, the elements around a node, may become much worse."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.ad_checkpoint import checkpoint_name
from jaxtyping import Array, Bool, Float, Int

from jaxsmooth.assembly import elements_with, frames_of, gather, local_nodes, over_chosen, patch_min
from jaxsmooth.guards.acceptance import OPEN
from jaxsmooth.guards.base import Guard, Guarded
from jaxsmooth.mesh.record import Mesh
from jaxsmooth.metrics.evaluation import Evaluation, evaluate_element, weight
from jaxsmooth.metrics.summary import POOR
from jaxsmooth.motion.base import Motion
from jaxsmooth.numerics.small import Frame
from jaxsmooth.numerics.varying import varying_like

__all__ = ["PatchGuard"]

Blocks = tuple[Float[Array, " _"], ...]
Corners = tuple[Float[Array, " _"] | None, ...]
Field = Float[Array, "nodes dim"]


class _Needs(NamedTuple):
    """What an element must keep after the move, block by block.

    Attributes:
        node: quality, for each of its nodes ``[elements, k]``: who moves answers for the patch.
        quality, jacobian, corners: of the element; all its nodes answer.
    """

    node: tuple[Float[Array, "_ _"], ...]
    quality: Blocks
    jacobian: Blocks
    corners: Corners


class PatchGuard(Guard):
    """Eq. 34 in a form that does not depend on node numbering, and what it leaves out.

    All nodes move; where a patch ends below γ times its least quality, the move of its node is
    halved, and in the end taken back; until no patch offends.  Where a node that stays is left with
    an offending patch, the moves of all nodes of the offending elements are shortened.  It ends,
    because elements whose nodes do not move offend nobody: that is the old mesh.

    Beyond Eq. 34 no single element may turn inverted, nor fall below a floor of its quality or of its
    scaled Jacobian (q is blunt about the corners of all but simplices); patches that are below may not get
    worse.  So poor elements never get more.  The floors are `poor` and `corner`, or the part `keep` of what
    the worst element of the mesh has, where that is more (of a scaled Jacobian no more than 0.7: above that
    it does not matter how open a corner is).

    The accepted fractions of the moves are constants for differentiation.

    Attributes:
        gamma: γ of Eq. 34.
        poor: floor of the quality; 0 for none.
        corner: floor of the scaled Jacobian; 0 for none.  With both at 0 this is Eq. 34 alone, with
            the test for inversion.
        keep: with 1 the least quality and the least scaled Jacobian of a mesh never fall.
        halvings: how often a move is halved before it is taken back, once it is no longer than the
            elements around it are large.
    """

    gamma: Float[Array, ""] | float = 0.8
    poor: Float[Array, ""] | float = POOR
    corner: Float[Array, ""] | float = 0.1
    keep: Float[Array, ""] | float = 0.8
    halvings: int = eqx.field(static=True, default=5)

    def threshold(self, least: Float[Array, " nodes"], floor: Float[Array, ""]) -> Float[Array, " nodes"]:
        """The quality that all elements around a moving node must keep."""
        return jnp.minimum(least, jnp.maximum(self.gamma * least, floor))

    def __call__(self, mesh: Mesh, motion: Motion, move: Field, before: Evaluation) -> Guarded:
        """Move the nodes of `mesh` by `move` ``[nodes, dim]``, as far as the patches allow."""
        stopped = jax.lax.stop_gradient
        frozen, path, start = mesh.with_points(stopped(mesh.points)), stopped(motion), stopped(before)
        admissible = path.at(frozen.points)
        moves = admissible.led((stopped(move) != 0).any(axis=-1))
        finite = ~admissible.together(~jnp.isfinite(stopped(move)).all(axis=-1))
        plain = jnp.where(finite[:, None], stopped(move), 0)
        needs = self._needs(frozen, moves, start)
        more = -admissible.least(-_extra_halvings(frozen, plain, start)) if self.halvings else 0
        limit = jnp.where(moves & finite, self.halvings + more, -1)

        def still(count):
            """Nodes that stay; those that follow others stay where all of these do."""
            return ~admissible.led(count <= limit)

        frame = Frame.of(frozen.points)

        def sweep(state):
            count, points, after, bad, sweeps = state
            together = admissible.together(bad)
            count = count + together
            now = moved(frozen, path, plain, fraction(count, limit)).points
            # all others offend nobody, as before: who offends has a node that must move less
            changed = (sweeps == 0) | together | (now != points).any(axis=1)
            after, bad = _looked_at(frozen, frame.into(now), changed, still(count), needs, after)
            return count, now, after, bad, sweeps + 1

        def unfinished(state):
            count, _, _, bad, sweeps = state
            return (sweeps == 0) | (bad & ~still(count)).any()

        nothing = jnp.zeros(len(mesh.points), jnp.int32)
        state = varying_like((nothing, frozen.points, start, nothing > 0, jnp.int32(0)), plain)
        count, _, after, _, sweeps = jax.lax.while_loop(unfinished, sweep, state)
        part = checkpoint_name(fraction(count, limit), "accepted")
        return Guarded(moved(mesh, motion, move, part).points, after, (moves & (part < 1)).sum(), sweeps)

    def _needs(self, mesh: Mesh, moves: Bool[Array, " nodes"], start: Evaluation) -> _Needs:
        slack = 32 * jnp.finfo(mesh.points.dtype).eps  # an element may be rounded in two ways
        floor, least = _floor(self.poor, self.keep, start.quality)
        node = jnp.where(moves, self.threshold(patch_min(mesh, start.quality), floor), -jnp.inf)
        corner_floor, corner_least = _floor(self.corner, self.keep, start.corners)
        corner_floor = jnp.minimum(corner_floor, jnp.maximum(self.corner, OPEN))
        corner_patch = patch_min(mesh, start.corners)
        needs = []
        for (_, nodes), q, det, corner in zip(mesh.blocks, *start, strict=True):
            need = gather(node, nodes) - slack, jnp.where(q >= floor, floor, least) - slack
            if corner is None:
                needs.append((*need, jnp.where(det > 0, 0, -jnp.inf), None))
                continue
            # valid elements stay valid; those that are not proven, but open at all corners, as good
            proven = jnp.where(det > 0, 0, jnp.where(corner > 0, (1 + slack) * det, -jnp.inf))
            around = jnp.where(det > 0, gather(corner_patch, nodes).max(axis=1), corner_least)
            open_ = jnp.where(corner >= corner_floor, corner_floor, around) - slack
            needs.append((*need, proven, open_))
        return _Needs(*zip(*needs, strict=True))


def _floor(
    floor: Array | float, keep: Array | float, values: Corners
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """`floor`, or a part of the least of all values where that is more, and that least; −∞ for no floor."""
    parts = [part.min() for part in values if part is not None]
    least = jnp.stack(parts).min() if parts else jnp.inf
    wanted = jnp.asarray(floor) > 0
    return jnp.where(wanted, jnp.maximum(floor, keep * least), -jnp.inf), jnp.where(wanted, least, -jnp.inf)


def _looked_at(
    mesh: Mesh,
    points: Field,
    changed: Bool[Array, " nodes"],
    still: Bool[Array, " nodes"],
    needs: _Needs,
    known: Evaluation,
) -> tuple[Evaluation, Bool[Array, " nodes"]]:
    """Elements with nodes that have changed are evaluated anew, at `points`; and nodes that these accuse.

    Nodes whose patch offends; of an element that offends a node that is still, all nodes.
    """
    found, bad = [], jnp.zeros(len(changed), bool)
    normals = mesh.normals or (None,) * len(mesh.types)
    for (kind, nodes), up, chosen, *rows in zip(
        mesh.blocks, normals, elements_with(mesh, changed), *needs, *known, strict=True
    ):
        need, values = (tuple(row for row in part if row is not None) for part in (rows[:4], rows[4:]))

        def look(state, numbers, kind=kind, nodes=nodes, up=up, need=need):
            values, bad = state
            corners, *least = (row.at[numbers].get(mode="clip") for row in (nodes, *need))
            up = None if up is None else up.at[numbers].get(mode="clip")
            local = local_nodes(points, corners, frames_of(kind, points, corners, up))
            new = jax.vmap(partial(evaluate_element, kind))(local)
            accused = _accused(least, new, gather(still, corners)) & (numbers < len(nodes))[:, None]
            values = tuple(
                old.at[numbers].set(part, mode="drop") for old, part in zip(values, new, strict=True)
            )
            return values, bad.at[corners].max(accused, mode="promise_in_bounds")

        values, bad = over_chosen(look, (values, bad), chosen, mesh.execution, weight(kind))
        found.append((*values, None)[:3])
    return Evaluation(*zip(*found, strict=True)), bad


def _accused(
    need: Sequence[Array], new: Sequence[Array], still: Bool[Array, "elements k"]
) -> Bool[Array, "elements k"]:
    """Nodes that must move less for the sake of these elements."""
    own = ~(new[0][:, None] >= need[0])  # so written, NaN offends
    whole = (own & still).any(axis=1) | ~(new[0] >= need[1]) | ~(new[1] > need[2])
    for corner, least in zip(new[2:], need[3:], strict=True):
        whole |= ~(corner >= least)
    return own | whole[:, None]


def _extra_halvings(mesh: Mesh, move: Field, start: Evaluation) -> Int[Array, " nodes"]:
    """Halvings that make a move as short as the least element around its node is large."""
    sizes = tuple(
        jnp.abs(det) ** (1 / kind.dim) for (kind, _), det in zip(mesh.blocks, start.jacobian, strict=True)
    )
    local = patch_min(mesh, sizes)
    length = jnp.abs(move).max(axis=-1) * Frame.of(mesh.points).scale
    ratio = jnp.where(jnp.isfinite(length) & (local > 0), length / jnp.where(local > 0, local, 1), 1)
    return jnp.ceil(jnp.log2(jnp.clip(ratio, 1, _LONGEST))).astype(jnp.int32)


_LONGEST = 2.0**10  # a move that is longer, over the size of the elements, is not worth the sweeps


def fraction(count: Int[Array, " nodes"], limit: Int[Array, " nodes"]) -> Float[Array, " nodes"]:
    """The part of its move that a node makes after `count` objections, of which it bears `limit`."""
    return jnp.where(count > limit, 0.0, 0.5**count)


def moved(mesh: Mesh, motion: Motion, move: Field, fraction: Float[Array, " nodes"]) -> Mesh:
    """The mesh with every node moved by a fraction of `move`."""
    scaled = jnp.where(fraction[:, None] > 0, move * fraction[:, None].astype(move.dtype), 0)
    return mesh.with_points(motion.retract(mesh.points, scaled))
