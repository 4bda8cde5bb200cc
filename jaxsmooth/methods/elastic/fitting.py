"""Least-squares fit of the ideal element to every element (Secs. 2.3, 2.4; Eqs. 6–30)."""

from __future__ import annotations

from collections.abc import Callable

from jaxtyping import Array, Float

from jaxsmooth.numerics.rotation import rotation

__all__ = ["moments", "placed", "target_element"]

Matrix = Float[Array, "dim dim"]


def moments(ideal: Float[Array, "k dim"], nodes: Float[Array, "k dim"]) -> Matrix:
    """H of Eqs. 23–27: what the rotation of the fit depends on, whatever the size of the ideal element."""
    return (_centred(ideal)[:, :, None] * _centred(nodes)[:, None, :]).sum(axis=0)


def placed(
    ideal: Float[Array, "k dim"], nodes: Float[Array, "k dim"], scale: Float[Array, ""], rotation: Matrix
) -> Float[Array, "k dim"]:
    """C of Eq. 29: the ideal element, scaled by α s (Eqs. 22, 36), rotated, and moved by T of Eq. 28."""
    turned = (_centred(ideal)[:, None, :] * rotation).sum(axis=-1)
    return scale * turned + nodes.mean(axis=0)


def target_element(
    ideal: Float[Array, "k dim"],
    nodes: Float[Array, "k dim"],
    scale: Float[Array, ""],
    rotate: Callable[[Matrix], Matrix] = rotation,
) -> Float[Array, "k dim"]:
    """The ideal element of a size where it is closest to `nodes`: it minimises Eq. 7."""
    return placed(ideal, nodes, scale, rotate(moments(ideal, nodes)))


def _centred(nodes: Float[Array, "k dim"]) -> Float[Array, "k dim"]:
    return nodes - nodes.mean(axis=0)
