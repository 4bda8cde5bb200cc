"""What the optimisation minimises, as a function of a mesh."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxsmooth.convert.meshfile import as_mesh
from jaxsmooth.mesh.record import Mesh
from jaxsmooth.methods.optimize.distortion import check_metric, inverse_quality
from jaxsmooth.methods.optimize.problem import Aggregation, Problem, problem
from jaxsmooth.metrics.record import Metric
from jaxsmooth.metrics.shape import SHAPE_AND_CORNERS, min_jacobian
from jaxsmooth.metrics.table import as_metric
from jaxsmooth.motion.base import Motion
from jaxsmooth.motion.planar import Constraints
from jaxsmooth.numerics.admissible import Admissible
from jaxsmooth.numerics.small import Frame, in_precision
from jaxsmooth.numerics.solve import apply_blocks, block_inverse
from jaxsmooth.targets import FreeSize, OwnSize, Target

__all__ = ["Energy", "energy"]

Field = Float[Array, "nodes dim"]
Scalar = Float[Array, ""]


def _metric(value: Metric | str) -> Metric:
    metric = as_metric(value)
    check_metric(metric, ())
    return metric


class Energy(eqx.Module):
    """The mean of φ(e) over the elements, e the inverse quality: a barrier, ∞ unless a mesh is valid.

    Valid means that the Jacobian determinants are positive at nodes and quadrature points.  Differentiable in
    points, target and aggregation, to every order; where it is ∞ its derivative is finite and means nothing.

    Attributes:
        metric: as for `Optimize`.
        target: `FreeSize` or `GivenSize`; an `OwnSize` is that of the mesh itself.
        aggregation: φ; by default 1 − 1/e and a light hand on the worst elements.
        regularisation: ε > 0 makes it finite on inverted elements: with determinants d over the target's,
            ``(d + √(d² + ε²)) / 2`` stands for d.
    """

    metric: Metric = eqx.field(static=True, converter=_metric, default=SHAPE_AND_CORNERS)
    target: Target = FreeSize()
    aggregation: Aggregation = Aggregation(1.0, 0.1, 4.0)
    regularisation: Scalar | float = 0.0

    def __call__(self, mesh: Any, motion: Motion | None = None) -> Scalar:
        """The energy of a mesh; elements none of whose nodes a motion lets move do not count."""
        mesh, motion = _sound(mesh, motion)
        frame = Frame.of(mesh.points)
        mesh = mesh.with_points(frame.into(mesh.points))
        return self.value(self.problem(mesh, motion.within(frame), frame), mesh.points)

    def hessian_product(self, mesh: Any, field: Field, motion: Motion | None = None) -> Field:
        """The product of the Hessian with a displacement ``[nodes, dim]`` of all points."""
        mesh, motion = _sound(mesh, motion)
        slope = jax.grad(lambda points: self(mesh.with_points(points), motion))
        return jax.jvp(slope, (mesh.points,), (jnp.asarray(field, mesh.points.dtype),))[1]

    def preconditioner(self, mesh: Any, motion: Motion | None = None) -> Callable[[Field], Field]:
        """Inverse node blocks of a positive Hessian model within a motion, as a function of a gradient.

        Makes displacements of gradients, for conjugate gradients or as a metric of an optimiser; a pytree.
        """
        mesh, motion = _sound(mesh, motion)
        frame = Frame.of(mesh.points)
        mesh, motion = mesh.with_points(frame.into(mesh.points)), motion.within(frame)
        admissible = motion.at(mesh.points)
        inverse = self.blocks(self.problem(mesh, motion, frame), mesh.points, admissible)
        return jax.tree_util.Partial(_precondition, inverse / frame.scale**2, admissible)

    def problem(self, mesh: Mesh, motion: Motion, frame: Frame) -> Problem:
        """Of a mesh and a motion in a frame."""
        energy = in_precision(self, mesh.points.dtype)
        sizes = (energy.target if energy.target.sized else OwnSize()).measures(mesh, frame)
        if not energy.target.sized:  # they are only units, and must not be zero in a mesh that is all flat
            least = 1 / sum(map(len, mesh.connectivity))
            sizes = tuple(jax.lax.stop_gradient(jnp.where(size > 0, size, least)) for size in sizes)
        weight = energy.target.weight if energy.target.sized else 0.0
        return problem(mesh, motion, sizes, energy.aggregation, energy.metric, weight)

    def value(self, task: Problem, points: Field) -> Scalar:
        """The energy at points of the frame of a problem."""
        eps = jnp.asarray(self.regularisation, points.dtype)

        def add(total, kind, chunk):
            def element(nodes, size):
                fit = (min_jacobian(kind, nodes) > 0) | (eps > 0)
                ideal = jnp.asarray(kind.ideal, nodes.dtype) * size ** (1 / kind.dim)
                whole = jnp.where(fit, nodes, ideal)
                e, _ = inverse_quality(kind, task.metric, task.size_weight, whole, size, eps)
                return jnp.where(fit, task.aggregation(e), jnp.inf)

            weight = chunk.data.weight
            found = jax.vmap(jax.checkpoint(element))(chunk.local, chunk.data.size)
            return total + (weight * jnp.where(weight > 0, found, 0)).sum()

        return task.scan(add, jnp.zeros((), points.dtype), points)

    def blocks(self, task: Problem, points: Field, admissible: Admissible) -> Float[Array, "nodes dim dim"]:
        """Inverse node blocks of the Hessian model at points of the frame."""
        return block_inverse(task.quadratic(points, self.regularisation).blocks, admissible)


def _precondition(inverse: Float[Array, "nodes dim dim"], admissible: Admissible, gradient: Field) -> Field:
    return admissible.followed(admissible.restrict(apply_blocks(inverse, admissible.collect(gradient))))


def _sound(mesh: Any, motion: Motion | None) -> tuple[Mesh, Motion]:
    mesh = as_mesh(mesh)
    if motion is None:
        motion = Constraints.hold(mesh, np.zeros(0, int))
    return mesh, in_precision(motion, mesh.points.dtype)


def energy(
    mesh: Any,
    *,
    metric: Metric | str = SHAPE_AND_CORNERS,
    target: Target | None = None,
    aggregation: Aggregation | None = None,
    motion: Motion | None = None,
    regularisation: Scalar | float = 0.0,
) -> Scalar:
    """How far the elements of a mesh are from ideal ones: a barrier to add to any objective.

    Args:
        mesh: a `Mesh`, whose points may be traced, or whatever else `as_mesh` takes.
        metric: see `Energy`, also for the rest.
        target: `FreeSize()` by default.
        aggregation: φ.
        motion: what the nodes may do: elements that can't change do not count.  By default all count.
        regularisation: 0, for ∞ on meshes that are not valid, or ε.

    Returns:
        0 for ideal elements and the default φ but for a constant; ∞ unless the mesh is valid.
    """
    record = Energy(
        metric=metric,
        target=FreeSize() if target is None else target,
        aggregation=Energy.aggregation if aggregation is None else aggregation,
        regularisation=regularisation,
    )
    return record(mesh, motion)
