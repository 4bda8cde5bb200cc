"""The driver: repeats a method's step, records what happens, decides when to stop."""

from __future__ import annotations

import enum
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxsmooth.constraints import Constraints, detect_constraints
from jaxsmooth.mesh import Mesh
from jaxsmooth.meshfile import as_mesh
from jaxsmooth.methods import Elastic, Method
from jaxsmooth.metrics import quality
from jaxsmooth.patches import Evaluation, evaluate
from jaxsmooth.runs import run

__all__ = ["SmoothResult", "Statistics", "Status", "StepRecord", "smooth", "statistics"]


class Status(enum.StrEnum):
    """Why a run ended; the value is the message."""

    CONVERGED = "converged"
    STEP_LIMIT = "step limit"
    STALLED = "stalled: no node may move without breaking the guard"
    NO_GAIN = "stopped: the next step would have made nothing better"
    NOT_FINITE = "stopped: the next step was not finite; the last finite mesh is returned"
    UNSOLVED = "stopped: the linear system of the next step could not be solved"


@dataclass(frozen=True)
class Statistics:
    """Statistics of a mesh; σ is the sample deviation, `below` counts q < 0.2."""

    q_min: float
    q_max: float
    q_avg: float
    q_std: float
    below: int
    inverted: int
    scaled_jacobian_min: float


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
    quality: tuple[Float[Array, " elements"], ...]
    history: tuple[StepRecord, ...]
    status: Status
    constraints: Constraints


@partial(jax.jit, static_argnames=("threshold",))
def _summary(evaluation: Evaluation, scaled: tuple[Array, ...], threshold: float) -> tuple[Array, ...]:
    q, det = jnp.concatenate(evaluation.quality), jnp.concatenate(evaluation.jacobian)
    deviation = jnp.std(q, ddof=1) if q.size > 1 else jnp.zeros((), q.dtype)
    worst = jnp.stack([part.min() for part in scaled]).min()
    # ~(det > 0) counts NaN as inverted
    return q.min(), q.max(), q.mean(), deviation, (q < threshold).sum(), (~(det > 0)).sum(), worst


def statistics(mesh: Any, evaluation: Evaluation | None = None, threshold: float = 0.2) -> Statistics:
    """Statistics of a mesh; an `evaluation` that is already known saves time."""
    mesh = as_mesh(mesh)
    evaluation = _evaluate(_bare(mesh)) if evaluation is None else evaluation
    values = _summary(evaluation, quality(mesh, "scaled_jacobian"), threshold)
    q_min, q_max, q_avg, q_std, below, inverted, worst = (v.item() for v in jax.device_get(values))
    return Statistics(q_min, q_max, q_avg, q_std, below, inverted, worst)


@jax.jit
def _step(method: Method, mesh: Mesh, constraints: Constraints, before: Evaluation):
    return method.step(mesh, constraints, before)


_evaluate = jax.jit(evaluate)


def _bare(mesh: Mesh) -> Mesh:
    """Labels are for the host: without them meshes of one shape share their compiled step."""
    return mesh.with_labels(None) if mesh.labels is not None else mesh


