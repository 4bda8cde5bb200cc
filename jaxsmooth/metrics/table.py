"""Quality metrics: the paper's (Eqs. 1–5) and the field's usual others, in one table.

Element-level functions take the nodes of one element ``[k, dim]`` and are vmapped over its
block.  All metrics are signed and differentiable, with finite gradients.
"""

from __future__ import annotations

import difflib
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxsmooth.assembly import gather
from jaxsmooth.cells.table import ElementType
from jaxsmooth.convert.meshfile import as_mesh
from jaxsmooth.numerics.small import contract, determinant, least, norm, power

__all__ = ["METRICS", "Metric", "measure", "metric", "quality", "quality_mean", "surface"]

Nodes = Float[Array, "k dim"]
Scalar = Float[Array, ""]


def measure(kind: ElementType, nodes: Nodes) -> Scalar:
    """Signed area or volume of one element, by its quadrature rule."""
    frames = contract(nodes, jnp.asarray(kind.gradients, nodes.dtype))
    return determinant(frames) @ jnp.asarray(kind.weights, nodes.dtype)


def surface(kind: ElementType, nodes: Nodes) -> Scalar:
    """Perimeter or surface area of one element; curved sides are integrated."""
    tangents = contract(nodes, jnp.asarray(kind.facet_tangents, nodes.dtype))
    normals = tangents[..., 0] if kind.dim == 2 else jnp.cross(tangents[..., 0], tangents[..., 1])
    return norm(normals) @ jnp.asarray(kind.facet_weights, nodes.dtype)


def shape_quality(kind: ElementType, nodes: Nodes, beta: Scalar | float = 2.0) -> Scalar:
    """The paper's metric, Eqs. 1–5, times the sign of the measure.

    ``q = 1 − |1 − (m_r / m)^β|`` with m the perimeter or surface area and m_r that of the
    ideal element of the same measure.  Its gradient is finite for flat elements when
    ``β ≥ dim / (dim − 1)``, which holds for the default.
    """
    volume, side = measure(kind, nodes), surface(kind, nodes)
    dim = kind.dim
    # (m_r / m)^β with the roots of the measure collected into one power
    top = kind.ideal_surface**beta * power(jnp.abs(volume), beta * (dim - 1) / dim)
    solid = side > 0
    ratio = jnp.where(solid, top / jnp.where(solid, side, 1) ** beta, 0)
    return jnp.sign(volume) * jnp.where(ratio > 1, 2 - ratio, ratio)


def min_jacobian(kind: ElementType, nodes: Nodes) -> Scalar:
    """Least Jacobian determinant over nodes and quadrature points.

    Relative to the ideal element of unit measure: the ideal element of measure V has V.
    An element is *inverted* where this is not positive.
    """
    return least(determinant(contract(nodes, jnp.asarray(kind.validity_gradients, nodes.dtype))))


def _corner_frames(kind: ElementType, nodes: Nodes) -> tuple[Array, np.ndarray]:
    """Edge tangents at the corners, of an element and of the ideal one (constants)."""
    ideal = np.einsum("kd,qkj->qdj", kind.ideal, kind.corner_frames)
    return contract(nodes, jnp.asarray(kind.corner_frames, nodes.dtype)), ideal


def scaled_jacobian(kind: ElementType, nodes: Nodes) -> Scalar:
    """Least over the corners of ``det(t₁, …) / ∏|tᵢ|``, over the ideal element's value there.

    The tᵢ are the tangents of the edges that leave the corner; the apex of a pyramid has no
    such frame and is left out.  The ideal value is 1 for quadrilaterals and hexahedra, √3/2
    for triangles and wedges, √2/2 for tetrahedra and pyramids.
    """

    def scaled(frames: Array) -> Array:
        lengths = norm(jnp.swapaxes(frames, -1, -2)).prod(axis=-1)
        solid = lengths > 0
        return jnp.where(solid, determinant(frames) / jnp.where(solid, lengths, 1), 0)

    frames, ideal = _corner_frames(kind, nodes)
    return least(scaled(frames) / scaled(jnp.asarray(ideal, frames.dtype)))


