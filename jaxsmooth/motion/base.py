"""What the nodes of a mesh may do."""

from __future__ import annotations

import abc

import equinox as eqx
from jaxtyping import Array, Float

from jaxsmooth.numerics.admissible import Admissible
from jaxsmooth.numerics.small import Frame

__all__ = ["Both", "Motion"]

Field = Float[Array, "nodes dim"]


class Motion(eqx.Module):
    """Which displacements are admissible, and where they lead.

    A motion of your own is a subclass with `at` and, where nodes do not go straight, `retract`.
    All moves of all methods go through it.
    """

    @abc.abstractmethod
    def at(self, points: Field) -> Admissible:
        """The admissible displacements at points ``[nodes, dim]``: the tangents there."""

    def retract(self, points: Field, move: Field) -> Field:
        """The admissible points that an admissible displacement of `points` leads to."""
        return points + move

    def within(self, frame: Frame) -> Motion:
        """The same motion in the coordinates of a frame; by default it does not depend on them."""
        return self

    def __and__(self, other: Motion) -> Motion:
        """Only what both admit."""
        return Both(self, other)


class Both(Motion):
    """What two motions admit, the second seen after the first.

    Where both bind a node, it may move along the directions that they share.  Nodes that follow others
    do so as one of the two says; both can not have such nodes.
    """

    first: Motion
    second: Motion

    def at(self, points: Field) -> Admissible:
        """The intersection of the tangents."""
        one, two = self.first.at(points), self.second.at(points)
        if one.links is not None and two.links is not None:
            raise ValueError(
                "two motions with dependent nodes can't be joined; give all links to one of them"
            )
        links = one.links if two.links is None else two.links
        a, b = one.projectors, two.projectors
        if links is not None:  # what binds a dependent node binds those that it follows
            a, b = (b, links.common(a)) if one.links is None else (a, links.common(b))
        return Admissible(shared(a, b), links)

    def retract(self, points: Field, move: Field) -> Field:
        """One after the other; nodes that follow others do so in the end."""
        first = self.first.retract(points, move)
        second = self.second.retract(points, first - points)
        links = self.at(points).links
        return second if links is None else links.carried(points, second)

    def within(self, frame: Frame) -> Motion:
        """Both in the frame."""
        return Both(self.first.within(frame), self.second.within(frame))


_ROUNDS = 12  # squarings, to the power 4096: directions that differ by more than 5° are told apart in float64


def shared(
    a: Float[Array, "nodes dim dim"], b: Float[Array, "nodes dim dim"]
) -> Float[Array, "nodes dim dim"]:
    """Projectors onto what two projectors share: the limit of ``(A B A)ⁿ`` (von Neumann)."""
    product = a @ b @ a
    for _ in range(_ROUNDS):
        product = product @ product
    square = product @ product  # what is nearly 0 or 1 becomes so
    return 3 * square - 2 * square @ product