def smooth(
    mesh: Any,
    method: Method | None = None,
    *,
    steps: int = 10,
    constraints: Constraints | None = None,
    tolerance_avg: float = 1e-3,
    tolerance_min: float = 2e-2,
    callback: Callable[[StepRecord], None] | None = None,
) -> SmoothResult:
    """Improve a mesh by moving its nodes (Algorithm 1).

    Args:
        mesh: a `Mesh`, a `MeshFile`, a `meshio.Mesh`, or ``(points, {"tetra": connectivity})``.
        method: how a step is made; `Elastic()`, the paper's standard method, by default.
        steps: the largest number of steps.
        constraints: how nodes may move; by default `detect_constraints(mesh)`, with the nodes that
            a `MeshFile` marks as `fixed` held.
        tolerance_avg: the run has converged when a step changes the average quality by less than
            this and the least quality by less than `tolerance_min`.  0 runs all steps.
        tolerance_min: see above.
        callback: called with every `StepRecord`, the input's first.

    With points that JAX traces (under `jax.grad`, `jit` or `vmap`) all steps are made, as by `run`, and
    the history is empty.

    Returns:
        The smoothed mesh with its history.  A valid mesh stays valid under every guarded method.

    Raises:
        ValueError: for an invalid mesh, or constraints that do not fit it.
    """
    fixed = getattr(mesh, "fixed", None)  # a file may name nodes to hold
    mesh = as_mesh(mesh)
    method = (Elastic() if method is None else method).prepare(mesh)
    if isinstance(mesh.points, jax.core.Tracer):
        return _smooth_traced(mesh, method, steps, constraints)
    constraints = detect_constraints(mesh, fixed=fixed) if constraints is None else constraints
    _check(mesh, constraints, steps)
    labels, mesh = mesh.labels, _bare(mesh)

    history: list[StepRecord] = []

    def record(row: StepRecord) -> None:
        history.append(row)
        if callback is not None:
            callback(row)

    start = time.perf_counter()
    evaluation = _evaluate(mesh)
    current = statistics(mesh, evaluation)
    record(StepRecord(0, current, seconds=time.perf_counter() - start))
    status = Status.STEP_LIMIT
    for index in range(1, steps + 1):
        start = time.perf_counter()
        step = _step(method, mesh, constraints, evaluation)
        if not bool(jnp.isfinite(step.points).all()):
            status = Status.NOT_FINITE if bool(jnp.isfinite(step.residual)) else Status.UNSOLVED
            break
        still = bool((step.points == mesh.points).all())
        moved = mesh.with_points(step.points)
        previous, current = current, statistics(moved, step.evaluation)
        settled = (
            abs(current.q_avg - previous.q_avg) < tolerance_avg
            and abs(current.q_min - previous.q_min) < tolerance_min
        )
        if method.guard is not None and not still and not _better(current, previous):
            status = Status.CONVERGED if settled else Status.NO_GAIN
            break
        mesh, evaluation = moved, step.evaluation
        counts = int(step.iterations), float(step.residual), int(step.shortened)
        record(StepRecord(index, current, *counts, time.perf_counter() - start))
        if still or settled:
            status = Status.STALLED if still and counts[2] else Status.CONVERGED
            break
    return SmoothResult(mesh.with_labels(labels), evaluation.quality, tuple(history), status, constraints)


def _smooth_traced(mesh: Mesh, method: Method, steps: int, constraints: Constraints | None) -> SmoothResult:
    """`run`, with constraints found on the host while the compiled function waits."""
    if constraints is None:
        leaves, structure = jax.tree.flatten(mesh)

        def detect(leaves: list[Any]) -> np.ndarray:
            return np.asarray(detect_constraints(jax.tree.unflatten(structure, leaves)).projectors)

        shape = jax.ShapeDtypeStruct((*mesh.points.shape, mesh.dim), mesh.points.dtype)
        fixed = jax.lax.stop_gradient(leaves)
        constraints = Constraints(jax.pure_callback(detect, shape, fixed, vmap_method="sequential"))
    labels, mesh = mesh.labels, run(_bare(mesh), method, constraints=constraints, steps=steps)
    return SmoothResult(mesh.with_labels(labels), evaluate(mesh).quality, (), Status.STEP_LIMIT, constraints)


def _better(now: Statistics, before: Statistics) -> bool:
    """True if anything improved: fewer inverted or poor elements, a higher q_min or q_avg."""
    return (
        now.inverted < before.inverted
        or now.below < before.below
        or now.q_min > before.q_min
        or now.q_avg > before.q_avg
    )


def _check(mesh: Mesh, constraints: Constraints, steps: int) -> None:
    shape = constraints.projectors.shape
    if shape != (*mesh.points.shape, mesh.dim):
        raise ValueError(
            f"the constraints are for {shape[0]} nodes in {shape[-1]}D; "
            f"the mesh has {len(mesh.points)} in {mesh.dim}D"
        )
    if steps < 0:
        raise ValueError(f"steps must be 0 or more, got {steps}")
