"""The nodes of a Gmsh file where they stand: other coordinates for them, and no parameters for meshio.

The section $Nodes of the versions, from the manual's chapter "MSH file format":

- 2.x: the number of nodes; then ``tag x y z`` a node;
- 4.0: the numbers of blocks and nodes; a block is ``tag dim parametric number``, then ``tag x y z`` a node;
- 4.1: as 4.0 with two more numbers; a block is ``dim tag parametric number``, then all tags, then ``x y z`` a
  node.

Where `parametric` is not 0, as many parameters as the entity has dimensions follow the coordinates.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from jaxsmooth.files.formats.mshraw import msh_format, section_span
from jaxsmooth.files.formats.record import Patched, Source, UnpatchableError
from jaxsmooth.files.numbers import Places, put_binary, put_text, tokens

__all__ = ["patch_msh", "without_parameters"]


@dataclass(frozen=True)
class _Block:
    """Nodes of one entity.

    Attributes:
        head: first byte, and the byte behind the last, of its number `parametric`.
        coordinates: where they begin: the index of a word in text, of a byte in binary files ``[nodes, 3]``.
        rest: the same for each node's parameters: first word or byte, and behind the last ``[nodes, 2]``.
        parametric: whether there are any.
    """

    head: tuple[int, int]
    coordinates: Int[np.ndarray, "nodes 3"]
    rest: Int[np.ndarray, "nodes 2"]
    parametric: bool


def patch_msh(
    source: Source, old: Float[np.ndarray, "nodes dim"], new: Float[np.ndarray, "nodes dim"]
) -> Patched:
    """The file with other coordinates; parameters (u, v, w) of nodes stay as they are."""
    content = source.content
    binary, starts, ends, blocks = _nodes(content)
    where = np.concatenate([np.zeros((0, 3), np.int64), *(block.coordinates for block in blocks)])
    if binary:
        content = put_binary(content, where, np.dtype("<f8"), old, new)
    else:
        content = put_text(content, Places(starts[where], ends[where]), old, new)
    parametric = np.concatenate([np.full(len(b.rest), b.parametric) for b in blocks] or [np.zeros(0, bool)])
    stale = int((parametric & (old != new).any(axis=1)).sum())
    told = f"the parametric coordinates of {stale} nodes that move are kept as they are in the file"
    return Patched(content, (told,) if stale else (), proven=True)


def without_parameters(content: bytes) -> bytes:
    """A file without parametric coordinates, which meshio (5.3.5) does not know; as it is, if it has none."""
    if (found := msh_format(content)) is None or not found[0].startswith("4") or b"$Nodes" not in content:
        return content
    binary, starts, ends, blocks = _nodes(content)
    cuts, zero = [], (0).to_bytes(4, "little") if binary else b"0"
    for block in blocks:
        if block.parametric and len(block.rest):
            first, last = block.rest[:, 0], block.rest[:, 1]
            spans = (first, last) if binary else (starts[first], ends[last - 1])
            cuts.append((*block.head, zero))
            cuts += [(a, b, b"") for a, b in zip(spans[0].tolist(), spans[1].tolist(), strict=True) if a < b]
        elif block.parametric:
            cuts.append((*block.head, zero))
    parts, at = [], 0
    for start, end, text in cuts:
        parts += [content[at:start], text]
        at = end
    return b"".join([*parts, content[at:]]) if cuts else content


def _nodes(content: bytes) -> tuple[bool, np.ndarray, np.ndarray, list[_Block]]:
    """Whether the file is binary; first and last bytes of the words of $Nodes in text; the blocks."""
    found = msh_format(content)
    if found is None:
        raise UnpatchableError("it does not say its version")
    version, binary, size = found
    start, end = section_span(content, "Nodes")
    walk = {"2": _walk2, "4": _walk40 if version == "4.0" else _walk41}.get(version[0])
    if walk is None:
        raise UnpatchableError(f"its version {version} is not known")
    if binary:
        nothing = np.zeros(0, np.int64)
        return True, nothing, nothing, list(walk(_Bytes(content, start, end, size)))
    starts, ends = tokens(content, start, end)
    return False, starts, ends, list(walk(_Words(content, starts, ends)))


class _Words:
    """The numbers of a section as text."""

    double = tag = 1

    def __init__(self, content: bytes, starts: np.ndarray, ends: np.ndarray):
        self._content, self._starts, self._ends, self.at = content, starts, ends, 0

    def integer(self, kind: str) -> int:
        """The next number."""
        start, end = self.span(kind)
        self.at += 1
        return int(self._content[start:end])

    def span(self, kind: str) -> tuple[int, int]:
        """Where the next number stands."""
        if self.at >= len(self._starts):
            raise UnpatchableError("its section $Nodes ends early")
        return int(self._starts[self.at]), int(self._ends[self.at])

    line = integer


class _Bytes:
    """The numbers of a section in binary."""

    double, tag = 8, 4

    def __init__(self, content: bytes, start: int, end: int, size: int):
        self._content, self._size, self.at, self._end = content, size, start, end
        self.tag41 = size

    def integer(self, kind: str) -> int:
        """The next number: ``i`` of four bytes, ``n`` of the file's size."""
        start, self.at = self.span(kind)
        return int.from_bytes(self._content[start : self.at], "little", signed=kind == "i")

    def span(self, kind: str) -> tuple[int, int]:
        """Where the next number stands."""
        end = self.at + (4 if kind == "i" else self._size)
        if end > self._end:
            raise UnpatchableError("its section $Nodes ends early")
        return self.at, end

    def line(self, kind: str) -> int:
        """The number that has a line of its own, as text."""
        end = self._content.index(b"\n", self.at)
        start, self.at = self.at, end + 1
        return int(self._content[start:end])


def _block(section: _Words | _Bytes, head: tuple[int, int], count: int, lead: int, parameters: int) -> _Block:
    """The next `count` rows: `lead` words or bytes, three coordinates, and parameters."""
    width = lead + section.double * (3 + parameters)
    first = section.at + width * np.arange(count, dtype=np.int64)[:, None] + lead
    section.at += width * count
    behind = first + section.double * 3
    rest = np.concatenate([behind, behind + section.double * parameters], axis=1)
    return _Block(head, first + section.double * np.arange(3), rest, parameters > 0)


def _walk2(section: _Words | _Bytes) -> Iterator[_Block]:
    count = section.line("n")
    yield _block(section, (0, 0), count, section.tag, 0)


def _walk40(section: _Words | _Bytes) -> Iterator[_Block]:
    blocks, _ = section.integer("n"), section.integer("n")
    for _ in range(blocks):
        _, dim = section.integer("i"), section.integer("i")
        head = section.span("i")
        parametric, count = section.integer("i"), section.integer("n")
        yield _block(section, head, count, section.tag, dim * bool(parametric))


def _walk41(section: _Words | _Bytes) -> Iterator[_Block]:
    blocks, _, _, _ = (section.integer("n") for _ in range(4))
    for _ in range(blocks):
        dim, _ = section.integer("i"), section.integer("i")
        head = section.span("i")
        parametric, count = section.integer("i"), section.integer("n")
        section.at += count * (section.tag41 if isinstance(section, _Bytes) else 1)
        yield _block(section, head, count, 0, dim * bool(parametric))
