"""The summary of a mesh, which history, tables, reports and acceptance share."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from jaxsmooth.assembly import local_nodes, tangents
from jaxsmooth.convert.meshfile import as_mesh
from jaxsmooth.mesh.memory import Remembered
from jaxsmooth.mesh.padding import Padded, padded
from jaxsmooth.mesh.record import Mesh
from jaxsmooth.metrics.evaluation import Evaluation, evaluate
from jaxsmooth.metrics.shape import scaled_jacobian
from jaxsmooth.metrics.validity import inverted

__all__ = [
    "POOR",
    "Statistics",
    "corners",
    "evaluate_padded",
    "evaluated",
    "remember",
    "statistics",
    "summary",
    "without_ghosts",
]

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

    def make() -> Evaluation:
        whole = padded(mesh)
        return without_ghosts(whole, evaluate_padded(whole))

    return _EVALUATIONS.get((mesh.points, *mesh.connectivity), make)


def evaluate_padded(whole: Padded) -> Evaluation:
    """`evaluate`, compiled, of all elements with the ghosts."""
    return _evaluate(whole.mesh)


def without_ghosts(whole: Padded, evaluation: Evaluation) -> Evaluation:
    """What the elements of a mesh are worth that has ghosts."""
    return Evaluation(*map(whole.real, evaluation))


def remember(mesh: Mesh, evaluation: Evaluation) -> None:
    """Keep an evaluation that is known for `evaluated`."""
    _EVALUATIONS.put((mesh.points, *mesh.connectivity), evaluation)


def corners(mesh: Mesh, evaluation: Evaluation) -> tuple[Float[Array, " _"], ...]:
    """The scaled Jacobian of all elements, block by block."""
    whole = padded(mesh)
    return whole.real(_scaled(whole, evaluation))


def _scaled(whole: Padded, evaluation: Evaluation) -> tuple[Float[Array, " _"], ...]:
    """The same with ghosts, where the evaluation has them or does not know."""
    wanted = tuple(part is None for part in evaluation.corners)
    found = iter(_corners(whole.mesh, wanted) if any(wanted) else ())
    return tuple(next(found) if known is None else known for known in evaluation.corners)


@partial(jax.jit, static_argnames=("wanted",))
def _corners(mesh: Mesh, wanted: tuple[bool, ...]) -> list[Float[Array, " _"]]:
    return [
        jax.vmap(partial(scaled_jacobian, kind))(local_nodes(mesh.points, nodes, frames))
        for (kind, nodes), frames, needed in zip(mesh.blocks, tangents(mesh), wanted, strict=True)
        if needed
    ]


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
    return summary(padded(mesh), evaluation, threshold)


def summary(whole: Padded, evaluation: Evaluation, threshold: float = POOR) -> Statistics:
    """Statistics of a mesh without its ghosts; the evaluation may have them."""
    # on the host, for numbers of elements are many, and would be compiled for
    q, worst, tangled = (
        np.concatenate([np.asarray(part)[:n] for part, n in zip(side, whole.elements, strict=True)])
        for side in (
            evaluation.quality,
            _scaled(whole, evaluation),
            inverted(whole.mesh, evaluation.jacobian),
        )
    )
    return Statistics(
        q_min=float(q.min()),
        q_max=float(q.max()),
        q_avg=float(q.mean(dtype=np.float64)),
        q_std=float(q.std(ddof=1, dtype=np.float64)) if len(q) > 1 else 0.0,
        below=int((q < threshold).sum()),
        inverted=int(tangled.sum()),
        scaled_jacobian_min=float(worst.min()),
    )
