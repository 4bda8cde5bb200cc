"""Projected, preconditioned conjugate gradients with an implicit derivative.

The constrained problem min ½ uᵀKu − fᵀu over the null space of the constraints, which are the fields
``u = T w`` (`Admissible`), is ``(TᵀK T + (I − P)) w = Tᵀf`` with one projector a node: positive definite,
and, unlike ``TᵀK T`` alone, right under differentiation, for the cotangent is projected as well.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.ad_checkpoint import checkpoint_name
from jaxtyping import Array, Bool, Float, Int

from jaxsmooth.numerics.admissible import Admissible
from jaxsmooth.numerics.small import cofactors, determinant
from jaxsmooth.numerics.varying import varying_like

__all__ = [
    "Solution",
    "apply_blocks",
    "block_inverse",
    "conjugate_gradients",
    "gradient_tolerance",
    "solve_projected",
]

Field = Float[Array, "nodes dim"]


class Solution(NamedTuple):
    """Attributes: the field ``[nodes, dim]``; iterations; true relative residual |b − Ax|/|b|."""

    field: Field
    iterations: Int[Array, ""]
    residual: Float[Array, ""]


def block_inverse(
    blocks: Float[Array, "nodes dim dim"], admissible: Admissible
) -> Float[Array, "nodes dim dim"]:
    """Inverses of symmetric non-negative node blocks within the constraints.

    A block ``P B P`` is completed by ``s (I − P)``, s its own size, so that it can be inverted whatever
    the units of B are; where it is singular all the same, s stands for it.
    """
    dim = blocks.shape[-1]
    eye, projectors = jnp.eye(dim, dtype=blocks.dtype), admissible.projectors
    inside = projectors @ admissible.collect_blocks(blocks) @ projectors
    scale = jnp.trace(inside, axis1=-2, axis2=-1)[:, None, None] / dim
    scale = jnp.where(scale > 0, scale, 1)
    blocks = inside / scale + (eye - projectors)
    det = determinant(blocks)[:, None, None]
    regular = det > jnp.finfo(blocks.dtype).eps
    inverse = cofactors(blocks) / jnp.where(regular, det, 1)
    return jnp.where(regular, inverse, eye) / scale


_RESTARTS = 4
_ROUNDING = 4  # iterations a degree of freedom, where exact arithmetic needs one


class _Iterate(NamedTuple):
    """State of the iteration: solution, residual, direction; r·z, r·r, and r·r when last true."""

    x: Field
    r: Field
    p: Field
    rho: Float[Array, ""]
    square: Float[Array, ""]
    confirmed: Float[Array, ""]
    iterations: Int[Array, ""]
    restarts: Int[Array, ""]
    check: Bool[Array, ""]
    done: Bool[Array, ""]


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
    computed, and the iteration starts again from there if it disagrees, as long as that helps.
    """
    size = jnp.abs(right).max()
    empty = ~(size > 0)
    b = right / jnp.where(empty, 1, size)
    unit = jnp.vdot(b, b)
    goal = (tolerance**2) * unit
    bound = jnp.minimum(max_iterations, _ROUNDING * right.size)

    def iterate(s: _Iterate) -> _Iterate:
        # One product serves both: with the direction, or, to check, with the solution.
        product = matvec(jnp.where(s.check, s.x, s.p))
        curvature = jnp.vdot(s.p, product)
        step = jnp.where(s.check | ~(curvature > 0), 0, s.rho / jnp.where(curvature > 0, curvature, 1))
        x = s.x + step * s.p
        r = jnp.where(s.check, b, s.r) - jnp.where(s.check, 1, step) * product
        z = precondition(r)
        rho, square = jnp.vdot(r, z), jnp.vdot(r, r)
        turn = jnp.where(s.check | ~(s.rho > 0), 0, rho / jnp.where(s.rho > 0, s.rho, 1))
        iterations = s.iterations + ~s.check
        full = iterations >= bound
        helped = (square < s.confirmed / 4) & (s.restarts < _RESTARTS)
        return _Iterate(
            x,
            r,
            z + turn * s.p,
            rho,
            square,
            confirmed=jnp.where(s.check, square, s.confirmed),
            iterations=iterations,
            restarts=s.restarts + s.check,
            check=~s.check & (~(square > goal) | full),
            done=s.check & (~(square > goal) | full | ~helped),
        )

    z = precondition(b)
    zero, no = jnp.int32(0), jnp.bool_(False)
    start = _Iterate(jnp.zeros_like(b), b, z, jnp.vdot(b, z), unit, unit, zero, zero, no, ~(unit > goal))
    start = varying_like(start, z)
    end = jax.lax.while_loop(lambda s: ~s.done, iterate, start)
    residual = jnp.sqrt(end.square / jnp.where(empty, 1, unit))
    return Solution(end.x * jnp.where(empty, 0, size), end.iterations, residual)


