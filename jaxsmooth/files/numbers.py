"""Numbers where they stand in a file: found, and replaced, with all other bytes as they are.

In text, a number that does not change keeps its letters.  One that does is written as its neighbours are
(with or without exponent, with as many decimals at least), and with as many digits as give it back exactly.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from jaxsmooth.files.formats.record import UnpatchableError

__all__ = [
    "Places",
    "blanked",
    "check_columns",
    "check_old",
    "put_binary",
    "put_text",
    "read_numbers",
    "tokens",
]


@dataclass(frozen=True)
class Places:
    """Where the coordinates of nodes stand in a text.

    Attributes:
        starts: the first byte of each ``[nodes, dim]``.
        ends: the byte behind the last of each.
    """

    starts: Int[np.ndarray, "nodes dim"]
    ends: Int[np.ndarray, "nodes dim"]


def tokens(content: bytes, start: int = 0, end: int | None = None) -> tuple[np.ndarray, np.ndarray]:
    """First bytes, and bytes behind the last, of the words between blanks in a part of a text."""
    data = np.frombuffer(content[start:end], np.uint8)
    blank = np.concatenate([[True], data <= 32, [True]])
    edges = np.flatnonzero(blank[1:] != blank[:-1]) + start
    return edges[0::2], edges[1::2]


def blanked(content: bytes, comment: bytes, end: bytes = b"\n") -> bytes:
    """The text with blanks for its comments, which reach from `comment` to the end of their lines."""
    pattern = re.escape(comment) + b"[^" + end + b"]*"
    return re.sub(pattern, lambda found: b" " * len(found[0]), content) if comment in content else content


def read_numbers(content: bytes, places: Places) -> Float[np.ndarray, "nodes dim"]:
    """The numbers at these places; an empty place is 0, and Fortran's D an exponent."""
    pairs = zip(places.starts.ravel().tolist(), places.ends.ravel().tolist(), strict=True)
    words = [content[start:end] for start, end in pairs]
    try:
        values = [float(word) for word in words]
    except ValueError:
        values = [float(re.sub(b"[dD]", b"e", word) or b"0") for word in words]
    return np.array(values).reshape(places.starts.shape)


def check_old(
    found: Float[np.ndarray, "found width"], old: Float[np.ndarray, "nodes dim"], tolerance: float = 0.0
) -> None:
    """Raise `UnpatchableError` where what stands in a file isn't what was read from it.

    Args:
        found: numbers at the places of the coordinates; columns that the file does not have are 0 in `old`.
        old: the coordinates as they were read.
        tolerance: of the largest coordinate.
    """
    width = found.shape[1]
    if len(found) != len(old) or width > old.shape[1] or old[:, width:].any():
        raise UnpatchableError(
            f"it has {len(found)} nodes with {width} coordinates where {len(old)} were read"
        )
    away = np.abs(found.astype(old.dtype) - old[:, :width])
    if len(old) and not away.max() <= tolerance * np.abs(old).max():
        node = int(away.max(axis=1).argmax())
        raise UnpatchableError(
            f"the coordinates of its node {node} (counted from 0) are not where they should be"
        )


def check_columns(width: int, old: np.ndarray, new: np.ndarray) -> None:
    """Raise `UnpatchableError` where coordinates change that a file does not have."""
    if not np.array_equal(old[:, width:], new[:, width:]):
        raise UnpatchableError(f"it has {width} coordinates a node, and others change")


# --- Text ----------------------------------------------------------------------------------


def put_text(
    content: bytes,
    places: Places,
    old: Float[np.ndarray, "nodes dim"],
    new: Float[np.ndarray, "nodes dim"],
) -> bytes:
    """Write new coordinates into a text.

    Args:
        content: the text.
        places: where its coordinates stand.
        old: what they are, as they were read.
        new: what they become.

    Raises:
        UnpatchableError: something else stands there.
    """
    width = places.starts.shape[1]
    check_old(read_numbers(content, places), old)
    check_columns(width, old, new)
    changed = (old != new)[:, :width]
    starts, ends = places.starts[changed], places.ends[changed]
    order = np.argsort(starts)
    write = _style([content[s:e] for s, e in _some(places)], old.dtype == np.float32)
    words = [write(value) for value in new[:, :width][changed][order].tolist()]
    return _spliced(content, starts[order].tolist(), ends[order].tolist(), words, _aligned(content, places))


