"""Target elements: how large the ideal element is that an element is compared with."""

from __future__ import annotations

import abc
from collections.abc import Callable
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsmooth.assembly import cut, each, gather, patch_mean, tangents
from jaxsmooth.cells.table import ElementType
from jaxsmooth.mesh.record import Mesh
from jaxsmooth.metrics.table import measure
from jaxsmooth.numerics.rotation import rotation
from jaxsmooth.numerics.small import Frame

__all__ = ["FreeSize", "GivenSize", "OwnSize", "Target"]

_LEAST_MEASURE = 1e-2  # of a target element, relative to the mean of its patches

Measures = tuple[Float[Array, " _"], ...]


class Target(eqx.Module):
    """The size of the ideal element that every element is compared with.

    A target of your own is a subclass with `measures`.

    Attributes:
        weight: how much the size counts beside the shape in the optimisation variant.
        sized: whether it counts at all (of the class).
    """

    weight: Float[Array, ""] | float = 1.0
    sized: ClassVar[bool] = True

    @abc.abstractmethod
    def measures(self, mesh: Mesh, frame: Frame) -> Measures:
        """Area or volume of the target of every element, positive, one array ``[elements]`` a block.

        Args:
            mesh: the mesh, its points already in the coordinates of `frame`.
            frame: a length there is `frame.scale` times the length in the mesh.
        """


class OwnSize(Target):
    """The element's own measure (Eq. 22), made useful where it says nothing.

    The absolute value, bounded below by a fraction of the mean of its patches, so that inverted
    and flat elements have a target to grow into.
    """

    def measures(self, mesh: Mesh, frame: Frame) -> Measures:
        """Own measures."""
        return _useful(mesh, tuple(jnp.abs(part) for part in _each(measure, mesh)))


class FreeSize(Target):
    """Whatever size fits the element best: only its shape counts."""

    sized: ClassVar[bool] = False

    def measures(self, mesh: Mesh, frame: Frame) -> Measures:
        """Measures of the ideal elements that are nearest, by rotation, translation and scaling."""
        return _useful(mesh, _each(_nearest_measure, mesh))


class GivenSize(Target):
    """A size that is asked for.

    Attributes:
        size: area or volume of the elements: a number, or one array ``[elements]`` a block.
    """

    size: Measures | Float[Array, ""] | float = eqx.field(kw_only=True)

    def measures(self, mesh: Mesh, frame: Frame) -> Measures:
        """The sizes, in the units of the frame."""
        given = self.size if isinstance(self.size, tuple) else (self.size,) * len(mesh.blocks)
        dtype = mesh.points.dtype
        return tuple(
            jnp.ones(len(nodes), dtype) * jnp.asarray(size, dtype) * frame.scale**kind.dim
            for size, (kind, nodes) in zip(given, mesh.blocks, strict=True)
        )


def _each(function: Callable[..., Array], mesh: Mesh) -> Measures:
    return tuple(
        each(
            lambda _, local, kind=kind: function(kind, local),
            cut(nodes, None, mesh.execution, frames=frames),
            mesh.points,
        )
        for (kind, nodes), frames in zip(mesh.blocks, tangents(mesh), strict=True)
    )


def _nearest_measure(kind: ElementType, nodes: Float[Array, "k dim"]) -> Float[Array, ""]:
    """With the rotation R of Eq. 14, the scale that minimises ``Σ |X − s R C|²`` is ``tr(R H) / Σ |C|²``."""
    ideal = jnp.asarray(kind.ideal - kind.ideal.mean(axis=0), nodes.dtype)
    moments = (ideal[:, :, None] * (nodes - nodes.mean(axis=0))[:, None, :]).sum(axis=0)
    scale = jnp.trace(rotation(moments) @ moments) / (ideal * ideal).sum()
    return jnp.maximum(scale, 0) ** kind.dim


def _useful(mesh: Mesh, own: Measures) -> Measures:
    around = patch_mean(mesh, own)
    return tuple(
        jnp.maximum(size, _LEAST_MEASURE * gather(around, nodes).mean(axis=1))
        for (_, nodes), size in zip(mesh.blocks, own, strict=True)
    )
