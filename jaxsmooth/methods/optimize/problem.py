"""What the optimisation variant minimises: metric × target × aggregation (TMOP, in words).

*Metric*: the inverse quality e ≥ 1 of an element, 1 only on the ideal element.  *Target*: what
size an ideal element has.  *Aggregation*: how the e of all elements become one number.

Elements stand in `jaxsmooth.methods.optimize.distortion`.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial, reduce
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxsmooth.assembly import Chunk, Chunks, cut, gather, scan, sum_to_nodes, tangents
from jaxsmooth.cells.table import ElementType
from jaxsmooth.mesh.execution import Execution
from jaxsmooth.mesh.record import Mesh
from jaxsmooth.methods.optimize.distortion import (
    apply_model,
    check_metric,
    hessian_model,
    inverse_quality,
    model_diagonal,
    regularisation,
)
from jaxsmooth.metrics.record import Metric
from jaxsmooth.metrics.shape import SHAPE_AND_CORNERS
from jaxsmooth.motion.base import Motion
from jaxsmooth.numerics.admissible import Admissible
from jaxsmooth.numerics.small import contract, determinant

__all__ = ["Aggregation", "Problem", "movable", "problem"]

_REACH = 4.0  # pivots, beyond which the penalty is straight
_HEAVY = 4  # memory of an element's energy, in units of a product with linear tetrahedra

Field = Float[Array, "nodes dim"]
Scalar = Float[Array, ""] | float


# --- Aggregation ---------------------------------------------------------------------------------


class Aggregation(eqx.Module):
    """``φ(e) = average · (1 − 1/e) + worst · (e / pivot)^power / power``.

    The first part is one minus the quality, so its mean is 1 − q_avg; the second grows towards a
    penalty on everything worse than the pivot as the power rises (a p-norm continuation).  From four
    pivots on the power goes on as its tangent: it stays convex, and finite in float32.
    """

    average: Scalar
    worst: Scalar
    power: Scalar
    pivot: Scalar = 1.0

    def __call__(self, e: Float[Array, "..."]) -> Float[Array, "..."]:
        """φ(e)."""
        ratio = e / self.pivot
        near = jnp.minimum(ratio, _REACH)
        penalty = near**self.power / self.power + near ** (self.power - 1) * (ratio - near)
        return self.average * (1 - 1 / e) + self.worst * penalty

    def derivatives(self, e: Float[Array, "..."]) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
        """φ′ and φ″."""
        ratio = e / self.pivot
        rise = self.worst / self.pivot * jnp.minimum(ratio, _REACH) ** (self.power - 1)
        bend = jnp.where(ratio < _REACH, (self.power - 1) / e * rise, 0)
        return self.average / e**2 + rise, -2 * self.average / e**3 + bend


# --- The whole mesh ------------------------------------------------------------------------------


class Weighted(NamedTuple):
    """What belongs to the elements of a block; ghosts have weight 0.

    Elements that are given up have a `relief`: an ε of their own, so that they may stay inverted.
    """

    size: Array
    weight: Array
    relief: Array


class Quadratic(NamedTuple):
    """A quadratic model of the objective.

    Attributes:
        value: the objective.
        gradient: with respect to all points ``[nodes, dim]``.
        models: the Hessian model of all elements; `Problem.apply` multiplies with it.
        blocks: its node blocks ``[nodes, dim, dim]``.
    """

    value: Float[Array, ""]
    gradient: Field
    models: tuple[Chunks, ...]
    blocks: Float[Array, "nodes dim dim"]


class Problem(eqx.Module):
    """The objective of a mesh as a function of its points, within its constraints.

    Elements without a free node have no weight; all others count alike.
    """

    motion: Motion
    blocks: tuple[Chunks, ...]
    aggregation: Aggregation
    size_weight: Float[Array, ""]
    kinds: tuple[ElementType, ...] = eqx.field(static=True)
    metric: Metric = eqx.field(static=True)

    def scan(self, function: Callable[..., Any], start: Any, points: Field) -> Any:
        """Carry `start` through all chunks: ``(carry, kind, chunk) -> carry``."""
        for kind, block in zip(self.kinds, self.blocks, strict=True):

            def add(carry, chunk, kind=kind):
                return function(carry, kind, _sound(kind, chunk)), None

            start, _ = scan(add, start, block, points)
        return start

    def inverse_quality(self, points: Field) -> tuple[Float[Array, " elements"], Float[Array, " elements"]]:
        """e of all elements with their weights, ghosts included."""
        found = []
        for kind, block in zip(self.kinds, self.blocks, strict=True):
            function = partial(inverse_quality, kind, self.metric, self.size_weight)
            batch = jax.vmap(jax.vmap(function, in_axes=(0, 0, None)), in_axes=(0, 0, None))
            corners = _whole(kind, block.data.weight, block.local_nodes(points))
            found.append((batch(corners, block.data.size, jnp.zeros((), points.dtype))[0], block.data.weight))
        e, weight = (
            jnp.concatenate([part.reshape(-1) for part in side]) for side in zip(*found, strict=True)
        )
        return e, weight

    def determinants(self, points: Field) -> tuple[Float[Array, "_ _"], ...]:
        """The least determinant of every element over its target's; ∞ for those without weight."""

        def found(kind, block):
            corners = _whole(kind, block.data.weight, block.local_nodes(points))
            det = jax.vmap(jax.vmap(partial(_least_determinant, kind)))(corners) / block.data.size
            return jnp.where(block.data.weight > 0, det, jnp.inf)

        return tuple(found(kind, block) for kind, block in zip(self.kinds, self.blocks, strict=True))

    def least(self, points: Field) -> Float[Array, ""]:
        """The least of all determinants, but for those of elements that are given up."""
        dets = self.determinants(points)
        return jnp.stack(
            [
                jnp.where(block.data.relief == 0, det, jnp.inf).min()
                for det, block in zip(dets, self.blocks, strict=True)
            ]
        ).min()

    def hopeless(self, points: Field) -> tuple[Bool[Array, "_ _"], ...]:
        """The elements that stay inverted: a determinant is not positive and all its nodes are held."""
        free = movable(self.motion.at(points))

        def found(kind, block):
            reference = jnp.asarray(kind.validity_gradients, points.dtype)
            depends = np.abs(kind.validity_gradients).max(axis=-1) > 1e-12  # zero but for rounding
            held = ~(depends & gather(free, block.nodes)[..., None, :]).any(axis=-1)
            corners = _whole(kind, block.data.weight, block.local_nodes(points))
            det = jax.vmap(jax.vmap(lambda nodes: determinant(contract(nodes, reference))))(corners)
            return (held & ~(det > 0)).any(axis=-1)

        return tuple(found(kind, block) for kind, block in zip(self.kinds, self.blocks, strict=True))

    def inverted(self, points: Field, but: tuple[Bool[Array, "_ _"], ...]) -> Float[Array, ""]:
        """The number of inverted elements, but for some."""
        dets = self.determinants(points)
        counts = [((det <= 0) & ~out).sum(dtype=det.dtype) for det, out in zip(dets, but, strict=True)]
        return reduce(jnp.add, counts)

    def giving_up(self, points: Field, elements: tuple[Bool[Array, "_ _"], ...]) -> Problem:
        """The problem in which those of the elements that are inverted do not stop the others."""
        dets = self.determinants(points)
        relief = [
            jnp.where((det <= 0) & out, regularisation(det), 0)
            for det, out in zip(dets, elements, strict=True)
        ]
        return eqx.tree_at(lambda task: [block.data.relief for block in task.blocks], self, relief)

    def value(self, points: Field, eps: Scalar) -> tuple[Float[Array, ""], Float[Array, ""]]:
        """The objective, and the least determinant over its target's (of weighted elements)."""

        def add(carry, kind, chunk):
            data = chunk.data

            def element(nodes, size, relief):
                eps_here = jnp.maximum(eps, relief)
                e, _ = inverse_quality(kind, self.metric, self.size_weight, nodes, size, eps_here)
                return self.aggregation(e), _least_determinant(kind, nodes) / size

            energy, det = jax.vmap(element)(chunk.local, data.size, data.relief)
            total, worst = carry
            counts = (data.weight > 0) & (data.relief == 0)
            worst = jnp.minimum(worst, jnp.where(counts, det, jnp.inf).min())
            return total + data.weight @ energy, worst

        return self.scan(add, (jnp.zeros((), points.dtype), jnp.full((), jnp.inf, points.dtype)), points)

    def value_and_grad(self, points: Field, eps: Scalar) -> tuple[Float[Array, ""], Field]:
        """The objective and its gradient with respect to all points."""

        def add(carry, kind, chunk):
            data = chunk.data

            def element(nodes, size, relief):
                eps_here = jnp.maximum(eps, relief)
                e, gradient = inverse_quality(kind, self.metric, self.size_weight, nodes, size, eps_here)
                return self.aggregation(e), self.aggregation.derivatives(e)[0] * gradient

            energies, slopes = jax.vmap(element)(chunk.local, data.size, data.relief)
            total, gradient = carry
            slopes = data.weight[:, None, None] * slopes
            return total + data.weight @ energies, chunk.add(gradient, slopes)

        start = (jnp.zeros((), points.dtype), jnp.zeros_like(points))
        return self.scan(add, start, points)

    def quadratic(self, points: Field, eps: Scalar) -> Quadratic:
        """The objective, its gradient and its Hessian model."""
        dim, models = points.shape[-1], []
        value, zero = jnp.zeros((), points.dtype), jnp.zeros_like(points)
        state = value, zero, jnp.zeros((*points.shape, dim), points.dtype)
        for kind, block in zip(self.kinds, self.blocks, strict=True):

            def element(nodes, data, kind=kind):
                def aggregate(e):
                    first, second = self.aggregation.derivatives(e)
                    return data.weight * first, data.weight * second

                eps_here = jnp.maximum(eps, data.relief)
                args = (kind, self.metric, self.size_weight, aggregate)
                e, gradient, model = hessian_model(*args, nodes, data.size, eps_here)
                slope = aggregate(e)[0] * gradient
                return data.weight * self.aggregation(e), slope, model, model_diagonal(kind, model)

            def add(state, chunk, kind=kind, element=element):
                value, gradient, blocks = state
                sound = _sound(kind, chunk)
                energy, slope, model, diagonal = jax.vmap(element)(sound.local, chunk.data)
                state = value + energy.sum(), chunk.add(gradient, slope), chunk.add(blocks, diagonal)
                return state, model

            state, model = scan(add, state, block, points)
            models.append(block.holding(model))
        value, gradient, blocks = state
        return Quadratic(value, gradient, tuple(models), blocks)

    def apply(self, models: tuple[Chunks, ...], move: Field) -> Field:
        """The Hessian model times a displacement."""
        total = jnp.zeros_like(move)
        for kind, model in zip(self.kinds, models, strict=True):

            def product(model, move, kind=kind):
                return apply_model(kind, move, model)

            total = sum_to_nodes(product, model, move, total)
        return total


