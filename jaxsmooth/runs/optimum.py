"""The optimum of one energy, and how it depends on everything."""

from __future__ import annotations

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxsmooth.convert.meshfile import as_mesh
from jaxsmooth.mesh.record import Mesh
from jaxsmooth.methods.optimize.energy import Energy
from jaxsmooth.methods.optimize.minimise import Newton
from jaxsmooth.motion.base import Motion
from jaxsmooth.numerics.admissible import Admissible
from jaxsmooth.numerics.implicit import attach_root, undefined_unless
from jaxsmooth.numerics.small import Frame, in_precision
from jaxsmooth.numerics.solve import apply_blocks, conjugate_gradients, gradient_tolerance
from jaxsmooth.numerics.varying import varying_like

__all__ = ["Optimum", "optimum"]

Field = Float[Array, "nodes dim"]
Scalar = Float[Array, ""]

_SUFFICIENT = 1e-4  # part of the predicted decrease that a step has to bring (Armijo)
_HALVINGS = 30
_FORCING = 0.1  # relative residual of the first linear systems


class Optimum(eqx.Module):
    """The mesh of least energy.

    Attributes:
        mesh: the optimised mesh.
        energy: its energy.
        residual: largest displacement that is left, by the preconditioned gradient, over the domain's size.
        steps: Newton steps with the exact Hessian.
        converged: whether the residual is within the tolerance; if not, the derivative is that of nothing.
    """

    mesh: Mesh
    energy: Scalar
    residual: Scalar
    steps: Int[Array, ""]
    converged: Bool[Array, ""]

    @property
    def points(self) -> Field:
        """The points of the optimised mesh."""
        return self.mesh.points


def optimum(
    mesh: Any,
    energy: Energy | None = None,
    *,
    motion: Motion,
    tolerance: float | None = None,
    max_steps: Int[Array, ""] | int = 50,
    max_iterations: int = 1000,
) -> Optimum:
    """Minimise an energy within a motion, to a tight residual, with an implicit derivative.

    With z the points that are given and u the free displacements, ``∂E(z + T u)/∂u = 0``.  Derivatives, of
    every order, solve with the exact Hessian, by conjugate gradients; targets and aggregation are
    parameters too, and where the free nodes started does not matter, unless a target is measured there.

    Args:
        mesh: the start, as for `run`; a valid mesh.
        energy: `Energy()` by default.
        motion: how nodes may move.
        tolerance: on the residual; `gradient_tolerance` by default.
        max_steps: bound on the steps with the exact Hessian.
        max_iterations: bound on the iterations of a linear solver.  A derivative that is not found is NaN.

    Returns:
        The optimum, and whether it was found.
    """
    mesh = as_mesh(mesh)
    chosen = Energy() if energy is None else energy
    energy, motion = in_precision((chosen, motion), mesh.points.dtype)
    tolerance = gradient_tolerance(mesh.points.dtype) if tolerance is None else tolerance
    frame = Frame.of(mesh.points)
    points, within = frame.into(mesh.points), motion.within(frame)
    # within `shard_map` JAX would cast constants of the linear solve a second time
    mesh, frame = varying_like((mesh, frame), points)
    here = _Search(mesh, frame, tolerance, max_iterations)
    parameters: tuple[Energy, Field, Motion] = varying_like((energy, points, within), points)
    end = here.search(*jax.lax.stop_gradient(parameters), max_steps)
    solve = here.solver(end.u, *jax.lax.stop_gradient(parameters))
    u = attach_root(here.residual, end.u, parameters, solve)
    # the frame is a power of two and an origin: what does not move keeps its bits
    move = (_place(u, points, within) - points) / frame.scale
    done = mesh.with_points(motion.retract(mesh.points, move))
    return Optimum(done, energy(done, motion), end.size, end.steps, end.size <= tolerance)


def _place(u: Field, points: Field, motion: Motion) -> Field:
    return motion.retract(points, motion.at(points).expand(u))


class _State(NamedTuple):
    """Of the search: displacement, energy, gradient, the largest displacement left, steps, standstill."""

    u: Field
    value: Scalar
    gradient: Field
    size: Scalar
    steps: Int[Array, ""]
    stuck: Bool[Array, ""]


