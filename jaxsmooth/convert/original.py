"""A file as it was when it was read, so that it can be written again with other coordinates in it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

__all__ = ["KEPT", "Original", "fingerprint"]

KEPT = 64 * 2**20
"""Files of at most so many bytes stay in memory; larger ones are read again when they are needed."""


@dataclass(frozen=True)
class Original:
    """What is known of a file that was read.

    Attributes:
        path: where it was.
        stamp: its size in bytes and the time of its last change in nanoseconds.
        content: its bytes; None for files larger than `KEPT`.
        marks: `fingerprint` of the mesh that was read from it.
    """

    path: Path
    stamp: tuple[int, int]
    content: bytes | None
    marks: tuple[Any, ...]

    @classmethod
    def of(cls, path: Path, source: Any) -> Original:
        """The record of a file that has just been read."""
        state = path.stat()
        content = path.read_bytes() if state.st_size <= KEPT else None
        return cls(path, (state.st_size, state.st_mtime_ns), content, fingerprint(source))

    def read(self) -> bytes | None:
        """Its bytes; None where they are not in memory, and the file is gone or has changed since."""
        if self.content is not None:
            return self.content
        try:
            content, state = self.path.read_bytes(), self.path.stat()
        except OSError:
            return None
        return content if (state.st_size, state.st_mtime_ns) == self.stamp else None


def fingerprint(source: Any) -> tuple[Any, ...]:
    """What tells whether somebody has added or replaced arrays of a `meshio.Mesh` since it was read."""
    held = [("points", id(source.points)), *(("cells", id(cells)) for cells in source.cells)]
    for kind in ("point_data", "cell_data", "point_sets", "cell_sets", "field_data"):
        held += [(kind, name, id(values)) for name, values in getattr(source, kind).items()]
    return tuple(held)