def mean_ratio(kind: ElementType, nodes: Nodes) -> Scalar:
    """Harmonic mean over the corners of ``dim · det(A)^(2/dim) / |A|²``; zero if any det ≤ 0.

    A maps the ideal element's corner frame to the element's (Knupp 2003); 1 only on the ideal
    element, for every type.  For triangles it is Lo's ``4√3 A / Σl²``, for tetrahedra Liu and
    Joe's ``12 (3V)^(2/3) / Σl²``.
    """
    frames, ideal = _corner_frames(kind, nodes)
    jacobians = frames @ jnp.asarray(np.linalg.inv(ideal), frames.dtype)
    det, size = determinant(jacobians), (jacobians**2).sum(axis=(-1, -2))
    valid = (det > 0).all()
    det = jnp.where(valid, det, 1)
    inverse = jnp.where(valid, size, 1) / (kind.dim * det ** (2 / kind.dim))
    return jnp.where(valid, 1 / inverse.mean(), 0)


def edge_ratio(kind: ElementType, nodes: Nodes) -> Scalar:
    """Shortest over longest edge, between corner nodes."""
    lengths = norm(nodes[kind.edges[:, 0]] - nodes[kind.edges[:, 1]])
    longest = -least(-lengths)
    return jnp.where(longest > 0, least(lengths) / jnp.where(longest > 0, longest, 1), 0)


@dataclass(frozen=True)
class Metric:
    """One row of the metric table.

    Attributes:
        name: how it is called in `quality` and on the command line.
        function: ``(kind, nodes [k, dim]) -> scalar``.
        range: least and greatest value.
        acceptable: values a solver usually lives with.
        ideal: value on the ideal element of unit measure.
        summary: one line for tables.
    """

    name: str
    function: Callable[[ElementType, Nodes], Scalar]
    range: tuple[float, float]
    acceptable: tuple[float, float]
    ideal: float
    summary: str


_INF = float("inf")
METRICS: dict[str, Metric] = {
    row.name: row
    for row in (
        Metric("shape", shape_quality, (-1, 1), (0.2, 1), 1, "the paper's q: isoperimetric ratio, signed"),
        Metric(
            "scaled_jacobian", scaled_jacobian, (-(2**0.5), 2**0.5), (0.2, 2**0.5), 1, "worst corner, signed"
        ),
        Metric("mean_ratio", mean_ratio, (0, 1), (0.2, 1), 1, "Knupp's shape metric against the ideal"),
        Metric("edge_ratio", edge_ratio, (0, 1), (0.2, 1), 1, "shortest over longest edge"),
        Metric("min_jacobian", min_jacobian, (-_INF, _INF), (0, _INF), 1, "least Jacobian determinant"),
        Metric("measure", measure, (-_INF, _INF), (0, _INF), 1, "signed area or volume"),
    )
}


def metric(name: str) -> Metric:
    """The metric called `name`.  Raises `ValueError` that suggests the nearest names."""
    if name in METRICS:
        return METRICS[name]
    near = difflib.get_close_matches(name, METRICS, n=2, cutoff=0.4)
    hint = f"did you mean {' or '.join(near)}?" if near else f"known are {', '.join(METRICS)}"
    raise ValueError(f"unknown metric {name!r}; {hint}")


@partial(jax.jit, static_argnames=("kind", "name"))
def _block_quality(kind: ElementType, name: str, points: Array, nodes: Int[Array, "elements k"]) -> Array:
    return jax.vmap(partial(METRICS[name].function, kind))(gather(points, nodes))


def quality(mesh: Any, name: str = "shape") -> tuple[Float[Array, " _"], ...]:
    """A metric on every element.

    Args:
        mesh: a `Mesh`, or whatever else `as_mesh` takes.
        name: a name of the `METRICS` table.

    Returns:
        One array ``[elements]`` for every block, dimensionless but for `measure` and
        `min_jacobian` (length to the power of the dimension).

    Raises:
        ValueError: for an unknown metric, or what is no mesh.
    """
    row, mesh = metric(name), as_mesh(mesh)
    return tuple(_block_quality(kind, row.name, mesh.points, nodes) for kind, nodes in mesh.blocks)


def quality_mean(mesh: Any, name: str = "shape") -> Scalar:
    """Mean of a metric over all elements: a differentiable scalar."""
    return jnp.concatenate(quality(mesh, name)).mean()
