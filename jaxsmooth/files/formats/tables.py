"""Other coordinates for text files in which the nodes stand one after another, behind their number."""

from __future__ import annotations

import re

import numpy as np
from jaxtyping import Float

from jaxsmooth.files.formats.record import Patch, Patched, Source, UnpatchableError
from jaxsmooth.files.numbers import Places, blanked, put_text, tokens

__all__ = ["patch_table"]


def patch_table(head: bytes, lead: int, width: int = 3, comment: bytes = b"#") -> Patch:
    """How to patch such a format.

    Args:
        head: a pattern for what stands before the nodes; its first group is their number.
        lead: how many numbers each node has before its coordinates.
        width: how many coordinates it has.
        comment: what begins a comment, which reaches to the end of its line.
    """

    def patch(
        source: Source, old: Float[np.ndarray, "nodes dim"], new: Float[np.ndarray, "nodes dim"]
    ) -> Patched:
        content = blanked(source.content, comment)
        found = re.search(head, content, re.M)
        if found is None:
            raise UnpatchableError("it does not begin as files of its format do")
        starts, ends = tokens(content, found.end())
        row = (lead + width) * np.arange(int(found[1]))[:, None] + lead + np.arange(width)
        if row.size and row.max() >= len(starts):
            raise UnpatchableError("its nodes end early")
        return Patched(put_text(source.content, Places(starts[row], ends[row]), old, new), proven=True)

    return patch
