"""Linear elasticity on elements, and its matrix-free operator on the whole mesh.

``K u`` is never assembled: gather, strain, stress, force, scatter-add.  An element stores the
physical gradients of its shape functions ``[q, k, dim]``, which is less than a third of its
stiffness matrix and less to read in every iteration of the solver.
"""

from __future__ import annotations

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxsmooth.elements import ElementType
from jaxsmooth.mesh import gather, scatter_add
from jaxsmooth.small import cofactors, contract, determinant

__all__ = ["ElementBlock", "Material", "Operator", "element_force", "linearise", "node_blocks", "stiffness"]

_CPU_CHUNK = 4096  # elements whose intermediates stay in the second-level cache
_FLAT = 1e-4  # determinant, relative to the target's, below which an element counts as flat


class Material(eqx.Module):
    """Young's modulus and Poisson's ratio (plane strain in 2D); the paper takes 1 and 0."""

    young: Float[Array, ""] | float = 1.0
    poisson: Float[Array, ""] | float = 0.0

    @property
    def lame(self) -> tuple[Array, Array]:
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


class ElementBlock(eqx.Module):
    """The linearised elements of one block, cut into chunks: leading axes ``[chunks, size]``.

    On CPU a loop over chunks keeps gather, product and scatter-add in cache, several times
    faster than one pass over all elements; elsewhere there is one chunk.
    """

    nodes: Int[Array, "chunks size k"]
    elements: Linearised

    @classmethod
    def cut(cls, nodes: Int[Array, "elements k"], elements: Linearised) -> ElementBlock:
        """Cut a block; the last chunk is filled up with ghost elements of zero volume."""
        count = len(nodes)
        size = min(count, _CPU_CHUNK) if jax.default_backend() == "cpu" else count
        chunks = -(-count // max(size, 1))

        def fold(array: Array) -> Array:
            padding = [(0, chunks * size - count)] + [(0, 0)] * (array.ndim - 1)
            return jnp.pad(array, padding).reshape(chunks, size, *array.shape[1:])

        return cls(fold(nodes), jax.tree.map(fold, elements))


class Operator(eqx.Module):
    """The stiffness of a whole mesh, as a function of a displacement field ``[nodes, dim]``."""

    blocks: tuple[ElementBlock, ...]
    material: Material

    def __call__(self, field: Float[Array, "nodes dim"]) -> Float[Array, "nodes dim"]:
        """``K u``."""
        force = jax.vmap(element_force, in_axes=(0, 0, None))

        def add(total, chunk):
            nodes, elements = chunk
            part = force(Linearised(*elements), gather(field, nodes), self.material)
            return total.at[nodes].add(part, mode="promise_in_bounds"), None

        total = jnp.zeros_like(field)
        for block in self.blocks:
            total, _ = jax.lax.scan(add, total, (block.nodes, tuple(block.elements)))
        return total

    def diagonal(self, count: int) -> Float[Array, "nodes dim dim"]:
        """Diagonal blocks of K at each of `count` nodes."""
        blocks = jax.vmap(jax.vmap(node_blocks, in_axes=(0, None)), in_axes=(0, None))
        return sum(
            scatter_add(blocks(block.elements, self.material), block.nodes, count) for block in self.blocks
        )
