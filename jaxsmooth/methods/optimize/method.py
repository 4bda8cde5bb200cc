"""The optimisation variant: shape quality maximised directly, within the same constraints."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, NamedTuple

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
from jaxsmooth.methods.optimize.goals import BALANCED, GOALS, UNTANGLE, Goal
from jaxsmooth.methods.optimize.minimise import Minimiser, Newton
from jaxsmooth.methods.optimize.problem import Aggregation, Problem, problem
from jaxsmooth.metrics.evaluation import Evaluation, evaluate
from jaxsmooth.metrics.summary import POOR
from jaxsmooth.motion.base import Motion
from jaxsmooth.numerics.small import Frame
from jaxsmooth.targets import FreeSize, OwnSize, Target

__all__ = ["Optimize"]

_VALID = PatchGuard(gamma=0.0, poor=0.0, corner=0.0)  # only against inversion
_PATIENCE = 4  # untangling stages without success
_SLACK = 1.0002  # a rise of the largest e that needs no repair


class _State(NamedTuple):
    """Between stages: `fewest` inverted elements so far, and the stages `waited` for fewer."""

    points: Float[Array, "nodes dim"]
    iterations: Int[Array, ""]
    fewest: Float[Array, ""]
    waited: Int[Array, ""]


def _goal(value: Goal | str) -> Goal:
    if isinstance(value, str) and value not in GOALS:
        raise ValueError(f"goal must be a Goal, or one of {', '.join(GOALS)}; got {value!r}")
    return GOALS[value] if isinstance(value, str) else value


class Optimize(Method):
    """Maximise the quality of all elements, starting from the elastic method's mesh.

    Attributes:
        goal: `AVERAGE`, `WORST` or `BALANCED`, or one of your own; a name of `GOALS` will do.
        metric: ``"shape"``, the paper's q where its optimum is the ideal element, both for wedges,
            pyramids and quadratic elements, or ``"mean_ratio"`` for all.
        target: `FreeSize`, `OwnSize` (the paper's) or `GivenSize`.
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

    goal: Goal = eqx.field(static=True, converter=_goal, default=BALANCED)
    metric: str = eqx.field(static=True, default="shape")
    target: Target = FreeSize()
    pivot: Float[Array, ""] | float = 0.5
    minimiser: Minimiser = Newton()
    start: Method | None = Elastic(tolerance=0.1)
    start_steps: int = 2
    untangling_steps: int = 10
    untangling_stages: int = eqx.field(static=True, default=20)
    guard: Guard | None = _VALID

    def __check_init__(self):
        if self.metric not in METRICS:
            raise ValueError(f"metric must be one of {', '.join(METRICS)}, got {self.metric!r}")

    @property
    def acceptance(self) -> AcceptanceRule:
        """A goal that knows the worst elements alone gives some of the average quality for them."""
        rule = super().acceptance
        return rule if self.goal.averaged else replace(rule, average=math.inf)

    def attempts(self, tangled: bool) -> tuple[Method, ...]:
        """The objective is trusted first, for it has a barrier of its own; then as for other methods."""
        if not isinstance(self.guard, PatchGuard):
            return (self,)
        usual = {"poor": POOR, "corner": PatchGuard().corner}
        return (self, self._looser()[0], self._guarded(**usual), self._guarded(**usual, keep=1.0))

    def propose(self, mesh: Mesh, motion: Motion, before: Evaluation, state: Any = None) -> Proposal:
        """The displacement to the optimised mesh."""
        mesh, motion = jax.lax.stop_gradient((mesh, motion))
        frame = Frame.of(mesh.points)
        mesh, motion = mesh.with_points(frame.into(mesh.points)), motion.within(frame)
        sizes = (self.target if self.target.sized else OwnSize()).measures(mesh, frame)  # as units, if free
        stages = (UNTANGLE,) * self.untangling_stages + self.goal.stages
        stages = jax.tree.map(lambda *values: jnp.stack([jnp.asarray(v) for v in values]), *stages)
        zero = jnp.zeros((), mesh.points.dtype)

        def task_of(stage, points):
            aggregation = Aggregation(*(jnp.asarray(value, points.dtype) for value in stage[:3]))
            task = self._problem(mesh, motion, sizes, aggregation)
            return eqx.tree_at(lambda t: t.aggregation.pivot, task, self._pivot(task, points))

        judge = task_of(self.goal.last, mesh.points)
        hopeless = judge.hopeless(mesh.points)
        # the start is for meshes that it helps: an optimised one goes on where it is
        value, least = judge.value(mesh.points, zero)
        begun = self._begin(mesh, motion, before, state)
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

    def init(self, mesh: Mesh) -> Any:
        """The state of the starting method."""
        return None if self.start is None else self.start.init(mesh)

    def _begin(self, mesh: Mesh, motion: Motion, before: Evaluation, state: Any) -> Float[Array, "nodes dim"]:
        """The points after the steps of the starting method."""
        if self.start is None:
            return mesh.points

        def unfinished(carry):
            _, before, count = carry
            tangled = jnp.stack([(det <= 0).any() for det in before.jacobian]).any()
            return count < jnp.where(tangled, self.untangling_steps, self.start_steps)

        def step(carry):
            points, before, count = carry
            found = self.start.step(mesh.with_points(points), motion, before, state)
            return found.points, found.evaluation, count + 1

        return jax.lax.while_loop(unfinished, step, (mesh.points, before, jnp.int32(0)))[0]

    def _problem(self, mesh: Mesh, motion: Motion, sizes, aggregation: Aggregation) -> Problem:
        weight = self.target.weight if self.target.sized else 0.0
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
