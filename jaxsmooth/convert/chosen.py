"""Nodes that are named in a word: a set, a tag, a range of numbers."""

from __future__ import annotations

import difflib
import re

import numpy as np

from jaxsmooth.convert.meshfile import MeshFile

__all__ = ["chosen_nodes"]

_RANGE = re.compile(r"\d+(-\d+)?(,\d+(-\d+)?)*")


def chosen_nodes(file: MeshFile, word: str) -> np.ndarray:
    """The nodes ``[nodes]`` that a word stands for.

    Args:
        file: what was read.
        word: the name of a set; ``DATA=TAG``, the nodes, or the nodes of the cells, whose data of this name
            is TAG (several are joined by commas); or numbers of nodes, counted from 0: ``"0-9,20"``.

    Raises:
        ValueError: no such set, data, tag or node.
    """
    if word in file.named_sets:
        return np.asarray(file.named_sets[word])
    name, equals, tags = word.rpartition("=")
    if equals:
        return _tagged(file, name, tags)
    if _RANGE.fullmatch(word):
        return _numbered(word, len(file.mesh.points))
    near = difflib.get_close_matches(word, file.named_sets, n=2, cutoff=0.4)
    known = ", ".join(file.named_sets) or "none"
    hint = f"did you mean {' or '.join(near)}?" if near else f"the file has {known}"
    raise ValueError(f"unknown set {word!r}; {hint}; a tag is written as DATA=TAG, nodes as 0-9")


def _numbered(word: str, count: int) -> np.ndarray:
    chosen = np.zeros(count, bool)
    for part in word.split(","):
        first, _, last = part.partition("-")
        first, last = int(first), int(last or first)
        if last < first or last >= count:
            raise ValueError(f"nodes {part}: the file has nodes 0 to {count - 1}; name some of these")
        chosen[first : last + 1] = True
    return chosen


def _tagged(file: MeshFile, name: str, words: str) -> np.ndarray:
    try:
        tags = [float(word) for word in words.split(",")]
    except ValueError:
        raise ValueError(f"{name}={words}: a tag is a number; join several by commas") from None
    source, found = file.source, np.zeros(len(file.mesh.points), bool)
    if name in source.point_data:
        found |= _has(source.point_data[name], tags)
    for cells, values in zip(source.cells, source.cell_data.get(name, ()), strict=False):
        found[np.asarray(cells.data)[_has(values, tags)].ravel()] = True
    known = sorted({*source.point_data, *source.cell_data})
    if name not in known:
        near = difflib.get_close_matches(name, known, n=2, cutoff=0.4)
        hint = f"did you mean {' or '.join(near)}?" if near else f"the file has {', '.join(known) or 'none'}"
        raise ValueError(f"unknown data {name!r}; {hint}")
    if not found.any():
        raise ValueError(f"{name}={words}: nothing in the file has this tag")
    return found


def _has(values: object, tags: list[float]) -> np.ndarray:
    values = np.asarray(values)
    if values.dtype.kind not in "iufb":
        return np.zeros(len(values), bool)
    return np.any(np.isin(values.reshape(len(values), -1).astype(float), tags), axis=1)
