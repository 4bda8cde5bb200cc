"""The optimisation variant: shape quality maximised directly, within the same constraints."""

from __future__ import annotations

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxsmooth.guards.base import Guard
from jaxsmooth.guards.patch import PatchGuard
from jaxsmooth.mesh.record import Mesh
from jaxsmooth.methods.base import Method, Proposal
from jaxsmooth.methods.elastic.method import Elastic
from jaxsmooth.methods.optimize.distortion import METRICS
from jaxsmooth.methods.optimize.minimise import Minimiser, Newton
from jaxsmooth.methods.optimize.problem import Aggregation, Problem, problem
from jaxsmooth.metrics.evaluation import Evaluation, evaluate
from jaxsmooth.metrics.summary import POOR
from jaxsmooth.motion.base import Motion
from jaxsmooth.numerics.small import Frame
from jaxsmooth.targets import target_measures

__all__ = ["GOALS", "Optimize", "Stage"]

TARGETS = ("free size", "own size", "given size")


class Stage(NamedTuple):
    """One minimisation: weights of the average and of the worst elements, and the power of the latter.

    One that is `untangling` is left out when the mesh is valid, one that is `repairing` unless the worst
    element is worse than at the start; that element is then the pivot.
    """

    average: float
    worst: float
    power: float
    untangling: bool = False
    repairing: bool = False


_VALID = PatchGuard(gamma=0.0, poor=0.0, corner=0.0)  # only against inversion
_PATIENCE = 4  # untangling stages without success
_UNTANGLE = Stage(0, 1, 2, untangling=True)  # unlike the mean of 1 − q, it grows without bound
_REPAIR = Stage(1, 30, 32, repairing=True)
_SLACK = 1.0002  # a rise of the largest e that needs no repair
# What a user wants, as minimisations one after another (see `Aggregation`).
GOALS: dict[str, tuple[Stage, ...]] = {
    # the mean of 1 − q, with a light hand on the worst elements; twice for the iterations
    "average": (Stage(1, 0.1, 4), Stage(1, 0.1, 4)),
    # a p-norm of 1/q that comes ever closer to the maximum
    "worst": (Stage(0, 1, 4), Stage(0, 1, 8), Stage(0, 1, 16)),
    # the mean of 1 − q, and a penalty on what is worse than the pivot, then than the worst at the start
    "balanced": (Stage(1, 1, 4), Stage(1, 2, 8), _REPAIR),
}


class _State(NamedTuple):
    """Between stages: `fewest` inverted elements so far, and the stages `waited` for fewer."""

    points: Float[Array, "nodes dim"]
    iterations: Int[Array, ""]
    fewest: Float[Array, ""]
    waited: Int[Array, ""]


