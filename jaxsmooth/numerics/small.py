"""Closed forms for 2×2 and 3×3 matrices, and roots with finite derivatives everywhere."""

from __future__ import annotations

from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

__all__ = [
    "Frame",
    "cofactors",
    "contract",
    "determinant",
    "in_precision",
    "least",
    "norm",
    "power",
    "signed_power",
    "solve_regular",
]

Tree = TypeVar("Tree")


def contract(points: Float[Array, "k dim"], gradients: Float[Array, "q k j"]) -> Float[Array, "q dim j"]:
    """``Xᵀ G`` at every sample point.  Written as a sum, which fuses with its surroundings
    and runs several times faster on CPU than a batched product of such small matrices."""
    return (points[None, :, :, None] * gradients[:, :, None, :]).sum(axis=1)


def cofactors(a: Float[Array, "... dim dim"]) -> Float[Array, "... dim dim"]:
    """Cofactor matrix: ``cofactors(a).T / det(a)`` is the inverse."""
    m = _entries(a)
    if len(m) == 2:
        rows = [[m[1][1], -m[1][0]], [-m[0][1], m[0][0]]]
    else:
        rows = [[_minor(m, i, j) for j in range(3)] for i in range(3)]
    return jnp.stack([part for row in rows for part in row], axis=-1).reshape(a.shape)


def _entries(a: Float[Array, "... dim dim"]) -> list[list[Array]]:
    """Row by row; taken all at once, for indices are most of what tracing such formulas costs."""
    dim = a.shape[-1]
    parts = jax.lax.split(a.reshape(*a.shape[:-2], dim * dim), (1,) * dim**2, axis=a.ndim - 2)
    numbers = [jax.lax.squeeze(part, (part.ndim - 1,)) for part in parts]
    return [numbers[dim * i : dim * (i + 1)] for i in range(dim)]


def _minor(m: list[list[Array]], i: int, j: int) -> Array:
    r, s, c, d = (i + 1) % 3, (i + 2) % 3, (j + 1) % 3, (j + 2) % 3
    return m[r][c] * m[s][d] - m[r][d] * m[s][c]


def determinant(a: Float[Array, "... dim dim"]) -> Float[Array, ...]:
    """Determinant by expansion along the first row."""
    m = _entries(a)
    if len(m) == 2:
        return m[0][0] * m[1][1] - m[0][1] * m[1][0]
    first, second, third = (m[0][j] * _minor(m, 0, j) for j in range(3))
    return first + second + third


def norm(vectors: Float[Array, "... dim"]) -> Float[Array, ...]:
    """Euclidean norm over the last axis; its derivative at zero is zero, not NaN."""
    return power((vectors * vectors).sum(axis=-1), 0.5)


def power(base: Float[Array, ...], exponent: Float[Array, ""] | float) -> Float[Array, ...]:
    """``base ** exponent`` for ``base >= 0``, with derivative zero where the base is zero."""
    positive = base > 0
    return jnp.where(positive, jnp.where(positive, base, 1) ** exponent, 0)


def signed_power(base: Float[Array, ...], exponent: Float[Array, ""] | float) -> Float[Array, ...]:
    """``sign(base) |base| ** exponent``: at zero its derivative is 1 for exponent 1, else 0."""
    return _signed_power(base, jnp.asarray(exponent, base.dtype))


@jax.custom_jvp
def _signed_power(base: Float[Array, ...], exponent: Float[Array, ""]) -> Float[Array, ...]:
    return jnp.sign(base) * power(jnp.abs(base), exponent)


@_signed_power.defjvp
def _signed_power_jvp(primals, tangents):
    (base, exponent), (change, growth) = primals, tangents
    value = _signed_power(base, exponent)
    solid = base != 0
    size = jnp.abs(jnp.where(solid, base, 1))
    flat = jnp.where(exponent == 1, 1, 0).astype(base.dtype)
    slope = exponent * jnp.where(solid, size ** (exponent - 1), flat)
    return value, slope * change + value * jnp.log(size) * growth


@jax.custom_jvp
def least(values: Float[Array, " n"]) -> Float[Array, ""]:
    """The minimum; its derivative is that of one of the least values.

    The derivative of `jnp.min` shares it among the values equal to the minimum, and is 0/0 where
    the compiler has rounded the two sides of that comparison differently.
    """
    return values.min()


@least.defjvp
def _least_jvp(primals, tangents):
    (values,), (change,) = primals, tangents
    chosen = jnp.arange(len(values)) == jnp.argmin(values)
    return least(values), jnp.where(chosen, change, 0).sum()


def solve_regular(a: Float[Array, "dim dim"], b: Float[Array, " dim"], floor: float) -> Float[Array, " dim"]:
    """``a⁻¹ b`` for symmetric non-negative ``a``; zero where ``det a ≤ floor · (tr a)ᵈⁱᵐ``."""
    det, scale = determinant(a), jnp.trace(a)
    regular = det > floor * scale ** a.shape[-1]
    return jnp.where(regular, cofactors(a).T @ b / jnp.where(regular, det, 1), 0)


def in_precision(tree: Tree, dtype: Any) -> Tree:
    """A pytree with all arrays of floats in the type of the mesh that they are used with."""

    def cast(leaf):
        known = isinstance(leaf, (jax.Array, np.ndarray)) and jnp.issubdtype(leaf.dtype, jnp.floating)
        return jnp.asarray(leaf, dtype) if known and leaf.dtype != dtype else leaf

    return jax.tree.map(cast, tree)


class Frame(NamedTuple):
    """Coordinates ``(x − origin) · scale``; both are constants for differentiation."""

    origin: Float[Array, " dim"]
    scale: Float[Array, ""]

    @classmethod
    def of(cls, points: Float[Array, "nodes dim"]) -> Frame:
        """The frame in which points have an extent between 1/2 and 1 and lie at the origin.

        The scale is a power of two, so multiplying by it is exact: what is computed in this frame does not
        depend on the unit of length, nor on where the origin is, and neither over- nor underflows.
        """
        points = jax.lax.stop_gradient(points)
        origin = points.min(axis=0)
        extent = (points.max(axis=0) - origin).max()
        return cls(origin, jnp.ldexp(jnp.ones((), points.dtype), -jnp.frexp(extent)[1]))

    def into(self, points: Float[Array, "... dim"]) -> Float[Array, "... dim"]:
        """Points in the coordinates of the frame."""
        return (points - self.origin) * self.scale
