"""One array of an HDF5 file with other values, all else as it is."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING

import numpy as np

from jaxsmooth.files.formats.record import UnpatchableError

if TYPE_CHECKING:
    import h5py

__all__ = ["is_hdf5", "read_array", "replace_array"]


def is_hdf5(content: bytes) -> bool:
    """Whether a file is HDF5's, by its first bytes."""
    return content.startswith(b"\x89HDF\r\n\x1a\n")


def read_array(content: bytes, path: str) -> np.ndarray:
    """The values of the array at a path."""
    import h5py

    with h5py.File(io.BytesIO(content), "r") as file:
        return np.asarray(_dataset(file, path)[()])


def replace_array(content: bytes, path: str, values: np.ndarray) -> bytes:
    """A file with other values in an array of the same shape, rounded to its precision.

    An array that lies in one piece is overwritten there, so that no other byte changes.  One in chunks is
    written by the HDF5 library, which may move its chunks.

    Raises `UnpatchableError` where it holds no floating-point numbers, or another number of them."""
    import h5py

    buffer = io.BytesIO(content)
    with h5py.File(buffer, "r+") as file:
        array = _dataset(file, path)
        if array.shape != values.shape or array.dtype.kind != "f":
            raise UnpatchableError(f"its array {path} is {list(array.shape)} of {array.dtype}")
        before = np.asarray(array[()])
        if np.array_equal(before, values.astype(array.dtype)):
            return content
        offset, size = array.id.get_offset(), array.dtype.itemsize * values.size
        data = values.astype(array.dtype).tobytes()
        if offset is not None and content[offset : offset + size] == before.tobytes():
            return content[:offset] + data + content[offset + size :]
        array[...] = values
    return buffer.getvalue()


def _dataset(file: h5py.File, path: str) -> h5py.Dataset:
    import h5py

    array = file[path]
    if not isinstance(array, h5py.Dataset):
        raise UnpatchableError(f"its {path} is not an array")
    return array
