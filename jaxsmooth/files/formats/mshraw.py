"""What a Gmsh file itself says: whether it is whole, and its entities.

meshio (5.3.5) takes sections that end early, wrong counts, and tags of nodes that aren't there; of the
groups of an entity it keeps the first."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from jaxsmooth.convert.checks import parse_numbers
from jaxsmooth.files.formats.mshtypes import NODES_OF

__all__ = ["Entity", "Section", "check_msh", "msh_format", "read_entities", "section_span"]


class Section:
    """The numbers of a section, taken from its begin to its end."""

    def __init__(self, content: bytes, name: str, binary: bool, size: int):
        self.name, self.binary, self.size = name, binary, size
        self.body = content[slice(*section_span(content, name))]
        self.at = 0
        if not binary:
            self.numbers = parse_numbers(self.body, f"its section ${name}")

    def take(self, count: int | np.integer, kind: str = "i") -> np.ndarray:
        """The next numbers: ``i`` integers, ``n`` sizes and tags, ``d`` coordinates."""
        if self.binary:
            dtype = np.dtype({"i": "<i4", "n": f"<u{self.size}", "d": "<f8"}[kind])
            end = self.at + count * dtype.itemsize
            taken = np.frombuffer(self.body[self.at : end], dtype) if end <= len(self.body) else None
        else:
            end = self.at + count
            taken = self.numbers[self.at : end] if end <= len(self.numbers) else None
        if taken is None or count < 0:
            raise ValueError(f"its section ${self.name} ends early; {_CUT}")
        self.at = end
        return taken if kind == "d" else taken.astype(np.int64)

    def line(self) -> int:
        """The number that a line of its own holds, also in binary 2.2 files."""
        if not self.binary:
            return int(self.take(1)[0])
        end = self.body.index(b"\n", self.at)
        number, self.at = int(self.body[self.at : end]), end + 1
        return number

    def end(self) -> None:
        """Raise `ValueError` where numbers are left."""
        rest = self.body[self.at :].strip() if self.binary else self.numbers[self.at :]
        if len(rest):
            raise ValueError(f"its section ${self.name} has more numbers than its counts say; {_CUT}")


_CUT = "the file is damaged or cut short"


def section_span(content: bytes, name: str) -> tuple[int, int]:
    """First byte of what stands in a section, and the byte behind the last; `ValueError` without it."""
    begin = b"$" + name.encode()
    head, at = re.compile(rb"[ \t]*\r?\n"), content.find(begin)
    while at >= 0:  # faster than a pattern for the whole line, and content may be binary
        found = head.match(content, at + len(begin))
        if found is not None and (at == 0 or content[at - 1 : at] == b"\n"):
            return found.end(), content.find(b"$End" + name.encode(), found.end())
        at = content.find(begin, at + 1)
    raise ValueError(f"it has no section ${name}")


def _begins(content: bytes) -> Iterator[bytes]:
    """Names of the sections that begin."""
    head, at = re.compile(rb"\$(?!End)(\w+)[ \t]*(?:\r?\n|$)"), content.find(b"$")
    while at >= 0:
        found = head.match(content, at)
        if found is not None and (at == 0 or content[at - 1 : at] == b"\n"):
            yield found[1]
        at = content.find(b"$", at + 1)


def msh_format(content: bytes) -> tuple[str, bool, int] | None:
    """Version, whether it is binary, and the bytes of a size; Gmsh writes 4 for 4.0."""
    found = re.search(rb"\$MeshFormat\s+(\d(?:\.\d+)?)\s+([01])\s+(\d+)", content[:4096])
    if found is None:
        return None
    version = found[1].decode()
    return "4.0" if version == "4" else version, found[2] == b"1", int(found[3])


def check_msh(content: bytes) -> None:
    """Raise `ValueError` where sections don't end, counts are wrong, or tags of nodes are not there.

    Knows 2.x and 4.1; of 4.0 it looks at the ends of sections only."""
    if (found := msh_format(content)) is None:
        return
    version, binary, size = found
    for name in _begins(content):
        if content.count(b"$End" + name) < 1:
            raise ValueError(f"its section ${name.decode()} has no end; {_CUT}")
    if not re.search(rb"\$End\w+\s*$", content[-4096:]):
        raise ValueError(f"it does not end with the end of a section; {_CUT}")
    if version == "4.0" or b"$Nodes" not in content or b"$Elements" not in content:
        return
    nodes, elements = (Section(content, name, binary, size) for name in ("Nodes", "Elements"))
    tags = _nodes2(nodes) if version[0] == "2" else _nodes4(nodes)
    _check_tags(tags)
    whole = tags[-1] - tags[0] == len(tags) - 1 and bool((np.diff(tags) == 1).all())  # the usual case
    known = tags if whole else np.unique(tags)
    for used in _elements2(elements) if version[0] == "2" else _elements4(elements):
        if whole and used.size and used.min() >= known[0] and used.max() <= known[-1]:
            continue
        at = np.minimum(np.searchsorted(known, used), len(known) - 1)
        missing = known[at] != used
        if missing.any():
            tag = used[missing][0]
            raise ValueError(
                f"an element refers to node {tag}, which its section $Nodes does not have; {_CUT}"
            )


def _check_tags(tags: np.ndarray) -> None:
    if not len(tags):
        raise ValueError("it has no nodes")
    if tags.min() < 1:
        raise ValueError(f"it has a node with the tag {tags.min()}; tags of nodes are counted from 1")
    if not (np.diff(tags) > 0).all() and len(np.unique(tags)) < len(tags):
        values, times = np.unique(tags, return_counts=True)
        raise ValueError(f"it has two nodes with the tag {values[times > 1][0]}; {_CUT}")


def _nodes2(section: Section) -> np.ndarray:
    count = section.line()
    if section.binary:
        table = np.dtype([("tag", "<i4"), ("x", "<f8", (3,))])
        rows = section.body[section.at :]
        if len(rows) < count * table.itemsize:
            section.take(-1)
        tags = np.frombuffer(rows, table, count)["tag"].astype(np.int64)
        section.at += count * table.itemsize
    else:
        tags = section.take(4 * count, "d").reshape(count, 4)[:, 0].astype(np.int64)
    section.end()
    return tags


def _elements2(section: Section) -> Iterator[np.ndarray]:
    """Nodes of the elements, in runs of one type and one number of tags."""
    left = section.line()
    while left:
        if section.binary:
            code, rows, tags = section.take(3)
            width = 1 + tags + _nodes_of(code)
            table = section.take(rows * width).reshape(rows, width)
        else:
            _, code, tags = section.take(3)
            section.at -= 3
            width = 3 + tags + _nodes_of(code)
            most = min(left, (len(section.numbers) - section.at) // width)
            if not most:
                section.take(width)
            table = section.numbers[section.at : section.at + most * width].reshape(most, width)
            other = np.flatnonzero((table[:, 1] != code) | (table[:, 2] != tags))
            rows = int(other[0]) if len(other) else most
            table = section.take(rows * width).reshape(rows, width)
        if rows < 1 or rows > left:
            raise ValueError(f"its section $Elements has more elements than it says; {_CUT}")
        left -= rows
        yield table[:, width - _nodes_of(code) :]
    section.end()


def _nodes_of(code: int | np.integer) -> int:
    if int(code) not in NODES_OF:
        raise ValueError(f"elements of Gmsh's type {code} are not supported")
    return NODES_OF[int(code)]


def _nodes4(section: Section) -> np.ndarray:
    blocks, count = section.take(4, "n")[:2]
    found = [np.zeros(0, np.int64)]
    for _ in range(blocks):
        dim, _, parametric = section.take(3)
        rows = int(section.take(1, "n")[0])
        found.append(section.take(rows, "n"))
        section.take(rows * (3 + dim * bool(parametric)), "d")
    section.end()
    tags = np.concatenate(found)
    if len(tags) != count:
        raise ValueError(f"its section $Nodes has {len(tags)} nodes and says {count}; {_CUT}")
    return tags


def _elements4(section: Section) -> Iterator[np.ndarray]:
    blocks, count = section.take(4, "n")[:2]
    total = 0
    for _ in range(blocks):
        code = section.take(3)[2]
        rows = int(section.take(1, "n")[0])
        width = 1 + _nodes_of(code)
        total += rows
        yield section.take(rows * width, "n").reshape(rows, width)[:, 1:]
    section.end()
    if total != count:
        raise ValueError(f"its section $Elements has {total} elements and says {count}; {_CUT}")


class Entity(NamedTuple):
    """A point, curve, surface or volume of the geometry, or the part of one that is in a partition."""

    dim: int
    tag: int
    groups: list[int]
    box: np.ndarray
    bounds: list[int]
    parent: tuple[int, int] | None


def read_entities(content: bytes) -> list[Entity]:
    """The entities of a file of version 4, those of partitions last."""
    found = msh_format(content)
    if found is None or not found[0].startswith("4"):
        return []
    version, binary, size = found
    return [
        entity
        for name in ("Entities", "PartitionedEntities")
        if b"$" + name.encode() in content
        for entity in _entities(Section(content, name, binary, size), version)
    ]


def _entities(section: Section, version: str) -> Iterator[Entity]:
    parts, parent = section.name == "PartitionedEntities", None
    if parts:
        section.take(1, "n")
        ghosts = section.take(1, "n")[0]
        section.take(2 * ghosts)
    for dim, count in enumerate(section.take(4, "n")):
        for _ in range(count):
            tag = int(section.take(1)[0])
            if parts:
                above, own = section.take(2).tolist()
                parent = above, own
                section.take(section.take(1, "n")[0])  # its partitions
            box = section.take(6 if dim or version == "4.0" else 3, "d")
            groups = section.take(section.take(1, "n")[0]).tolist()
            bounds = section.take(section.take(1, "n")[0]).tolist() if dim else []
            yield Entity(dim, tag, groups, box, bounds, parent)
    section.end()
