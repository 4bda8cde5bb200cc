"""Projected, preconditioned conjugate gradients with an implicit derivative.

The constrained problem min ½ uᵀKu − fᵀu over the null space of the constraints is
``(P K P + (I − P)) u = P f`` with one projector a node: positive definite, and, unlike
``P K P`` alone, right under differentiation, for the cotangent is projected as well.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.ad_checkpoint import checkpoint_name
from jaxtyping import Array, Float, Int

from jaxsmooth.small import cofactors, determinant

__all__ = ["Solution", "block_inverse", "gradient_tolerance", "project", "solve_projected"]

Field = Float[Array, "nodes dim"]


class Solution(NamedTuple):
    """Attributes: the field ``[nodes, dim]``; iterations; true relative residual |b − Ax|/|b|."""

    field: Field
    iterations: Int[Array, ""]
    residual: Float[Array, ""]


def project(projectors: Float[Array, "nodes dim dim"], field: Field) -> Field:
    """``P u``, node by node."""
    return (projectors * field[:, None, :]).sum(axis=-1)


def block_inverse(blocks: Float[Array, "nodes dim dim"]) -> Float[Array, "nodes dim dim"]:
    """Inverses of symmetric positive definite node blocks; identity where a block is singular."""
    dim = blocks.shape[-1]
    scale = jnp.trace(blocks, axis1=-2, axis2=-1)[:, None, None] / dim
    scale = jnp.where(scale > 0, scale, 1)
    blocks = blocks / scale
    det = determinant(blocks)[:, None, None]
    regular = det > jnp.finfo(blocks.dtype).eps
    inverse = cofactors(blocks) / jnp.where(regular, det, 1)
    return jnp.where(regular, inverse, jnp.eye(dim, dtype=blocks.dtype)) / scale


_RESTARTS = 4
_PATIENCE = 10  # times more iterations for a differentiated solve


def conjugate_gradients(
    matvec: Callable[[Field], Field],
    right: Field,
    precondition: Callable[[Field], Field],
    tolerance: Float[Array, ""] | float,
    max_iterations: Int[Array, ""] | int,
) -> Solution:
    """Preconditioned CG until the *true* residual is below `tolerance` times ``|b|``.

    The right-hand side is scaled to unit size first, so that tiny ones (cotangents) are solved
    as well as large ones.  When the recursion says that it has converged the true residual is
    computed, and the iteration starts again from there if it disagrees.
    """
    size = jnp.abs(right).max()
    empty = ~(size > 0)
    b = right / jnp.where(empty, 1, size)
    goal = (tolerance**2) * jnp.vdot(b, b)

    def restart(carry):
        x, count, restarts, _ = carry
        r = b - matvec(x)
        z = precondition(r)

        def more(state):
            _, r, _, _, n = state
            return (jnp.vdot(r, r) > goal) & (n < max_iterations)

        def iterate(state):
            x, r, p, rho, n = state
            ap = matvec(p)
            curvature = jnp.vdot(p, ap)
            step = jnp.where(curvature > 0, rho / jnp.where(curvature > 0, curvature, 1), 0)
            x, r = x + step * p, r - step * ap
            z = precondition(r)
            next_rho = jnp.vdot(r, z)
            return x, r, z + next_rho / jnp.where(rho > 0, rho, 1) * p, next_rho, n + 1

        x, _, _, _, count = jax.lax.while_loop(more, iterate, (x, r, z, jnp.vdot(r, z), count))
        r = b - matvec(x)
        return x, count, restarts + 1, jnp.vdot(r, r)

    def unfinished(carry):
        _, count, restarts, square = carry
        return (square > goal) & (count < max_iterations) & (restarts < _RESTARTS)

    start = (jnp.zeros_like(b), jnp.int32(0), jnp.int32(0), jnp.vdot(b, b))
    x, count, _, square = jax.lax.while_loop(unfinished, restart, start)
    residual = jnp.sqrt(square / jnp.where(empty, 1, jnp.vdot(b, b)))
    return Solution(x * jnp.where(empty, 0, size), count, residual)


def solve_projected(
    operator: Callable[[Field], Field],
    diagonal: Float[Array, "nodes dim dim"],
    projectors: Float[Array, "nodes dim dim"],
    force: Field,
    tolerance: float = 1e-2,
    max_iterations: int = 1000,
) -> Solution:
    """Solve ``(P K P + (I − P)) u = P f`` (Eq. 33 without its multipliers).

    Under differentiation the system is solved to `gradient_tolerance`, and so is its
    derivative: implicitly, by one more solve with the same operator and a projected
    right-hand side.  The derivative of a loosely solved system would be that of nothing.

    Args:
        operator: ``u -> K u``, a pytree; it may hold differentiated values.
        diagonal: node blocks of K, for the block-Jacobi preconditioner.
        projectors: onto the free directions of every node.
        force: f, ``[nodes, dim]``.
        tolerance: on the true residual, relative to ``|P f|``.
        max_iterations: bound on all iterations together.

    Returns:
        The solution, with the iterations it took and its true relative residual.
    """
    system = (operator, jax.lax.stop_gradient(diagonal), projectors, force)
    return _solve(system, tolerance, max_iterations)


def gradient_tolerance(dtype: Any) -> float:
    """Relative residual to which differentiated systems are solved: 4e-10, or 7e-5 in float32."""
    return float(jnp.finfo(dtype).eps) ** 0.6


@jax.custom_jvp
def _solve(system, tolerance, max_iterations) -> Solution:
    matvec, right, solver = _equations(system, tolerance, max_iterations)
    field, (iterations, residual) = solver(matvec, right)
    return Solution(field, iterations, residual)


@_solve.defjvp
def _solve_jvp(primals, tangents):
    """With A u = b:  A du = db − dA u."""
    system, tolerance, max_iterations = primals
    tight = jnp.minimum(tolerance, gradient_tolerance(system[-1].dtype))
    solution = _solve(system, tight, _PATIENCE * max_iterations)
    # saved under this name, a rematerialised step need not solve again
    field = checkpoint_name(solution.field, "displacement")

    def residual(system):
        matvec, right, _ = _equations(system, tight, max_iterations)
        return right - matvec(field)

    _, change = jax.jvp(residual, (system,), tangents[:1])
    matvec, _, solver = _equations(system, tight, _PATIENCE * max_iterations)
    slope, _ = jax.lax.custom_linear_solve(matvec, change, solver, symmetric=True, has_aux=True)
    iterations = np.zeros((), jax.dtypes.float0)
    return solution._replace(field=field), Solution(slope, iterations, jnp.zeros_like(solution.residual))


def _equations(system, tolerance, max_iterations):
    """The operator P K P + (I − P), the right-hand side P f, and a solver for them."""
    operator, diagonal, projectors, force = system
    rest = jnp.eye(force.shape[-1], dtype=force.dtype) - projectors
    inverse = jax.lax.stop_gradient(block_inverse(projectors @ diagonal @ projectors + rest))

    def matvec(u: Field) -> Field:
        return project(projectors, operator(project(projectors, u))) + project(rest, u)

    def solver(matvec, b):
        solution = conjugate_gradients(matvec, b, lambda r: project(inverse, r), tolerance, max_iterations)
        return solution.field, (solution.iterations, solution.residual)

    return matvec, project(projectors, force), solver
