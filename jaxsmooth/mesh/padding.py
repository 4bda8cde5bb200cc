"""Meshes in sizes of a short list, so that what is compiled for one serves others of about its size."""

from __future__ import annotations

from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxsmooth.mesh.record import Mesh

__all__ = ["Padded", "padded"]

_LEAST = 32  # smaller meshes have the size of this one


class Padded(NamedTuple):
    """A mesh with ghosts: elements that are ideal, on nodes of their own, which nothing joins to the others.

    Attributes:
        mesh: with ghosts behind the nodes, and behind the elements of every block.
        nodes: number of nodes without ghosts.
        elements: number of elements without ghosts, of every block.
    """

    mesh: Mesh
    nodes: int
    elements: tuple[int, ...]

    @classmethod
    def as_it_is(cls, mesh: Mesh) -> Padded:
        """Without any."""
        return cls(mesh, len(mesh.points), tuple(map(len, mesh.connectivity)))

    def real(self, values: Any) -> Any:
        """A pytree of values ``[elements, …]`` in tuples with an entry a block, without those of ghosts."""
        return tuple(
            None if part is None else _first(part, count)
            for part, count in zip(values, self.elements, strict=True)
        )

    def real_points(self, points: Float[Array, "nodes dim"]) -> Float[Array, "real dim"]:
        """Points without those of ghosts."""
        return _first(points, self.nodes)


def _first(values: Array, count: int) -> Array:
    # by way of the host, for XLA would compile a slice of every length
    return values if len(values) == count else jnp.asarray(np.asarray(values)[:count])


def padded(mesh: Mesh) -> Padded:
    """The mesh in the next sizes of the list, with at most a quarter more nodes and elements; on the host."""
    mesh = mesh.bare
    own = Padded.as_it_is(mesh)
    kinds = [kind for kind, _ in mesh.blocks]
    total = _size(own.nodes + sum(kind.k for kind in kinds))
    points = np.asarray(mesh.points)
    low = points.min(axis=0)
    extent = (points.max(axis=0) - low).min()
    places = [np.zeros((total - own.nodes, mesh.dim))]
    connectivity, start = [], own.nodes
    for kind, nodes in zip(kinds, mesh.connectivity, strict=True):
        ideal = kind.ideal - kind.ideal.min(axis=0)
        places[0][start - own.nodes : start - own.nodes + kind.k, : kind.dim] = ideal / ideal.max()
        ghost = np.arange(start, start + kind.k, dtype=np.int32)
        fill = np.tile(ghost, (_size(len(nodes)) - len(nodes), 1))
        connectivity.append(jnp.asarray(np.concatenate([np.asarray(nodes), fill])))
        start += kind.k
    # within the mesh, at a corner of its box; a power of two keeps what is exact
    scale = 2.0 ** np.floor(np.log2(extent)) if extent > 0 and np.isfinite(extent) else 1.0
    ghosts = (low + scale * places[0]).astype(points.dtype)
    new = jnp.asarray(np.concatenate([points, ghosts]))
    whole = eqx.tree_at(lambda m: (m.points, m.connectivity), mesh, (new, tuple(connectivity)))
    if mesh.normals is not None:
        fills = [len(nodes) - count for nodes, count in zip(connectivity, own.elements, strict=True)]
        up = jnp.asarray([0, 0, 1], mesh.points.dtype)
        normals = [
            jnp.concatenate([part, jnp.tile(up, (fill, 1))])
            for part, fill in zip(mesh.normals, fills, strict=True)
        ]
        whole = eqx.tree_at(lambda m: m.normals, whole, tuple(normals))
    return Padded(whole, own.nodes, own.elements)


def _size(count: int) -> int:
    """The least of 4, 5, 6, 7 times a power of two that is not less."""
    unit = 2 ** max(int(np.ceil(np.log2(max(count, _LEAST)))) - 3, 0)
    return unit * -(-max(count, _LEAST) // unit)
