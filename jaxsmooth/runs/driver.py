"""The driver: repeats a method's step, records what happens, decides when to stop."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsmooth.convert.meshfile import as_mesh
from jaxsmooth.guards.acceptance import AcceptanceRule, Status
from jaxsmooth.mesh.record import Mesh
from jaxsmooth.methods import Elastic, Method
from jaxsmooth.metrics.evaluation import Evaluation
from jaxsmooth.metrics.summary import Statistics, evaluated, statistics
from jaxsmooth.motion.base import Motion
from jaxsmooth.motion.detect import detect_constraints

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
        quality: shape quality, one array ``[elements]`` a block.
        history: a `StepRecord` for the input and for every step.
        status: why the run ended.
        constraints: the constraints that were used.
    """

    mesh: Mesh
    quality: tuple[Float[Array, " _"], ...]
    history: tuple[StepRecord, ...]
    status: Status
    constraints: Motion


@jax.jit
def _step(method: Method, mesh: Mesh, motion: Motion, before: Evaluation):
    return method.step(mesh, motion, before)


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

    Args:
        mesh: a `Mesh`, a `MeshFile`, a `meshio.Mesh`, or ``(points, {"tetra": connectivity})``.
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
    mesh = as_mesh(mesh)
    if isinstance(mesh.points, jax.core.Tracer):
        raise TypeError(
            "smooth decides on the host when to stop, so JAX can't trace it; inside jit, grad or vmap use "
            "run(mesh, method, constraints=constraints, steps=3), with constraints found beforehand"
        )
    method = (Elastic() if method is None else method).prepare(mesh)
    constraints = detect_constraints(mesh) if constraints is None else constraints
    _check(mesh, constraints, steps)
    accept = method.acceptance if accept is None else accept
    labels, mesh = mesh.labels, mesh.bare

    start = time.perf_counter()
    evaluation = evaluated(mesh)
    first = StepRecord(0, statistics(mesh, evaluation), seconds=time.perf_counter() - start)
    driver = _Driver(constraints, accept, (tolerance_avg, tolerance_min), callback)
    driver.record(first)
    (mesh, evaluation), status = driver.run(method, mesh, evaluation, steps)
    return SmoothResult(
        mesh.with_labels(labels), evaluation.quality, tuple(driver.history), status, constraints
    )


_PATIENCE = 3  # steps without change after which a mesh is taken to stay tangled
_EXCURSION = 2  # steps that may break the rule, and untangle nothing, before one that meets it again


@dataclass
class _Driver:
    """The loop of `smooth`; `history` has the steps that count."""

    constraints: Motion
    accept: AcceptanceRule
    tolerances: tuple[float, float]
    callback: Callable[[StepRecord], None] | None
    history: list[StepRecord] = field(default_factory=list)

    def record(self, row: StepRecord) -> None:
        """One more step that counts."""
        self.history.append(row)
        if self.callback is not None:
            self.callback(row)

    def run(
        self, method: Method, mesh: Mesh, evaluation: Evaluation, steps: int
    ) -> tuple[tuple[Mesh, Evaluation], Status]:
        """Make the steps; where they lead nowhere, go back and on with the stricter method.

        Returns the mesh of the last step that counts, its evaluation, and why the run ended.
        """
        reached, refused = (mesh, evaluation), None
        attempts = list(method.attempts(tangled=self.history[0].statistics.inverted > 0))
        waiting: list[StepRecord] = []  # steps that do not count, unless one after them does
        settled = lost = 0
        while (index := len(self.history) + len(waiting)) <= steps:
            start = time.perf_counter()
            step = _step(attempts[0], mesh, self.constraints, evaluation)
            if not bool(jnp.isfinite(step.points).all()):
                return reached, Status.NOT_FINITE if bool(jnp.isfinite(step.residual)) else Status.UNSOLVED
            still = bool((step.points == mesh.points).all()) and not waiting
            mesh, evaluation = mesh.with_points(step.points), step.evaluation
            now = statistics(mesh, evaluation)
            counts = int(step.iterations), float(step.residual), int(step.shortened)
            settled = settled + 1 if self._settled((waiting or self.history)[-1].statistics, now) else 0
            done = still or settled >= (_PATIENCE if now.inverted else 1)
            fewest = min(row.statistics.inverted for row in (self.history[-1], *waiting))
            lost = 0 if now.inverted < fewest else lost + 1
            waiting.append(StepRecord(index, now, *counts, time.perf_counter() - start))
            refusal = None if still else self._objection(now, mesh)
            if still and refused is not None:
                return reached, refused
            if refusal is None:
                if self.history[-1].statistics.inverted and not now.inverted:
                    attempts, done = list(method.attempts(tangled=False)), False
                for row in waiting:
                    self.record(row)
                reached, waiting, lost = (mesh, evaluation), [], 0
                if done:
                    status = Status.STALLED if still and counts[2] else Status.CONVERGED
                    return reached, status
                refused = None
            elif done or lost > _EXCURSION or index == steps:
                last = self.history[-1].step > 0 and settled and len(waiting) == 1 and not now.inverted
                if len(attempts) == 1 or last:
                    return reached, Status.CONVERGED if settled else refusal
                attempts, settled, refused = attempts[1:], 0, refusal
                (mesh, evaluation), waiting, lost = reached, [], 0
        return reached, Status.STEP_LIMIT

    def _objection(self, now: Statistics, mesh: Mesh) -> Status | None:
        first, last = self.history[0].statistics, self.history[-1].statistics
        rounding = 64 * float(jnp.finfo(mesh.points.dtype).eps)  # qualities are of order 1
        return self.accept.objection(first, last, now, rounding)

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
