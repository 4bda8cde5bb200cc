"""Least-squares fit of the ideal element to every element (Secs. 2.3, 2.4; Eqs. 6–30)."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsmooth.small import determinant, norm, solve_regular

__all__ = ["fit", "rotation", "rotation_svd", "target_element"]

Matrix = Float[Array, "dim dim"]
_SWEEPS = 5  # of Jacobi rotations; four reach rounding on random matrices
_AXIAL = ((2, 1), (0, 2), (1, 0))


def rotation_svd(moments: Matrix) -> Matrix:
    """The rotation that maximises ``tr(R H)``, by the SVD ``H = U Λ Vᵀ``: the definition.

    Eq. 14, corrected: ``R = V diag(1, …, det(V Uᵀ)) Uᵀ``; without the determinant an inverted
    element would be fitted by a reflection.
    """
    u, _, vt = jnp.linalg.svd(moments)
    flip = jnp.ones(len(moments), moments.dtype).at[-1].set(jnp.sign(determinant(u) * determinant(vt)))
    return (vt.T * flip) @ u.T


@jax.custom_jvp
def rotation(moments: Matrix) -> Matrix:
    """The same rotation as `rotation_svd`, several times faster, with its own derivative.

    2D: closed form.  3D: one-sided Jacobi rotations make the columns of H orthogonal; the
    third axis is the cross product of the other two, which holds for inverted and flat
    elements too.  Where the rotation is not unique (the two least signed singular values sum
    to zero) one of the minimisers is returned and its derivative is zero.
    """
    return _rotation_2d(moments) if len(moments) == 2 else _rotation_3d(moments)


@rotation.defjvp
def _rotation_jvp(primals: tuple[Matrix], tangents: tuple[Matrix]) -> tuple[Matrix, Matrix]:
    """With S = R H and D = R dH: (tr(S) I − S) w = axial(D − Dᵀ), dR = −[w]ₓ R.

    It is the derivative of the condition that S be symmetric, and finite wherever R is unique,
    also at an ideal element, where the derivative of the SVD is not.
    """
    (moments,), (change,) = primals, tangents
    r = rotation(moments)
    size = jnp.abs(moments).max()
    size = jax.lax.stop_gradient(jnp.where(size > 0, size, 1))
    moments, change = moments / size, change / size
    s, d = r @ moments, r @ change
    floor = 8 * jnp.finfo(moments.dtype).eps
    skew = d - d.T
    if len(moments) == 2:
        stiffness = jnp.trace(s)
        unique = stiffness > floor * norm(moments.reshape(-1))
        angle = jnp.where(unique, skew[0, 1] / jnp.where(unique, stiffness, 1), 0)
        return r, angle * jnp.array([[0, -1], [1, 0]], moments.dtype) @ r
    symmetric = (s + s.T) / 2
    axial = jnp.stack([skew[i, j] for i, j in _AXIAL])
    w = solve_regular(jnp.trace(s) * jnp.eye(3, dtype=s.dtype) - symmetric, axial, floor)
    zero = jnp.zeros_like(w[0])
    cross = jnp.stack([zero, -w[2], w[1], w[2], zero, -w[0], -w[1], w[0], zero]).reshape(3, 3)
    return r, -cross @ r


def _rotation_2d(h: Matrix) -> Matrix:
    h = _scaled(h)
    cosine, sine = h[0, 0] + h[1, 1], h[0, 1] - h[1, 0]
    length = jnp.sqrt(cosine * cosine + sine * sine)
    regular = length > 4 * jnp.finfo(h.dtype).eps  # less is rounding
    scale = 1 / jnp.where(regular, length, 1)
    cosine, sine = jnp.where(regular, cosine * scale, 1), sine * scale
    return jnp.stack([jnp.stack([cosine, -sine]), jnp.stack([sine, cosine])])


def _scaled(h: Matrix) -> Matrix:
    """h over its largest entry: squares of what is left neither over- nor underflow."""
    size = jnp.abs(h).max()
    return h / jnp.where(size > 0, size, 1)


def _rotation_3d(h: Matrix) -> Matrix:
    tiny = jnp.finfo(h.dtype).tiny
    h = _scaled(h)

    # Columns as tuples of scalars: under vmap everything stays elementwise and fuses.
    def dot(a, b):
        return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]

    def cross(a, b):
        return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])

    def angle(a, b):
        """Cosine and sine of the rotation that makes two columns orthogonal."""
        gap, overlap = dot(b, b) - dot(a, a), 2 * dot(a, b)
        root = jnp.abs(gap) + jnp.sqrt(gap * gap + overlap * overlap)
        tangent = jnp.where(gap >= 0, overlap, -overlap) / (root + tiny)
        cosine = 1 / jnp.sqrt(1 + tangent * tangent)
        return cosine, cosine * tangent

    def turn(triple, cosine, sine):
        """Rotate the first two vectors, then renumber: 0, 1, 2 become 2, 0, 1."""
        a, b, c = triple
        first = tuple(cosine * x - sine * y for x, y in zip(a, b, strict=True))
        return tuple(sine * x + cosine * y for x, y in zip(a, b, strict=True)), c, first

    # The compiler may evaluate an expression once for every result that uses it, each time with
    # other rounding.  Every decision (the sign of an angle, which column is longest) therefore
    # depends on numbers that the loop stores: taken twice, it is taken alike.
    def rotate(_, state):
        columns, axes, (cosine, sine), _ = state
        columns, axes = turn(columns, cosine, sine), turn(axes, cosine, sine)
        return columns, axes, angle(*columns[:2]), tuple(dot(c, c) for c in columns)

    columns = tuple(tuple(h[i, j] for i in range(3)) for j in range(3))
    axes = tuple(tuple(jnp.full_like(h[0, 0], i == j) for i in range(3)) for j in range(3))
    state = columns, axes, angle(*columns[:2]), tuple(dot(c, c) for c in columns)
    columns, axes, _, lengths = jax.lax.fori_loop(0, 3 * _SWEEPS, rotate, state)

    def pick(which, triple):
        return tuple(
            jnp.where(which[0], x, jnp.where(which[1], y, z)) for x, y, z in zip(*triple, strict=True)
        )

    x, y, z = lengths
    longest = (x >= y) & (x >= z), (y > x) & (y >= z)
    # of the two others the longer one
    middle = (
        jnp.where(longest[0], False, jnp.where(longest[1], x > z, x >= y)),
        jnp.where(longest[0], y >= z, jnp.where(longest[1], False, y > x)),
    )
    long, short = pick(longest, columns), pick(middle, columns)
    first = _unit_or(long, (1.0, 0.0, 0.0), dot)
    # a needle has no second direction: any normal to the first one is a minimiser
    spare = cross(first, _least_axis(long))
    second = _unit_or(short, _unit_or(spare, (0.0, 1.0, 0.0), dot), dot)
    u = (first, second, cross(first, second))
    v = (pick(longest, axes), pick(middle, axes))
    v = (*v, cross(*v))
    return jnp.stack(
        [jnp.stack([sum(v[m][i] * u[m][j] for m in range(3)) for j in range(3)]) for i in range(3)]
    )


def _unit_or(vector, fallback, dot):
    square = dot(vector, vector)
    regular = square > jnp.finfo(square.dtype).eps ** 3
    scale = 1 / jnp.sqrt(jnp.where(regular, square, 1))
    return tuple(jnp.where(regular, x * scale, f) for x, f in zip(vector, fallback, strict=True))


def _least_axis(a):
    x, y, z = (jnp.abs(c) for c in a)
    first, second = (x <= y) & (x <= z), (y < x) & (y <= z)
    return tuple(m.astype(a[0].dtype) for m in (first, second, ~first & ~second))


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
