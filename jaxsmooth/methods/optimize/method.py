"""The optimisation variant: shape quality maximised directly, within the same constraints."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxsmooth.guards.acceptance import AcceptanceRule
from jaxsmooth.guards.base import Guard
from jaxsmooth.guards.patch import PatchGuard
from jaxsmooth.mesh.record import Mesh
from jaxsmooth.methods.base import Method, Proposal
from jaxsmooth.methods.elastic.method import Elastic
from jaxsmooth.methods.optimize.distortion import METRICS, check_metric
from jaxsmooth.methods.optimize.goals import BALANCED, GOALS, UNTANGLE, Goal, When
from jaxsmooth.methods.optimize.minimise import Minimiser, Newton
from jaxsmooth.methods.optimize.problem import Aggregation, Problem, problem
from jaxsmooth.metrics.evaluation import Evaluation
from jaxsmooth.metrics.record import Metric
from jaxsmooth.metrics.shape import SHAPE_AND_CORNERS
from jaxsmooth.metrics.summary import POOR
from jaxsmooth.metrics.table import as_metric
from jaxsmooth.motion.base import Motion
from jaxsmooth.numerics.implicit import undifferentiated
from jaxsmooth.numerics.small import Frame
from jaxsmooth.targets import FreeSize, OwnSize, Target

__all__ = ["Optimize"]

_VALID = PatchGuard(gamma=0.0, poor=0.0, corner=0.0)  # only against inversion
_PATIENCE = 4  # untangling stages without success
_NO_DERIVATIVE = (
    "Optimize has no derivative: it is several minimisations that are not carried to their ends; "
    "use js.optimum, which solves for one optimum and differentiates that, or Elastic"
)
_SLACK = 1.0002  # a rise of the largest e that needs no repair
_NEAR = 1 / (POOR + 0.0175)  # the e from which elements are close to being poor


class _Start(NamedTuple):
    """The mesh where the minimisation starts, its evaluation, and its largest e."""

    mesh: Mesh
    motion: Motion
    evaluation: Evaluation
    worst: Float[Array, ""]


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


def _metric(value: Metric | str) -> Metric:
    metric = as_metric(value)
    check_metric(metric, ())
    return metric


class Optimize(Method):
    """Maximise the quality of all elements, starting from the elastic method's mesh.

    Attributes:
        goal: `AVERAGE`, `WORST` or `BALANCED`, or one of your own; a name of `GOALS` will do.
        metric: `SHAPE_AND_CORNERS`, the paper's q where its optimum is the ideal element, both for wedges,
            pyramids and quadratic elements, `MEAN_RATIO` for all (`metrics.shape`), or any other that has a
            derivative and no unit of length; names of `METRICS` will do.
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

    A step is a whole optimisation; another one goes on from there.  It has no derivative, and raises a
    `TypeError` that names `js.optimum`, which has.
    """

    goal: Goal = eqx.field(static=True, converter=_goal, default=BALANCED)
    metric: Metric = eqx.field(static=True, converter=_metric, default=SHAPE_AND_CORNERS)
    target: Target = FreeSize()
    pivot: Float[Array, ""] | float = 0.5
    minimiser: Minimiser = Newton()
    start: Method | None = Elastic(tolerance=0.1)
    start_steps: int = 2
    untangling_steps: int = 10
    untangling_stages: int = eqx.field(static=True, default=20)
    guard: Guard | None = _VALID

    @property
    def acceptance(self) -> AcceptanceRule:
        """A goal that knows the worst elements alone, or another metric, is worth some average quality."""
        rule = super().acceptance
        kept = self.goal.averaged and self.metric in METRICS
        return rule if kept else replace(rule, average=math.inf)

    def attempts(self, tangled: bool) -> tuple[Method, ...]:
        """The objective is trusted first, for it has a barrier of its own; then as for other methods."""
        if not isinstance(self.guard, PatchGuard):
            return (self,)
        guard, usual = self.guard, {"poor": POOR, "corner": PatchGuard().corner}
        mended = self._guarded(guard, **usual), self._guarded(guard, **usual, keep=1.0)
        return (self, self._looser(guard)[0], *mended)

    def propose(self, mesh: Mesh, motion: Motion, before: Evaluation, state: Any = None) -> Proposal:
        """The displacement to the optimised mesh."""
        points, motion, method = undifferentiated((mesh.points, motion, self), _NO_DERIVATIVE)
        return method._optimised(mesh.with_points(points), motion, before, state)

    def _optimised(self, mesh: Mesh, motion: Motion, before: Evaluation, state: Any) -> Proposal:
        frame = Frame.of(mesh.points)
        mesh, motion = mesh.with_points(frame.into(mesh.points)), motion.within(frame)
        sizes = (self.target if self.target.sized else OwnSize()).measures(mesh, frame)  # units, if free
        weight = self.target.weight if self.target.sized else 0.0
        task = problem(mesh, motion, sizes, Aggregation(0.0, 0.0, 1.0), self.metric, weight)
        start = self._start(task, mesh, motion, before, state)
        hopeless = task.hopeless(mesh.points)
        tangled = task.inverted(start.mesh.points, hopeless)
        end = self._stages(task, start, hopeless, tangled)
        finite = jnp.isfinite(end.points).all()
        move = jnp.where(finite, end.points - mesh.points, 0)
        return Proposal(move / frame.scale, end.iterations, jnp.zeros((), mesh.points.dtype))

    def _start(self, task: Problem, mesh: Mesh, motion: Motion, before: Evaluation, state: Any) -> _Start:
        """Where the minimisation starts: the start is for meshes that it helps, an optimised one goes on."""
        begun, evaluation = self._begin(mesh, motion, before, state)
        looks = jax.lax.map(partial(_look, task), jnp.stack([mesh.points, begun]))
        stage = self.goal.last
        judge = Aggregation(stage.average, stage.worst, stage.power, self._pivot(looks.ordered[0]))
        here, there = (looks.weight * judge(looks.e)).sum(axis=1)
        helped = (there < here) | (task.least(mesh.points) <= 0)
        points, evaluation = jax.tree.map(
            lambda a, b: jnp.where(helped, a, b), (begun, evaluation), (mesh.points, before)
        )
        worst = jnp.where(helped, looks.ordered[1, -1], looks.ordered[0, -1])
        return _Start(mesh.with_points(points), motion, evaluation, worst)

    def _stages(self, task: Problem, start: _Start, hopeless: Any, tangled: Array) -> _State:
        """One minimisation after another; one copy of each function in the compiled program."""
        stages = (UNTANGLE,) * self.untangling_stages + self.goal.stages
        stages = jax.tree.map(lambda *values: jnp.stack([jnp.asarray(v) for v in values]), *stages)

        def minimise(state, stage, ordered):
            points, dtype = state.points, state.points.dtype
            usual = self._pivot(ordered)
            pivot = jnp.stack([usual, usual, usual, _NEAR, start.worst])[stage.when]
            numbers = [jnp.asarray(value, dtype) for value in (*stage[:-1], pivot)]
            give_up = tuple(out | (stage.when != When.INVERTED) for out in hopeless)
            here = eqx.tree_at(lambda t: t.aggregation, task, Aggregation(*numbers))
            found = self.minimiser(here.giving_up(points, give_up), points)
            inverted = task.inverted(found.points, hopeless)
            waited = jnp.where(inverted < state.fewest, 0, state.waited + 1)
            iterations = state.iterations + found.iterations
            return _State(found.points, iterations, jnp.minimum(inverted, state.fewest), waited)

        def go(state, stage):
            ordered = _look(task, state.points).ordered
            poor = ordered[-1] > 1 / POOR
            worsened = (tangled == 0) & (ordered[-1] > _SLACK * start.worst)
            due = jnp.stack([True, True, ~poor, poor, worsened])[stage.when]
            return jax.lax.cond(due, minimise, lambda state, *_: state, state, stage, ordered)

        def guarded(points):
            return _VALID(start.mesh, start.motion, points - start.mesh.points, start.evaluation).points

        def run(state, numbered):
            index, stage = numbered
            idle = (stage.when == When.INVERTED) & ((state.fewest == 0) | (state.waited > _PATIENCE))
            state = jax.lax.cond(idle, lambda state, _: state, go, state, stage)
            untangled = (index == self.untangling_stages - 1) & (tangled > 0)
            points = jax.lax.cond(untangled, guarded, lambda points: points, state.points)
            return state._replace(points=points), None

        first = _State(start.mesh.points, jnp.int32(0), tangled, jnp.int32(0))
        return jax.lax.scan(run, first, (jnp.arange(len(stages.power)), stages))[0]

    def init(self, mesh: Mesh) -> Any:
        """The state of the starting method."""
        return None if self.start is None else self.start.init(mesh)

    def _begin(
        self, mesh: Mesh, motion: Motion, before: Evaluation, state: Any
    ) -> tuple[Float[Array, "nodes dim"], Evaluation]:
        """The points after the steps of the starting method, and their evaluation."""
        start = self.start
        if start is None:
            return mesh.points, before

        def unfinished(carry):
            _, before, count = carry
            tangled = jnp.stack([(det <= 0).any() for det in before.jacobian]).any()
            return count < jnp.where(tangled, self.untangling_steps, self.start_steps)

        def step(carry):
            points, before, count = carry
            found = start.step(mesh.with_points(points), motion, before, state)
            return found.points, found.evaluation, count + 1

        return jax.lax.while_loop(unfinished, step, (mesh.points, before, jnp.int32(0)))[:2]

    def _pivot(self, ordered: Float[Array, " elements"]) -> Float[Array, ""]:
        """The e that so many of the elements with weight exceed."""
        behind = jnp.floor(self.pivot * jnp.sqrt((ordered > 0).sum())).astype(jnp.int32)
        # 1 where nothing may move
        return jnp.maximum(ordered[jnp.maximum(len(ordered) - 1 - behind, 0)], 1)


class _Look(NamedTuple):
    """e of all elements, their weights, and the finite e of those with weight in order, after zeros."""

    e: Float[Array, " elements"]
    weight: Float[Array, " elements"]
    ordered: Float[Array, " elements"]


def _look(task: Problem, points: Float[Array, "nodes dim"]) -> _Look:
    e, weight = task.inverse_quality(points)
    ordered = jnp.sort(jnp.where((weight > 0) & jnp.isfinite(e), jnp.maximum(e, 1), 0))
    return _Look(e, weight, ordered)
