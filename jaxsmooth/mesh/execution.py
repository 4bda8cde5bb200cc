"""How the element loop runs: a value that a mesh carries, decided on the host."""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["Execution"]

_CACHED = 4096
"""Elements a chunk on CPU.  A product with 240 thousand linear tetrahedra takes 38 ms in chunks of 4096,
whose intermediates stay in the second-level cache, and several times as long in one pass."""


@dataclass(frozen=True)
class Execution:
    """Attributes: elements a chunk (static), or None for all elements of a block at once."""

    elements: int | None = _CACHED

    @classmethod
    def here(cls) -> Execution:
        """What suits JAX's default device."""
        import jax

        return cls(_CACHED if jax.default_backend() == "cpu" else None)

    def chunk(self, count: int, weight: int = 1) -> int:
        """Elements in a chunk of a block of `count`, for a function that needs `weight` times the memory."""
        return count if self.elements is None else min(count, max(self.elements // weight, 1))

    def portion(self, count: int, weight: int = 1) -> int:
        """Elements in a chunk where only a few of a block of `count` are wanted."""
        wanted = _CACHED // 8 if self.elements is None else self.elements // 8
        least = count // 16 if self.elements is None else 0  # a device is not busy with less
        return min(count, max(wanted // weight, least, 1))
