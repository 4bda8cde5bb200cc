"""Damaged files: each is refused in one sentence, or read whole, or a note says what is missing.

    python -m benchmarks.files.damaged [--files 300]

makes files of every format, damages copies of them at random, and gives them to the command line.  Prints how
many ended how, and the name and damage of every file that was read with other elements and without a note.
Exit code 1 if there is one.
"""

from __future__ import annotations

import argparse
import collections
import contextlib
import io
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np

import jaxsmooth as js
from benchmarks.files.making import MAKERS, make
from jaxsmooth.cli import BAD_INPUT
from jaxsmooth.cli import main as command
from jaxsmooth.convert.checks import MeshFileError


def main() -> int:
    """Damage files, and count what comes of it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--files", type=int, default=300, help="number of damaged files")
    options = parser.parse_args()
    ends, wrong = collections.Counter(), []
    with tempfile.TemporaryDirectory() as folder:
        inputs, place = Path(folder, "in"), Path(folder, "damaged")
        inputs.mkdir()
        place.mkdir()
        whole = [(path, _elements(path)) for name in MAKERS if (path := make(name, inputs)) is not None]
        for number in range(options.files):
            path, elements = whole[number % len(whole)]
            damage = DAMAGES[number // len(whole) % len(DAMAGES)]
            data = damage(np.random.default_rng(number), path.read_bytes())
            copy = place / path.name
            copy.write_bytes(data)
            end = _end(copy, elements)
            ends[end] += 1
            if end.startswith("WRONG"):
                wrong.append(f"{number}: {path.name}, {damage.__name__}: {end}")
                print(wrong[-1], flush=True)
    for end, count in sorted(ends.items()):
        print(f"{count:5d} {end}")
    return int(bool(wrong))


def _elements(path: Path) -> int:
    return sum(len(nodes) for nodes in js.read(path).mesh.connectivity)


def _end(path: Path, elements: int) -> str:
    """What the command line does with a file, and whether elements are missing."""
    said, shown = io.StringIO(), io.StringIO()
    with contextlib.redirect_stderr(said), contextlib.redirect_stdout(shown):
        code = command(["info", str(path)])
    lines = said.getvalue().strip().splitlines()
    if code == BAD_INPUT:
        return "refused in one sentence" if len(lines) == 1 else f"WRONG: {len(lines)} lines: {lines}"
    if code not in (0, 3):  # 3: there are inverted elements
        return f"WRONG: exit code {code}: {lines}"
    try:
        file = js.read(path)
    except MeshFileError as error:
        return f"WRONG: info takes what read refuses: {error}"
    found = sum(len(nodes) for nodes in file.mesh.connectivity)
    if found == elements:
        return "read whole"
    return "read, with a note" if file.notes else f"WRONG: {elements} elements became {found}, without a note"


def cut(rng: np.random.Generator, data: bytes) -> bytes:
    """The end is missing."""
    return data[: rng.integers(1, max(len(data) - 20, 2))]


def hole(rng: np.random.Generator, data: bytes) -> bytes:
    """A part in the middle is missing."""
    start = rng.integers(len(data) // 4, len(data) - 2)
    return data[:start] + data[start + rng.integers(1, 200) :]


def zeros(rng: np.random.Generator, data: bytes) -> bytes:
    """A part is overwritten by zeros, as after a crash."""
    start = rng.integers(0, len(data) - 2)
    length = min(int(rng.integers(1, 512)), len(data) - start)
    return data[:start] + bytes(length) + data[start + length :]


def flipped(rng: np.random.Generator, data: bytes) -> bytes:
    """Eight bytes have a bit flipped."""
    changed = bytearray(data)
    for place in rng.integers(0, len(data), 8):
        changed[place] ^= 1 << rng.integers(8)
    return bytes(changed)


def swapped(rng: np.random.Generator, data: bytes) -> bytes:
    """Two parts have changed places."""
    a, b, c = np.sort(rng.integers(0, len(data), 3))
    return data[:a] + data[b:c] + data[a:b] + data[c:]


DAMAGES: tuple[Callable[[np.random.Generator, bytes], bytes], ...] = (cut, hole, zeros, flipped, swapped)


if __name__ == "__main__":
    raise SystemExit(main())
