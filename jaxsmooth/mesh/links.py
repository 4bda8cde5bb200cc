"""Nodes that belong together: what a mesh says about them, on the host."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Float, Int

__all__ = ["NodeLinks"]


class NodeLinks(eqx.Module):
    """Nodes whose displacements depend on those of others: ``u_node = R Σ weight · u_parent``.

    As they are found: a node may have several links, and may be a parent in others.  Periodic nodes and
    nodes of one place have one parent of weight 1; a node that hangs on an edge or a face has the nodes of
    that as parents, weighted by their shape functions.

    Attributes:
        nodes: node numbers ``[links]``.
        parents: node numbers ``[links, p]``; where there are fewer than p, the first again.
        weights: of the parents ``[links, p]``; 0 where there are fewer.
        rotations: orthogonal, ``[links, dim, dim]``; the identity but for rotational periodicity.
    """

    nodes: Int[np.ndarray, " links"]
    parents: Int[np.ndarray, "links p"]
    weights: Float[np.ndarray, "links p"]
    rotations: Float[np.ndarray, "links dim dim"]

    @classmethod
    def pairs(cls, pairs: Any, rotation: Any) -> NodeLinks:
        """The first node of every pair ``[m, 2]`` does what the second does, turned by R ``[dim, dim]``."""
        pairs = np.asarray(pairs).astype(np.int64).reshape(-1, 2)
        turned = np.tile(np.asarray(rotation, np.float64), (len(pairs), 1, 1))
        return cls(pairs[:, 0], pairs[:, 1:], np.ones((len(pairs), 1)), turned)

    @classmethod
    def hanging(cls, nodes: np.ndarray, parents: np.ndarray, weights: np.ndarray, dim: int) -> NodeLinks:
        """Nodes ``[m]`` at weighted means of their parents ``[m, p]``."""
        return cls(nodes, parents, weights, np.tile(np.eye(dim), (len(nodes), 1, 1)))

    @classmethod
    def join(cls, parts: Sequence[NodeLinks]) -> NodeLinks | None:
        """All links of several records, or None if there are none."""
        parts = [part for part in parts if len(part.nodes)]
        if not parts:
            return None
        width = max(part.parents.shape[1] for part in parts)
        missing = [((0, 0), (0, width - part.parents.shape[1])) for part in parts]
        parents = [  # the first again
            np.concatenate([part.parents, np.repeat(part.parents[:, :1], more[1][1], axis=1)], axis=1)
            for part, more in zip(parts, missing, strict=True)
        ]
        return cls(
            np.concatenate([part.nodes for part in parts]),
            np.concatenate(parents),
            np.concatenate([np.pad(p.weights, more) for p, more in zip(parts, missing, strict=True)]),
            np.concatenate([part.rotations for part in parts]),
        )

    @property
    def rigid(self) -> np.ndarray:
        """True where a node does all that its only parent does ``[links]``."""
        return (self.weights[:, 0] == 1) & (self.weights[:, 1:] == 0).all(axis=1)

    def select(self, chosen: np.ndarray) -> NodeLinks:
        """The links of a mask or of indices."""
        return NodeLinks(
            self.nodes[chosen], self.parents[chosen], self.weights[chosen], self.rotations[chosen]
        )

    def members(self, count: int) -> np.ndarray:
        """Mask ``[nodes]`` of all nodes that have a part in a link, of a mesh of `count` nodes."""
        mask = np.zeros(count, bool)
        mask[self.nodes] = mask[self.parents] = True
        return mask
