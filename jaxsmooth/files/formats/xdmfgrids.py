"""XDMF files where they stand: which grid is read, and other coordinates for it.

The description is XML; the numbers are in it, or in HDF5 files beside it.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
from jaxtyping import Float

from jaxsmooth.files.formats.hdf5 import read_array, replace_array
from jaxsmooth.files.formats.record import Patched, Source, UnpatchableError
from jaxsmooth.files.numbers import Places, check_columns, check_old, put_text, tokens

__all__ = ["only_grid", "patch_xdmf"]


def only_grid(root: ElementTree.Element) -> list[str]:
    """Leave the first uniform grid in the domain, which is what meshio (5.3.5) wants; returns notes."""
    domain = root.find("Domain")
    grids = [] if domain is None else [g for g in domain.iter("Grid") if g.find("Geometry") is not None]
    if domain is None or not grids or list(domain) == grids[:1]:
        return []
    for child in list(domain):
        domain.remove(child)
    for child in [child for child in grids[0] if child.tag == "Time"]:
        grids[0].remove(child)
    domain.append(grids[0])
    name = grids[0].get("Name", "")
    return [
        f"the mesh and data of the first grid of the XDMF file ({name}) are read; others stay in XDMF files"
    ]


def _items(content: bytes, within: str) -> Iterator[tuple[dict[str, str], tuple[int, int]]]:
    """Attributes of the data items in elements of a name, and where their text is."""
    pattern = rb"<%s\b[^>]*>\s*<DataItem\b([^>]*)>([^<]*)</DataItem>" % within.encode()
    for found in re.finditer(pattern, content):
        pairs = re.findall(rb"(\w+)\s*=\s*[\"']([^\"']*)[\"']", found[1])
        yield {name.decode(): value.decode() for name, value in pairs}, found.span(2)


def patch_xdmf(
    source: Source, old: Float[np.ndarray, "nodes dim"], new: Float[np.ndarray, "nodes dim"]
) -> Patched:
    """The file, and those beside it, with other coordinates.

    Files with numbers are copied under names that fit the output's, and all grids must have one geometry."""
    content = re.sub(rb"<!--.*?-->", lambda found: b" " * len(found[0]), source.content, flags=re.DOTALL)
    items = list(_items(content, "Geometry"))
    texts = {content[start:end].strip() for _, (start, end) in items}
    if len(texts) != 1:
        raise UnpatchableError(f"its grids have {len(texts)} geometries of their own")
    own, (start, end) = items[0]
    kind, text = own.get("Format", "XML"), texts.pop().decode()
    if "Reference" in own:
        raise UnpatchableError("its geometry is a reference")
    if kind == "XML":
        if len(items) != 1:
            raise UnpatchableError("its geometry stands there more than once")
        starts, ends = tokens(source.content, start, end)
        shape = (len(old), -1)
        return Patched(
            put_text(source.content, Places(starts.reshape(shape), ends.reshape(shape)), old, new),
            refers=tuple(_others(content)),
        )
    name, _, path = text.partition(":")
    if kind != "HDF":
        raise UnpatchableError(f"its coordinates are in the format {kind}")
    before = (source.path.parent / name).read_bytes()
    after = _in_hdf5(before, path.strip("/"), old, new)
    return _renamed(source, content, name, after)


def _in_hdf5(content: bytes, path: str, old: np.ndarray, new: np.ndarray) -> bytes:
    found = read_array(content, path)
    check_old(found, old)
    check_columns(found.shape[1], old, new)
    return replace_array(content, path, new[:, : found.shape[1]])


def _others(content: bytes) -> list[str]:
    """Names of all files that the numbers are in."""
    texts = re.findall(rb"<DataItem\b[^>]*Format\s*=\s*[\"'](?:HDF|Binary)[\"'][^>]*>([^<]*)<", content)
    return list(dict.fromkeys(text.decode().partition(":")[0].strip() for text in texts))


def _renamed(source: Source, content: bytes, changed: str, after: bytes) -> Patched:
    """Copies of all files with numbers, one of them changed, and the description with their new names.

    Where output and input are one file, that one is replaced, and the others stay."""
    in_place = source.output.resolve() == source.path.resolve()
    names, companions = {}, {}
    for name in _others(content):
        plain = Path(name)
        if plain.name != name:
            raise UnpatchableError(f"its file {name} is in another folder")
        stem, old = source.output.stem, source.path.stem
        same = plain.stem == old or len(_others(content)) == 1
        names[name] = name if in_place else f"{stem}{plain.suffix}" if same else f"{stem}-{name}"
        if name == changed:
            companions[names[name]] = after
        elif not in_place:
            companions[names[name]] = (source.path.parent / name).read_bytes()
    if len(set(names.values())) < len(names):
        raise UnpatchableError("its files would have one name")

    def other(found: re.Match) -> bytes:
        name = names.get(found[2].decode())
        return found[1] + name.encode() + found[3] if name is not None else found[0]

    pattern = rb"(<DataItem\b[^>]*>\s*)([^<>:\s]+)(\s*[:<])"
    inputs = () if in_place else tuple(source.path.parent / name for name in names)
    stay = tuple(name for name in names.values() if name not in companions)
    return Patched(re.sub(pattern, other, source.content), companions=companions, inputs=inputs, refers=stay)
