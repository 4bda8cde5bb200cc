"""The cards of Abaqus' input files as text: keyword, options, data lines."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from jaxsmooth.convert.checks import check_last_line, parse_numbers
from jaxsmooth.files.numbers import Places

__all__ = ["Card", "integers_of", "node_places", "nodes_of", "read_cards", "set_members"]


@dataclass(frozen=True)
class Card:
    """A keyword with its options and data lines.

    Attributes:
        key: the keyword in capitals.
        options: by name in capitals.
        lines: data lines without comments.
        span: first byte of the data lines in the file, and the byte behind the last; None where they are in
            another file.
        file: that file, relative to the folder of the first.
    """

    key: str
    options: dict[str, str]
    lines: list[str]
    span: tuple[int, int] | None
    file: str | None = None


def read_cards(
    content: bytes, folder: Path, wanted: frozenset[str] | None = None, depth: int = 0
) -> Iterator[Card]:
    """All cards of a file in a folder, those of included files in their places.

    Only cards with the `wanted` keywords have their data lines; None for all."""
    check_last_line(content, b"**")
    starts = [found.start() for found in re.finditer(rb"^\*(?=[^*])", content, re.M)]
    for start, end in pairwise([*starts, len(content)]):
        head, start = _head(content, start, end)
        words = [word.strip() for word in head[1:].split(",")]
        options = {}
        for word in words[1:]:
            name, _, value = word.partition("=")
            options[name.strip().upper()] = value.strip().strip('"')
        key = " ".join(words[0].upper().split())
        if key == "INCLUDE":
            other = folder / options.get("INPUT", "")
            if depth > 8 or not other.is_file():
                raise ValueError(f"its *INCLUDE file {options.get('INPUT', '')!r} isn't there")
            yield Card(key, options, [], None, _relative(other, folder))
            for card in read_cards(other.read_bytes(), other.parent, wanted, depth + 1):
                yield replace(
                    card, span=None, file=_relative(other.parent / (card.file or other.name), folder)
                )
            continue
        lines, file = [], None
        if wanted is None or key in wanted:
            lines = _lines(content[start:end])
        if key in ("NODE", "ELEMENT", "NSET", "ELSET") and "INPUT" in options:
            other = folder / options.pop("INPUT")
            if not other.is_file():
                raise ValueError(f"the file {other.name!r} of its *{key} isn't there")
            lines, file = lines + _lines(other.read_bytes()), _relative(other, folder)
        yield Card(key, options, lines, (start, end) if file is None else None, file)


def _relative(path: Path, folder: Path) -> str:
    return os.path.relpath(path, folder)


def _head(content: bytes, start: int, end: int) -> tuple[str, int]:
    """The line of the keyword, with those that continue it, and where the data lines begin."""
    head = ""
    while start < end and (not head or head.endswith(",")):
        line, start = start, content.find(b"\n", start, end) + 1 or end
        more = _lines(content[line:start])
        head += more[0] if more else ""
    return head, start


def _lines(content: bytes) -> list[str]:
    """Data lines, without blank ones and comments."""
    text = content.decode(errors="replace")
    return [s for line in text.splitlines() if (s := line.strip()) and not s.startswith("**")]


def node_places(content: bytes, start: int, end: int) -> Places:
    """Where the coordinates of nodes stand in data lines, as `nodes_of` reads them; (0, 0) for none."""
    field = rb"(?:,[ \t]*([^,\r\n]*?)[ \t]*(?=[,\r\n]))?"
    line = re.compile(rb"^[ \t]*(?!\*\*)[^,\s][^,\r\n]*(?=[,\r\n])" + 3 * field, re.M)
    spans = [[found.span(k) for k in (1, 2, 3)] for found in line.finditer(content, start, end)]
    table = np.maximum(np.array(spans, np.int64).reshape(-1, 3, 2), 0)
    return Places(table[..., 0], table[..., 1])


def integers_of(lines: list[str]) -> np.ndarray:
    """All numbers of data lines."""
    return parse_numbers(" ".join(lines).replace(",", " "), "one of its cards", np.int64)


def nodes_of(lines: list[str]) -> tuple[np.ndarray, np.ndarray]:
    """Numbers of nodes, and their coordinates ``[nodes, 3]``; what is left out is 0."""
    if not lines:
        return np.zeros(0, np.int64), np.zeros((0, 3))
    commas = {line.rstrip(",").count(",") for line in lines}
    if commas in ({2}, {3}):  # the usual case, if no field is empty
        text = " ".join(lines).replace(",", " ").upper().replace("D", "E")  # Fortran's exponent
        numbers, width = parse_numbers(text, "one of its node cards"), 1 + commas.pop()
        if len(numbers) == width * len(lines):
            table = numbers.reshape(-1, width)
            return table[:, 0].astype(np.int64), np.pad(table[:, 1:], ((0, 0), (0, 4 - width)))
    rows = [line.rstrip(",").split(",")[:4] for line in lines]
    rows = [[word if word.strip() else "0" for word in row] + ["0"] * (4 - len(row)) for row in rows]
    table = np.char.replace(np.char.upper(np.array(rows)), "D", "E")
    return table[:, 0].astype(np.int64), table[:, 1:].astype(np.float64)


def set_members(lines: list[str], options: dict[str, str]) -> list:
    """Members of a set: arrays of numbers, and names of other sets."""
    words = [[word.strip() for word in line.split(",") if word.strip()] for line in lines]
    if "GENERATE" in options:
        ranges = [[int(word) for word in row] for row in words]
        return [np.arange(r[0], r[1] + 1, r[2] if len(r) > 2 else 1) for r in ranges]
    flat = [word for row in words for word in row]
    numbers = [word for word in flat if word.lstrip("+-").isdigit()]
    names = [word.strip('"') for word in flat if not word.lstrip("+-").isdigit()]
    return [np.array(numbers, dtype=np.int64), *names]
