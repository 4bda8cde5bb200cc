"""The summary of a mesh, which history, tables, reports and acceptance share."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax.core import Tracer
from jaxtyping import Array, Float

from jaxsmooth.assembly import gather
from jaxsmooth.convert.meshfile import as_mesh
from jaxsmooth.mesh.memory import Remembered
from jaxsmooth.mesh.record import Mesh
from jaxsmooth.metrics.evaluation import Evaluation, evaluate
from jaxsmooth.metrics.shape import scaled_jacobian
from jaxsmooth.metrics.validity import inverted

__all__ = ["POOR", "Statistics", "corners", "evaluated", "remember", "statistics"]

POOR = 0.2
"""Quality below which an element counts as poor (Tables 7 and 8)."""


@dataclass(frozen=True)
class Statistics:
    """Statistics of a mesh; σ is the sample deviation, `below` counts poor elements (q < 0.2)."""

    q_min: float
    q_max: float
    q_avg: float
    q_std: float
    below: int
    inverted: int
    scaled_jacobian_min: float


_evaluate = jax.jit(evaluate)
_EVALUATIONS: Remembered[Evaluation] = Remembered()


def evaluated(mesh: Mesh) -> Evaluation:
    """`evaluate`, compiled; a mesh that was just evaluated is not evaluated again."""
    return _EVALUATIONS.get((mesh.points, *mesh.connectivity), lambda: _evaluate(mesh.bare))


def remember(mesh: Mesh, evaluation: Evaluation) -> None:
    """Keep an evaluation that is known for `evaluated`."""
    _EVALUATIONS.put((mesh.points, *mesh.connectivity), evaluation)


@jax.jit
def corners(mesh: Mesh, evaluation: Evaluation) -> list[Float[Array, " _"]]:
    """The scaled Jacobian of all elements, block by block."""
    return [
        jax.vmap(partial(scaled_jacobian, kind))(gather(mesh.points, nodes)) if known is None else known
        for (kind, nodes), known in zip(mesh.blocks, evaluation.corners, strict=True)
    ]


@partial(jax.jit, static_argnames=("threshold",))
def _summary(mesh: Mesh, evaluation: Evaluation, threshold: float) -> tuple[Array, ...]:
    q = jnp.concatenate(evaluation.quality)
    deviation = jnp.std(q, ddof=1) if q.size > 1 else jnp.zeros((), q.dtype)
    worst = jnp.stack([part.min() for part in corners(mesh, evaluation)]).min()
    return q.min(), q.max(), q.mean(), deviation, worst, (q < threshold).sum()


def statistics(mesh: Any, evaluation: Evaluation | None = None, threshold: float = POOR) -> Statistics:
    """Statistics of a mesh; an `evaluation` that is already known saves time.

    Raises:
        TypeError: for points that JAX traces; use `quality` or `quality_mean`.
    """
    mesh = as_mesh(mesh).bare
    if isinstance(mesh.points, Tracer):
        raise TypeError(
            "statistics are numbers on the host, so JAX can't trace them; inside jit, grad or vmap use "
            "quality(mesh) or quality_mean(mesh)"
        )
    evaluation = evaluated(mesh) if evaluation is None else evaluation
    *values, below = (value.item() for value in jax.device_get(_summary(mesh, evaluation, threshold)))
    tangled = sum(int(part.sum()) for part in inverted(mesh, evaluation.jacobian))
    q_min, q_max, q_avg, q_std, worst = values
    return Statistics(q_min, q_max, q_avg, q_std, below, tangled, worst)
