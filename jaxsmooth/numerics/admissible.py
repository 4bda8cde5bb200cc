"""Displacement fields that are admissible: free directions of every node, and nodes that follow others.

An admissible field is ``u = T w`` with an independent field ``w`` of the same shape: at free nodes
``u = P w`` with a projector P, at dependent nodes a combination of what their parents do.  A quadratic
energy in u is minimised by ``TᵀK T w = Tᵀf``; ``T`` is `Admissible.expand`, ``Tᵀ`` is `Admissible.collect`.
"""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

__all__ = ["Admissible", "Links"]

Field = Float[Array, "nodes dim"]


class Links(eqx.Module):
    """Nodes that follow others: ``u_dependent = R Σ weight · u_parent``.

    Attributes:
        dependent: node numbers ``[links]``, each once; none of them is a parent.
        parents: node numbers ``[links, p]``.
        weights: of the parents ``[links, p]``; 0 where there are fewer.
        rotations: R, ``[links, dim, dim]``.
    """

    dependent: Int[Array, " links"]
    parents: Int[Array, "links p"]
    weights: Float[Array, "links p"]
    rotations: Float[Array, "links dim dim"]

    @property
    def rigid(self) -> Float[Array, " links"]:
        """1 where a node does all that its only parent does, so that either could lead; else 0."""
        return (self.weights[:, 0] == 1).astype(self.weights.dtype)

    def follow(self, field: Field) -> Float[Array, "links dim"]:
        """What the dependent nodes do if the parents do `field`."""
        led = (self.weights[..., None] * field[self.parents]).sum(axis=1)
        return (self.rotations * led[:, None, :]).sum(axis=-1)

    def carried(self, old: Field, new: Field) -> Field:
        """`new` points with the dependent nodes where their parents lead them from the `old` ones.

        Nodes of one place stay in one place to the last bit, and so do nodes whose parents stay.
        """
        offset = old[self.dependent] - self.follow(old)
        moved = (new[self.parents] != old[self.parents]).any(axis=(1, 2))
        placed = jnp.where(moved[:, None], self.follow(new) + offset, old[self.dependent])
        return new.at[self.dependent].set(placed)

    def common(self, projectors: Float[Array, "nodes dim dim"]) -> Float[Array, "nodes dim dim"]:
        """At parents the mean of their own projectors and those of their dependents, turned back.

        What it maps onto itself, all of them do.
        """
        turned = jnp.swapaxes(self.rotations, -1, -2) @ projectors[self.dependent] @ self.rotations
        leads = (self.weights != 0).astype(projectors.dtype)
        total = projectors.at[self.parents].add(leads[..., None, None] * turned[:, None])
        count = jnp.ones(len(projectors), projectors.dtype).at[self.parents].add(leads)
        return total / count[:, None, None]


class Admissible(eqx.Module):
    """The admissible displacements of a mesh at its present points.

    Attributes:
        projectors: symmetric, onto the free directions of every node; 0 for dependent ones.
        links: dependent nodes, or None.
    """

    projectors: Float[Array, "nodes dim dim"]
    links: Links | None = None

    @property
    def freedom(self) -> np.ndarray:
        """Free directions of every node ``[nodes]``: 0 held, 1 on a line, 2 in a plane, 3 free.

        Nodes that follow others have as many as the freest of these.
        """
        free = np.rint(np.trace(np.asarray(self.projectors), axis1=-2, axis2=-1)).astype(int)
        if self.links is not None:
            free[np.asarray(self.links.dependent)] = free[np.asarray(self.links.parents)].max(axis=1)
        return free

    def restrict(self, field: Field) -> Field:
        """``P w``: the part of an independent field that counts."""
        return (self.projectors * field[:, None, :]).sum(axis=-1)

    def rest(self, field: Field) -> Field:
        """``w − P w``."""
        return field - self.restrict(field)

    def expand(self, field: Field) -> Field:
        """``T w``: the admissible displacement of an independent field."""
        return self.followed(self.restrict(field))

    def followed(self, field: Field) -> Field:
        """``T w`` of a field ``w = P w``."""
        if self.links is None:
            return field
        return field.at[self.links.dependent].set(self.links.follow(field))

    def collect(self, forces: Field) -> Field:
        """``Tᵀ f``: forces on dependent nodes act on their parents."""
        if self.links is not None:
            forces = _added(self.links, forces, self.links.weights)
        return self.restrict(forces)

    def independent(self, field: Field) -> Field:
        """The independent field that comes closest to a displacement; of nodes that are equals, the mean."""
        if self.links is None:
            return self.restrict(field)
        links = self.links
        rigid = links.rigid[:, None] * links.weights
        count = jnp.ones(len(field), field.dtype).at[links.parents].add(rigid)
        return self.restrict(_added(links, field, rigid) / count[:, None])

    def project(self, field: Field) -> Field:
        """An admissible displacement near any displacement: the nearest, but where nodes hang on others."""
        return self.expand(self.independent(field))

    def collect_blocks(self, blocks: Float[Array, "nodes dim dim"]) -> Float[Array, "nodes dim dim"]:
        """``Tᵀ D T`` of node blocks, without what couples two parents."""
        if self.links is None:
            return blocks
        links = self.links
        turned = jnp.swapaxes(links.rotations, -1, -2) @ blocks[links.dependent] @ links.rotations
        return blocks.at[links.parents].add(links.weights[..., None, None] ** 2 * turned[:, None])

    def least(self, values: Array) -> Array:
        """For every node the least value ``[nodes]`` of those that it leads or follows."""
        if self.links is None:
            return values
        links = self.links
        values = values.at[links.parents].min(values[links.dependent][:, None])
        return values.at[links.dependent].set(values[links.parents].min(axis=1))

    def least_of_equals(self, values: Array) -> Array:
        """The same among nodes that do all that the other does; those that hang get their parents' least."""
        if self.links is None:
            return values
        links = self.links
        equal = links.rigid[:, None] > 0
        values = values.at[links.parents].min(
            jnp.where(equal, values[links.dependent][:, None], values[links.parents])
        )
        return values.at[links.dependent].set(values[links.parents].min(axis=1))

    def together(self, mask: Array) -> Array:
        """Nodes of a mask ``[nodes]``, and those that they lead or follow."""
        return ~self.least(~mask)

    def led(self, mask: Array) -> Array:
        """A mask ``[nodes]`` in which nodes that follow others are if a parent is, and only then."""
        if self.links is None:
            return mask
        return mask.at[self.links.dependent].set(mask[self.links.parents].any(axis=1))


def _added(links: Links, field: Field, weights: Float[Array, "links p"]) -> Field:
    back = (field[links.dependent][:, :, None] * links.rotations).sum(axis=1)
    return field.at[links.parents].add(weights[..., None] * back[:, None])
