"""Whole runs as pure functions: differentiable, jittable, and ready for `jax.vmap`.

`smooth` decides on the host when to stop and what to report; here nothing is decided.
"""

from __future__ import annotations

import math
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.core import Tracer
from jaxtyping import Array, Bool, Float, Int

from jaxsmooth.convert.meshfile import as_mesh
from jaxsmooth.mesh.record import Mesh
from jaxsmooth.methods import Elastic, Method
from jaxsmooth.metrics.evaluation import Evaluation, evaluate
from jaxsmooth.motion.base import Motion
from jaxsmooth.numerics.implicit import attach_root, conjugate_residuals
from jaxsmooth.numerics.small import in_precision
from jaxsmooth.numerics.solve import gradient_tolerance
from jaxsmooth.numerics.varying import varying_like

__all__ = ["FixedPoint", "Run", "fixed_point", "if_valid", "method_state", "run", "step"]

Field = Float[Array, "nodes dim"]
_UNNESTED = 16  # steps whose points alone are kept; more are nested, for memory ~ √steps


def step(mesh: Any, method: Method, constraints: Motion, state: Any = None) -> Mesh:
    """One step of a method, ``mesh -> mesh``: the differentiable atom of all runs.

    Derivatives go through quality, fit, forces and the solve; the fractions of the moves that
    the guard accepts are constants for them.  `state` is what `method.init` has made; it is made here
    where the connectivity is not traced.
    """
    mesh = as_mesh(mesh)
    state = method_state(method, mesh) if state is None else state
    return mesh.with_points(_step(mesh.bare, method, constraints, state))


@jax.jit
def _step(mesh: Mesh, method: Method, constraints: Motion, state: Any) -> Field:
    return method.step(mesh, constraints, _before(mesh), state).points


def _before(mesh: Mesh) -> Evaluation:
    return jax.lax.stop_gradient(evaluate(mesh))


def method_state(method: Method, mesh: Mesh) -> Any:
    """The state of the method, where the connectivity is known on the host."""
    traced = any(isinstance(nodes, Tracer) for nodes in mesh.connectivity)
    return None if traced else method.init(mesh)


class Run(eqx.Module):
    """What `run` returns.

    Attributes:
        mesh: the smoothed mesh.
        evaluation: what its elements are worth.
        residuals: true relative residual of the linear solve of every step ``[steps]``.
        iterations: of the linear solver in every step ``[steps]``.
        shortened: nodes whose move the guard shortened, in every step ``[steps]``.
        least: the least bound of the Jacobian determinant, of the mesh scaled to about unit size: where it is
            positive the mesh is valid.
    """

    mesh: Mesh
    evaluation: Evaluation
    residuals: Float[Array, " steps"]
    iterations: Int[Array, " steps"]
    shortened: Int[Array, " steps"]
    least: Float[Array, ""]

    @property
    def points(self) -> Field:
        """The points of the smoothed mesh."""
        return self.mesh.points


def run(
    mesh: Any,
    method: Method | None = None,
    *,
    constraints: Motion,
    steps: int = 3,
    state: Any = None,
) -> Run:
    """A fixed number of steps.

    Reverse mode keeps, for every step, the points, the displacement and the guard's decision,
    and computes the rest again: memory hardly grows with the number of steps and not at all
    with the iterations of the solver.

    Args:
        mesh: a `Mesh`, whose points may be traced, batched, or both; or whatever else `as_mesh` takes.
        method: `Elastic()` by default, whose linear systems are solved as tightly as derivatives need.
        constraints: how nodes may move (found beforehand, from concrete points).
        steps: number of steps (static).
        state: what `method.init` has made, for methods that need it, where the connectivity is traced.

    Returns:
        The smoothed mesh, and what was done.
    """
    mesh = as_mesh(mesh)
    method = Elastic() if method is None else method
    state = method_state(method, mesh) if state is None else state
    done = _run(mesh.bare, method, constraints, state, steps)
    return eqx.tree_at(lambda run: run.mesh, done, mesh.with_points(done.points))


