"""The rotation that fits one set of points to another: its definition, and a fast form."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsmooth.numerics.small import cofactors, determinant, norm, solve_regular

__all__ = ["rotation", "rotation_svd"]

Matrix = Float[Array, "dim dim"]
_AXIAL = ((2, 1), (0, 2), (1, 0))
_DIAGONAL = (1, 0, 0, 0, 1, 0, 0, 1, 0, 1)  # of an upper triangle, row by row
_ANYWHERE = (0.787, 0.413, 0.326, 0.321)  # a quaternion that no symmetric mesh has


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

    2D: closed form.  3D: the first eigenvector of a symmetric 4×4 matrix, by its characteristic
    polynomial.  Where the rotation is not unique (the two least signed singular values sum to
    zero) one of the minimisers is returned and its derivative is zero; where that sum is below
    about ``√eps`` of the largest, one that is as good to ``√eps``.
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
    floor = 8 * float(jnp.finfo(moments.dtype).eps)
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
    """By unit quaternions (Horn 1987): tr(R H) = qᵀ N q is largest for the first eigenvector of N.

    Everything is written in scalars, which under vmap stay elementwise and fuse.  No branch and no
    choice is made: the compiler may evaluate one twice, with other rounding.
    """
    h = _scaled(h)
    n, largest = _horn(h), _largest_eigenvalue(h)
    m = _adjugate(*(largest * d - x if d else -x for x, d in zip(n, _DIAGONAL, strict=True)))

    def unit(q):
        square = sum(x * x for x in q)
        regular = square > 0
        scale = 1 / jnp.sqrt(jnp.where(regular, square, 1))
        return tuple(
            jnp.where(regular, x * scale, one) for x, one in zip(q, (1.0, 0.0, 0.0, 0.0), strict=True)
        )

    def apply(_, q):
        w, x, y, z = q
        return unit(
            (
                m[0] * w + m[1] * x + m[2] * y + m[3] * z,
                m[1] * w + m[4] * x + m[5] * y + m[6] * z,
                m[2] * w + m[5] * x + m[7] * y + m[8] * z,
                m[3] * w + m[6] * x + m[8] * y + m[9] * z,
            )
        )

    # The adjugate of λ − N is q qᵀ but for a factor.  Twice more, for a start orthogonal to q.
    start = tuple(jnp.full_like(h[0, 0], part) for part in _ANYWHERE)
    w, x, y, z = jax.lax.fori_loop(0, 3, apply, start)
    rows = (
        (w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z),
    )
    return jnp.stack([jnp.stack(row) for row in rows])


def _horn(h: Matrix) -> tuple[Array, ...]:
    """Upper triangle of Horn's symmetric matrix N, row by row."""
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = h
    return (
        *(xx + yy + zz, yz - zy, zx - xz, xy - yx),
        *(xx - yy - zz, xy + yx, zx + xz),
        *(yy - xx - zz, yz + zy),
        zz - xx - yy,
    )


def _largest_eigenvalue(h: Matrix) -> Array:
    """Of N: the largest root of ``(λ² − |H|²)² − 8 λ det H − 4 |cof H|²`` (as Theobald 2005).

    Newton's method comes down to it from an upper bound.  Towards a double root it halves the
    distance, and stops with half of the digits: closer, the adjugate would be all rounding.
    """
    cof = cofactors(h)
    square, det, minors = (h * h).sum(), (h[0] * cof[0]).sum(), (cof * cof).sum()
    numbers = jnp.finfo(h.dtype)

    def unfinished(state):
        root, step, count = state
        return (step > numbers.eps * root) & (count < numbers.nmant // 2)

    def newton(state):
        root, _, count = state
        gap = root * root - square
        value, slope = gap * gap - 8 * det * root - 4 * minors, 4 * root * gap - 8 * det
        rising = (value > 0) & (slope > 0)
        step = jnp.where(rising, value / jnp.where(rising, slope, 1), 0)
        return root - step, step, count + 1

    bound = jnp.sqrt(3 * square)
    return jax.lax.while_loop(unfinished, newton, (bound, bound, jnp.int32(0)))[0]


def _adjugate(a00, a01, a02, a03, a11, a12, a13, a22, a23, a33) -> tuple[Array, ...]:
    """Adjugate of a symmetric 4×4 matrix, upper triangles row by row, from its 2×2 minors."""
    # of the rows 0 and 1
    t01, t02, t03 = a00 * a11 - a01 * a01, a00 * a12 - a01 * a02, a00 * a13 - a01 * a03
    t12, t13, t23 = a01 * a12 - a11 * a02, a01 * a13 - a11 * a03, a02 * a13 - a12 * a03
    # of the rows 2 and 3
    b02, b03 = a02 * a23 - a03 * a22, a02 * a33 - a03 * a23
    b12, b13, b23 = a12 * a23 - a13 * a22, a12 * a33 - a13 * a23, a22 * a33 - a23 * a23
    return (
        a11 * b23 - a12 * b13 + a13 * b12,
        a02 * b13 - a01 * b23 - a03 * b12,
        a13 * t23 - a23 * t13 + a33 * t12,
        a22 * t13 - a12 * t23 - a23 * t12,
        a00 * b23 - a02 * b03 + a03 * b02,
        a23 * t03 - a03 * t23 - a33 * t02,
        a02 * t23 - a22 * t03 + a23 * t02,
        a03 * t13 - a13 * t03 + a33 * t01,
        a12 * t03 - a02 * t13 - a23 * t01,
        a02 * t12 - a12 * t02 + a22 * t01,
    )