def _least_determinant(kind: ElementType, nodes: Array) -> Float[Array, ""]:
    return determinant(contract(nodes, jnp.asarray(kind.validity_gradients, nodes.dtype))).min()


def _whole(kind: ElementType, weight: Array, nodes: Array) -> Array:
    """The ideal element in place of one without weight, which may be degenerate."""
    shape = (*weight.shape, *(1,) * (nodes.ndim - weight.ndim))
    return jnp.where(weight.reshape(shape) > 0, nodes, jnp.asarray(kind.ideal, nodes.dtype))


def _sound(kind: ElementType, chunk: Chunk) -> Chunk:
    return chunk._replace(local=_whole(kind, chunk.data.weight, chunk.local))


def movable(admissible: Admissible) -> Bool[Array, " nodes"]:
    """Nodes that can move at all."""
    return admissible.together(jnp.trace(admissible.projectors, axis1=-2, axis2=-1) > 0)


def problem(
    mesh: Mesh,
    motion: Motion,
    sizes: tuple[Float[Array, " _"], ...],
    aggregation: Aggregation,
    metric: Metric = SHAPE_AND_CORNERS,
    size_weight: Scalar = 0.0,
) -> Problem:
    """The objective of a mesh.

    Args:
        mesh: its topology counts, and at its points which nodes can move.
        motion: what the nodes may do.
        sizes: measure of the target elements, one array a block; they also normalise the determinants.
        aggregation: φ.
        metric: what e is the inverse of.
        size_weight: see `inverse_quality`.

    Raises `ValueError` when the metric can't be optimised on the elements.
    """
    dtype = mesh.points.dtype
    free = movable(motion.at(mesh.points))
    kinds = tuple(kind for kind, _ in mesh.blocks)
    check_metric(metric, kinds)
    counted = [gather(free, nodes).any(axis=1).astype(dtype) for _, nodes in mesh.blocks]
    total = jnp.concatenate(counted).sum()
    blocks = tuple(
        _cut(nodes, size, part / jnp.where(total > 0, total, 1), mesh.execution, frames)
        for (_, nodes), frames, size, part in zip(mesh.blocks, tangents(mesh), sizes, counted, strict=True)
    )
    return Problem(motion, blocks, aggregation, jnp.asarray(size_weight, dtype), kinds, metric)


def _cut(nodes: Array, size: Array, weight: Array, execution: Execution, frames: Array | None) -> Chunks:
    chunks = cut(nodes, Weighted(size, weight, jnp.zeros_like(size)), execution, _HEAVY, frames)
    return eqx.tree_at(lambda c: c.data.weight, chunks, jnp.where(chunks.real, chunks.data.weight, 0))
