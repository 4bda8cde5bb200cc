"""How exact the coordinates of a mesh are."""

from __future__ import annotations

import numpy as np

__all__ = ["CLOSE", "ROUNDINGS", "coordinate_error", "type_error"]

ROUNDINGS = 4.0  # two nodes of one place are so many coordinate errors apart at most …
CLOSE = 1e-2  # … and so small a part of the shortest edge there, whatever the error


def type_error(points: np.ndarray) -> np.ndarray:
    """The rounding of each node's coordinates by their type ``[nodes]``, in units of length.

    Float64 coordinates that float32 holds exactly are taken for float32 ones.
    """
    sizes = np.abs(np.asarray(points))
    return _machine(sizes) * sizes.max(axis=1, initial=0.0).astype(np.float64)


def coordinate_error(points: np.ndarray) -> np.ndarray:
    """How far the coordinates of each node may be off ``[nodes]``.

    By the rounding of their type, which is relative to their size; or, where text files carry
    few significant digits, by that: the least number (of five to nine) that reproduces all
    coordinates is taken for theirs.
    """
    sizes = np.abs(np.asarray(points))
    values = sizes[sizes != 0]
    if len(values) == 0:
        return np.zeros(len(points))
    machine = _machine(sizes)
    error = machine * sizes.max(axis=1).astype(np.float64)
    if _dyadic(values):
        return error  # few digits by design
    values = values.astype(np.float64)
    unit = 10.0 ** np.floor(np.log10(values))
    mantissa = values / unit
    for decimals in range(4, 9):
        if 0.5 * 10.0**-decimals < 16 * machine:
            break  # the type itself carries no more
        if (np.abs(mantissa - np.round(mantissa, decimals)) <= 8 * machine * mantissa).all():
            return np.maximum(error, 0.5 * 10.0**-decimals * float(unit.max()))
    return error


def _machine(sizes: np.ndarray) -> float:
    scaled = _scaled(sizes)
    single = sizes.dtype == np.float32 or (scaled == scaled.astype(np.float32)).all()
    return float(np.finfo(np.float32 if single else np.float64).eps)


def _scaled(sizes: np.ndarray) -> np.ndarray:
    """Values over a power of two, with the largest between ½ and 1: units do not matter then."""
    largest = float(sizes.max(initial=0.0))
    return np.ldexp(sizes.astype(np.float64), -int(np.frexp(largest)[1]))


def _dyadic(sizes: np.ndarray) -> bool:
    """Whether all values are multiples of one power of two, of 16 bits at most (0.25, 0.375, …)."""
    grid = _scaled(sizes) * 2.0**16
    return bool((grid == np.round(grid)).all())
