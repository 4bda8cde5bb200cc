"""What the optimisation variant minimises: metric × target × aggregation (TMOP, in words).

*Metric*: the inverse quality e ≥ 1 of an element, 1 only on the ideal element.  *Target*: what
size an ideal element has.  *Aggregation*: how the e of all elements become one number.

Elements stand in `jaxsmooth.methods.optimize.distortion`.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxsmooth.assembly import Chunks, cut, gather, scan, sum_to_nodes
from jaxsmooth.cells.table import ElementType
from jaxsmooth.mesh.execution import Execution
from jaxsmooth.mesh.record import Mesh
from jaxsmooth.methods.optimize.distortion import (
    apply_model,
    hessian_model,
    inverse_quality,
    model_diagonal,
    regularisation,
)
from jaxsmooth.motion.base import Motion
from jaxsmooth.numerics.admissible import Admissible
from jaxsmooth.numerics.small import contract, determinant

__all__ = ["Aggregation", "Problem", "problem"]

_HEAVY = 4  # memory of an element's energy, in units of a product with linear tetrahedra

Field = Float[Array, "nodes dim"]
Scalar = Float[Array, ""]


# --- Aggregation ---------------------------------------------------------------------------------


class Aggregation(eqx.Module):
    """``φ(e) = average · (1 − 1/e) + worst · (e / pivot)^power / power``.

    The first part is one minus the quality, so its mean is 1 − q_avg; the second grows towards a
    penalty on everything worse than the pivot as the power rises (a p-norm continuation).
    """

    average: Scalar | float
    worst: Scalar | float
    power: Scalar | float
    pivot: Scalar | float = 1.0

    def __call__(self, e: Scalar) -> Scalar:
        """φ(e)."""
        return self.average * (1 - 1 / e) + self.worst / self.power * (e / self.pivot) ** self.power

    def derivatives(self, e: Scalar) -> tuple[Scalar, Scalar]:
        """φ′ and φ″."""
        rise = self.worst / self.pivot * (e / self.pivot) ** (self.power - 1)
        return self.average / e**2 + rise, -2 * self.average / e**3 + (self.power - 1) / e * rise


# --- The whole mesh ------------------------------------------------------------------------------


class Weighted(NamedTuple):
    """What belongs to the elements of a block; ghosts have weight 0.

    Elements that are given up have a `relief`: an ε of their own, so that they may stay inverted.
    """

    size: Array
    weight: Array
    relief: Array


class Problem(eqx.Module):
    """The objective of a mesh as a function of its points, within its constraints.

    Elements without a free node have no weight; all others count alike.
    """

    motion: Motion
    blocks: tuple[Chunks, ...]
    aggregation: Aggregation
    size_weight: Scalar
    kinds: tuple[ElementType, ...] = eqx.field(static=True)
    metric: str = eqx.field(static=True)

    def _scan(self, function: Callable[..., Any], start: Any, points: Field) -> Any:
        """Carry `start` through all chunks: ``(carry, kind, nodes, data, corners) -> carry``."""
        for kind, block in zip(self.kinds, self.blocks, strict=True):

            def add(carry, nodes, data, corners, kind=kind):
                return function(carry, kind, nodes, data, _whole(kind, data.weight, corners)), None

            start, _ = scan(add, start, block, points)
        return start

    def inverse_quality(self, points: Field) -> tuple[Float[Array, " elements"], Float[Array, " elements"]]:
        """e of all elements with their weights, ghosts included."""
        found = []
        for kind, block in zip(self.kinds, self.blocks, strict=True):
            function = partial(inverse_quality, kind, self.metric, self.size_weight)
            batch = jax.vmap(jax.vmap(function, in_axes=(0, 0, None)), in_axes=(0, 0, None))
            corners = _whole(kind, block.data.weight, gather(points, block.nodes))
            found.append((batch(corners, block.data.size, jnp.zeros((), points.dtype))[0], block.data.weight))
        return tuple(
            jnp.concatenate([part.reshape(-1) for part in side]) for side in zip(*found, strict=True)
        )

    def determinants(self, points: Field) -> tuple[Float[Array, "chunks size"], ...]:
        """The least determinant of every element over its target's; ∞ for those without weight."""

        def found(kind, block):
            corners = _whole(kind, block.data.weight, gather(points, block.nodes))
            det = jax.vmap(jax.vmap(partial(_least_determinant, kind)))(corners) / block.data.size
            return jnp.where(block.data.weight > 0, det, jnp.inf)

        return tuple(found(kind, block) for kind, block in zip(self.kinds, self.blocks, strict=True))

    def hopeless(self, points: Field) -> tuple[Bool[Array, "chunks size"], ...]:
        """The elements that stay inverted: a determinant is not positive and all its nodes are held."""
        free = movable(self.motion.at(points))

        def found(kind, block):
            reference = jnp.asarray(kind.validity_gradients, points.dtype)
            depends = np.abs(kind.validity_gradients).max(axis=-1) > 1e-12  # zero but for rounding
            held = ~(depends & gather(free, block.nodes)[..., None, :]).any(axis=-1)
            corners = _whole(kind, block.data.weight, gather(points, block.nodes))
            det = jax.vmap(jax.vmap(lambda nodes: determinant(contract(nodes, reference))))(corners)
            return (held & ~(det > 0)).any(axis=-1)

        return tuple(found(kind, block) for kind, block in zip(self.kinds, self.blocks, strict=True))

    def inverted(self, points: Field, but: tuple[Bool[Array, "chunks size"], ...]) -> Scalar:
        """The number of inverted elements, but for some."""
        dets = self.determinants(points)
        return sum(((det <= 0) & ~out).sum(dtype=det.dtype) for det, out in zip(dets, but, strict=True))

    def giving_up(self, points: Field, elements: tuple[Bool[Array, "chunks size"], ...]) -> Problem:
        """The problem in which those of the elements that are inverted do not stop the others."""
        dets = self.determinants(points)
        relief = [
            jnp.where((det <= 0) & out, regularisation(det), 0)
            for det, out in zip(dets, elements, strict=True)
        ]
        return eqx.tree_at(lambda task: [block.data.relief for block in task.blocks], self, relief)

    def value(self, points: Field, eps: Scalar) -> tuple[Scalar, Scalar]:
        """The objective, and the least determinant over its target's (of weighted elements)."""

        def add(carry, kind, _, data, corners):
            def element(nodes, size, relief):
                eps_here = jnp.maximum(eps, relief)
                e, _ = inverse_quality(kind, self.metric, self.size_weight, nodes, size, eps_here)
                return self.aggregation(e), _least_determinant(kind, nodes) / size

            energy, det = jax.vmap(element)(corners, data.size, data.relief)
            total, worst = carry
            counts = (data.weight > 0) & (data.relief == 0)
            worst = jnp.minimum(worst, jnp.where(counts, det, jnp.inf).min())
            return total + data.weight @ energy, worst

        return self._scan(add, (jnp.zeros((), points.dtype), jnp.full((), jnp.inf, points.dtype)), points)

    def value_and_grad(self, points: Field, eps: Scalar) -> tuple[Scalar, Field]:
        """The objective and its gradient with respect to all points."""

        def add(carry, kind, nodes, data, corners):
            def element(nodes, size, relief):
                eps_here = jnp.maximum(eps, relief)
                e, gradient = inverse_quality(kind, self.metric, self.size_weight, nodes, size, eps_here)
                return self.aggregation(e), self.aggregation.derivatives(e)[0] * gradient

            energies, slopes = jax.vmap(element)(corners, data.size, data.relief)
            total, gradient = carry
            slopes = data.weight[:, None, None] * slopes
            gradient = gradient.at[nodes].add(slopes, mode="promise_in_bounds")
            return total + data.weight @ energies, gradient

        start = (jnp.zeros((), points.dtype), jnp.zeros_like(points))
        return self._scan(add, start, points)

    def model(self, points: Field, eps: Scalar) -> tuple[tuple[Chunks, ...], Float[Array, "nodes dim dim"]]:
        """The Hessian model of all elements, and its node blocks."""
        models = []
        total = jnp.zeros((*points.shape, points.shape[-1]), points.dtype)
        for kind, block in zip(self.kinds, self.blocks, strict=True):

            def element(nodes, data, kind=kind):
                def aggregate(e):
                    first, second = self.aggregation.derivatives(e)
                    return data.weight * first, data.weight * second

                nodes, eps_here = _whole(kind, data.weight, nodes), jnp.maximum(eps, data.relief)
                args = (kind, self.metric, self.size_weight, aggregate)
                model = hessian_model(*args, nodes, data.size, eps_here)
                return model, model_diagonal(kind, model)

            def add(total, nodes, data, corners, element=element):
                model, diagonal = jax.vmap(element)(corners, data)
                return total.at[nodes].add(diagonal, mode="promise_in_bounds"), model

            total, model = scan(add, total, block, points)
            models.append(Chunks(block.nodes, model, block.count))
        return tuple(models), total

    def apply(self, models: tuple[Chunks, ...], move: Field) -> Field:
        """The Hessian model times a displacement."""
        total = jnp.zeros_like(move)
        for kind, model in zip(self.kinds, models, strict=True):
            total = sum_to_nodes(partial(apply_model, kind), model, move, total)
        return total


