"""What the optimisation variant minimises: metric × target × aggregation (TMOP, in words).

*Metric*: the inverse quality e ≥ 1 of an element, 1 only on the ideal element.  *Target*: what
size an ideal element has.  *Aggregation*: how the e of all elements become one number.

Elements stand in `jaxsmooth.distortion`.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxsmooth.constraints import Constraints
from jaxsmooth.distortion import (
    Model,
    apply_model,
    hessian_model,
    inverse_quality,
    model_diagonal,
    regularisation,
)
from jaxsmooth.elements import ElementType
from jaxsmooth.mesh import Mesh, gather
from jaxsmooth.small import contract, determinant
from jaxsmooth.solve import block_inverse, project

__all__ = ["Aggregation", "Problem", "problem"]

_CPU_CHUNK = 1024  # elements whose intermediates stay in the second-level cache

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


class Block(eqx.Module):
    """One element block cut into chunks ``[chunks, size]``; ghosts have weight 0.

    Elements that are given up have a `relief`: an ε of their own, so that they may stay inverted.
    """

    nodes: Array
    size: Array
    weight: Array
    relief: Array

    @property
    def fields(self) -> tuple[Array, ...]:
        """What a scan over the chunks takes."""
        return self.nodes, self.size, self.weight, self.relief


class Problem(eqx.Module):
    """The objective of a mesh as a function of its points, within its constraints.

    Elements without a free node have no weight; all others count alike.
    """

    projectors: Float[Array, "nodes dim dim"]
    blocks: tuple[Block, ...]
    aggregation: Aggregation
    size_weight: Scalar
    kinds: tuple[ElementType, ...] = eqx.field(static=True)
    metric: str = eqx.field(static=True)

    def _scan(self, function: Callable[..., Any], start: Any, points: Field) -> Any:
        """Carry `start` through all chunks: ``(carry, kind, block, corners) -> carry``."""
        for kind, block in zip(self.kinds, self.blocks, strict=True):

            def add(carry, chunk, kind=kind):
                chunk = Block(*chunk)
                corners = _whole(kind, chunk.weight, gather(points, chunk.nodes))
                return function(carry, kind, chunk, corners), None

            start, _ = jax.lax.scan(add, start, block.fields)
        return start

    def inverse_quality(self, points: Field) -> tuple[Float[Array, " elements"], Float[Array, " elements"]]:
        """e of all elements with their weights, ghosts included."""
        found = []
        for kind, block in zip(self.kinds, self.blocks, strict=True):
            function = partial(inverse_quality, kind, self.metric, self.size_weight)
            batch = jax.vmap(jax.vmap(function, in_axes=(0, 0, None)), in_axes=(0, 0, None))
            corners = _whole(kind, block.weight, gather(points, block.nodes))
            found.append((batch(corners, block.size, jnp.zeros((), points.dtype))[0], block.weight))
        return tuple(
            jnp.concatenate([part.reshape(-1) for part in side]) for side in zip(*found, strict=True)
        )

    def determinants(self, points: Field) -> tuple[Float[Array, "chunks size"], ...]:
        """The least determinant of every element over its target's; ∞ for those without weight."""

        def found(kind, block):
            corners = _whole(kind, block.weight, gather(points, block.nodes))
            det = jax.vmap(jax.vmap(partial(_least_determinant, kind)))(corners) / block.size
            return jnp.where(block.weight > 0, det, jnp.inf)

        return tuple(found(kind, block) for kind, block in zip(self.kinds, self.blocks, strict=True))

    def hopeless(self, points: Field) -> tuple[Bool[Array, "chunks size"], ...]:
        """The elements that stay inverted: a determinant is not positive and all its nodes are held."""
        free = jnp.trace(self.projectors, axis1=-2, axis2=-1) > 0

        def found(kind, block):
            reference = jnp.asarray(kind.validity_gradients, points.dtype)
            depends = np.abs(kind.validity_gradients).max(axis=-1) > 1e-12  # zero but for rounding
            held = ~(depends & gather(free, block.nodes)[..., None, :]).any(axis=-1)
            corners = _whole(kind, block.weight, gather(points, block.nodes))
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
        return eqx.tree_at(lambda task: [block.relief for block in task.blocks], self, relief)

    def value(self, points: Field, eps: Scalar) -> tuple[Scalar, Scalar]:
        """The objective, and the least determinant over its target's (of weighted elements)."""

        def add(carry, kind, block, corners):
            def element(nodes, size, relief):
                eps_here = jnp.maximum(eps, relief)
                e, _ = inverse_quality(kind, self.metric, self.size_weight, nodes, size, eps_here)
                return self.aggregation(e), _least_determinant(kind, nodes) / size

            energy, det = jax.vmap(element)(corners, block.size, block.relief)
            total, worst = carry
            counts = (block.weight > 0) & (block.relief == 0)
            worst = jnp.minimum(worst, jnp.where(counts, det, jnp.inf).min())
            return total + block.weight @ energy, worst

        return self._scan(add, (jnp.zeros((), points.dtype), jnp.full((), jnp.inf, points.dtype)), points)

    def value_and_grad(self, points: Field, eps: Scalar) -> tuple[Scalar, Field]:
        """The objective and its gradient, projected onto the free directions."""

        def add(carry, kind, block, corners):
            def element(nodes, size, relief):
                eps_here = jnp.maximum(eps, relief)
                e, gradient = inverse_quality(kind, self.metric, self.size_weight, nodes, size, eps_here)
                return self.aggregation(e), self.aggregation.derivatives(e)[0] * gradient

            energies, slopes = jax.vmap(element)(corners, block.size, block.relief)
            total, gradient = carry
            slopes = block.weight[:, None, None] * slopes
            gradient = gradient.at[block.nodes].add(slopes, mode="promise_in_bounds")
            return total + block.weight @ energies, gradient

        start = (jnp.zeros((), points.dtype), jnp.zeros_like(points))
        value, gradient = self._scan(add, start, points)
        return value, project(self.projectors, gradient)

    def model(self, points: Field, eps: Scalar) -> tuple[tuple[Model, ...], Float[Array, "nodes dim dim"]]:
        """The Hessian model of all elements, and the inverse of its projected node blocks."""
        models = []
        dim = points.shape[-1]
        blocks = jnp.zeros((*points.shape, dim), points.dtype)
        for kind, block in zip(self.kinds, self.blocks, strict=True):

            def element(nodes, size, weight, relief, kind=kind):
                def aggregate(e):
                    first, second = self.aggregation.derivatives(e)
                    return weight * first, weight * second

                nodes, eps_here = _whole(kind, weight, nodes), jnp.maximum(eps, relief)
                model = hessian_model(kind, self.metric, self.size_weight, aggregate, nodes, size, eps_here)
                return model, model_diagonal(kind, model)

            def add(total, chunk, element=element):
                nodes, *rest = chunk
                model, diagonal = jax.vmap(element)(gather(points, nodes), *rest)
                return total.at[nodes].add(diagonal, mode="promise_in_bounds"), model

            blocks, model = jax.lax.scan(add, blocks, block.fields)
            models.append(model)
        return tuple(models), block_inverse(blocks, self.projectors)

    def apply(self, models: tuple[Model, ...], move: Field) -> Field:
        """The projected Hessian model times a displacement within the constraints."""
        total = jnp.zeros_like(move)
        for kind, block, model in zip(self.kinds, self.blocks, models, strict=True):

            def add(total, chunk, kind=kind):
                nodes, model = chunk
                part = jax.vmap(partial(apply_model, kind))(gather(move, nodes), model)
                return total.at[nodes].add(part, mode="promise_in_bounds"), None

            total, _ = jax.lax.scan(add, total, (block.nodes, model))
        return project(self.projectors, total)


