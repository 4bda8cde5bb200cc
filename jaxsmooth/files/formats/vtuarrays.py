"""Arrays of VTK's XML files where they stand: other values for the coordinates, all else as it is.

From "XML file formats" in VTK's documentation.  The values of a ``DataArray`` are text, base64 or raw bytes,
in the element itself or behind the underscore of ``AppendedData``.  Bytes begin with a header: the number of
bytes or, if the file is compressed, the number of blocks, their size, the size of the last (0: the same),
and the compressed size of each.
"""

from __future__ import annotations

import base64
import binascii
import lzma
import re
import zlib
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from jaxsmooth.files.formats.record import UnpatchableError
from jaxsmooth.files.numbers import Places, put_binary, put_text, tokens

__all__ = ["replace_points"]

_FLOATS = {"Float32": "f4", "Float64": "f8"}
_LEVELS = {0: 1, 1: 5, 2: 6, 3: 9}  # what zlib's header says of the level, and the usual one of each


@dataclass(frozen=True)
class _Layout:
    """How a file stores its arrays.

    Attributes:
        order: of bytes, ``"<"`` or ``">"``.
        header: type of the numbers in headers.
        compressor: its name in the file, or ``""``.
        head: where the XML before the appended data ends.
        appended: where those begin, behind the underscore; −1 without.
        raw: whether they are raw bytes.
    """

    order: str
    header: np.dtype
    compressor: str
    head: int
    appended: int
    raw: bool


def _attributes(tag: bytes) -> dict[str, str]:
    found = re.findall(rb"([\w:]+)\s*=\s*(?:\"([^\"]*)\"|'([^']*)')", tag)
    return {name.decode(): (one or other).decode() for name, one, other in found}


def _layout(content: bytes) -> _Layout:
    root = re.search(rb"<VTKFile\b[^>]*>", content)
    if root is None:
        raise UnpatchableError("it has no element VTKFile")
    own = _attributes(root[0])
    order = ">" if own.get("byte_order") == "BigEndian" else "<"
    header = np.dtype(order + {"UInt64": "u8"}.get(own.get("header_type", ""), "u4"))
    appended = re.search(rb"<AppendedData\b[^>]*>\s*_", content)
    return _Layout(
        order,
        header,
        own.get("compressor", ""),
        len(content) if appended is None else appended.start(),
        -1 if appended is None else appended.end(),
        appended is not None and _attributes(appended[0]).get("encoding") == "raw",
    )


def replace_points(
    content: bytes, old: Float[np.ndarray, "nodes dim"], new: Float[np.ndarray, "nodes dim"]
) -> bytes:
    """A file with other coordinates of its nodes, in its own precision and encoding.

    Args:
        content: the file.
        old: its coordinates, as they were read.
        new: other ones.

    Raises:
        UnpatchableError: it has more than one piece, or they are not stored in a known way.
    """
    layout = _layout(content)
    pattern = rb"<Points\b[^>]*>\s*<DataArray\b([^>]*?)(?:/>|>([^<]*)<)"
    found = list(re.finditer(pattern, content[: layout.head]))
    if len(found) != 1:
        raise UnpatchableError(f"it has {len(found)} arrays of points")
    own = _attributes(found[0][1])
    if own.get("NumberOfComponents") != "3":
        raise UnpatchableError("its points don't have three coordinates")
    kind = own.get("format", "ascii")
    if kind == "ascii":
        starts, ends = tokens(content, *found[0].span(2))
        if len(starts) != old.size:
            raise UnpatchableError(f"its points have {len(starts)} numbers")
        return put_text(content, Places(starts.reshape(-1, 3), ends.reshape(-1, 3)), old, new)
    if own.get("type") not in _FLOATS:
        raise UnpatchableError(f"its coordinates are of the type {own.get('type')}")
    dtype = np.dtype(layout.order + _FLOATS[own["type"]])

    def moved(data: bytes) -> bytes:
        index = np.arange(old.size).reshape(old.shape)
        if len(data) != old.size * dtype.itemsize:
            raise UnpatchableError(f"its points have {len(data)} bytes")
        return put_binary(data, dtype.itemsize * index, dtype, old, new)

    if kind == "binary":
        start, end = found[0].span(2)
        text = content[start:end]
        start, end = start + len(text) - len(text.lstrip()), end - (len(text) - len(text.rstrip()))
        text, _ = _recoded(content[start:end], layout, moved, raw=False)
        return content[:start] + text + content[end:]
    if kind != "appended" or layout.appended < 0:
        raise UnpatchableError(f"its points are in the format {kind}")
    offset = int(own["offset"])
    start = layout.appended + offset
    coded, used = _recoded(content[start:], layout, moved, raw=layout.raw)
    shift = len(coded) - used
    head = _shifted(content[: layout.head], offset, shift) if shift else content[: layout.head]
    return head + content[layout.head : start] + coded + content[start + used :]


