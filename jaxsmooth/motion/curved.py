"""Sliding on curved surfaces and along curves: tangents and nearest points, without a search tree.

A surface is made of quadratic patches.  The point of it that is nearest to a place is found by walking from
patch to neighbouring patch with Newton's method, starting from a patch that was there at the outset.
"""

from __future__ import annotations

import abc
from typing import ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxsmooth.motion.base import Motion
from jaxsmooth.numerics.admissible import Admissible
from jaxsmooth.numerics.small import Frame, cofactors, determinant

__all__ = ["Carrier", "Patches", "Sliding"]

Field = Float[Array, "nodes dim"]

_WALK = 40  # patches and Newton steps on the way to a nearest point
_IDLE = 8  # patches that meet at a vertex: a walk that goes round it more than once has arrived
_TURNS = 2  # times a walk may go back over the same edge before it stays on it


class Carrier(eqx.Module):
    """What some nodes slide on."""

    nodes: eqx.AbstractVar[Int[Array, " sliding"]]
    tethered: ClassVar[bool] = False  # whether its nodes lie on it from the outset

    @abc.abstractmethod
    def foot(self, points: Float[Array, "sliding dim"]) -> Float[Array, "sliding dim"]:
        """The points of it that are nearest to places."""

    @abc.abstractmethod
    def tangents(self, points: Float[Array, "sliding dim"]) -> Float[Array, "sliding dim dim"]:
        """Projectors onto its tangents at these points."""

    @abc.abstractmethod
    def within(self, frame: Frame) -> Carrier:
        """The same in the coordinates of a frame."""

    def limited(self, move: Float[Array, "sliding dim"]) -> Float[Array, "sliding dim"]:
        """A move, shortened where it is longer than can be followed."""
        return move


class Sliding(Motion):
    """Nodes that go straight along constant directions, and nodes that slide on something curved.

    Attributes:
        projectors: onto the free directions of every node ``[nodes, dim, dim]``: the identity where
            carriers say all.
        carriers: what nodes slide on; a node of several takes one after the other.
    """

    projectors: Float[Array, "nodes dim dim"]
    carriers: tuple[Carrier, ...]

    def at(self, points: Field) -> Admissible:
        """The tangents at the present points."""
        projectors = self.projectors
        for carrier in self.carriers:
            tangents = carrier.tangents(points[carrier.nodes])
            projectors = projectors.at[carrier.nodes].set(_shared(projectors[carrier.nodes], tangents))
        return Admissible(projectors)

    def retract(self, points: Field, move: Field) -> Field:
        """The nearest points of what nodes slide on; a node that does not move stays exactly where it is.

        A node stays as well where the nearest point would be much farther away than the move is long.
        """
        for carrier in self.carriers:
            move = move.at[carrier.nodes].set(carrier.limited(move[carrier.nodes]))
        found = points + move
        for carrier in self.carriers:
            here, step = points[carrier.nodes], move[carrier.nodes]
            foot = carrier.foot(found[carrier.nodes])
            still = (step == 0).all(axis=-1, keepdims=True)
            unmoved = still | ~jnp.isfinite(foot).all(axis=-1, keepdims=True)
            if carrier.tethered:
                long = ((foot - here) ** 2).sum(axis=-1) > 4 * (step**2).sum(axis=-1)
                unmoved |= long[:, None]
            change = foot - jax.lax.stop_gradient(foot)
            foot = jnp.where(unmoved, here + jnp.where(still, change, 0), foot)
            found = found.at[carrier.nodes].set(foot)
        return found

    def within(self, frame: Frame) -> Sliding:
        """The same in the frame."""
        return Sliding(self.projectors, tuple(carrier.within(frame) for carrier in self.carriers))

    @property
    def counts(self) -> dict[str, int]:
        """How many nodes slide on curved faces, along curved edges, and on given surfaces."""
        names = {2: "on curved faces", 1: "along curved edges"}
        found: dict[str, int] = {}
        for carrier in self.carriers:
            name = names[carrier.dim] if isinstance(carrier, Patches) else "on given surfaces"
            found[name] = found.get(name, 0) + len(carrier.nodes)
        return found