class Optimize(Method):
    """Maximise the quality of all elements, starting from the elastic method's mesh.

    Attributes:
        goal: ``"average"``, ``"worst"`` or ``"balanced"``: the best mean quality, the best of
            the poor elements, or both; see `GOALS`.
        metric: ``"shape_and_corners"``, the paper's q where its optimum is the ideal element, both for
            wedges, pyramids and quadratic elements, or ``"mean_ratio"`` for all; see `metrics.shape`.
        target: ``"free size"``, ``"own size"`` (the paper's) or ``"given size"``.
        size: for a given size, the measure of the target elements: a number, or one array a block.
        size_weight: how much the size counts beside the shape, unless it is free.
        pivot: of n elements, ``pivot · √n`` count as poor: the value of the next is the pivot of
            the aggregation.
        minimiser: how the objective is reduced.
        start: the method that makes the first steps, or None.
        start_steps: their number.
        untangling_steps: their number while elements are inverted.
        untangling_stages: bound on the minimisations that follow while elements are inverted; they end
            earlier when several of them have not made the inverted elements fewer.
        guard: refuses moves that invert an element; `smooth` tries stricter ones where that is not enough.

    A step is a whole optimisation; another one goes on from there.  It is not differentiable in reverse mode.
    """

    goal: str = eqx.field(static=True, default="balanced")
    metric: str = eqx.field(static=True, default="shape_and_corners")
    target: str = eqx.field(static=True, default="free size")
    size: tuple[Float[Array, " _"], ...] | Float[Array, ""] | float | None = None
    size_weight: Float[Array, ""] | float = 1.0
    pivot: Float[Array, ""] | float = 0.5
    minimiser: Minimiser = Newton()
    start: Method | None = Elastic(tolerance=0.1)
    start_steps: int = 2
    untangling_steps: int = 10
    untangling_stages: int = eqx.field(static=True, default=20)
    guard: Guard | None = _VALID

    def __check_init__(self):
        for name, known in (("goal", GOALS), ("metric", METRICS), ("target", TARGETS)):
            if getattr(self, name) not in known:
                raise ValueError(f"{name} must be one of {', '.join(known)}, got {getattr(self, name)!r}")
        if (self.target == "given size") != (self.size is not None):
            raise ValueError("size goes with target='given size', and only with it")

    def attempts(self, tangled: bool) -> tuple[Method, ...]:
        """The objective is trusted first, for it has a barrier of its own; then as for other methods."""
        if not isinstance(self.guard, PatchGuard):
            return (self,)
        usual = {"poor": POOR, "corner": PatchGuard().corner}
        return (self, self._looser()[0], self._guarded(**usual), self._guarded(**usual, keep=1.0))

    def propose(self, mesh: Mesh, motion: Motion, before: Evaluation) -> Proposal:
        """The displacement to the optimised mesh."""
        mesh, motion = jax.lax.stop_gradient((mesh, motion))
        frame = Frame.of(mesh.points)
        mesh, motion = mesh.with_points(frame.into(mesh.points)), motion.within(frame)
        sizes = self._sizes(mesh, frame.scale)
        stages = (_UNTANGLE,) * self.untangling_stages + GOALS[self.goal]
        stages = jax.tree.map(lambda *values: jnp.stack([jnp.asarray(v) for v in values]), *stages)
        zero = jnp.zeros((), mesh.points.dtype)

        def task_of(stage, points):
            aggregation = Aggregation(*(jnp.asarray(value, points.dtype) for value in stage[:3]))
            task = self._problem(mesh, motion, sizes, aggregation)
            return eqx.tree_at(lambda t: t.aggregation.pivot, task, self._pivot(task, points))

        judge = task_of(next(s for s in reversed(GOALS[self.goal]) if not s.repairing), mesh.points)
        hopeless = judge.hopeless(mesh.points)
        # the start is for meshes that it helps: an optimised one goes on where it is
        value, least = judge.value(mesh.points, zero)
        begun = self._begin(mesh, motion, before)
        helped = (judge.value(begun, zero)[0] < value) | (least <= 0)
        start = mesh.with_points(jnp.where(helped, begun, mesh.points))
        worst = _ordered(judge, start.points)[-1]

        def minimise(state, stage):
            give_up = tuple(out | ~stage.untangling for out in hopeless)
            task = task_of(stage, state.points)
            pivot = jnp.where(stage.repairing, worst, task.aggregation.pivot)
            task = eqx.tree_at(lambda t: t.aggregation.pivot, task, pivot).giving_up(state.points, give_up)
            found = self.minimiser(task, state.points)
            inverted = task.inverted(found.points, hopeless)
            waited = jnp.where(inverted < state.fewest, 0, state.waited + 1)
            iterations = state.iterations + found.iterations
            return _State(found.points, iterations, jnp.minimum(inverted, state.fewest), waited)

        def guarded(points):
            return _VALID(start, motion, points - start.points, evaluate(start)).points

        def sound(points):
            return (tangled > 0) | (_ordered(judge, points)[-1] <= _SLACK * worst)

        def run(state, numbered):
            index, stage = numbered
            idle = stage.untangling & ((state.fewest == 0) | (state.waited > _PATIENCE))
            idle |= jax.lax.cond(stage.repairing, sound, lambda _: jnp.bool_(False), state.points)
            state = jax.lax.cond(idle, lambda state, _: state, minimise, state, stage)
            untangled = (index == self.untangling_stages - 1) & (tangled > 0)
            points = jax.lax.cond(untangled, guarded, lambda points: points, state.points)
            return state._replace(points=points), None

        tangled = judge.inverted(start.points, hopeless)
        first = _State(start.points, jnp.int32(0), tangled, jnp.int32(0))
        end, _ = jax.lax.scan(run, first, (jnp.arange(len(stages.power)), stages))
        finite = jnp.isfinite(end.points).all()
        move = jnp.where(finite, end.points - mesh.points, 0)
        return Proposal(move / frame.scale, end.iterations, zero)

    def _begin(self, mesh: Mesh, motion: Motion, before: Evaluation) -> Float[Array, "nodes dim"]:
        """The points after the steps of the starting method."""
        if self.start is None:
            return mesh.points

        def unfinished(carry):
            _, before, count = carry
            tangled = jnp.stack([(det <= 0).any() for det in before.jacobian]).any()
            return count < jnp.where(tangled, self.untangling_steps, self.start_steps)

        def step(carry):
            points, before, count = carry
            found = self.start.step(mesh.with_points(points), motion, before)
            return found.points, found.evaluation, count + 1

        return jax.lax.while_loop(unfinished, step, (mesh.points, before, jnp.int32(0)))[0]

    def _sizes(self, mesh: Mesh, scale: Float[Array, ""]) -> tuple[Float[Array, " _"], ...]:
        """Of a mesh that has been scaled; given sizes are not."""
        own = target_measures(mesh)
        if self.target != "given size":
            return own
        given = self.size if isinstance(self.size, tuple) else (self.size,) * len(own)
        unit = scale**mesh.dim
        return tuple(
            jnp.full_like(part, 1) * jnp.asarray(size, part.dtype) * unit
            for size, part in zip(given, own, strict=True)
        )

    def _problem(self, mesh: Mesh, motion: Motion, sizes, aggregation: Aggregation) -> Problem:
        weight = 0.0 if self.target == "free size" else self.size_weight
        return problem(mesh, motion, sizes, aggregation, self.metric, weight)

    def _pivot(self, task: Problem, points: Float[Array, "nodes dim"]) -> Float[Array, ""]:
        """The e that so many of the elements with weight exceed."""
        e = _ordered(task, points)
        behind = jnp.floor(self.pivot * jnp.sqrt((e > 0).sum())).astype(jnp.int32)
        return jnp.maximum(e[jnp.maximum(len(e) - 1 - behind, 0)], 1)  # 1 where nothing may move


def _ordered(task: Problem, points: Float[Array, "nodes dim"]) -> Float[Array, " elements"]:
    """The finite e of the elements with weight in ascending order, after zeros for the others."""
    e, weight = task.inverse_quality(points)
    return jnp.sort(jnp.where((weight > 0) & jnp.isfinite(e), jnp.maximum(e, 1), 0))
