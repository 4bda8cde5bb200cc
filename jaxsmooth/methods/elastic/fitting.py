"""Least-squares fit of the ideal element to every element (Secs. 2.3, 2.4; Eqs. 6–30)."""

from __future__ import annotations

from jaxtyping import Array, Float

from jaxsmooth.numerics.rotation import rotation

__all__ = ["fit", "target_element"]

Matrix = Float[Array, "dim dim"]


def fit(
    reference: Float[Array, "k dim"], nodes: Float[Array, "k dim"], rotate=rotation
) -> tuple[Matrix, Float[Array, " dim"]]:
    """Rotation and translation that place `reference` closest to `nodes`.

    They minimise Eq. 7, with H from Eqs. 23–27 and T from Eq. 28.
    """
    centre, reference_centre = nodes.mean(axis=0), reference.mean(axis=0)
    moments = ((reference - reference_centre)[:, :, None] * (nodes - centre)[:, None, :]).sum(axis=0)
    r = rotate(moments)
    return r, centre - r @ reference_centre


def target_element(
    ideal: Float[Array, "k dim"],
    nodes: Float[Array, "k dim"],
    scale: Float[Array, ""],
    rotate=rotation,
) -> Float[Array, "k dim"]:
    """The ideal element, scaled by `scale` (α s of Eqs. 22, 36) and fitted: C of Eq. 29."""
    reference = scale * ideal
    r, t = fit(reference, nodes, rotate)
    return (reference[:, None, :] * r).sum(axis=-1) + t
