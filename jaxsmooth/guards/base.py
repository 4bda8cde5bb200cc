"""The interface of a guard: how far the nodes may go along a proposed move."""

from __future__ import annotations

import abc
from typing import NamedTuple

import equinox as eqx
from jaxtyping import Array, Float, Int

from jaxsmooth.mesh.record import Mesh
from jaxsmooth.metrics.evaluation import Evaluation
from jaxsmooth.motion.base import Motion

__all__ = ["Guard", "Guarded"]

Field = Float[Array, "nodes dim"]


class Guarded(NamedTuple):
    """Attributes: new points; their evaluation; nodes whose move was shortened; sweeps taken."""

    points: Field
    evaluation: Evaluation
    shortened: Int[Array, ""]
    sweeps: Int[Array, ""]


class Guard(eqx.Module):
    """Accepts of a move what is fit.

    A guard of your own is a subclass with `__call__`.  It moves nodes by `motion.retract` only, lets nodes
    that are coupled (`Admissible.together`) go equally far, and takes no part of a move that is not finite.
    """

    @abc.abstractmethod
    def __call__(self, mesh: Mesh, motion: Motion, move: Field, before: Evaluation) -> Guarded:
        """Move the nodes of `mesh` by an admissible `move` ``[nodes, dim]``, as far as they may.

        `before` is the evaluation of `mesh`.  What is decided is a constant for differentiation.
        """
