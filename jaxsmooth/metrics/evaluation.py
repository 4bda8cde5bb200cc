"""The evaluation of a mesh: what every element is worth."""

from __future__ import annotations

from typing import NamedTuple

from jaxtyping import Array, Float

from jaxsmooth.assembly import cut, each, tangents
from jaxsmooth.cells.table import ElementType
from jaxsmooth.mesh.record import Mesh
from jaxsmooth.metrics.shape import min_jacobian, scaled_jacobian, shape_quality
from jaxsmooth.metrics.validity import determinant_bound
from jaxsmooth.numerics.small import Frame

__all__ = ["Evaluation", "evaluate", "evaluate_element", "weight"]

Blocks = tuple[Float[Array, " _"], ...]

_HEAVY = 4  # where many points are looked at


class Evaluation(NamedTuple):
    """What every element is worth, block by block.

    Attributes:
        quality: the paper's q (Eqs. 1–5).
        jacobian: a bound of the Jacobian determinant, of the mesh scaled to about unit size: where it
            is positive the element is valid everywhere; else it is inverted, or not proven valid.
        corners: scaled Jacobian, which sees single corners; None for triangles and tetrahedra, of
            which q does.
    """

    quality: Blocks
    jacobian: Blocks
    corners: tuple[Float[Array, " _"] | None, ...]


def evaluate(mesh: Mesh, beta: Float[Array, ""] | float = 2.0) -> Evaluation:
    """Quality, validity and corners of all elements."""
    points = Frame.of(mesh.points).into(mesh.points)
    found = [
        each(
            lambda _, local, kind=kind: evaluate_element(kind, local, beta),
            cut(nodes, None, mesh.execution, weight(kind), frames),
            points,
        )
        for (kind, nodes), frames in zip(mesh.blocks, tangents(mesh), strict=True)
    ]
    return Evaluation(*zip(*((*values, None)[:3] for values in found), strict=True))


def evaluate_element(
    kind: ElementType, nodes: Float[Array, "k dim"], beta: Float[Array, ""] | float = 2.0
) -> tuple[Float[Array, ""], ...]:
    """Quality, bound of the determinant and, of types that have them, corners of one element."""
    q = shape_quality(kind, nodes, beta)
    if kind.constant_jacobian:  # a fair q means open corners
        return q, min_jacobian(kind, nodes)
    return q, determinant_bound(kind, nodes), scaled_jacobian(kind, nodes)


def weight(kind: ElementType) -> int:
    """Memory of an evaluation, in units of a product with linear tetrahedra."""
    return 1 if kind.constant_jacobian else _HEAVY
