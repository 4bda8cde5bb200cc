"""Minimisers behind one small interface: they take a `Problem` and points, and never throw.

`Newton` is made for the problem; the others hand it to a library, in coordinates within the
constraints that are scaled by the local size.
"""

from __future__ import annotations

import abc
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxsmooth.methods.optimize.distortion import regularisation
from jaxsmooth.methods.optimize.problem import Problem
from jaxsmooth.numerics.solve import apply_blocks, block_inverse, conjugate_gradients
from jaxsmooth.numerics.varying import varying_like

__all__ = ["Jaxopt", "Minimised", "Minimiser", "Newton", "Optax", "Optimistix"]

Field = Float[Array, "nodes dim"]
Scalar = Float[Array, ""]

_SUFFICIENT = 1e-4  # part of the predicted decrease that a step has to bring (Armijo)
_HALVINGS = 12


class Minimised(NamedTuple):
    """The best points found; the objective there; iterations taken."""

    points: Field
    value: Scalar
    iterations: Int[Array, ""]


class Taken(NamedTuple):
    """A step: the points after it, the objective before and after, the least determinant, and whether any
    length of it was good enough."""

    points: Field
    before: Scalar
    after: Scalar
    least: Scalar
    accepted: Bool[Array, ""]


class Minimiser(eqx.Module):
    """How an objective is reduced.  Valid meshes stay valid; the value never rises."""

    @abc.abstractmethod
    def __call__(self, problem: Problem, points: Field) -> Minimised:
        """Reduce the objective from `points`."""


class Newton(Minimiser):
    """Truncated Newton steps with a positive semi-definite Hessian model, by projected CG.

    Attributes:
        iterations: bound on the steps.
        tolerance: stop when a step lowers the objective by less than this part of it.
        cg_iterations: bound on the iterations of the linear solver in a step.
        cg_tolerance: relative residual of the linear system.
    """

    iterations: int = 5
    tolerance: float = 1e-5
    cg_iterations: int = 8
    cg_tolerance: float = 0.1

    def __call__(self, problem: Problem, points: Field) -> Minimised:
        """Reduce the objective from `points`."""

        def unfinished(state):
            *_, count, done = state
            return ~done & (count < self.iterations)

        def step(state):
            points, worst, _, count, _ = state
            taken = self.step(problem, points, regularisation(worst), worst)
            fall = taken.before - taken.after
            # while ε falls the values of two steps do not compare
            little = (fall <= self.tolerance * jnp.abs(taken.before)) & (taken.least > 0)
            return taken.points, taken.least, taken.after, count + 1, ~taken.accepted | little

        one = jnp.ones((), points.dtype)
        start = (points, problem.least(points), jnp.inf * one, jnp.int32(0), jnp.bool_(False))
        points, _, value, count, _ = jax.lax.while_loop(unfinished, step, varying_like(start, points))
        return Minimised(points, value, count)

    def step(self, problem: Problem, points: Field, eps: Scalar, worst: Scalar) -> Taken:
        """One step for the regularisation ε, from points whose least relative determinant is `worst`."""
        here = problem.motion.at(points)
        value, gradient, models, blocks = problem.quadratic(points, eps)
        gradient = here.collect(gradient)
        inverse = block_inverse(blocks, here)
        move = conjugate_gradients(
            lambda w: here.collect(problem.apply(models, here.followed(w))),
            -gradient,
            lambda r: here.restrict(apply_blocks(inverse, r)),
            self.cg_tolerance,
            self.cg_iterations,
        ).field
        slope = jnp.vdot(gradient, move)

        def place(length):  # projected again: what cancels in a sum of long moves leaves rounding
            return problem.motion.retract(points, here.expand(length * move))

        def rejected(trial):
            length, after, least, halvings = trial
            lower = after <= value + _SUFFICIENT * length * slope
            valid = (least > 0) | (worst <= 0)
            return ~(lower & valid) & (halvings < _HALVINGS)

        def halve(trial):
            length, _, _, halvings = trial
            length = length / 2
            return length, *problem.value(place(length), eps), halvings + 1

        one = jnp.ones((), points.dtype)
        first = varying_like((2.0 * one, jnp.inf * one, -one, jnp.int32(-1)), points)
        length, after, least, halvings = jax.lax.while_loop(rejected, halve, first)
        accepted = (halvings < _HALVINGS) & jnp.isfinite(after)
        return Taken(
            jnp.where(accepted, place(length), points),
            value,
            jnp.where(accepted, after, value),
            jnp.where(accepted, least, worst),
            accepted,
        )