def _shared(
    one: Float[Array, "sliding dim dim"], tangents: Float[Array, "sliding dim dim"]
) -> Float[Array, "sliding dim dim"]:
    """Projectors onto what two have in common: a plane within space, a line of two planes, or a line.

    A line that is not quite in the tangents is replaced by the nearest one that is.
    """
    dim = one.shape[-1]
    rank = jnp.trace(one, axis1=-2, axis2=-1)[:, None, None]
    both = tangents @ one @ tangents
    size = jnp.trace(both, axis1=-2, axis2=-1)[:, None, None]
    line = (rank < 1.5) & (size > 0.25)
    found = jnp.where(line, both / jnp.where(line, size, 1), jnp.where(rank > dim - 0.5, both, 0))
    if dim == 2:
        return found
    # what neither leaves out: the cofactors of the sum of the complements are those of its null space
    rest = 2 * jnp.eye(dim, dtype=one.dtype) - one - tangents
    null = cofactors(rest)
    size = jnp.trace(null, axis1=-2, axis2=-1)[:, None, None]
    planes = (rank > 1.5) & (rank < 2.5) & (size > 0.01)
    return jnp.where(planes, null / jnp.where(planes, size, 1), found)


# --- Quadratic patches ------------------------------------------------------------------------------


class Patches(Carrier):
    """A surface or curve of quadratic simplices ``S(λ) = Σ λᵢ xᵢ + Σ 4 λⱼ λₖ bᵢ``.

    Edge i of a triangle is the one that vertex i is not on; a line has one bulge b.

    Attributes:
        nodes: that slide on it.
        home: a patch near each of them; the walk starts there.
        start: where, in barycentric coordinates.
        reach: the longest move of each node.
        vertices: numbers of the vertices of each patch: neighbours share them.
        neighbours: the patch behind the side that vertex i is not on; −1 where the face ends.
        corners: x.
        bulges: b.
        directions: unit tangents of a curve, or normals of a surface, at the vertices.
    """

    nodes: Int[Array, " sliding"]
    home: Int[Array, " sliding"]
    start: Float[Array, "sliding v"]
    reach: Float[Array, " sliding"]
    vertices: Int[Array, "patches v"]
    neighbours: Int[Array, "patches v"]
    corners: Float[Array, "patches v dim"]
    bulges: Float[Array, "patches _ dim"]
    directions: Float[Array, "patches v dim"]
    tethered: ClassVar[bool] = True

    @property
    def dim(self) -> int:
        """1 for curves, 2 for surfaces."""
        return self.vertices.shape[1] - 1

    def foot(self, points: Float[Array, "sliding dim"]) -> Float[Array, "sliding dim"]:
        """The nearest points of the surface; where the face ends, of its border."""
        return _feet(self, points)[0]

    def tangents(self, points: Float[Array, "sliding dim"]) -> Float[Array, "sliding dim dim"]:
        """Projectors onto the tangents at the nearest points; they do not jump between patches."""
        along = _feet(self, points)[1]
        square = along[:, :, None] * along[:, None]
        square = square / (along**2).sum(axis=-1)[:, None, None]
        return square if self.dim == 1 else jnp.eye(points.shape[1], dtype=points.dtype) - square

    def within(self, frame: Frame) -> Patches:
        """The same in the frame."""
        corners = (self.corners - frame.origin) * frame.scale
        parts = corners, self.bulges * frame.scale, self.reach * frame.scale
        return eqx.tree_at(lambda p: (p.corners, p.bulges, p.reach), self, parts)

    def limited(self, move: Float[Array, "sliding dim"]) -> Float[Array, "sliding dim"]:
        """No longer than the reach."""
        square = (move**2).sum(axis=-1)
        far = square > self.reach**2
        factor = jnp.where(far, self.reach / jnp.sqrt(jnp.where(far, square, 1)), 1)
        return move * factor[:, None]


