"""Meshes as functions of a design: boundaries that are given, and gradients that are smooth."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxsmooth.assembly import cut, local_nodes, scan, tangents
from jaxsmooth.convert.meshfile import as_mesh
from jaxsmooth.mesh.record import Mesh
from jaxsmooth.methods import Elastic, Method
from jaxsmooth.methods.elastic.elasticity import Material, Operator, linearise
from jaxsmooth.metrics.table import measure
from jaxsmooth.motion.base import Motion
from jaxsmooth.motion.planar import Constraints
from jaxsmooth.numerics.small import Frame, in_precision
from jaxsmooth.numerics.solve import gradient_tolerance, solve_projected
from jaxsmooth.runs.pure import Run, run

__all__ = ["Design", "design", "filter_gradient"]

Field = Float[Array, "nodes dim"]
_MOST = 10_000  # iterations of a solver


class Design(eqx.Module):
    """A smoothed mesh as a differentiable function of the places of some of its nodes; see `design`.

    Attributes:
        mesh: the mesh at first.
        motion: what the nodes may do; those that are given are held.
        nodes: those whose places are given ``[m]``.
        method: smooths.
        steps: their number (static).
    """

    mesh: Mesh
    motion: Motion
    nodes: Int[Array, " m"]
    method: Method
    steps: int = eqx.field(static=True)

    @property
    def places(self) -> Float[Array, "m dim"]:
        """Where the given nodes are at first."""
        return self.mesh.points[self.nodes]

    def __call__(self, places: Float[Array, "m dim"]) -> Run:
        """The mesh whose given nodes are at `places`: extended elastically from the first, then smoothed."""
        start = self.mesh.points
        move = jnp.zeros_like(start).at[self.nodes].set(places - self.places)
        points = start + _extension(self.mesh, self.motion, move)
        return run(self.mesh.with_points(points), self.method, constraints=self.motion, steps=self.steps)


def design(mesh: Any, nodes: Any, *, motion: Motion, method: Method | None = None, steps: int = 3) -> Design:
    """A function from the places of some nodes, boundary nodes as a rule, to the smoothed mesh.

    ``design(mesh, nodes, motion=constraints)(boundary(parameters))`` is a `Run` that is differentiable in
    the parameters.  The other nodes first follow by linear elasticity of the first mesh (a linear map), which
    keeps most meshes valid; then the method smooths.  Compile it as an argument of a function, or by
    `equinox.filter_jit`: it is a pytree that holds the mesh.

    Args:
        mesh: a `Mesh`, or whatever else `as_mesh` takes.
        nodes: a mask ``[nodes]`` or indices ``[m]``.
        motion: what the other nodes may do.
        method: by default `Elastic` without guard, which varies smoothly with the design (see `if_valid`).
        steps: number of steps.
    """
    mesh = as_mesh(mesh)
    nodes = np.asarray(nodes)
    nodes = np.flatnonzero(nodes) if nodes.dtype == bool else nodes
    method = Elastic(guard=None) if method is None else method
    motion = in_precision(motion, mesh.points.dtype) & Constraints.hold(mesh, nodes)
    return Design(mesh.bare, motion, jnp.asarray(nodes, jnp.int32), method, steps)


def _extension(mesh: Mesh, motion: Motion, move: Field) -> Field:
    """The displacement of least elastic energy that is `move` where nodes are held."""
    frame = Frame.of(mesh.points)
    mesh = mesh.with_points(frame.into(mesh.points))
    operator = _operator(mesh)
    admissible, tolerance = motion.within(frame).at(mesh.points), gradient_tolerance(move.dtype)
    diagonal = operator.diagonal(len(move))
    found = solve_projected(operator, diagonal, admissible, -operator(move), tolerance, _MOST)
    return move + found.field


class _Filter(eqx.Module):
    """``M + r² K``."""

    masses: Float[Array, "nodes 1"]
    square: Float[Array, ""]
    stiffness: Operator

    def __call__(self, field: Field) -> Field:
        return self.masses * field + self.square * self.stiffness(field)


def filter_gradient(mesh: Any, gradient: Any, *, motion: Motion, radius: Float[Array, ""] | float) -> Field:
    """A gradient with respect to points as a smooth displacement: ``(M + r² K) s = g`` within a motion.

    M are the measures of the nodes' share of the elements and K is the elastic stiffness, for Young's
    modulus 1: s is the gradient in another metric, so that −s descends, and it does not depend on how fine
    the mesh is.  For r = 0 it is the gradient over the measure.

    Args:
        mesh: a valid mesh.
        gradient: ``[nodes, dim]``.
        motion: what the nodes may do.
        radius: r, a length: what is shorter is smoothed away.
    """
    mesh = as_mesh(mesh)
    gradient = jnp.asarray(gradient, mesh.points.dtype)
    motion = in_precision(motion, gradient.dtype)
    frame = Frame.of(mesh.points)
    mesh = mesh.with_points(frame.into(mesh.points))
    masses = jnp.zeros((len(gradient), 1), gradient.dtype)
    for (kind, nodes), frames in zip(mesh.blocks, tangents(mesh), strict=True):
        local = local_nodes(mesh.points, nodes, frames)
        share = jax.vmap(lambda x, kind=kind: measure(kind, x))(local) / kind.k
        masses = masses.at[nodes].add(share[:, None, None])
    square = jnp.asarray((radius * frame.scale) ** 2, gradient.dtype)
    operator = _Filter(masses, square, _operator(mesh))
    blocks = masses[..., None] * jnp.eye(mesh.dim, dtype=gradient.dtype)
    blocks = blocks + square * operator.stiffness.diagonal(len(gradient))
    admissible = motion.within(frame).at(mesh.points)
    found = solve_projected(operator, blocks, admissible, gradient, gradient_tolerance(gradient.dtype), _MOST)
    return found.field * frame.scale**mesh.element_dim


def _operator(mesh: Mesh) -> Operator:
    """The stiffness of the elements as they are."""
    blocks = []
    for (kind, nodes), frames in zip(mesh.blocks, tangents(mesh), strict=True):

        def visit(carry, chunk, kind=kind):
            found = jax.vmap(lambda x: linearise(kind, x, jnp.abs(measure(kind, x))))(chunk.local)
            return carry, found

        chunks = cut(nodes, None, mesh.execution, frames=frames)
        _, elements = scan(visit, None, chunks, mesh.points)
        blocks.append(chunks.holding(elements))
    return Operator(tuple(blocks), Material())