# --- Libraries -----------------------------------------------------------------------------------


def _reduced(problem: Problem, points: Field):
    """The objective of y, with points + T (s y); s makes the Hessian's diagonal blocks about 1."""
    worst = problem.least(points)
    eps = regularisation(worst)
    here = problem.motion.at(points)
    inverse = block_inverse(problem.quadratic(points, eps).blocks, here)
    scale = jnp.sqrt(jnp.trace(inverse, axis1=-2, axis2=-1) / points.shape[-1])[:, None]

    def place(y):
        return problem.motion.retract(points, here.expand(scale * y))

    @jax.custom_vjp
    def function(y):
        value, least = problem.value(place(y), eps)
        return jnp.where((least > 0) | (worst <= 0), value, jnp.inf)

    def forward(y):
        there, pull = jax.vjp(place, y)
        return function(y), pull(problem.value_and_grad(there, eps)[1])[0]

    function.defvjp(forward, lambda gradient, cotangent: (cotangent * gradient,))
    return function, place


def _best(function, place, y: Field, count) -> Minimised:
    """What a library returns, if it is better than the start."""
    nothing = jnp.zeros_like(y)
    start, end = function(nothing), function(y)
    better = end < start  # so written, NaN is not
    points = place(jnp.where(better, y, nothing))
    return Minimised(points, jnp.where(better, end, start), jnp.asarray(count, jnp.int32))


class Optimistix(Minimiser):
    """L-BFGS of optimistix."""

    iterations: int = eqx.field(static=True, default=60)
    tolerance: float = 1e-4

    def __call__(self, problem: Problem, points: Field) -> Minimised:
        """Reduce the objective from `points`."""
        import optimistix as optx

        function, place = _reduced(problem, points)
        solution = optx.minimise(
            lambda y, _: function(y),
            optx.LBFGS(rtol=self.tolerance, atol=self.tolerance),
            jnp.zeros_like(points),
            options={"autodiff_mode": "bwd"},
            max_steps=self.iterations,
            throw=False,
        )
        return _best(function, place, solution.value, solution.stats["num_steps"])


class Jaxopt(Minimiser):
    """L-BFGS of jaxopt."""

    iterations: int = eqx.field(static=True, default=60)
    tolerance: float = 1e-6

    def __call__(self, problem: Problem, points: Field) -> Minimised:
        """Reduce the objective from `points`."""
        import jaxopt

        function, place = _reduced(problem, points)
        solver = jaxopt.LBFGS(
            function, maxiter=self.iterations, tol=self.tolerance, linesearch="backtracking"
        )
        result = solver.run(jnp.zeros_like(points))
        return _best(function, place, result.params, result.state.iter_num)


class Optax(Minimiser):
    """L-BFGS of optax, with its backtracking line search."""

    iterations: int = eqx.field(static=True, default=60)
    tolerance: float = 1e-6

    def __call__(self, problem: Problem, points: Field) -> Minimised:
        """Reduce the objective from `points`."""
        import optax

        function, place = _reduced(problem, points)
        solver = optax.lbfgs(linesearch=optax.scale_by_backtracking_linesearch(20, store_grad=True))
        both = optax.value_and_grad_from_state(function)

        def unfinished(carry):
            _, _, slope, count = carry
            return (count < self.iterations) & (slope > self.tolerance)

        def iterate(carry):
            y, state, _, count = carry
            value, gradient = both(y, state=state)
            updates, state = solver.update(gradient, state, y, value=value, grad=gradient, value_fn=function)
            return optax.apply_updates(y, updates), state, jnp.linalg.norm(gradient), count + 1

        y = jnp.zeros_like(points)
        start = (y, solver.init(y), jnp.full((), jnp.inf, points.dtype), jnp.int32(0))
        y, _, _, count = jax.lax.while_loop(unfinished, iterate, start)
        # optax calls y any tree
        return _best(function, place, y, count)  # pyright: ignore[reportArgumentType]