@jax.jit
def _feet(
    patches: Patches, points: Float[Array, "sliding dim"]
) -> tuple[Float[Array, "sliding dim"], Float[Array, "sliding dim"]]:
    """The nearest points, and the directions there."""
    fixed = jax.lax.stop_gradient(patches)
    walk = jax.vmap(lambda x, home, start: _walk(fixed, x, home, start))
    places = walk(jax.lax.stop_gradient(points), fixed.home, fixed.start)
    return jax.vmap(lambda x, place: _there(patches, x, place))(points, places)


class _Place(NamedTuple):
    """Where on the patches: a patch, barycentric coordinates; then how a walk got there.

    `entry` is the side of the patch over which the walk came (−1 for none), `turns` how often in a row it has
    come back over the same edge, `idle` how many patches in a row it has crossed without getting anywhere.
    """

    patch: Int[Array, ""]
    weights: Float[Array, " v"]
    entry: Int[Array, ""]
    turns: Int[Array, ""]
    idle: Int[Array, ""]
    visited: Int[Array, ""]
    done: Bool[Array, ""]


class _Geometry(NamedTuple):
    """A point; the derivatives ``[dim, p]`` and ``[dim, p, p]`` by all weights but the first."""

    point: Float[Array, " dim"]
    frame: Float[Array, "dim p"]
    bend: Float[Array, "dim p p"]


_EDGES = {2: np.array([[1, 0], [0, 1]]), 3: np.array([[3, 2, 1], [2, 3, 0], [1, 0, 3]])}


def _geometry(patches: Patches, patch: Int[Array, ""], weights: Float[Array, " v"]) -> _Geometry:
    """A patch at barycentric coordinates."""
    corners, bulges = patches.corners[patch], patches.bulges[patch]
    none = jnp.zeros_like(bulges[:1])
    twist = 4 * jnp.concatenate([bulges, none])[_EDGES[len(weights)]]  # [v, v, dim]
    slope = corners + (twist * weights[:, None, None]).sum(axis=0)
    point = (weights[:, None] * (corners + slope)).sum(axis=0) / 2
    across = twist[1:] - twist[:1]
    return _Geometry(point, (slope[1:] - slope[0]).T, jnp.moveaxis(across[:, 1:] - across[:, :1], -1, 0))


def _there(
    patches: Patches, x: Float[Array, " dim"], place: _Place
) -> tuple[Float[Array, " dim"], Float[Array, " dim"]]:
    """The nearest point at a known place, and the direction there, with their derivatives."""
    fixed, frozen = jax.lax.stop_gradient((patches, place))
    inverse = jax.lax.stop_gradient(_newton(fixed, jax.lax.stop_gradient(x), frozen)[1])
    here = jax.lax.stop_gradient(_geometry(fixed, frozen.patch, frozen.weights))
    step = inverse @ (here.frame.T @ (x - here.point))
    step = step - jax.lax.stop_gradient(step)  # the walk has come to its end: only the derivative counts
    weights = frozen.weights + jnp.append(-step.sum(), step)
    along = (weights[:, None] * patches.directions[frozen.patch]).sum(axis=0)
    return _geometry(patches, frozen.patch, weights).point, along


