"""Nodes that are named in a word: a set, a tag, a range of numbers."""

from __future__ import annotations

import difflib
import re

import numpy as np

from jaxsmooth.cells.table import TYPES
from jaxsmooth.convert.meshfile import MeshFile
from jaxsmooth.convert.regions import plain, region_arrays

__all__ = ["chosen_nodes", "tags_of"]

_RANGE = re.compile(r"\d+(-\d+)?(,\d+(-\d+)?)*")


def chosen_nodes(file: MeshFile, word: str) -> np.ndarray:
    """The nodes ``[nodes]`` that a word stands for.

    Args:
        file: what was read.
        word: the name of a set; ``DATA=TAG``, the nodes, or the nodes of the cells, whose data of this name
            is TAG (several are joined by commas); ``2:7``, the nodes of faces with tag 7, and so for other
            dimensions; or numbers of nodes, counted from 0: ``"0-9,20"``.

    Raises:
        ValueError: no such set, data, tag or node.
    """
    if word in file.named_sets:
        return np.asarray(file.named_sets[word])
    if found := re.fullmatch(r"([0-3]):(-?\d+)", word):
        return _of_dimension(file, word, int(found[1]), int(found[2]))
    name, equals, tags = word.rpartition("=")
    if equals:
        return _tagged(file, name, tags)
    if _RANGE.fullmatch(word):
        return _numbered(word, len(file.mesh.points))
    near = difflib.get_close_matches(word, file.named_sets, n=2, cutoff=0.4)
    known = ", ".join(file.named_sets) or "none"
    hint = f"did you mean {' or '.join(near)}?" if near else f"the file has {known}"
    raise ValueError(f"unknown set {word!r}; {hint}; a tag is written as DATA=TAG, nodes as 0-9")


def _of_dimension(file: MeshFile, word: str, dim: int, tag: int) -> np.ndarray:
    known, mask = tags_of(file), np.zeros(len(file.mesh.points), bool)
    found = [nodes for (d, _, number), nodes in known.items() if (d, number) == (dim, tag)]
    if not found:
        there = ", ".join(f"{d}:{number}" for d, _, number in list(known)[:12]) or "none"
        raise ValueError(f"{word}: no cells have this tag; the file has {there} (dimension:tag)")
    for nodes in found:
        mask[nodes] = True
    return mask


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


def tags_of(file: MeshFile) -> dict[tuple[int, str, int], np.ndarray]:
    """Nodes of the cells of every tag: by the dimension of the cells, the name of the array and the tag.

    Of each dimension the first array with a usual name counts that has any tags (`REGION_NAMES`)."""
    cells, found = file.source.cells, {}
    for dim in (3, 2, 1, 0):
        blocks = [k for k, part in enumerate(cells) if len(part) and _dimension(part.type) == dim]
        for name, tags in region_arrays(file.source, blocks):
            if not any(part.any() for part in tags.values()):
                continue
            for tag in np.unique(np.concatenate([*tags.values()])).tolist():
                rows = [plain(cells[k].data)[part == tag].ravel() for k, part in tags.items()]
                found[dim, name, tag] = np.unique(np.concatenate(rows))
            break
    return found


def _dimension(name: str) -> int | None:
    if name == "vertex":
        return 0
    return TYPES[name].dim if name in TYPES else None
