"""What a file format is to this package: one record each."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import meshio
import numpy as np
from jaxtyping import Float

__all__ = ["Format", "Holds", "Patch", "Patched", "Source", "UnpatchableError", "keep_nothing", "stem_format"]

Reader = Callable[[Path], tuple[meshio.Mesh, list[str]]]
Writer = Callable[[Path, meshio.Mesh, int, str], list[str]]


class UnpatchableError(ValueError):
    """Why a file can't get other coordinates where it stands: a clause that follows "because"."""


@dataclass(frozen=True)
class Source:
    """A file that gets other coordinates.

    Attributes:
        content: its bytes.
        path: where they are from; companions lie beside it.
        output: where the result will be; companions get names that fit its name.
    """

    content: bytes
    path: Path
    output: Path


@dataclass(frozen=True)
class Patched:
    """A file with other coordinates in it.

    Attributes:
        content: its bytes.
        notes: what the user should know.
        companions: other files that belong to it, by name; they go into the same folder.
        inputs: files beside the source that must not be replaced.
        refers: files, relative to the folder of the source, that the result names and that stay there.
        proven: only bytes of coordinates are others, and stood where the old ones were found; others are
            read again before they count.
    """

    content: bytes
    notes: tuple[str, ...] = ()
    companions: dict[str, bytes] = field(default_factory=dict)
    inputs: tuple[Path, ...] = ()
    refers: tuple[str, ...] = ()
    proven: bool = False


Patch = Callable[[Source, Float[np.ndarray, "nodes dim"], Float[np.ndarray, "nodes dim"]], Patched]


def keep_nothing(mesh: meshio.Mesh, dim: int) -> list[str]:
    """Take all data off a mesh; returns their names."""
    lost = [*mesh.point_data, *mesh.cell_data]
    mesh.point_data, mesh.cell_data = {}, {}
    return lost


@dataclass(frozen=True)
class Holds:
    """What a format has room for.

    Attributes:
        types: cell types that it can hold; None: all that its writer takes, but for those that it `lacks`.
        lacks: see types.
        any_data: it holds any point and cell data.
        sets: named sets that are left to its writer: True for all, else their names.
        groups: it has named physical groups (`meshio.Mesh.field_data`), which are left to its writer.
        private: names of cell sets that mean something to this format only, and are left to its writer.
        space: its nodes always have three coordinates.
        reduce: takes off a mesh what of its data the format can't hold ``(mesh, dim)``, and returns their
            names; not called for formats with `any_data`.
        materials: it has sections of its own for materials; else they become cell data.
    """

    types: frozenset[str] | None = None
    lacks: frozenset[str] = frozenset()
    any_data: bool = False
    sets: bool | frozenset[str] = False
    groups: bool = False
    private: frozenset[str] = frozenset()
    space: bool = False
    reduce: Callable[[meshio.Mesh, int], list[str]] = keep_nothing
    materials: bool = False

    def cells(self, name: str) -> bool:
        """Whether it can hold cells of a type."""
        return name not in self.lacks and (self.types is None or name in self.types)


@dataclass(frozen=True)
class Format:
    """A file format.

    Attributes:
        name: by which users ask for it; followed by ``:ascii`` or ``:binary`` where it has both.
        suffixes: endings of names, in small letters and with their dots.  Of several formats with one
            suffix, the first that is registered is the one that new files are written in.
        read: takes a path, and returns the mesh and notes.  It may raise anything; a `ValueError` with one
            sentence is best.
        write: takes a path, the mesh (its own copy, to change at will), the dimension of the elements and
            the variant (``"ascii"``, ``"binary"`` or ``""``), and returns notes on what is lost.  None
            where nothing writes this format.
        holds: what the format has room for.
        sniff: takes the first 4096 bytes of a file with one of the suffixes, and returns its variant, or
            None where it is of another format.  A format without takes those that no other one of the suffix
            takes.
        variants: of the format; the first is the usual one.
        needs: a package that it needs.
        refuse: takes a path, and returns a sentence where a file of this name can't be written.
        patch: takes the file that was read, its coordinates as `read` gave them and other ones, and
            returns the same file with those; raises `UnpatchableError` where it can't.  None for formats
            that are always written anew.
    """

    name: str
    suffixes: tuple[str, ...]
    read: Reader
    write: Writer | None = None
    holds: Holds = Holds()
    sniff: Callable[[bytes], str | None] | None = None
    variants: tuple[str, ...] = ("",)
    needs: str | None = None
    refuse: Callable[[Path], str | None] = lambda path: None
    patch: Patch | None = None

    def full_name(self, variant: str | None = None) -> str:
        """The name with a variant, the usual one by default."""
        variant = self.variants[0] if variant is None else variant
        return f"{self.name}:{variant}" if variant else self.name


def stem_format(name: str) -> str:
    """The format without ``:ascii`` or ``:binary``."""
    return name.partition(":")[0]