def _some(places: Places) -> list[tuple[int, int]]:
    """Places spread over all of them, a thousand at most."""
    starts, ends = places.starts.ravel(), places.ends.ravel()
    step = max(len(starts) // 1000, 1)
    return list(zip(starts[::step].tolist(), ends[::step].tolist(), strict=True))


def _style(words: list[bytes], single: bool) -> Callable[[float], bytes]:
    """How numbers like these are written, with all digits of double (or single) precision."""
    split = [re.fullmatch(rb"[+-]?\d*\.?(\d*)(?:([eEdD])[+-]?(\d+))?", word) for word in words]
    found = [one for one in split if one is not None]
    letters = [one[2] for one in found if one[2]]
    letter = letters[0].decode() if letters else "e"
    if 2 * len(letters) > len(found):
        digits = max(8 if single else 16, *(len(one[1]) for one in found))
        powers = min(len(one[3]) for one in found if one[3])

        def scientific(value: float) -> bytes:
            mantissa, _, power = f"{value:.{digits}e}".partition("e")
            return f"{mantissa}{letter}{power[0]}{power[1:].zfill(powers)}".encode()

        simple = letter == "e" and powers <= 2
        return (lambda value: b"%.*e" % (digits, value)) if simple else scientific
    decimals = {len(one[1]) for one in found if not one[2]}
    least = decimals.pop() if len(decimals) == 1 else 0

    def general(value: float) -> bytes:
        text = str(np.float32(value)) if single else repr(value)
        if "e" in text:
            return text.replace("e", letter).encode()
        return (text + "0" * (least - len(text.partition(".")[2]))).encode()

    return general


def _aligned(content: bytes, places: Places) -> bool:
    """Whether numbers stand in columns: some have more than one blank before them."""
    return any(content[max(start - 2, 0) : start] == b"  " for start, _ in _some(places))


def _spliced(content: bytes, starts: list[int], ends: list[int], words: list[bytes], aligned: bool) -> bytes:
    """The text with other words; those in columns keep their right end, where blanks leave the room."""
    parts, at = [], 0
    for start, end, word in zip(starts, ends, words, strict=True):
        if aligned:
            need = len(word) - (end - start)
            if need < 0:
                word = b" " * -need + word
            while need > 0 and start - 2 >= at and content[start - 2 : start] == b"  ":
                start, need = start - 1, need - 1
        parts += [content[at:start], word]
        at = end
    return b"".join([*parts, content[at:]])


# --- Binary --------------------------------------------------------------------------------


def put_binary(
    content: bytes,
    offsets: Int[np.ndarray, "nodes dim"],
    dtype: np.dtype,
    old: Float[np.ndarray, "nodes dim"],
    new: Float[np.ndarray, "nodes dim"],
) -> bytes:
    """Write new coordinates into binary content.

    Args:
        content: the bytes.
        offsets: where each coordinate stands.
        dtype: of the file, with its byte order.
        old: what they are, as they were read.
        new: what they become; rounded to the file's precision.

    Raises:
        UnpatchableError: something else stands there, or the file holds whole numbers.
    """
    if dtype.kind != "f":
        raise UnpatchableError("its coordinates are whole numbers")
    width = offsets.shape[1]
    data = np.frombuffer(bytearray(content), np.uint8)
    if offsets.size and (offsets.min() < 0 or offsets.max() + dtype.itemsize > len(data)):
        raise UnpatchableError("its coordinates are not where they should be")
    span = np.arange(dtype.itemsize)
    found = np.ascontiguousarray(data[offsets[..., None] + span]).view(dtype)[..., 0]
    check_old(found.astype(np.float64), old)
    check_columns(width, old, new)
    changed = (old != new)[:, :width]
    values = new[:, :width][changed].astype(dtype)
    data[offsets[changed][:, None] + span] = values[:, None].view(np.uint8)
    return data.tobytes()