class _Search(NamedTuple):
    """Functions of displacements u, all in the frame; what is differentiated are their other arguments."""

    mesh: Mesh
    frame: Frame
    tolerance: float
    max_iterations: int

    def slope(self, u: Field, energy: Energy, points: Field, motion: Motion) -> Field:
        """∂E/∂u, written out: its linearisation is the exact Hessian."""
        task = energy.problem(self.mesh.with_points(points), motion, self.frame)
        there, pull = jax.vjp(lambda u: _place(u, points, motion), u)
        return pull(task.value_and_grad(there, energy.regularisation)[1])[0]

    def residual(self, u: Field, energy: Energy, points: Field, motion: Motion) -> Field:
        """∂E/∂u, and u where it does not count."""
        return self.slope(u, energy, points, motion) + motion.at(points).rest(u)

    def precondition(self, u: Field, energy: Energy, points: Field, motion: Motion):
        """Inverse node blocks of the Hessian model within the constraints."""
        task = energy.problem(self.mesh.with_points(points), motion, self.frame)
        admissible: Admissible = motion.at(points)
        inverse = energy.blocks(task, _place(u, points, motion), admissible)

        def apply(r: Field) -> Field:
            return admissible.restrict(apply_blocks(inverse, admissible.restrict(r))) + admissible.rest(r)

        return apply

    def solver(self, u: Field, energy: Energy, points: Field, motion: Motion):
        """For linear systems with the Hessian at u."""
        apply = self.precondition(u, energy, points, motion)
        tolerance = gradient_tolerance(u.dtype)

        def solver(matvec, right):
            found = conjugate_gradients(matvec, right, apply, tolerance, self.max_iterations)
            return undefined_unless(found.residual, tolerance, found.field)

        return lambda matvec, right: jax.lax.custom_linear_solve(matvec, right, solver, symmetric=True)

    def search(self, energy: Energy, points: Field, motion: Motion, max_steps) -> _State:
        """The minimum: first with the positive model, then with the exact Hessian."""
        fixed = (energy, points, motion)
        task = energy.problem(self.mesh.with_points(points), motion, self.frame)

        def value(u):
            return energy.value(task, _place(u, points, motion))

        def measured(u, energy_there, count, stuck):
            gradient = self.slope(u, *fixed)
            size = jnp.abs(self.precondition(u, *fixed)(gradient)).max()
            return _State(u, energy_there, gradient, size, count, stuck)

        def unfinished(state):
            return (state.size > self.tolerance) & (state.steps < max_steps) & ~state.stuck

        def again(state):
            move = self._direction(state, fixed)
            slope = jnp.vdot(state.gradient, move)
            noise = 8 * jnp.finfo(points.dtype).eps * jnp.abs(state.value)

            def rejected(trial):
                length, after, halvings = trial
                return ~(after <= state.value + _SUFFICIENT * length * slope + noise) & (halvings < _HALVINGS)

            def halve(trial):
                length, _, halvings = trial
                return length / 2, value(state.u + length / 2 * move), halvings + 1

            start = (jnp.full((), 2.0, points.dtype), jnp.full((), jnp.inf, points.dtype), jnp.int32(-1))
            start = varying_like(start, points)
            length, after, halvings = jax.lax.while_loop(rejected, halve, start)
            stuck = halvings >= _HALVINGS
            u, after = (
                jnp.where(stuck, state.u, state.u + length * move),
                jnp.where(stuck, state.value, after),
            )
            return measured(u, after, state.steps + 1, stuck)

        begun = Newton(iterations=30, tolerance=1e-6)(task, points).points
        u = motion.at(points).independent(begun - points)
        start = varying_like(measured(u, value(u), jnp.int32(0), jnp.bool_(False)), points)
        return jax.lax.while_loop(unfinished, again, start)

    def _direction(self, state: _State, fixed: tuple[Energy, Field, Motion]) -> Field:
        """A descent direction: Newton's, or, where that leads up, the preconditioned gradient's."""
        apply = self.precondition(state.u, *fixed)
        _, hessian = jax.linearize(lambda u: self.residual(u, *fixed), state.u)
        forcing = jnp.minimum(_FORCING, state.size)
        found = conjugate_gradients(hessian, -state.gradient, apply, forcing, self.max_iterations).field
        descends = jnp.vdot(state.gradient, found) < 0
        return jnp.where(descends, found, -apply(state.gradient))
