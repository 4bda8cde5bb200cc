"""The driver: repeats a method's step, records what happens, decides when to stop."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from typing import Any

import jax
import jax.numpy as jnp
from jax.core import Tracer
from jaxtyping import Array, Float

from jaxsmooth.convert.meshfile import MeshFile, with_file
from jaxsmooth.guards.acceptance import AcceptanceRule, Status
from jaxsmooth.mesh.padding import Padded
from jaxsmooth.mesh.record import Mesh
from jaxsmooth.methods import Elastic, Method, Untangle
from jaxsmooth.metrics.evaluation import Evaluation
from jaxsmooth.metrics.summary import Statistics, evaluate_padded, remember, summary, without_ghosts
from jaxsmooth.motion.base import Motion
from jaxsmooth.motion.detect import detect_constraints
from jaxsmooth.runs.ghosts import with_ghosts

__all__ = ["SmoothResult", "StepRecord", "smooth"]


@dataclass(frozen=True)
class StepRecord:
    """One row of the history; row 0 is the input.

    `residual` is the true relative residual of the step's linear solve, `shortened` counts the
    nodes whose move the guard shortened, `seconds` is wall time with compilation.
    """

    step: int
    statistics: Statistics
    solver_iterations: int = 0
    residual: float = 0.0
    shortened: int = 0
    seconds: float = 0.0

    def as_json(self) -> dict[str, Any]:
        """The row in the documented JSON format."""
        row = asdict(self)
        stats = row.pop("statistics")
        stats["q_below_0.2"] = stats.pop("below")
        return {"step": row.pop("step"), **stats, **row}


@dataclass(frozen=True)
class SmoothResult:
    """What `smooth` returns.

    Attributes:
        mesh: the smoothed mesh.
        evaluation: what its elements are worth.
        history: a `StepRecord` for the input and for every step.
        status: why the run ended.
        constraints: the constraints that were used.
        file: what was known beside the input's mesh: data, sets, where it comes from; None for a bare `Mesh`.
    """

    mesh: Mesh
    evaluation: Evaluation
    history: tuple[StepRecord, ...]
    status: Status
    constraints: Motion
    file: MeshFile | None = field(default=None, repr=False)

    @property
    def quality(self) -> tuple[Float[Array, " _"], ...]:
        """Shape quality, one array ``[elements]`` a block."""
        return self.evaluation.quality


@jax.jit
def _step(method: Method, mesh: Mesh, motion: Motion, before: Evaluation, state: Any):
    return method.step(mesh, motion, before, state)


def smooth(
    mesh: Any,
    method: Method | None = None,
    *,
    steps: int = 10,
    constraints: Motion | None = None,
    accept: AcceptanceRule | None = None,
    tolerance_avg: float = 1e-3,
    tolerance_min: float = 2e-2,
    callback: Callable[[StepRecord], None] | None = None,
) -> SmoothResult:
    """Improve a mesh by moving its nodes (Algorithm 1).

    The first step on a tangled mesh is one of `Untangle`, whatever the method, unless it has no guard.

    Args:
        mesh: a `Mesh`, a `MeshFile`, a PyVista grid, or whatever else `as_mesh` takes.
        method: how a step is made; `Elastic()`, the paper's standard method, by default.
        steps: the largest number of steps.
        constraints: how nodes may move; by default `detect_constraints(mesh)`.
        accept: what the result keeps of the input; by default what the method's `acceptance` says:
            no more inverted or poor elements, no worse worst element and corner, no lower average.
        tolerance_avg: the run has converged when a step changes the average quality by less than
            this, the least quality by less than `tolerance_min`, and the numbers of inverted and poor
            elements not at all; while elements are inverted, when three steps in a row do so.
            0 runs all steps.
        tolerance_min: see above.
        callback: called with every `StepRecord`, the input's first.

    Returns:
        The smoothed mesh with its history: the last step that `accept` has nothing against.

    Raises:
        ValueError: for an invalid mesh, or constraints that do not fit it.
        TypeError: for points that JAX traces; use `run`.
    """
    mesh, file = with_file(mesh)
    if isinstance(mesh.points, Tracer):
        raise TypeError(
            "smooth decides on the host when to stop, so JAX can't trace it; inside jit, grad or vmap use "
            "run(mesh, method, constraints=constraints, steps=3), with constraints found beforehand"
        )
    method = (Elastic() if method is None else method).loosely()
    constraints = detect_constraints(mesh) if constraints is None else constraints
    _check(mesh, constraints, steps)
    accept = method.acceptance if accept is None else accept
    labels, mesh = mesh.labels, mesh.bare
    whole, motion = with_ghosts(mesh, method, constraints)
    state = method.init(whole.mesh)

    start = time.perf_counter()
    evaluation = evaluate_padded(whole)
    first = StepRecord(0, summary(whole, evaluation), seconds=time.perf_counter() - start)
    remember(mesh, without_ghosts(whole, evaluation))
    tolerances = (tolerance_avg, tolerance_min)
    place = _Place(whole, evaluation, first)
    driver = _Driver(method, motion, state, accept, tolerances, callback, place)
    status = driver.run(steps)
    end, history = driver.reached, tuple(driver.history)
    if end.row.step:
        mesh = mesh.with_points(whole.real_points(end.mesh.points))
    evaluation = without_ghosts(whole, end.evaluation)
    remember(mesh, evaluation)
    return SmoothResult(mesh.with_labels(labels), evaluation, history, status, constraints, file)


_PATIENCE = 3  # steps without change after which a mesh is taken to stay tangled
_EXCURSION = 2  # steps that may break the rule, and untangle nothing, before one that meets it again


@dataclass(frozen=True)
class _Place:
    """A mesh on the way with its ghosts, its evaluation, and its row of the history."""

    whole: Padded
    evaluation: Evaluation
    row: StepRecord

    @property
    def mesh(self) -> Mesh:
        return self.whole.mesh

    @property
    def now(self) -> Statistics:
        return self.row.statistics


@dataclass
class _Driver:
    """The loop of `smooth`.

    Attributes:
        reached: the last place that counts: the result, if nothing better comes.
        waiting: places after it that do not count, unless one after them does.
        attempts: the method with guards that are tried one after another.
        refused: why the last attempt led nowhere.
    """

    method: Method
    motion: Motion
    state: Any
    accept: AcceptanceRule
    tolerances: tuple[float, float]
    callback: Callable[[StepRecord], None] | None
    reached: _Place
    history: list[StepRecord] = field(default_factory=list)
    waiting: list[_Place] = field(default_factory=list)
    attempts: list[Method] = field(default_factory=list)
    refused: Status | None = None

    def run(self, steps: int) -> Status:
        """Make the steps; where they lead nowhere, go back and on with the stricter method."""
        self._record(self.reached.row)
        if steps and self.reached.now.inverted and self.method.guard is not None:
            self._untangle()
        self.attempts = list(self.method.attempts(tangled=self.reached.now.inverted > 0))
        settled = lost = 0
        while (index := len(self.history) + len(self.waiting)) <= steps:
            before = (self.waiting or [self.reached])[-1]
            place = self._advance(before, index, self.attempts[0])
            if isinstance(place, Status):
                return place
            now = place.now
            still = not self.waiting and bool((place.mesh.points == before.mesh.points).all())
            if still and self.refused is not None:
                return self.refused
            settled = settled + 1 if self._settled(before.now, now) else 0
            done = still or settled >= (_PATIENCE if now.inverted else 1)
            fewest = min(p.now.inverted for p in (self.reached, *self.waiting))
            lost = 0 if now.inverted < fewest else lost + 1
            self.waiting.append(place)
            refusal = None if still else self._objection(place)
            if refusal is None:
                valid = self.reached.now.inverted and not now.inverted
                self._accept()
                lost = 0
                if valid:
                    self.attempts = list(self.method.attempts(tangled=False))
                elif done:
                    return Status.STALLED if still and place.row.shortened else Status.CONVERGED
            elif done or lost > _EXCURSION or index == steps or self._ended(settled, refusal):
                if self._ended(settled, refusal):
                    return Status.CONVERGED
                if len(self.attempts) == 1:
                    return Status.CONVERGED if settled else refusal
                self.attempts, self.waiting, self.refused = self.attempts[1:], [], refusal
                settled = lost = 0
        return Status.STEP_LIMIT

    def _untangle(self) -> None:
        """A first step that turns elements right side out; the run goes on from there.

        What is valid throughout may have to be improved before it counts.
        """
        place = self._advance(self.reached, 1, Untangle())
        if isinstance(place, Status) or place.now.inverted >= self.reached.now.inverted:
            return
        counts = self._objection(place) is None
        if counts or not place.now.inverted:
            self.waiting.append(place)
        if counts:
            self._accept()

    def _advance(self, before: _Place, index: int, method: Method) -> _Place | Status:
        """One step of a method, or why there is none."""
        start = time.perf_counter()
        step = _step(method, before.mesh, self.motion, before.evaluation, self.state)
        if not bool(jnp.isfinite(step.points).all()):
            return Status.NOT_FINITE if bool(jnp.isfinite(step.residual)) else Status.UNSOLVED
        whole = before.whole._replace(mesh=before.mesh.with_points(step.points))
        now = summary(whole, step.evaluation)
        counts = int(step.iterations), float(step.residual), int(step.shortened)
        row = StepRecord(index, now, *counts, time.perf_counter() - start)
        return _Place(whole, step.evaluation, row)

    def _accept(self) -> None:
        """The last place counts, and with it those that led there."""
        for place in self.waiting:
            self._record(place.row)
        self.reached, self.waiting, self.refused = self.waiting[-1], [], None

    def _record(self, row: StepRecord) -> None:
        self.history.append(row)
        if self.callback is not None:
            self.callback(row)

    def _objection(self, place: _Place) -> Status | None:
        first, last = self.history[0].statistics, self.reached.now
        rounding = 64 * float(jnp.finfo(place.mesh.points.dtype).eps)  # qualities are of order 1
        return self.accept.objection(first, last, place.now, rounding)

    def _ended(self, settled: int, refusal: Status) -> bool:
        """Whether a valid mesh that has improved improves no more: the first step from it brings nothing."""
        first = len(self.waiting) == 1 and self.reached.row.step > 0
        useless = bool(settled) or refusal is Status.NO_GAIN
        return first and useless and not self.waiting[0].now.inverted

    def _settled(self, before: Statistics, now: Statistics) -> bool:
        """Whether a step has changed nothing that counts."""
        average, least = self.tolerances
        return (
            abs(now.q_avg - before.q_avg) < average
            and abs(now.q_min - before.q_min) < least
            and (now.below, now.inverted) == (before.below, before.inverted)
        )


def _check(mesh: Mesh, constraints: Motion, steps: int) -> None:
    shape = jax.eval_shape(constraints.at, mesh.points).projectors.shape
    if shape != (*mesh.points.shape, mesh.dim):
        raise ValueError(
            f"the constraints are for {shape[0]} nodes in {shape[-1]}D; "
            f"the mesh has {len(mesh.points)} in {mesh.dim}D"
        )
    if steps < 0:
        raise ValueError(f"steps must be 0 or more, got {steps}")