@partial(jax.jit, static_argnames="steps")
def _run(mesh: Mesh, method: Method, constraints: Motion, state: Any, steps: int) -> Run:
    """`run`, compiled once for all calls that differ in numbers only, also those outside of `jax.jit`."""
    saved = jax.checkpoint_policies.save_only_these_names("displacement", "accepted")
    dtype = mesh.points.dtype
    nothing = jnp.zeros((), dtype), jnp.int32(0), jnp.int32(0)

    def advance(points: Field, index: Int[Array, ""]) -> tuple[Field, Any]:
        def move(points: Field) -> tuple[Field, Any]:
            here = mesh.with_points(points)
            done = method.step(here, constraints, _before(here), state)
            counts = jnp.asarray(done.residual, dtype), done.iterations, done.shortened.astype(jnp.int32)
            return done.points, jax.lax.stop_gradient(counts)

        return jax.lax.cond(index < steps, move, lambda p: varying_like((p, nothing), p), points)

    inner = steps if steps <= _UNNESTED else math.ceil(math.sqrt(steps))
    outer = -(-steps // max(inner, 1))
    one = jax.checkpoint(advance, policy=saved)

    def several(points: Field, indices: Int[Array, " inner"]) -> tuple[Field, Any]:
        return jax.lax.scan(one, points, indices)

    if outer <= 1:
        points, counts = several(mesh.points, jnp.arange(steps))
    else:
        indices = jnp.arange(outer * inner).reshape(outer, inner)
        points, counts = jax.lax.scan(jax.checkpoint(several), mesh.points, indices)
        counts = jax.tree.map(lambda part: part.reshape(-1)[:steps], counts)
    mesh = mesh.with_points(points)
    evaluation = evaluate(mesh)
    least = jnp.stack([part.min() for part in evaluation.jacobian]).min()
    residuals, iterations, shortened = counts
    return Run(mesh, evaluation, residuals, iterations, shortened, least)


def if_valid(value: Float[Array, ""], mesh: Any) -> Float[Array, ""]:
    """A number where a mesh is valid, else ∞: what a line search has to see.

    A trial step of an optimiser may tangle the mesh, and an energy of it then falls without bound: return
    ``if_valid(objective, done)`` of what `run` has returned, and use a line search that takes ∞ for worse.
    Its derivative where it is ∞ means nothing.
    """
    if isinstance(mesh, Run):
        least = mesh.least
    else:
        least = jnp.stack([part.min() for part in _before(as_mesh(mesh)).jacobian]).min()
    return jnp.where(jax.lax.stop_gradient(least) > 0, value, jnp.inf)


class FixedPoint(eqx.Module):
    """A converged mesh.

    Attributes:
        mesh: the mesh that a further step leaves where it is.
        steps: steps taken.
        change: largest move of the last step, relative to the size of the domain.
        converged: whether that is within the tolerance; if not, the derivative is that of nothing.
    """

    mesh: Mesh
    steps: Int[Array, ""]
    change: Float[Array, ""]
    converged: Bool[Array, ""]

    @property
    def points(self) -> Field:
        """The points of the converged mesh."""
        return self.mesh.points


def fixed_point(
    mesh: Any,
    method: Method | None = None,
    *,
    constraints: Motion,
    tolerance: float | None = None,
    max_steps: int = 200,
    max_iterations: int = 500,
) -> FixedPoint:
    """Repeat unguarded steps until the mesh stays where it is, with an implicit derivative.

    With z the points that are held and u the free displacements, the mesh solves
    ``u = G(u, z) = P (step(z + P u) − z)``.  Its derivative is ``(I − G_u)⁻¹ G_z``, found by conjugate
    residuals with the linearised step: one solution for any number of steps, and no dependence on where the
    free nodes started.  Derivatives of every order are right.

    Args:
        mesh: the start, a mesh as for `run`; near enough to a valid mesh that no guard is needed.
        method: `Elastic()` by default; solved tightly throughout.
        constraints: how nodes may move.
        tolerance: on the largest move, relative to the size of the domain, and on the relative residual of
            the derivative; 1e-9 by default, 7e-5 in float32.
        max_steps: bound on steps.
        max_iterations: bound on the iterations of the derivative.  A derivative that is not found is NaN.

    Returns:
        The mesh, the number of steps, the last change, and whether it is within the tolerance.
    """
    mesh = as_mesh(mesh)
    chosen = Elastic() if method is None else method
    method, constraints = in_precision((chosen, constraints), mesh.points.dtype)
    tolerance = max(1e-9, gradient_tolerance(mesh.points.dtype)) if tolerance is None else tolerance
    state = method_state(method, mesh)
    bare = eqx.tree_at(lambda m: m.guard, method, None, is_leaf=lambda x: x is None)
    stopped = jax.lax.stop_gradient
    points = mesh.points
    extent = stopped(jnp.ptp(points, axis=0).max())

    def place(u: Field, points: Field, motion: Motion) -> Field:
        return motion.retract(points, motion.at(points).expand(u))

    def displaced(u: Field, method: Method, points: Field, motion: Motion) -> Field:
        after = step(mesh.with_points(place(u, points, motion)), method, motion, state).points
        return motion.at(points).independent(after - points)

    def search(u: Field):
        fixed = stopped((bare, points, constraints))

        def unfinished(state):
            _, change, count = state
            return (change > tolerance) & (count < max_steps)

        def again(state):
            u, _, count = state
            new = displaced(u, *fixed)
            return new, jnp.abs(new - u).max() / extent, count + 1

        start = varying_like((u, jnp.asarray(jnp.inf, u.dtype), jnp.int32(0)), points)
        return jax.lax.while_loop(unfinished, again, start)

    u, change, count = search(jnp.zeros_like(points))

    def solve(matvec, right):
        def solver(matvec, right):
            return conjugate_residuals(matvec, right, tolerance, max_iterations)

        return jax.lax.custom_linear_solve(matvec, right, solver, solver)

    u = attach_root(lambda u, *p: u - displaced(u, *p), u, (bare, points, constraints), solve)
    return FixedPoint(mesh.with_points(place(u, points, constraints)), count, change, change <= tolerance)
