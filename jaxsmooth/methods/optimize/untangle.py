"""Untangling: inverted elements are turned right side out, wherever that can be done."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxsmooth.assembly import gather, patch_mean
from jaxsmooth.guards.acceptance import AcceptanceRule
from jaxsmooth.guards.base import Guard
from jaxsmooth.guards.patch import PatchGuard
from jaxsmooth.mesh.record import Mesh
from jaxsmooth.methods.base import Method, Proposal
from jaxsmooth.methods.optimize.distortion import positive_part
from jaxsmooth.methods.optimize.minimise import Newton
from jaxsmooth.methods.optimize.problem import Aggregation, Problem, problem
from jaxsmooth.metrics.evaluation import Evaluation
from jaxsmooth.metrics.shape import MEAN_RATIO
from jaxsmooth.motion.base import Motion
from jaxsmooth.numerics.implicit import undifferentiated
from jaxsmooth.numerics.small import Frame
from jaxsmooth.numerics.varying import varying_like
from jaxsmooth.targets import Measures, OwnSize

__all__ = ["Untangle"]

_ROUNDS = 3  # sizes in a tangled mesh are noise, their means over neighbours much less so
_LEAST_FALL = 0.1  # part by which ε's measure falls in every step (σ of Garanzha et al. 2021)
_SETTLED, _FAST_FALL = 1e-3, 0.7  # the same where the energy of one ε falls by less than the first
_FIRST = 0.01  # least ε at the start
_STUCK = 0.1  # ε over the worst inversion, below which that is there to stay
_NO_DERIVATIVE = "Untangle has no derivative: what it finds depends on its start; use js.optimum from there"

Given = tuple[Bool[Array, "_ _"], ...]
Scalar = Float[Array, ""]


class _State(NamedTuple):
    """On the way: ε, the least determinant of all elements that are not given up, and which are."""

    points: Float[Array, "nodes dim"]
    eps: Scalar
    worst: Scalar
    given: Given
    relief: tuple[Float[Array, "_ _"], ...]
    taken: Int[Array, ""]


class Untangle(Method):
    """Minimise the mean inverse mean ratio with a barrier that falls as inversions do.

    The method of Garanzha, Kaporin, Kudryavtseva, Protais, Ray and Sokolov (2021), "Foldover-free maps in
    50 lines of code": χ(det, ε) stands for the determinant, and after every step ε is set by what the energy
    has fallen and by the worst determinant D, ``μ = (1 − σ) χ(D, ε)``, ``ε = 2 √(μ (μ − D))``; ours falls
    faster where the energy has settled.  Elements that can't be repaired because of nodes that are held would
    stop the others: those whose nodes are all held are left out from the start, and where ε has become small
    beside D, the worst are.

    Attributes:
        iterations: bound on the steps of the minimisation in one step of the method.
        minimiser: what makes them.
        guard: takes back what has inverted an element that was not.

    A valid mesh stays as it is; of a tangled one `smooth` keeps whatever has fewer inverted elements.  There
    is no derivative: a `TypeError` says so.
    """

    iterations: int = 100
    minimiser: Newton = Newton(cg_iterations=20, cg_tolerance=0.05)
    guard: Guard | None = PatchGuard(gamma=0.0, poor=0.0, corner=0.0)

    @property
    def acceptance(self) -> AcceptanceRule:
        """Only inversion counts."""
        return AcceptanceRule(0, math.inf, math.inf, math.inf, math.inf)

    def attempts(self, tangled: bool) -> tuple[Method, ...]:
        """The method alone: stricter guards leave more inverted."""
        return (self,)

    def propose(self, mesh: Mesh, motion: Motion, before: Evaluation, state: Any = None) -> Proposal:
        """The displacement to the untangled mesh."""
        points, motion, method = undifferentiated((mesh.points, motion, self), _NO_DERIVATIVE)
        return method._untangled(mesh.with_points(points), motion)

    def _untangled(self, mesh: Mesh, motion: Motion) -> Proposal:
        frame = Frame.of(mesh.points)
        mesh, motion = mesh.with_points(frame.into(mesh.points)), motion.within(frame)
        task = problem(mesh, motion, _sizes(mesh, frame), Aggregation(0.0, 1.0, 1.0), MEAN_RATIO)
        points, dtype = mesh.points, mesh.points.dtype
        nothing = jnp.finfo(dtype).eps ** 0.6  # determinants of flat elements are rounding

        def unfinished(state):
            return (state.worst <= 0) & (state.taken < self.iterations)

        def step(state):
            here = _relieved(task, state.relief)
            taken = self.minimiser.step(here, state.points, state.eps, state.worst)
            fall = 1 - taken.after / taken.before
            fall = jnp.where(fall < _SETTLED, _FAST_FALL, jnp.maximum(fall, _LEAST_FALL))
            mu = (1 - fall) * positive_part(taken.least, state.eps)
            eps = jnp.where(taken.least > 0, 0, 2 * jnp.sqrt(mu * (mu - jnp.minimum(taken.least, 0))))
            following = _State(taken.points, eps, taken.least, state.given, state.relief, state.taken + 1)
            stuck = (taken.least <= 0) & ((eps < -_STUCK * taken.least) | (taken.least > -nothing))
            return jax.lax.cond(stuck, give_up, lambda state: state, following)

        def give_up(state):
            below = jnp.where(state.worst < -nothing, state.worst / 2, 0)
            dets = task.determinants(state.points)
            given = tuple(out | (det <= below) for out, det in zip(state.given, dets, strict=True))
            return start(state.points, given, state.taken + 1)

        def start(points, given, count):
            here = task.giving_up(points, given)
            worst = here.least(points)
            relief = tuple(block.data.relief for block in here.blocks)
            eps = jnp.maximum(_FIRST, -worst)
            return varying_like(_State(points, eps, worst, given, relief, count), points)

        first = start(points, task.hopeless(points), jnp.int32(0))
        end = jax.lax.while_loop(unfinished, step, first)
        move = jnp.where(jnp.isfinite(end.points).all(), end.points - points, 0)
        return Proposal(move / frame.scale, end.taken, jnp.zeros((), dtype))


def _relieved(task: Problem, relief: tuple[Array, ...]) -> Problem:
    return eqx.tree_at(lambda task: [block.data.relief for block in task.blocks], task, list(relief))


def _sizes(mesh: Mesh, frame: Frame) -> Measures:
    """What elements measure, averaged over neighbours."""
    sizes = OwnSize().measures(mesh, frame)
    for _ in range(_ROUNDS):
        around = patch_mean(mesh, sizes)
        sizes = tuple(gather(around, nodes).mean(axis=1) for _, nodes in mesh.blocks)
    return sizes
