"""Linear elasticity on elements, and its matrix-free operator on the whole mesh.

``K u`` is never assembled: gather, strain, stress, force, scatter-add.  An element stores the
physical gradients of its shape functions ``[q, k, dim]``, which is less than a third of its
stiffness matrix and less to read in every iteration of the solver.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsmooth.assembly import Chunks, sum_to_nodes
from jaxsmooth.cells.table import ElementType
from jaxsmooth.numerics.small import cofactors, contract, determinant

__all__ = ["Material", "Operator", "element_force", "linearise", "node_blocks", "stiffness"]

_FLAT = 1e-4  # determinant, relative to the target's, below which an element counts as flat


class Material(eqx.Module):
    """Young's modulus and Poisson's ratio (plane strain in 2D); the paper takes 1 and 0."""

    young: Float[Array, ""] | float = 1.0
    poisson: Float[Array, ""] | float = 0.0

    @property
    def lame(self) -> tuple[Array | float, Array | float]:
        """Lamé's constants (λ, μ)."""
        e, nu = self.young, self.poisson
        return e * nu / ((1 + nu) * (1 - 2 * nu)), e / (2 * (1 + nu))


class Linearised(NamedTuple):
    """One element: physical gradients ``[q, k, dim]`` and quadrature volumes ``[q]``."""

    gradients: Float[Array, "q k dim"]
    volumes: Float[Array, " q"]


def linearise(kind: ElementType, nodes: Float[Array, "k dim"], measure: Float[Array, ""]) -> Linearised:
    """Gradients and volumes of one element with the nodes ``[k, dim]``.

    Absolute Jacobian determinants keep K positive semi-definite where an element is inverted;
    they are bounded below by a fraction of `measure` (the target's), so that the stiffness of a
    flat element stays finite.
    """
    reference = jnp.asarray(kind.gradients, nodes.dtype)
    frames = contract(nodes, reference)
    det = determinant(frames)
    size = jnp.maximum(jnp.abs(det), _FLAT * measure)
    inverse = cofactors(frames) * (jnp.where(det < 0, -1, 1) / size)[:, None, None]
    gradients = (reference[:, :, None, :] * inverse[:, None, :, :]).sum(axis=-1)
    return Linearised(gradients, size * jnp.asarray(kind.weights, nodes.dtype))


def element_force(
    element: Linearised, displacement: Float[Array, "k dim"], material: Material
) -> Float[Array, "k dim"]:
    """``K_e u_e`` (Eq. 31): the nodal forces of one element under a displacement ``[k, dim]``."""
    lam, mu = material.lame
    gradients, volumes = element
    slope = (displacement[None, :, :, None] * gradients[:, :, None, :]).sum(axis=1)
    trace = jnp.trace(slope, axis1=-2, axis2=-1)[:, None, None]
    identity = jnp.eye(slope.shape[-1], dtype=slope.dtype)
    stress = lam * trace * identity + mu * (slope + jnp.swapaxes(slope, -1, -2))
    stress = stress * volumes[:, None, None]
    return (gradients[:, :, None, :] * stress[:, None]).sum(axis=(0, -1))


def stiffness(element: Linearised, material: Material) -> Float[Array, "n n"]:
    """The element stiffness matrix K_e, ``[k·dim, k·dim]``, node by node."""
    _, k, dim = element.gradients.shape
    units = jnp.eye(k * dim, dtype=element.gradients.dtype).reshape(-1, k, dim)
    return jax.vmap(lambda u: element_force(element, u, material).reshape(-1))(units).T


def node_blocks(element: Linearised, material: Material) -> Float[Array, "k dim dim"]:
    """Diagonal blocks of K_e, one ``[dim, dim]`` a node: what block-Jacobi needs."""
    lam, mu = material.lame
    gradients, volumes = element
    outer = gradients[..., :, None] * gradients[..., None, :]
    square = (gradients**2).sum(axis=-1)[..., None, None] * jnp.eye(gradients.shape[-1], dtype=outer.dtype)
    return (((lam + mu) * outer + mu * square) * volumes[:, None, None, None]).sum(axis=0)


class Operator(eqx.Module):
    """The stiffness of a whole mesh, as a function of a displacement field ``[nodes, dim]``."""

    blocks: tuple[Chunks, ...]
    material: Material

    def __call__(self, field: Float[Array, "nodes dim"]) -> Float[Array, "nodes dim"]:
        """``K u``."""
        total = jnp.zeros_like(field)
        for block in self.blocks:
            total = sum_to_nodes(partial(element_force, material=self.material), block, field, total)
        return total

    def diagonal(self, count: int) -> Float[Array, "nodes dim dim"]:
        """Diagonal blocks of K at each of `count` nodes."""
        first = self.blocks[0]
        dim = (first.data.gradients if first.frames is None else first.frames).shape[-1]
        total = jnp.zeros((count, dim, dim), self.blocks[0].data.gradients.dtype)
        for block in self.blocks:
            total = sum_to_nodes(lambda element, _: node_blocks(element, self.material), block, None, total)
        return total
