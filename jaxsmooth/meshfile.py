"""Between `meshio.Mesh` and `Mesh`: pure conversions, no disk.

What a file says beyond points and elements stays in the `meshio.Mesh` that was read; smoothing
changes coordinates, so writing means replacing them in a copy of the source.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import jax
import meshio
import numpy as np

from jaxsmooth.elements import element_type
from jaxsmooth.files.checks import (
    SYNONYMS,
    MeshFileError,
    check_cells,
    check_points,
    dimension,
    element_dim,
    in_plane,
)
from jaxsmooth.files.labels import held_nodes, make_labels, make_named_sets, plain
from jaxsmooth.mesh import Mesh
from jaxsmooth.orientation import orient

__all__ = ["MeshFile", "MeshFileError", "as_mesh", "from_meshio", "to_meshio"]


@dataclass(frozen=True)
class MeshFile:
    """A mesh with everything its file says about it.

    Attributes:
        mesh: the mesh that is smoothed; it has all nodes of the file, in the file's order, and one
            block an element type.
        source: what was read; never modified.
        path: where it was read from, or None.
        format: the format it is written in again, such as ``"gmsh22:binary"``, or None.
        notes: sentences for the user about what was found, or done, on the way.
        fixed: nodes that point or cell data called ``fixed`` hold ``[nodes]``.
        named_sets: nodes of every named set ``{name: [nodes]}``.
        placement: for every cell block of the source the block of `mesh` it went to (−1: none) and
            the element there of each of its cells.
    """

    mesh: Mesh
    source: meshio.Mesh
    path: Path | None
    format: str | None
    notes: tuple[str, ...]
    fixed: np.ndarray
    named_sets: Mapping[str, np.ndarray]
    placement: tuple[tuple[int, np.ndarray], ...] = field(repr=False)


def from_meshio(
    source: meshio.Mesh,
    *,
    path: str | Path | None = None,
    format: str | None = None,
    dtype: Any = None,
) -> MeshFile:
    """Take the mesh out of a `meshio.Mesh`.

    Cell blocks of one type become one element block; elements that are numbered the other way round
    are mirrored (in `mesh`, not in `source`); lower-dimensional cells and material tags become
    `Mesh.labels`.  The mesh is 2D when its highest cells are and all of them lie in one plane z = c.

    Args:
        source: what meshio read.
        path: where from.
        format: in which format.
        dtype: float32 or float64; by default that of the points (as far as JAX allows it).

    Raises:
        MeshFileError: no elements, types that are not supported, surfaces in 3D, coordinates that
            are not finite, elements that refer to missing nodes or to one node twice.
    """
    points = plain(source.points)
    cells = [(SYNONYMS.get(c.type, c.type), c.data) for c in source.cells]
    check_points(points)
    dim = element_dim(cells)
    chosen = [k for k, (name, data) in enumerate(cells) if len(data) and dimension(name) == dim]
    check_cells(cells, chosen, len(points))
    names = list(dict.fromkeys(cells[k][0] for k in chosen))
    notes: list[str] = []
    parts = [[k for k in chosen if cells[k][0] == name] for name in names]
    numbering, placement = [], [(-1, np.zeros(0, np.int64))] * len(cells)
    first: list[np.ndarray] = []
    for block, (name, own) in enumerate(zip(names, parts, strict=True)):
        nodes = np.concatenate([np.asarray(cells[k][1]).astype(np.int64) for k in own])
        kept, element = _distinct(name, nodes, notes)
        numbering.append(nodes[kept])
        first.append(kept)
        ends = np.cumsum([len(cells[k][1]) for k in own])[:-1]
        for k, rows in zip(own, np.split(element, ends), strict=True):
            placement[k] = (block, rows)
    points = in_plane(points, numbering, dim)

    blocks = _oriented(points, names, numbering, notes)
    _count_orphans(len(points), cells, notes)
    labels = make_labels(source, cells, dim, parts, first)
    mesh = Mesh(_cast(points, dtype), blocks, labels)
    if dtype is not None and mesh.points.dtype != np.dtype(dtype):
        notes.append(f"{np.dtype(dtype)} was asked for, but JAX runs without jax_enable_x64: float32 is used")
    return MeshFile(
        mesh=mesh,
        source=source,
        path=None if path is None else Path(path),
        format=format,
        notes=tuple(notes),
        fixed=held_nodes(source, len(points)),
        named_sets=make_named_sets(source, len(points)),
        placement=tuple(placement),
    )


def to_meshio(
    file: MeshFile,
    points: Any = None,
    *,
    point_data: Mapping[str, Any] | None = None,
    cell_data: Mapping[str, Any] | None = None,
) -> meshio.Mesh:
    """The file's mesh with other coordinates; all else is the source's, in the source's order.

    Coordinates that are equal to those of `file.mesh` are written as they were read, so a float32 run
    leaves what it didn't move untouched; so are z in 2D and nodes outside of all elements.

    Args:
        file: what was read.
        points: new coordinates ``[nodes, dim]``; None for the old ones.
        point_data: more arrays ``{name: [nodes, …]}``.
        cell_data: more arrays, ``{name: {type: [elements, …]}}`` or a list with one array a block of
            `file.mesh`; cells that are not elements of it get NaN.

    Raises:
        ValueError: arrays whose shape doesn't fit the mesh.
    """
    source = file.source
    out = copy.copy(source)
    for name in ("point_data", "cell_data", "point_sets", "cell_sets", "field_data"):
        # copied one level deeper: meshio's writers replace entries in place
        old = getattr(source, name)
        setattr(out, name, {k: list(v) if isinstance(v, list) else v for k, v in old.items()})
    out.cells = list(source.cells)
    out.points = _moved(file, points)
    for name, values in (point_data or {}).items():
        values = np.asarray(values)
        if len(values) != len(out.points):
            raise ValueError(f"point data {name!r} has {len(values)} rows for {len(out.points)} nodes")
        out.point_data[name] = values
    for name, values in (cell_data or {}).items():
        out.cell_data[name] = _to_cells(file, name, values)
    return out


def as_mesh(anything: Any) -> Mesh:
    """A `Mesh` from whatever is one: `Mesh`, `MeshFile`, `meshio.Mesh`, ``(points, {"tetra": nodes})``.

    A `Mesh` comes back as it is, its points traced by JAX or not; all else is read as files are, so
    that reversed elements are turned, and nodes that belong together are held.

    Raises:
        ValueError: it is none of these, or not a mesh that can be smoothed.
    """
    if isinstance(anything, Mesh):
        return anything
    if isinstance(anything, MeshFile):
        return anything.mesh
    if isinstance(anything, meshio.Mesh):
        return from_meshio(anything).mesh
    if isinstance(anything, (tuple, list)) and len(anything) == 2:
        return from_meshio(_from_pair(*anything)).mesh
    raise ValueError(
        f"can't take {type(anything).__name__} for a mesh; give a Mesh, a MeshFile (read(path)), "
        "a meshio.Mesh or (points, {'tetra': connectivity})"
    )


# --- From the source ---------------------------------------------------------------------


def _from_pair(points: Any, blocks: Any) -> meshio.Mesh:
    """What a pair ``(points, {"tetra": nodes})`` says, as a file would say it."""
    if isinstance(points, jax.core.Tracer):
        raise ValueError(
            "the numbering of elements can't be checked while JAX traces the points; build the mesh before, "
            "by as_mesh((points, blocks)), and trace mesh.with_points(points)"
        )
    pairs = blocks.items() if isinstance(blocks, Mapping) else blocks
    cells = [(str(name), np.asarray(nodes)) for name, nodes in pairs]
    for index, (name, nodes) in enumerate(cells):
        if name not in SYNONYMS and name != "vertex":
            element_type(name)  # raises for unknown names
        if nodes.ndim != 2 or nodes.dtype.kind not in "iu":
            raise ValueError(
                f"block {index} ({name}): connectivity must be integers of shape [elements, k], "
                f"got {nodes.dtype} {list(nodes.shape)}"
            )
    return meshio.Mesh(np.asarray(points), cells)


def _cast(points: np.ndarray, dtype: Any) -> np.ndarray:
    if dtype is None:
        return points if points.dtype.kind == "f" else points.astype(np.float64)
    if np.dtype(dtype) not in (np.float32, np.float64):
        raise ValueError(f"dtype must be float32 or float64, got {np.dtype(dtype)}")
    return points.astype(dtype)


def _distinct(name: str, nodes: np.ndarray, notes: list[str]) -> tuple[np.ndarray, np.ndarray]:
    """Rows to keep of a block ``[elements, k]``, and for every row its element among those.

    Gmsh 2.2 files have an element once for each of its physical groups."""
    every = np.arange(len(nodes))
    weights = np.random.default_rng(0).integers(2**63, size=int(nodes.max()) + 1, dtype=np.uint64)
    if len(np.unique(weights[nodes].sum(axis=1))) == len(nodes):  # the usual case, found fast
        return every, every
    kept, element = np.unique(np.sort(nodes, axis=1), axis=0, return_index=True, return_inverse=True)[1:]
    if len(kept) == len(nodes):
        return every, every
    notes.append(
        f"{len(nodes) - len(kept)} of the {len(nodes)} {name} cells repeat another one, as Gmsh writes "
        "elements of several groups; each is used once, and written as often as it was"
    )
    order = np.argsort(kept)  # in the order of the file
    return kept[order], np.argsort(order)[element.ravel()]


def _oriented(points, names, numbering, notes: list[str]) -> list[tuple[str, np.ndarray]]:
    """Blocks with reversed elements mirrored; notes on them, on tangled and on flat elements."""
    kinds = [element_type(name) for name in names]
    precision = np.finfo(points.dtype).eps if points.dtype.kind == "f" else np.finfo(np.float64).eps
    points = points.astype(np.float64)
    found = orient(points, list(zip(kinds, numbering, strict=True)))
    blocks = []
    for kind, nodes, reverse, measures in zip(kinds, numbering, found.reverse, found.measures, strict=True):
        if reverse.any():
            nodes = np.where(reverse[:, None], nodes[:, kind.mirror], nodes)
            which = "all" if reverse.all() else str(int(reverse.sum()))
            mixed = "" if reverse.all() else "the numbering of the file is mixed: "
            notes.append(
                f"{mixed}{which} of the {len(nodes)} {kind.name} elements are numbered the other way round; "
                "they are turned for the computation and written in the file's own order"
            )
        corners = points[nodes[:, : kind.corners]]
        size = np.ptp(corners, axis=1).max(axis=-1) + precision * np.abs(corners).max(axis=(1, 2))
        flat = np.abs(measures) <= 64 * precision * size**kind.dim
        if flat.any():
            notes.append(
                f"{int(flat.sum())} of the {len(nodes)} {kind.name} elements have zero measure, "
                f"the first is {kind.name} {int(np.argmax(flat))} (counted from 0)"
            )
        inverted = (measures < 0) & ~flat
        if inverted.any():
            notes.append(
                f"{int(inverted.sum())} of the {len(nodes)} {kind.name} elements are inverted (numbered "
                f"like their neighbours, negative measure), first {kind.name} {int(np.argmax(inverted))}; "
                "the mesh is tangled"
            )
        blocks.append((kind.name, nodes))
    return blocks


def _count_orphans(count: int, cells: Sequence[tuple[str, Any]], notes: list[str]) -> None:
    used = np.zeros(count, bool)
    for name, data in cells:
        if len(data) and not name.startswith("polyhedron"):
            nodes = np.asarray(data)
            used[nodes[(nodes >= 0) & (nodes < count)]] = True
    if not used.all():
        notes.append(f"{int((~used).sum())} of the {count} nodes belong to no cell; they stay where they are")


# --- To the source -----------------------------------------------------------------------


def _moved(file: MeshFile, points: Any) -> np.ndarray:
    source = plain(file.source.points)
    out = source.astype(source.dtype if source.dtype.kind == "f" else np.float64)
    if points is None:
        return out
    old, new = np.asarray(file.mesh.points), np.asarray(points)
    if new.shape != old.shape:
        raise ValueError(f"points have shape {list(new.shape)}, the mesh has {list(old.shape)}")
    used = np.zeros(len(old), bool)
    for nodes in file.mesh.connectivity:
        used[np.asarray(nodes)] = True
    coarse = np.float32 if np.float32 in (old.dtype, new.dtype) else np.float64
    changed = used[:, None] & (new.astype(coarse) != old.astype(coarse))
    dim = old.shape[1]
    out[:, :dim] = np.where(changed, new, out[:, :dim])
    return out


def _to_cells(file: MeshFile, name: str, values: Any) -> list[np.ndarray]:
    mesh = file.mesh
    parts = [values[t] for t in mesh.types] if isinstance(values, Mapping) else list(values)
    parts = [np.asarray(part) for part in parts]
    sizes = [len(nodes) for nodes in mesh.connectivity]
    if [len(part) for part in parts] != sizes:
        raise ValueError(
            f"cell data {name!r} has {[len(p) for p in parts]} rows for the blocks of {sizes} elements "
            f"({', '.join(mesh.types)})"
        )
    out = []
    for cells, (block, rows) in zip(file.source.cells, file.placement, strict=True):
        if block < 0:
            out.append(np.full((len(cells), *parts[0].shape[1:]), np.nan))
        else:
            out.append(parts[block][rows])
    if any(block < 0 for block, _ in file.placement):
        out = [part.astype(np.float64) for part in out]  # NaN needs a float
    return out