def _least_determinant(kind: ElementType, nodes: Array) -> Scalar:
    return determinant(contract(nodes, jnp.asarray(kind.validity_gradients, nodes.dtype))).min()


def _whole(kind: ElementType, weight: Array, nodes: Array) -> Array:
    """The ideal element in place of one without weight, which may be degenerate."""
    shape = (*weight.shape, *(1,) * (nodes.ndim - weight.ndim))
    return jnp.where(weight.reshape(shape) > 0, nodes, jnp.asarray(kind.ideal, nodes.dtype))


def movable(admissible: Admissible) -> Bool[Array, " nodes"]:
    """Nodes that can move at all."""
    return admissible.together(jnp.trace(admissible.projectors, axis1=-2, axis2=-1) > 0)


def problem(
    mesh: Mesh,
    motion: Motion,
    sizes: tuple[Float[Array, " _"], ...],
    aggregation: Aggregation,
    metric: str = "shape_and_corners",
    size_weight: Scalar | float = 0.0,
) -> Problem:
    """The objective of a mesh.

    Args:
        mesh: its topology counts, and at its points which nodes can move.
        motion: what the nodes may do.
        sizes: measure of the target elements, one array a block; they also normalise the determinants.
        aggregation: φ.
        metric: ``"shape_and_corners"`` or ``"mean_ratio"``.
        size_weight: see `inverse_quality`.
    """
    dtype = mesh.points.dtype
    free = movable(motion.at(mesh.points))
    kinds = tuple(kind for kind, _ in mesh.blocks)
    counted = [gather(free, nodes).any(axis=1).astype(dtype) for _, nodes in mesh.blocks]
    total = jnp.concatenate(counted).sum()
    blocks = tuple(
        _cut(nodes, size, part / jnp.where(total > 0, total, 1), mesh.execution)
        for (_, nodes), size, part in zip(mesh.blocks, sizes, counted, strict=True)
    )
    return Problem(motion, blocks, aggregation, jnp.asarray(size_weight, dtype), kinds, metric)


def _cut(nodes: Array, size: Array, weight: Array, execution: Execution) -> Chunks:
    chunks = cut(nodes, Weighted(size, weight, jnp.zeros_like(size)), execution, _HEAVY)
    ghosts = jnp.where(chunks.data.weight > 0, chunks.data.size, 1)
    return eqx.tree_at(lambda c: c.data.size, chunks, ghosts)