def _shifted(head: bytes, offset: int, shift: int) -> bytes:
    """The XML with the offsets of all arrays behind one moved."""

    def moved(found: re.Match) -> bytes:
        number = int(found[2])
        return found[1] + str(number + shift if number > offset else number).encode() + found[3]

    return re.sub(rb"(\boffset\s*=\s*[\"']\s*)(\d+)(\s*[\"'])", moved, head)


def _recoded(coded: bytes, layout: _Layout, moved, raw: bool) -> tuple[bytes, int]:
    """An array with other values, and how many bytes of `coded` the old one has."""
    size = layout.header.itemsize
    if not layout.compressor:
        if raw:
            count = int(np.frombuffer(coded, layout.header, 1)[0])
            return coded[:size] + moved(coded[size : size + count]), size + count
        # VTK encodes the header by itself, others together with the values
        lead = _letters(size)
        alone = coded[:lead].endswith(b"=")
        count = int(np.frombuffer(_decoded(coded[: _letters(size)]), layout.header, 1)[0])
        if alone:
            used = lead + _letters(count)
            return coded[:lead] + base64.b64encode(moved(_decoded(coded[lead:used]))), used
        used = _letters(size + count)
        data = _decoded(coded[:used])
        return base64.b64encode(data[:size] + moved(data[size:])), used
    if raw:
        count = int(np.frombuffer(coded, layout.header, 1)[0])
        header = np.frombuffer(coded, layout.header, 3 + count)
        used = header.nbytes + int(header[3:].sum())
        header, blocks = _recompressed(header, coded[header.nbytes : used], layout, moved)
        return header.tobytes() + blocks, used
    count = int(np.frombuffer(_decoded(coded[: _letters(size)])[:size], layout.header, 1)[0])
    lead = _letters(size * (3 + count))
    header = np.frombuffer(_decoded(coded[:lead]), layout.header, 3 + count)
    used = lead + _letters(int(header[3:].sum()))
    header, blocks = _recompressed(header, _decoded(coded[lead:used]), layout, moved)
    return base64.b64encode(header.tobytes()) + base64.b64encode(blocks), used


def _recompressed(header: np.ndarray, coded: bytes, layout: _Layout, moved) -> tuple[np.ndarray, bytes]:
    """Header and blocks with other values; a block whose values stay, stays."""
    ends = np.cumsum(header[3:]).tolist()
    blocks = [coded[start:end] for start, end in zip([0, *ends], ends, strict=False)]
    parts = [_decompressed(block, layout.compressor) for block in blocks]
    data = moved(b"".join(parts))
    at = 0
    for k, part in enumerate(parts):
        values = data[at : at + len(part)]
        at += len(part)
        if values != part:
            blocks[k] = _compressed(values, blocks[k], layout.compressor)
    sizes = np.array([len(block) for block in blocks], header.dtype)
    return np.concatenate([header[:3], sizes]).astype(header.dtype), b"".join(blocks)


def _decompressed(block: bytes, compressor: str) -> bytes:
    if compressor == "vtkZLibDataCompressor":
        return zlib.decompress(block)
    if compressor == "vtkLZMADataCompressor":
        return lzma.decompress(block)
    raise UnpatchableError(f"its compressor {compressor} is not known")


def _compressed(values: bytes, before: bytes, compressor: str) -> bytes:
    if compressor == "vtkZLibDataCompressor":
        return zlib.compress(values, _LEVELS[before[1] >> 6])
    return lzma.compress(values)


def _letters(size: int) -> int:
    """Of base64 for so many bytes."""
    return -(-size // 3) * 4


def _decoded(text: bytes) -> bytes:
    try:
        return base64.b64decode(text, validate=True)
    except binascii.Error as error:
        raise UnpatchableError("its points are not plain base64") from error
