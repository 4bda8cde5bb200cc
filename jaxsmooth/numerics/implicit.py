"""Solutions of equations with implicit derivatives of every order, and the linear solver that they need."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxsmooth.numerics.solve import gradient_tolerance
from jaxsmooth.numerics.varying import varying_like

__all__ = ["attach_root", "conjugate_residuals", "undefined_unless", "undifferentiated"]

Field = Float[Array, "nodes dim"]
Matvec = Callable[[Field], Field]

_KEPT = 30  # directions that a new one is made orthogonal to
_SLACK = 100.0  # a residual that exceeds its tolerance by more is a failure, less is rounding


def attach_root(
    residual: Callable[..., Field],
    solution: Field,
    parameters: tuple[Any, ...],
    solve: Callable[[Matvec, Field], Field],
) -> Field:
    """`solution` of ``residual(u, *parameters) = 0`` with its derivative with respect to the parameters.

    ``du = −(∂r/∂u)⁻¹ ∂r/∂p dp``.  The rule attaches the solution again, so that derivatives of derivatives
    know how it depends on the parameters.

    Args:
        residual: the equation; it may close over constants.
        solution: u, from whatever solver.
        parameters: pytrees.
        solve: ``(matvec, right) -> x`` with a derivative of its own, such as `jax.lax.custom_linear_solve`.
    """

    @jax.custom_jvp
    def attach(solution, parameters):
        return solution

    @attach.defjvp
    def _(primals, tangents):
        solution, parameters = attach(*primals), primals[1]
        _, change = jax.jvp(lambda p: residual(solution, *p), (parameters,), tangents[1:])
        _, slope = jax.linearize(lambda u: residual(u, *parameters), solution)
        return solution, solve(slope, -change)

    return attach(jax.lax.stop_gradient(solution), parameters)


def undefined_unless(residual: Float[Array, ""], tolerance: Float[Array, ""] | float, field: Field) -> Field:
    """The solution of a linear system, or NaN where its residual is far from the tolerance."""
    return jnp.where(
        residual <= _SLACK * jnp.maximum(tolerance, gradient_tolerance(field.dtype)), field, jnp.nan
    )


class _Iterate(NamedTuple):
    x: Field
    r: Field
    directions: Float[Array, "kept nodes dim"]
    images: Float[Array, "kept nodes dim"]
    done: Int[Array, ""]


def conjugate_residuals(
    matvec: Matvec, right: Field, tolerance: Float[Array, ""] | float, max_iterations: int
) -> Field:
    """``A⁻¹ b`` for any matrix whose symmetric part is positive: NaN unless it is found.

    Generalised conjugate residuals (Eisenstat, Elman and Schultz 1983), with the last 30 directions:
    the residuals of GMRES, from which it is started twice more, for the products may be rounded.
    """
    size = jnp.abs(right).max()
    b = right / jnp.where(size > 0, size, 1)
    goal = tolerance * jnp.linalg.norm(b)

    def unfinished(s: _Iterate):
        length = jnp.linalg.norm(s.r)
        return (length > goal) & (s.done < max_iterations)

    def iterate(s: _Iterate) -> _Iterate:
        p, q = s.r, matvec(s.r)
        for _ in range(2):  # once more for rounding
            along = jnp.einsum("kij,ij->k", s.images, q)
            p = p - jnp.einsum("k,kij->ij", along, s.directions)
            q = q - jnp.einsum("k,kij->ij", along, s.images)
        length = jnp.linalg.norm(q)
        length = jnp.where(length > 0, length, 1)
        p, q = p / length, q / length
        step, slot = jnp.vdot(q, s.r), s.done % _KEPT
        directions, images = s.directions.at[slot].set(p), s.images.at[slot].set(q)
        return _Iterate(s.x + step * p, s.r - step * q, directions, images, s.done + 1)

    none = varying_like(jnp.zeros((_KEPT, *b.shape), b.dtype), b)

    def again(_, state):
        x, r, count = state
        end = jax.lax.while_loop(unfinished, iterate, _Iterate(x, r, none, none, count))
        return end.x, b - matvec(end.x), end.done

    x, r, _ = jax.lax.fori_loop(0, 3, again, varying_like((jnp.zeros_like(b), b, jnp.int32(0)), b))
    length = jnp.linalg.norm(b)
    residual = jnp.linalg.norm(r) / jnp.where(length > 0, length, 1)
    return undefined_unless(residual, tolerance, x) * size


def undifferentiated(tree: Any, message: str) -> Any:
    """A pytree whose derivative raises a `TypeError` with a message, where it would be silently wrong."""

    @jax.custom_jvp
    def keep(tree):
        return tree

    @keep.defjvp
    def _(primals, tangents):
        raise TypeError(message)

    return keep(tree)
