"""The paper's method: one elastic problem for the whole mesh a step (Secs. 2.4–2.6)."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxsmooth.assembly import cut, each, local_nodes, mapped, scan, tangents
from jaxsmooth.guards.acceptance import AcceptanceRule
from jaxsmooth.guards.base import Guard
from jaxsmooth.guards.patch import PatchGuard
from jaxsmooth.mesh.record import Mesh
from jaxsmooth.methods.base import Method, Proposal
from jaxsmooth.methods.elastic.elasticity import Material, Operator, element_force, linearise
from jaxsmooth.methods.elastic.fitting import moments, placed
from jaxsmooth.metrics.evaluation import Evaluation
from jaxsmooth.metrics.table import shape_quality
from jaxsmooth.motion.base import Motion
from jaxsmooth.numerics.rotation import rotation
from jaxsmooth.numerics.small import Frame, least
from jaxsmooth.numerics.solve import gradient_tolerance, solve_projected
from jaxsmooth.targets import OwnSize, Target

__all__ = ["Elastic"]

_LOOSE, _FEW = 3e-2, 1000  # residual and iterations of a step that is looked at


class Elastic(Method):
    """Physics-based smoothing by fitted ideal elements.

    Attributes:
        extended: weigh the element forces by (1 − q) / (1 − q_min) (Eq. 35).
        alpha: reduction factor of the target elements (Eq. 36).
        beta: exponent of the quality in the weights of the extended method (Eqs. 1, 2).
        target: the size of the ideal elements, before alpha.
        material: Young's modulus and Poisson's ratio of the elements.
        guard: the patch guard (Eq. 34), or None for the full step.
        tolerance: relative residual of the linear system, of its solution and of its derivative.  By default
            `gradient_tolerance`; in `smooth`, which looks at every step, 0.03: a mesh does not profit from
            exact steps, derivatives do.
        max_iterations: bound on the iterations of the solver.
    """

    extended: bool = eqx.field(static=True, default=False)
    alpha: Float[Array, ""] | float = 1.0
    beta: Float[Array, ""] | float = 2.0
    target: Target = OwnSize()
    material: Material = Material()
    guard: Guard | None = PatchGuard()
    tolerance: Float[Array, ""] | float | None = None
    max_iterations: Int[Array, ""] | int = 10_000

    @property
    def acceptance(self) -> AcceptanceRule:
        """The extended method gives some of the average quality for the worst elements."""
        rule = super().acceptance
        return replace(rule, average=math.inf) if self.extended else rule

    def loosely(self) -> Elastic:
        """With loose linear systems, unless a tolerance has been chosen."""
        return self if self.tolerance is not None else replace(self, tolerance=_LOOSE, max_iterations=_FEW)

    def propose(self, mesh: Mesh, motion: Motion, before: Evaluation, state: Any = None) -> Proposal:
        """Solve K U = F (Eqs. 31–36) in the null space of the constraints."""
        frame = Frame.of(mesh.points)
        mesh, motion = mesh.with_points(frame.into(mesh.points)), motion.within(frame)
        count = len(mesh.points)
        sizes = self.target.measures(mesh, frame)
        frames = tangents(mesh)
        rotations = _rotations(mesh, frames)
        weights = self.priorities(mesh) if self.extended else tuple(jnp.ones_like(part) for part in sizes)
        force, blocks = jnp.zeros_like(mesh.points), []
        for (kind, nodes), own, *data in zip(mesh.blocks, frames, sizes, rotations, weights, strict=True):

            def pull(element, nodes, kind=kind):
                size, turn, weight = element
                scale = self.alpha * size ** (1 / kind.dim)
                target = placed(jnp.asarray(kind.ideal, nodes.dtype), nodes, scale, turn)
                linear = linearise(kind, nodes, size)
                return weight * element_force(linear, target - nodes, self.material), linear

            def add(total, chunk, pull=pull):
                forces, elements = jax.vmap(pull)(chunk.data, chunk.local)
                return chunk.add(total, forces), elements

            chunks = cut(nodes, tuple(data), mesh.execution, frames=own)
            force, elements = scan(add, force, chunks, mesh.points)
            blocks.append(chunks.holding(elements))
        operator = Operator(tuple(blocks), self.material)
        found = solve_projected(
            operator,
            operator.diagonal(count),
            motion.at(mesh.points),
            force,
            gradient_tolerance(force.dtype) if self.tolerance is None else self.tolerance,
            self.max_iterations,
        )
        return Proposal(found.field / frame.scale, found.iterations, found.residual)

    def priorities(self, mesh: Mesh) -> tuple[Float[Array, " _"], ...]:
        """(1 − q) / (1 − q_min) of Eq. 35; zero where all elements are ideal."""

        def quality(kind, nodes):
            return shape_quality(kind, nodes, self.beta)

        q = tuple(
            jax.vmap(partial(quality, kind))(local_nodes(mesh.points, nodes, frames))
            for (kind, nodes), frames in zip(mesh.blocks, tangents(mesh), strict=True)
        )
        gap = 1 - least(jnp.concatenate(q))
        perfect = gap <= 0
        return tuple(jnp.where(perfect, 0, (1 - part) / jnp.where(perfect, 1, gap)) for part in q)


def _rotations(
    mesh: Mesh, frames: tuple[Float[Array, "_ 2 3"] | None, ...]
) -> list[Float[Array, "_ dim dim"]]:
    """Of the fitted ideal elements (Eq. 14, corrected); all blocks together, for it is a large program."""
    found = []
    for (kind, nodes), own in zip(mesh.blocks, frames, strict=True):
        ideal = jnp.asarray(kind.ideal, mesh.points.dtype)
        function = partial(lambda ideal, _, local: moments(ideal, local), ideal)
        found.append(each(function, cut(nodes, None, mesh.execution, frames=own), mesh.points))
    turned = mapped(rotation, jnp.concatenate(found), mesh.execution)
    ends = np.cumsum([len(part) for part in found])[:-1]
    return jnp.split(turned, ends)
