"""What a quality metric is: a value that users can write too."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from jaxtyping import Array, Float

from jaxsmooth.cells.table import ElementType, element_type

__all__ = ["FAMILIES", "Metric", "family"]

FAMILIES = {
    (2, 3): "triangle",
    (2, 4): "quad",
    (3, 4): "tetra",
    (3, 5): "pyramid",
    (3, 6): "wedge",
    (3, 8): "hexahedron",
}
"""Dimension and number of corners, and the linear type that has them."""


def family(kind: ElementType) -> str:
    """The linear element type with the corners of `kind`: ``"tetra"`` for tetra10."""
    return FAMILIES[kind.dim, kind.corners]


@dataclass(frozen=True)
class Metric:
    """A number for each element of a mesh.  Make it once: every new function is compiled anew.

        flatness = Metric("flatness", lambda kind, nodes: jnp.ptp(nodes[:, -1]), "extent in z")
        values = jaxsmooth.quality(mesh, metric=flatness)

    Attributes:
        name: what tables call it.
        function: ``(kind, nodes [k, dim]) -> scalar`` of one element, in `jax.numpy`; it is vmapped and
            compiled.  With `relative` it takes as a third argument the mean absolute measure of the
            elements of its type.
        summary: one line for tables.
        families: linear types that it is for, with their quadratic members; empty: all.
        corners_only: it knows only straight elements: of a quadratic one it is given the linear type
            and the corner nodes.
        relative: whether it compares an element with the others of its type.
        range: least and greatest value.
        acceptable: values that a solver usually lives with.
        ideal: value on the ideal element of unit measure, or a mapping from family to it.
        units: ``""`` for none, ``"degrees"``, ``"length"`` or ``"measure"`` (area or volume).
        larger_is_better: None where neither larger nor smaller is.
        differentiable: whether it has a derivative almost everywhere, finite also on degenerate elements.
        reference: where it is defined, and where it departs from there.
    """

    name: str
    function: Callable[..., Float[Array, ""]]
    summary: str = ""
    families: tuple[str, ...] = ()
    corners_only: bool = False
    relative: bool = False
    range: tuple[float, float] = (-float("inf"), float("inf"))
    acceptable: tuple[float, float] = (-float("inf"), float("inf"))
    ideal: float | Mapping[str, float] = field(default=1.0, compare=False)
    units: str = ""
    larger_is_better: bool | None = True
    differentiable: bool = True
    reference: str = ""

    def __post_init__(self) -> None:
        if unknown := set(self.families) - set(FAMILIES.values()):
            known = ", ".join(FAMILIES.values())
            raise ValueError(f"metric {self.name!r}: no element family {min(unknown)!r}; known are {known}")
        if self.units not in ("", "degrees", "length", "measure"):
            raise ValueError(
                f"metric {self.name!r}: units are '', 'degrees', 'length' or 'measure', got {self.units!r}"
            )

    def applies_to(self, kind: ElementType) -> bool:
        """Whether elements of a type have this metric."""
        return not self.families or family(kind) in self.families

    def sees(self, kind: ElementType) -> ElementType:
        """The type whose nodes the function is given: the linear one if it knows only corners."""
        return element_type(family(kind)) if self.corners_only else kind

    def ideal_value(self, kind: ElementType) -> float:
        """Value on the ideal element of a type, of unit measure."""
        return self.ideal[family(kind)] if isinstance(self.ideal, Mapping) else self.ideal

    def length_power(self, kind: ElementType) -> int:
        """The power of length that values have as their unit."""
        return {"length": 1, "measure": kind.dim}.get(self.units, 0)

    def __call__(
        self, kind: ElementType, nodes: Float[Array, "k dim"], *mean: Float[Array, ""]
    ) -> Float[Array, ""]:
        """The metric of one element, `mean` for `relative` ones only."""
        kind = self.sees(kind)
        return self.function(kind, nodes[: kind.k], *mean)
