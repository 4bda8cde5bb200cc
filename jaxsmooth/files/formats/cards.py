"""The cards of Abaqus' input files as text: keyword, options, data lines."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from jaxsmooth.convert.checks import check_last_line

__all__ = ["integers_of", "nodes_of", "read_cards", "set_members"]


def read_cards(path: Path, depth: int = 0) -> Iterator[tuple[str, dict[str, str], list[str]]]:
    """Keyword, options and data lines of every card."""
    text = path.read_text(encoding="utf-8", errors="replace")
    check_last_line(text.encode(), b"**")
    for card in re.split(r"^(?=\*[^*])", text, flags=re.MULTILINE):
        if not card.startswith("*") or card.startswith("**"):
            continue
        lines = [s for line in card.splitlines() if (s := line.strip()) and not s.startswith("**")]
        head = lines.pop(0)
        while head.endswith(",") and lines:
            head += lines.pop(0)
        words = [word.strip() for word in head[1:].split(",")]
        options = {}
        for word in words[1:]:
            name, _, value = word.partition("=")
            options[name.strip().upper()] = value.strip().strip('"')
        key = " ".join(words[0].upper().split())
        if key == "INCLUDE":
            other = path.parent / options.get("INPUT", "")
            if depth > 8 or not other.is_file():
                raise ValueError(f"its *INCLUDE file {options.get('INPUT', '')!r} isn't there")
            yield from read_cards(other, depth + 1)
            continue
        if key in ("NODE", "ELEMENT", "NSET", "ELSET") and "INPUT" in options:
            other = path.parent / options.pop("INPUT")
            if not other.is_file():
                raise ValueError(f"the file {other.name!r} of its *{key} isn't there")
            lines += [s for line in other.read_text().splitlines() if (s := line.strip()) and s[:2] != "**"]
        yield key, options, lines


def integers_of(lines: list[str]) -> np.ndarray:
    """All numbers of data lines."""
    return np.array([word for word in ",".join(lines).split(",") if word.strip()], dtype=np.int64)


def nodes_of(lines: list[str]) -> tuple[np.ndarray, np.ndarray]:
    """Numbers of nodes, and their coordinates ``[nodes, 3]``; what is left out is 0."""
    if not lines:
        return np.zeros(0, np.int64), np.zeros((0, 3))
    rows = [line.rstrip(",").split(",")[:4] for line in lines]
    rows = [[word if word.strip() else "0" for word in row] + ["0"] * (4 - len(row)) for row in rows]
    table = np.char.replace(np.char.upper(np.array(rows)), "D", "E")  # Fortran's exponent
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
