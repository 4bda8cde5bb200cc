"""The interface of a smoothing method."""

from __future__ import annotations

import abc
from dataclasses import replace
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxsmooth.guards.acceptance import AcceptanceRule
from jaxsmooth.guards.base import Guard
from jaxsmooth.guards.patch import PatchGuard
from jaxsmooth.mesh.record import Mesh
from jaxsmooth.metrics.evaluation import Evaluation, evaluate
from jaxsmooth.motion.base import Motion
from jaxsmooth.numerics.small import in_precision

__all__ = ["Method", "Proposal", "Step"]


_NEXT_TO_NOTHING = 1e-9  # a floor that only inverted elements are below


class Proposal(NamedTuple):
    """A displacement ``[nodes, dim]`` and what it cost: solver iterations, relative residual."""

    move: Float[Array, "nodes dim"]
    iterations: Int[Array, ""]
    residual: Float[Array, ""]


class Step(NamedTuple):
    """One step: the new points ``[nodes, dim]``, their evaluation, and counts."""

    points: Float[Array, "nodes dim"]
    evaluation: Evaluation
    iterations: Int[Array, ""]
    residual: Float[Array, ""]
    shortened: Int[Array, ""]


class Method(eqx.Module):
    """How one step is made: a method proposes a displacement, its guard accepts what is fit.

    A new method is a subclass with `propose`; a line in the table of methods gives it a name.
    """

    guard: eqx.AbstractVar[Guard | None]

    def init(self, mesh: Mesh) -> Any:
        """What the steps need to know of the topology: a pytree that is passed along; by default None.

        Host-side work, done once before the first step.
        """
        return None

    def loosely(self) -> Method:
        """The method as `smooth` uses it, which looks at every step and needs no exact ones."""
        return self

    @property
    def acceptance(self) -> AcceptanceRule:
        """What a run with this method keeps of its input, unless the user says otherwise."""
        return AcceptanceRule() if self.guard is not None else AcceptanceRule.anything()

    def attempts(self, tangled: bool) -> tuple[Method, ...]:
        """The method, and with other guards: a run goes on with the next where one leads nowhere.

        The last is strict: it lets neither q_min nor the least scaled Jacobian of a mesh fall.  While
        elements are inverted, two looser ones come first; they look at inversion, and one of them at
        what turns worse than all there is.  Only numbers differ, so that all share their compiled step.
        """
        if not isinstance(self.guard, PatchGuard):
            return (self,)
        looser = self._looser(self.guard) if tangled else ()
        return (*looser, self, self._guarded(self.guard, keep=1.0))

    def _looser(self, guard: PatchGuard) -> tuple[Method, Method]:
        return (
            self._guarded(guard, gamma=0.0, poor=_NEXT_TO_NOTHING, corner=_NEXT_TO_NOTHING),
            self._guarded(guard, gamma=0.0, poor=0.0, corner=0.0),
        )

    def _guarded(self, guard: PatchGuard, **numbers: float) -> Method:
        return eqx.tree_at(lambda method: method.guard, self, replace(guard, **numbers))

    @abc.abstractmethod
    def propose(self, mesh: Mesh, motion: Motion, before: Evaluation, state: Any = None) -> Proposal:
        """An admissible displacement of all nodes.

        Args:
            mesh: the mesh.
            motion: what its nodes may do.
            before: the evaluation of the mesh.
            state: what `init` has made.
        """

    def step(self, mesh: Mesh, motion: Motion, before: Evaluation, state: Any = None) -> Step:
        """Propose and guard: pure, jittable and differentiable in points and parameters."""
        method, motion = in_precision((self, motion), mesh.points.dtype)
        proposal = method.propose(mesh, motion, before, state)
        if method.guard is None:
            points = motion.retract(mesh.points, proposal.move)
            after = evaluate(mesh.with_points(points))
            shortened = jnp.int32(0)
        else:
            points, after, shortened, _ = method.guard(mesh, motion, proposal.move, before)
        return Step(points, after, proposal.iterations, proposal.residual, shortened)