def apply_blocks(blocks: Float[Array, "nodes dim dim"], field: Field) -> Field:
    """The product of node blocks with a field."""
    return (blocks * field[:, None, :]).sum(axis=-1)


def solve_projected(
    operator: Callable[[Field], Field],
    diagonal: Float[Array, "nodes dim dim"],
    admissible: Admissible,
    force: Field,
    tolerance: Float[Array, ""] | float = 1e-2,
    max_iterations: Int[Array, ""] | int = 1000,
) -> Solution:
    """Solve ``(TᵀK T + (I − P)) w = Tᵀf``, and return ``u = T w`` (Eq. 33 without its multipliers).

    The derivative is implicit: one more solve with the same operator and a projected right-hand side, to the
    same tolerance.  The derivative of a loosely solved system is that of nothing: see `gradient_tolerance`.

    Args:
        operator: ``u -> K u``, a pytree; it may hold differentiated values.
        diagonal: node blocks of K, for the block-Jacobi preconditioner.
        admissible: the displacements that are.
        force: f, ``[nodes, dim]``.
        tolerance: on the true residual, relative to ``|Tᵀf|``.
        max_iterations: bound on all iterations together.

    Returns:
        The displacement u, with the iterations it took and its true relative residual.
    """
    system = (operator, jax.lax.stop_gradient(diagonal), admissible, force)
    given = system, tolerance, max_iterations
    # within `shard_map` JAX would cast constants of the linear solve a second time
    field, (iterations, residual) = _solve(*varying_like(given, given))
    return Solution(admissible.followed(field), iterations.astype(jnp.int32), residual)


def gradient_tolerance(dtype: Any) -> float:
    """Relative residual that derivatives need: 4e-10, or 7e-5 in float32."""
    return float(jnp.finfo(dtype).eps) ** 0.6


@jax.custom_jvp
def _solve(system, tolerance, max_iterations):
    """The independent field, and iterations and residual in its type: integers' tangents know no device."""
    matvec, right, solver = _equations(system, tolerance, max_iterations)
    field, (iterations, residual) = solver(matvec, right)
    return system[2].restrict(field), (iterations.astype(field.dtype), residual)


@_solve.defjvp
def _solve_jvp(primals, tangents):
    """With A w = b:  A dw = db − dA w."""
    system, tolerance, max_iterations = primals
    field, counts = _solve(system, tolerance, max_iterations)
    # saved under this name, a rematerialised step need not solve again
    field = checkpoint_name(field, "displacement")

    def residual(system):
        matvec, right, _ = _equations(system, tolerance, max_iterations)
        return right - matvec(field)

    _, change = jax.jvp(residual, (system,), tangents[:1])
    matvec, _, solver = _equations(system, tolerance, max_iterations)
    slope, _ = jax.lax.custom_linear_solve(matvec, change, solver, symmetric=True, has_aux=True)
    return (field, counts), (slope, jax.tree.map(jnp.zeros_like, counts))


def _equations(system, tolerance, max_iterations):
    """The operator TᵀK T + (I − P), the right-hand side Tᵀf, and a solver for them."""
    operator, diagonal, admissible, force = system
    inverse = jax.lax.stop_gradient(block_inverse(diagonal, admissible))

    def within(w: Field) -> Field:
        """The operator on the independent fields, which the iteration does not leave."""
        return admissible.collect(operator(admissible.followed(w)))

    def matvec(w: Field) -> Field:
        return within(admissible.restrict(w)) + admissible.rest(w)

    def precondition(r: Field) -> Field:
        return admissible.restrict(apply_blocks(inverse, r))

    def solver(_, b):
        inside = admissible.restrict(b)
        found = conjugate_gradients(within, inside, precondition, tolerance, max_iterations)
        # outside, where a tangent or cotangent has a part, A is the identity
        return found.field + (b - inside), (found.iterations, found.residual)

    return matvec, admissible.collect(force), solver
