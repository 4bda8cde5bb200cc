"""Whether elements are valid everywhere: rigorous bounds of the Jacobian determinant.

Samples at nodes and quadrature points say that an element is inverted, never that it is not.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxsmooth.assembly import local_nodes, tangents
from jaxsmooth.cells.bernstein import Bernstein, bernstein
from jaxsmooth.cells.table import ElementType
from jaxsmooth.mesh.record import Mesh

__all__ = ["determinant_bound", "inverted"]

_ROUNDING = 8.0  # error of a coefficient over eps, `_scale` and the norm of its row
_MANY = 64  # samples; more are taken in layers
_DEPTH = 12  # halvings; what is undecided then has a least determinant of some 4⁻¹² of its variation
_PIECES = 4096  # of one element; more are needed only where the determinant is zero along a curve
_CHUNK = 1 << 18  # coefficients that are halved at a time

_Either = TypeVar("_Either", Array, np.ndarray)


def determinant_bound(kind: ElementType, nodes: Float[Array, "k dim"]) -> Float[Array, ""]:
    """A number that the Jacobian determinant exceeds in the whole of one element.

    The least Bernstein coefficient of the determinant relative to the ideal element, less what
    rounding may have added: a positive bound proves that the element is valid.  Exact for
    triangles, tetrahedra, linear quadrilaterals and linear pyramids; on other types a valid element
    that is strongly distorted may have a negative bound (see `inverted`).

    Args:
        kind: the element type.
        nodes: its nodes ``[k, dim]``.

    Returns:
        The bound, of the dimension of a measure: the ideal element of measure V has V.
    """
    table = bernstein(kind)
    nodes = nodes - nodes[0]  # so that a distance from the origin costs no digits
    coefficients = (_in_layers if len(table.points) > _MANY else _at_once)(table, nodes)
    noise = _noise(table.bounding, jnp.finfo(nodes.dtype))
    return coefficients.min() - noise * _scale(table, nodes)


_product = partial(jnp.matmul, precision="highest")  # some devices round the factors otherwise


def _at_once(table: Bernstein, nodes: Float[Array, "k dim"]) -> Float[Array, "..."]:
    """Coefficients whose least is the bound."""
    shapes = [rows.shape[:-1] for rows in table.tangents]
    if len(table.points) == 1:  # sums fuse, see `small.contract`; else one product is faster
        rows = [jnp.asarray(rows, nodes.dtype) for rows in table.tangents]
        return _volumes([(nodes * row[..., None]).sum(axis=-2) for row in rows]).reshape(-1)
    rows = np.concatenate([rows.reshape(-1, table.kind.k) for rows in table.tangents])
    ends = np.cumsum([np.prod(shape) for shape in shapes])[:-1]
    parts = jnp.split(_product(nodes.T, jnp.asarray(rows.T, nodes.dtype)), ends, axis=1)
    tangents = [jnp.moveaxis(p.reshape(-1, *s), 0, -1) for p, s in zip(parts, shapes, strict=True)]
    return _product(jnp.asarray(table.bounding, nodes.dtype), _volumes(tangents).reshape(-1))


def _in_layers(table: Bernstein, nodes: Float[Array, "k dim"]) -> Float[Array, "..."]:
    """The same for many samples: matrix products, and one layer of samples at a time for memory."""
    first, other = (jnp.asarray(matrix, nodes.dtype) for matrix in table.layer_matrices)

    def layer(rows: Float[Array, "k columns"]) -> Float[Array, " _"]:
        tangents = _product(nodes.T, rows).reshape(table.kind.dim, table.kind.dim, -1)
        return _volumes(list(jnp.moveaxis(tangents, 0, -1)))

    samples = jax.lax.map(layer, jnp.asarray(table.layers, nodes.dtype))
    return _product(_product(first, samples), other.T)


def _scale(table: Bernstein, nodes: Float[Array, "k dim"]) -> Float[Array, ""]:
    """What the rounding of a determinant is relative to.

    The rounding of a tangent is relative to the longest, so that of the determinant to the longest
    times the largest product of all but one; lengths are root mean squares over the ends."""
    squares = []
    for rows in table.ends:
        tangents = (nodes * jnp.asarray(rows, nodes.dtype)[..., None]).sum(axis=-2)
        squares.append((tangents * tangents).sum() / len(rows))
    lengths = jnp.sqrt(jnp.stack(squares))
    others = lengths if len(squares) == 2 else lengths * jnp.roll(lengths, 1)
    return lengths.max() * others.max()


def _noise(matrix: np.ndarray, numbers: np.finfo) -> float:
    """Rounding of the coefficients that `matrix` makes from samples, over `_scale`."""
    return _ROUNDING * float(numbers.eps) * float(np.linalg.norm(matrix, axis=1).max())


def _volumes(tangents: Sequence[_Either]) -> _Either:
    """Determinants of the matrices with these columns ``[..., dim]``, which broadcast."""
    (a, b), (c, d) = ((t[..., 0], t[..., 1]) for t in tangents[:2])
    if len(tangents) == 2:
        return a * d - b * c
    x, y, z = (tangents[2][..., axis] for axis in range(3))
    e, f = tangents[0][..., 2], tangents[1][..., 2]
    return x * (b * f - e * d) + y * (e * c - a * f) + z * (a * d - b * c)


# --- The verdict ------------------------------------------------------------------------


@partial(jax.jit, static_argnames=("kind",))
def _bounds(kind: ElementType, points: Array, nodes: Array, frames: Array | None) -> Array:
    return jax.vmap(partial(determinant_bound, kind))(local_nodes(points, nodes, frames))


_tangents = jax.jit(tangents)


def inverted(
    mesh: Mesh, bounds: Sequence[Float[Array, " _"]] | None = None
) -> tuple[Bool[np.ndarray, " _"], ...]:
    """Which elements are not valid: their Jacobian determinant is not positive somewhere inside.

    The bounds decide nearly all; the others are halved until one of their parts is refuted or all are
    proven.  An element whose determinant touches zero, to rounding, counts as inverted; so does one with
    a coordinate that is not finite.  For use on the host.

    Args:
        mesh: the mesh.
        bounds: `determinant_bound` of its elements, where it is known, times any positive number.

    Returns:
        One mask ``[elements]`` for every block.
    """
    points = np.asarray(mesh.points, np.float64)
    frames = _tangents(mesh.bare) if mesh.surface else (None,) * len(mesh.types)
    if bounds is None:
        bounds = [
            _bounds(kind, mesh.points, nodes, own)
            for (kind, nodes), own in zip(mesh.blocks, frames, strict=True)
        ]
    found = []
    for (kind, nodes), own, bound in zip(mesh.blocks, frames, bounds, strict=True):
        refuted = ~(np.asarray(bound) > 0)  # NaN is refuted below
        open_ = np.flatnonzero(refuted)
        places = points[np.asarray(nodes)[open_]]
        if own is not None:
            places = np.einsum("mkd,mjd->mkj", places, np.asarray(own, np.float64)[open_])
        refuted[open_] = _refute(kind, places)
        found.append(refuted)
    return tuple(found)


def _refute(kind: ElementType, nodes: Float[np.ndarray, "n k dim"]) -> Bool[np.ndarray, " n"]:
    """Halve elements until every part is proven valid or one is not."""
    table, size = bernstein(kind), len(bernstein(kind).points)
    result, pieces = np.zeros(len(nodes), bool), np.zeros(len(nodes), int)
    stack = [(_coefficients(table, nodes[rows]), rows, 0) for rows in _chunks(len(nodes), size)]
    while stack:
        coefficients, owner, depth = stack.pop()
        np.add.at(pieces, owner, 1)
        refuted = ~(coefficients[:, table.corners] > 0).all(axis=1)
        undecided = ~(coefficients > 0).all(axis=1)
        refuted |= undecided & ((depth == _DEPTH) | (pieces[owner] > _PIECES))
        result[owner[refuted]] = True
        go_on = undecided & ~result[owner]
        halved = table.halve(coefficients[go_on])
        owners = np.repeat(owner[go_on], len(table.halves))
        stack += [(halved[rows], owners[rows], depth + 1) for rows in _chunks(len(halved), size)]
    return result


def _chunks(count: int, size: int) -> list[Int[np.ndarray, " _"]]:
    """Row numbers, as many at a time as may be halved together."""
    step = max(_CHUNK // size, 1)
    return [np.arange(low, min(low + step, count)) for low in range(0, count, step)]


def _coefficients(table: Bernstein, nodes: Float[np.ndarray, "n k dim"]) -> Float[np.ndarray, "n s"]:
    """Coefficients of elements that are scaled to size 1, less their rounding."""
    nodes = nodes - nodes[:, :1]
    size = np.abs(nodes).max(axis=(1, 2), keepdims=True)
    nodes = nodes / np.where(size > 0, size, 1)
    tangents = [np.einsum("...k,nkd->n...d", rows, nodes) for rows in table.tangents]
    samples = _volumes(tangents).reshape(len(nodes), -1)
    squares = [(t * t).sum(axis=-1).reshape(len(t), -1).max(axis=1) for t in tangents]
    lengths = np.sqrt(squares)
    others = lengths if len(squares) == 2 else lengths * np.roll(lengths, 1, axis=0)
    scale = lengths.max(axis=0) * others.max(axis=0)
    return samples @ table.matrix.T - _noise(table.matrix, np.finfo(float)) * scale[:, None]
