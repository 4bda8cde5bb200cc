"""Results that are kept while the arrays live that they were made of."""

from __future__ import annotations

import weakref
from collections.abc import Callable, Sequence
from typing import Any, Generic, TypeVar

__all__ = ["Remembered"]

Value = TypeVar("Value")

_SIZE = 4  # a mesh before, one after, and what a step is made of


class Remembered(Generic[Value]):
    """A few results, known by the identity of arrays, which nobody changes in place."""

    def __init__(self):
        self._kept: list[tuple[tuple[weakref.ref, ...], Value]] = []

    def get(self, arrays: Sequence[Any], make: Callable[[], Value]) -> Value:
        """The result for these arrays: the one that is known, or a new one."""
        for references, value in self._kept:
            if len(references) == len(arrays) and all(
                reference() is array for reference, array in zip(references, arrays, strict=True)
            ):
                return value
        return self.put(arrays, make())

    def put(self, arrays: Sequence[Any], value: Value) -> Value:
        """Keep a result that is known."""
        alive = [entry for entry in self._kept if all(reference() is not None for reference in entry[0])]
        self._kept = [*alive[1 - _SIZE :], (tuple(map(weakref.ref, arrays)), value)]
        return value
