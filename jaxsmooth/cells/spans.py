"""Spans of shape functions: polynomials, and the rational functions of pyramids.

A span is written as text: its functions with blanks between them, each a sum of monomials that are
written as exponent digits.  ``"00 10 01"`` is 1, x, y; ``"11-21-12"`` is the bubble xy − x²y − xy² of a
triangle; ``"110/1"`` is xy / (1 − z), ``"220/2"`` is x²y² / (1 − z)².
"""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np

__all__ = ["APEX", "Span", "tensor"]

Array = np.ndarray

APEX = 2.0**-40  # the distance from the apex of a pyramid that stands for the apex
_FUNCTION = re.compile(r"[+-]?\d+(?:/\d)?(?:[+-]\d+(?:/\d)?)*")
_MONOMIAL = re.compile(r"([+-]?)(\d+)(?:/(\d))?")


@dataclass(frozen=True, eq=False)
class Span:
    """The span of `k` sums of `m` monomials.

    Attributes:
        powers: exponents of the natural coordinates ``[m, dim]``.
        poles: exponents ``[m]`` of 1 / (1 − z).
        sums: what each function takes of each monomial ``[k, m]``.
    """

    powers: Array
    poles: Array
    sums: Array

    @classmethod
    def of(cls, text: str) -> Span:
        """The span that a text says, see the module.  Raises `ValueError` for other texts."""
        functions, found = text.split(), {}
        rows = []
        for function in functions:
            if not _FUNCTION.fullmatch(function):
                raise ValueError(f"{function!r} is no function of a span; write monomials as in '11-21-12'")
            rows.append({})
            for sign, digits, pole in _MONOMIAL.findall(function):
                column = found.setdefault((digits, int(pole or 0)), len(found))
                rows[-1][column] = rows[-1].get(column, 0.0) + (-1.0 if sign == "-" else 1.0)
        if len({len(digits) for digits, _ in found}) != 1:
            raise ValueError(f"the functions {text!r} need as many exponents each, one a coordinate")
        sums = np.zeros((len(rows), len(found)))
        for row, terms in enumerate(rows):
            sums[row, list(terms)] = list(terms.values())
        powers = np.array([[int(digit) for digit in digits] for digits, _ in found])
        return cls(powers, np.array([pole for _, pole in found]), sums)

    @property
    def k(self) -> int:
        """Number of functions."""
        return len(self.sums)

    @property
    def dim(self) -> int:
        """Number of natural coordinates."""
        return self.powers.shape[1]

    def at(self, points: Array) -> tuple[Array, Array]:
        """Values ``[points, k]`` and derivatives ``[points, k, dim]`` at natural points ``[points, dim]``.

        At an apex x and y are zero, and so are all functions with a pole."""
        height = np.maximum(1.0 - points[:, -1:], APEX)
        divisor = height**self.poles
        values = np.prod(points[:, None, :] ** self.powers, axis=-1) / divisor
        slopes = np.empty((*values.shape, self.dim))
        for axis in range(self.dim):
            lowered = self.powers.copy()
            lowered[:, axis] = np.maximum(lowered[:, axis] - 1, 0)
            falling = self.powers[:, axis] * np.prod(points[:, None, :] ** lowered, axis=-1)
            slopes[..., axis] = falling / divisor
        slopes[..., -1] += self.poles * values / height
        return values @ self.sums.T, np.einsum("pmd,km->pkd", slopes, self.sums)


def tensor(first: str, second: str) -> str:
    """The products of the monomials of two texts, whose coordinates are different ones."""
    return " ".join(a + b for a in first.split() for b in second.split())
