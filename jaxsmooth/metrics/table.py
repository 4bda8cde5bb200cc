"""The names of the metrics, and metrics of whole meshes.

The command line knows metrics by these names; in Python a metric is a value, of the user's own too (see
`jaxsmooth.metrics.record.Metric`).
"""

from __future__ import annotations

import difflib
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxsmooth.assembly import cut, each, frames_of
from jaxsmooth.cells.table import ElementType
from jaxsmooth.convert.meshfile import as_mesh
from jaxsmooth.mesh.execution import Execution
from jaxsmooth.metrics.literature import LITERATURE
from jaxsmooth.metrics.record import Metric
from jaxsmooth.metrics.shape import (
    EDGE_RATIO,
    MEAN_RATIO,
    MEASURE,
    MIN_JACOBIAN,
    SCALED_JACOBIAN,
    SHAPE,
    SHAPE_AND_CORNERS,
    measure,
    min_jacobian,
    scaled_jacobian,
    shape_quality,
    surface,
)
from jaxsmooth.metrics.verdict_angles import ANGLES
from jaxsmooth.metrics.verdict_ratios import RATIOS

__all__ = [
    "METRICS",
    "USUAL",
    "Metric",
    "as_metric",
    "measure",
    "min_jacobian",
    "named",
    "quality",
    "quality_least",
    "quality_mean",
    "scaled_jacobian",
    "shape_quality",
    "surface",
]

USUAL = (SHAPE, SCALED_JACOBIAN, MEAN_RATIO, EDGE_RATIO, MIN_JACOBIAN, MEASURE)
"""What tables show unless asked for something else."""

METRICS: dict[str, Metric] = {
    row.name: row for row in (*USUAL, SHAPE_AND_CORNERS, *RATIOS, *ANGLES, *LITERATURE)
}
"""All metrics of the package by name."""

_OTHER_NAMES = {"area": "measure", "volume": "measure"}
_HEAVY = 2  # memory of an element function, in units of a product with linear tetrahedra


def named(name: str) -> Metric:
    """The metric called `name`.  Raises `ValueError` that suggests the nearest names."""
    name = _OTHER_NAMES.get(name, name)
    if name in METRICS:
        return METRICS[name]
    near = difflib.get_close_matches(name, METRICS, n=2, cutoff=0.4)
    hint = f"did you mean {' or '.join(near)}?" if near else f"known are {', '.join(METRICS)}"
    raise ValueError(f"unknown metric {name!r}; {hint}")


def as_metric(metric: Metric | str) -> Metric:
    """A metric as it is, or by its name in `METRICS`."""
    return named(metric) if isinstance(metric, str) else metric


@partial(jax.jit, static_argnames=("kind", "metric", "execution"))
def _block_quality(
    kind: ElementType,
    metric: Metric,
    execution: Execution,
    points: Array,
    nodes: Int[Array, "elements k"],
    normals: Float[Array, "elements 3"] | None,
) -> Array:
    chunks = cut(nodes, None, execution, _HEAVY, frames_of(kind, points, nodes, normals))
    mean = ()
    if metric.relative:
        seen = metric.sees(kind)
        size = each(lambda _, local: MEASURE(seen, local[: seen.k]), chunks, points)
        mean = (jnp.abs(size).mean(),)
    return each(lambda _, local: metric(kind, local, *mean), chunks, points)


def quality(mesh: Any, metric: Metric | str = SHAPE) -> tuple[Float[Array, " _"], ...]:
    """A metric on every element.

    Args:
        mesh: a `Mesh`, or whatever else `as_mesh` takes.
        metric: a `Metric`, or a name of the `METRICS` table.

    Returns:
        One array ``[elements]`` for every block, in the units of the metric; NaN in blocks of a type that
        it is not for.

    Raises:
        ValueError: for an unknown metric, one that is for none of the blocks, or what is no mesh.
    """
    metric, mesh = as_metric(metric), as_mesh(mesh)
    if not any(metric.applies_to(kind) for kind, _ in mesh.blocks):
        raise ValueError(
            f"metric {metric.name!r} is for {', '.join(metric.families)}, and the mesh has "
            f"{', '.join(mesh.types) or 'no elements'}; choose another"
        )
    return tuple(
        _block_quality(kind, metric, mesh.execution, mesh.points, nodes, up)
        if metric.applies_to(kind)
        else jnp.full(len(nodes), jnp.nan, mesh.points.dtype)
        for (kind, nodes), up in zip(mesh.blocks, mesh.normals or (None,) * len(mesh.types), strict=True)
    )


def quality_mean(mesh: Any, metric: Metric | str = SHAPE) -> Float[Array, ""]:
    """Mean of a metric over all elements that have it: a differentiable scalar."""
    metric, mesh = as_metric(metric), as_mesh(mesh)
    found = zip(mesh.blocks, quality(mesh, metric), strict=True)
    return jnp.concatenate([values for (kind, _), values in found if metric.applies_to(kind)]).mean()


def quality_least(
    mesh: Any, metric: Metric | str = SHAPE, sharpness: Float[Array, ""] | float = 100.0
) -> Float[Array, ""]:
    """A smooth bound below the least quality, for constraints: ``−log Σ exp(−s q) / s`` over all elements.

    Of n elements it is no more than ``log(n) / s`` below the least.
    """
    metric, mesh = as_metric(metric), as_mesh(mesh)
    found = zip(mesh.blocks, quality(mesh, metric), strict=True)
    q = jnp.concatenate([values for (kind, _), values in found if metric.applies_to(kind)])
    return -jax.nn.logsumexp(-sharpness * q) / sharpness
