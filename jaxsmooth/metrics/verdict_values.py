"""How metrics of Verdict are made from the functions of its element families."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

from jaxtyping import Array, Float

from jaxsmooth.cells.table import ElementType
from jaxsmooth.metrics.geometry import greatest, in_space
from jaxsmooth.metrics.record import Metric, family
from jaxsmooth.numerics.small import least

__all__ = [
    "INF",
    "NO_ORIENTATION",
    "PLANE",
    "Function",
    "call",
    "greatest_of",
    "least_of",
    "mean_of",
    "verdict",
]

Function = Callable[[Array], Array]
"""Of the corners of one element in space, ``[k, 3] -> scalar``."""
INF = float("inf")
PLANE = "Verdict gives triangles and plane quadrilaterals no orientation: a mirrored one has the same value"
NO_ORIENTATION = "no orientation: a mirrored element has the same value"


def call(
    functions: Mapping[str, Function], kind: ElementType, points: Float[Array, "k dim"]
) -> Float[Array, ""]:
    """The function of the family of an element, at its corners in space."""
    return functions[family(kind)](in_space(points))


def verdict(
    name: str, functions: Mapping[str, Function], summary: str, note: str = "", **fields: Any
) -> Metric:
    """A metric from one function a family; the note goes to its reference."""
    if not note and {"triangle", "quad"} & set(functions):
        note = PLANE
    reference = f"Verdict (Stimpson et al. 2007){'; ' * bool(note)}{note}"
    fields = {"families": tuple(functions), "corners_only": True, "reference": reference, **fields}
    return Metric(name, partial(call, functions), summary, **fields)


def greatest_of(function: Function) -> Function:
    """The greatest of several values."""
    return lambda points: greatest(function(points))


def least_of(function: Function) -> Function:
    """The least of several values."""
    return lambda points: least(function(points))


def mean_of(function: Function) -> Function:
    """The mean of several values."""
    return lambda points: function(points).mean()
