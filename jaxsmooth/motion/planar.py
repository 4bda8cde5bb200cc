"""Sliding within flat faces and along straight edges: one projector ``[dim, dim]`` a node.

A facet keeps its shape if its nodes move within its plane.  A node may therefore move in the
null space of the normals of all facets around it that have to be kept: in a plane, along a
straight edge, or not at all.  That rule needs no search for planes and edges and does not
depend on numbering.
"""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxsmooth.mesh.record import Mesh
from jaxsmooth.motion.base import Motion
from jaxsmooth.numerics.admissible import Admissible

__all__ = ["Constraints", "node_mask"]


class Constraints(Motion):
    """Nodes that go straight along constant directions.

    Attributes:
        projectors: orthogonal, onto the free directions of every node ``[nodes, dim, dim]``.
    """

    projectors: Float[Array, "*batch nodes dim dim"]

    @property
    def freedom(self) -> np.ndarray:
        """Free directions of every node ``[nodes]``: 0 held, 1 on a line, 2 in a plane, 3 free."""
        return Admissible(self.projectors).freedom

    @classmethod
    def hold(cls, mesh: Mesh, nodes: Any) -> Constraints:
        """Hold the nodes of a mask ``[nodes]`` or an index array, leave all others free."""
        projectors = np.tile(np.eye(mesh.dim), (len(mesh.points), 1, 1))
        projectors[node_mask(nodes, len(mesh.points))] = 0
        return cls(jnp.asarray(projectors, mesh.points.dtype))

    def at(self, points: Float[Array, "nodes dim"]) -> Admissible:
        """The same everywhere."""
        return Admissible(self.projectors)


def node_mask(nodes: Any, count: int) -> np.ndarray:
    mask = np.zeros(count, dtype=bool)
    if nodes is None:
        return mask
    nodes = np.asarray(nodes)
    if nodes.dtype == bool and nodes.shape != (count,):
        raise ValueError(f"the mask of fixed nodes has shape {list(nodes.shape)}; the mesh has {count} nodes")
    if nodes.dtype != bool and nodes.size and not (nodes.min() >= 0 and nodes.max() < count):
        raise ValueError(f"a fixed node is out of range; the mesh has {count} nodes")
    mask[nodes if nodes.dtype == bool else nodes.astype(int)] = True
    return mask
