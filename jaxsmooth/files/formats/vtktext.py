"""Data of VTK's legacy files that meshio (5.3.5) does not know: text, bits, and the old type names in 5.1,
where it takes ``int`` for eight bytes."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator

from jaxsmooth.files.numbers import tokens

__all__ = ["lines_like", "lines_with", "with_sizes", "without_text"]


def lines_with(pattern: re.Pattern[bytes], content: bytes, word: bytes) -> Iterator[re.Match[bytes]]:
    """Where a pattern fits lines that have a word, which is found far faster than the pattern."""
    at = content.find(word)
    while at >= 0:
        line = pattern.match(content, content.rfind(b"\n", 0, at) + 1)
        if line is not None and line.end() >= at:
            yield line
        at = content.find(word, at + len(word))


def lines_like(pattern: re.Pattern[bytes], content: bytes, words: Iterable[bytes]) -> list[re.Match[bytes]]:
    """The same for lines that have one of some words, in their order."""
    found = {line.start(): line for word in words for line in lines_with(pattern, content, word)}
    return [found[start] for start in sorted(found)]


_ARRAY = re.compile(rb"^(\S+)[ \t]+(\d+)[ \t]+(\d+)[ \t]+(string|bit)[ \t]*\r?\n", re.M)
_FIELD = re.compile(rb"^(FIELD[ \t]+\S+[ \t]+)(\d+)(?=[ \t]*\r?\n)", re.M | re.I)


_SIZES = {
    "char": "vtktypeint8",
    "unsigned_char": "vtktypeuint8",
    "short": "vtktypeint16",
    "unsigned_short": "vtktypeuint16",
    "int": "vtktypeint32",
    "unsigned_int": "vtktypeuint32",
    "long": "vtktypeint64",
    "unsigned_long": "vtktypeuint64",
}
_TYPED = re.compile(
    rb"^((?:SCALARS|VECTORS|NORMALS|TENSORS)[ \t]+\S+[ \t]+|\S+[ \t]+\d+[ \t]+\d+[ \t]+)(%s)(?=[ \t\d]*\r?$)"
    % "|".join(_SIZES).encode(),
    re.M,
)


def with_sizes(content: bytes) -> bytes:
    """A file of version 5 with type names that say how many bits they have."""
    parts, at = [], 0
    for found in lines_like(_TYPED, content, (b"char", b"short", b"int", b"long")):
        parts += [content[at : found.start(2)], _SIZES[found[2].decode()].encode()]
        at = found.end(2)
    return b"".join([*parts, content[at:]]) if parts else content


def without_text(content: bytes, binary: bool) -> tuple[bytes, list[str]]:
    """The file without such arrays in its fields, and their names."""
    names = []
    for found in reversed(lines_like(_ARRAY, content, (b"string", b"bit"))):
        count = int(found[2]) * int(found[3])
        fields = list(_FIELD.finditer(content, 0, found.start()))
        if not fields:
            continue
        skip = (_texts if found[4] == b"string" else _bits)(content, found.end(), count, binary)
        field, number = fields[-1], int(fields[-1][2]) - 1
        content = (
            content[: field.start()]
            + field[1]
            + str(number).encode()
            + content[field.end() : found.start()]
            + content[skip:]
        )
        names.append(found[1].decode(errors="replace"))
    return content, names[::-1]


def _texts(content: bytes, at: int, count: int, binary: bool) -> int:
    """The byte behind texts: lines, or behind their lengths, whose first two bits say how long those are."""
    for _ in range(count):
        if binary:
            size = {3: 1, 2: 2, 1: 4, 0: 8}[content[at] >> 6]
            length = int.from_bytes(content[at : at + size], "big") & ((1 << (8 * size - 2)) - 1)
            at += size + length
        else:
            at = content.index(b"\n", at) + 1
    blank = re.compile(rb"\r?\n").match(content, at)  # ends them; not all writers have it in text
    return blank.end() if blank else at


def _bits(content: bytes, at: int, count: int, binary: bool) -> int:
    """The byte behind bits: eight to a byte, or numbers."""
    if binary:
        return content.index(b"\n", at + -(-count // 8)) + 1
    ends = tokens(content, at)[1]
    return content.index(b"\n", int(ends[count - 1])) + 1 if count else at