def _least_determinant(kind: ElementType, nodes: Array) -> Scalar:
    return determinant(contract(nodes, jnp.asarray(kind.validity_gradients, nodes.dtype))).min()


def _whole(kind: ElementType, weight: Array, nodes: Array) -> Array:
    """The ideal element in place of one without weight, which may be degenerate."""
    shape = (*weight.shape, *(1,) * (nodes.ndim - weight.ndim))
    return jnp.where(weight.reshape(shape) > 0, nodes, jnp.asarray(kind.ideal, nodes.dtype))


def problem(
    mesh: Mesh,
    constraints: Constraints,
    sizes: tuple[Float[Array, " elements"], ...],
    aggregation: Aggregation,
    metric: str = "shape",
    size_weight: Scalar | float = 0.0,
) -> Problem:
    """The objective of a mesh.

    Args:
        mesh: gives the topology.
        constraints: of its nodes.
        sizes: measure of the target elements, one array a block; they also normalise the determinants.
        aggregation: φ.
        metric: ``"shape"`` or ``"mean_ratio"``.
        size_weight: see `inverse_quality`.
    """
    dtype = mesh.points.dtype
    free = jnp.trace(constraints.projectors, axis1=-2, axis2=-1) > 0
    kinds = tuple(kind for kind, _ in mesh.blocks)
    movable = [gather(free, nodes).any(axis=1).astype(dtype) for _, nodes in mesh.blocks]
    total = jnp.concatenate(movable).sum()
    blocks = tuple(
        _cut(nodes, size, part / jnp.where(total > 0, total, 1))
        for (_, nodes), size, part in zip(mesh.blocks, sizes, movable, strict=True)
    )
    return Problem(
        constraints.projectors, blocks, aggregation, jnp.asarray(size_weight, dtype), kinds, metric
    )


def _cut(nodes: Array, size: Array, weight: Array) -> Block:
    count = len(nodes)
    length = min(count, _CPU_CHUNK) if jax.default_backend() == "cpu" else count
    chunks = -(-count // max(length, 1))

    def fold(array: Array, filling: float) -> Array:
        padding = [(0, chunks * length - count)] + [(0, 0)] * (array.ndim - 1)
        padded = jnp.pad(array, padding, constant_values=filling)
        return padded.reshape(chunks, length, *array.shape[1:])

    return Block(fold(nodes, 0), fold(size, 1), fold(weight, 0), fold(jnp.zeros_like(size), 0))