def _newton(
    patches: Patches, x: Float[Array, " dim"], place: _Place
) -> tuple[Float[Array, " v"], Float[Array, "p p"]]:
    """Newton's step towards the nearest point, in weights, along sides that the walk may not cross.

    Also the inverse of the Hessian on what is open to it.
    """
    here = _geometry(patches, place.patch, place.weights)
    gap = x - here.point
    first = here.frame.T @ here.frame
    second = first - (gap[:, None, None] * here.bend).sum(axis=0)
    convex = (_determinant(second) > 0.1 * _determinant(first)) & (jnp.trace(second) > 0)
    hessian = jnp.where(convex, second, first)
    inverse = _inverse(hessian)
    right = here.frame.T @ gap
    step = _weights(inverse @ right)
    count = len(place.weights)
    closed = (patches.neighbours[place.patch] < 0) | (
        (jnp.arange(count) == place.entry) & (place.turns >= _TURNS)
    )
    at_side = closed & (place.weights <= 0)
    blocked = at_side & (step < 0)
    if count == 2:
        stuck = blocked.any()
        return jnp.where(stuck, 0, step), jnp.where(stuck, 0, inverse)
    side = jnp.argmin(jnp.where(blocked, step, jnp.inf))
    along = jnp.asarray(_ALONG, x.dtype)[side]
    line = along[:, None] * along / (along @ hessian @ along)
    slide = _weights(line @ right)
    stuck = (at_side & (slide < 0) & (jnp.arange(count) != side)).any()
    line, slide = jnp.where(stuck, 0, line), jnp.where(stuck, 0, slide)
    held = blocked.any()
    return jnp.where(held, slide, step), jnp.where(held, line, inverse)


_ALONG = np.array([[-1.0, 1.0], [0.0, 1.0], [1.0, 0.0]])  # the side that vertex i is not on, in weights 1, 2


def _weights(step: Float[Array, " p"]) -> Float[Array, " v"]:
    return jnp.concatenate([-step.sum(keepdims=True), step])


def _determinant(matrix: Float[Array, "p p"]) -> Float[Array, ""]:
    return matrix[0, 0] if len(matrix) == 1 else determinant(matrix)


def _inverse(matrix: Float[Array, "*b p p"]) -> Float[Array, "*b p p"]:
    """Inverse of 1×1 or 2×2; 0 where there is none."""
    if matrix.shape[-1] == 1:
        return jnp.where(matrix > 0, 1 / jnp.where(matrix > 0, matrix, 1), 0)
    det = determinant(matrix)[..., None, None]
    return jnp.where(det > 0, cofactors(matrix) / jnp.where(det > 0, det, 1), 0)


def _walk(
    patches: Patches, x: Float[Array, " dim"], home: Int[Array, ""], start: Float[Array, " v"]
) -> _Place:
    """The place nearest to x that is found from `start` on patch `home`."""
    tolerance = float(jnp.finfo(x.dtype).eps) ** 0.6  # what is left after such a step is its square
    sides = jnp.arange(len(start))

    def advance(place: _Place) -> _Place:
        step, _ = _newton(patches, x, place)
        part = jnp.where(step < 0, place.weights / jnp.where(step < 0, -step, 1), jnp.inf)
        side = jnp.argmin(part)
        there = jnp.abs(step).max() <= tolerance  # then rounding shall not lead to another patch
        leaves = (part[side] < 1) & ~there
        weights = place.weights + jnp.minimum(part[side], 1) * step
        weights = jnp.where(leaves & (sides == side), 0, jnp.maximum(weights, 0))
        weights = weights / weights.sum()
        other = patches.neighbours[place.patch, side]
        back = (side == place.entry) & leaves
        crosses = leaves & (other >= 0) & ~(back & (place.turns >= _TURNS))
        patch = jnp.where(crosses, other, place.patch)
        same = patches.vertices[patch][:, None] == patches.vertices[place.patch]
        taken = jnp.where(crosses, (same * weights).sum(axis=1), weights)
        turns = jnp.where(crosses, jnp.where(back, place.turns + 1, 0), place.turns)
        entry = jnp.where(crosses, jnp.argmin(same.any(axis=1)).astype(jnp.int32), place.entry)
        length = jnp.minimum(part[side], 1) * jnp.abs(step).max()
        idle = jnp.where(crosses & (length <= tolerance), place.idle + 1, 0)
        return _Place(patch, taken, entry, turns, idle, place.visited + 1, there | (idle >= _IDLE))

    zero = jnp.int32(0)
    first = _Place(home, start, jnp.int32(-1), zero, zero, zero, jnp.bool_(False))
    return jax.lax.while_loop(lambda p: ~p.done & (p.visited < _WALK), advance, first)
