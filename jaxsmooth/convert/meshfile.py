"""Between `meshio.Mesh` and `Mesh`: pure conversions, no disk.

What a file says beyond points and elements stays in the `meshio.Mesh` that was read; smoothing
changes coordinates, so writing means replacing them in a copy of the source.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import meshio
import numpy as np
from jax.core import Tracer

from jaxsmooth.convert.blocks import collected, count_orphans, oriented, placed, without_cohesive
from jaxsmooth.convert.checks import (
    SYNONYMS,
    MeshFileError,
    check_cells,
    check_points,
    dimension,
    element_dim,
    tell_meshio,
)
from jaxsmooth.convert.coupling import find_coupled
from jaxsmooth.convert.foreign import as_source
from jaxsmooth.convert.labels import held_nodes, make_labels, make_named_sets, plain
from jaxsmooth.convert.original import Original
from jaxsmooth.convert.planes import Plane, find_plane
from jaxsmooth.mesh.layers import STRETCHED, boundary_layers, stretched
from jaxsmooth.mesh.record import Mesh

__all__ = ["MeshFile", "MeshFileError", "as_file", "as_mesh", "from_meshio", "to_meshio", "with_file"]


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
        fixed: nodes that point or cell data called ``fixed`` hold ``[nodes]``; `mesh.labels.held` has
            them too, with those of cells that are not smoothed.
        named_sets: nodes of every named set ``{name: [nodes]}``.
        placement: for every cell block of the source the block of `mesh` it went to (−1: none) and
            the element there of each of its cells (−1: none).
        plane: for a plane mesh whose file has three coordinates a node, where in space it lies:
            `mesh.points` are coordinates in this plane.  None otherwise.
        original: the file as it was read, so that it can be written again with nothing but its coordinates
            changed; None if there is none.
    """

    mesh: Mesh
    source: meshio.Mesh
    path: Path | None
    format: str | None
    notes: tuple[str, ...]
    fixed: np.ndarray
    named_sets: Mapping[str, np.ndarray]
    placement: tuple[tuple[int, np.ndarray], ...] = field(repr=False)
    plane: Plane | None = field(default=None, repr=False)
    original: Original | None = field(default=None, repr=False)


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
    `Mesh.labels`.  The mesh is 2D when its highest cells are and all of them lie in one plane, whichever
    (but for noise of 1e-5 of its size); else such cells are a surface in space.  Nodes that belong
    together (periodic pairs, parts in contact, hanging nodes, the two sides of cohesive cells) are
    `Labels.links`; nodes that the file marks, and those of shells in a solid, are `Labels.held`.  Elements
    without thickness (cohesive cells) are left out.

    Args:
        source: what meshio read.
        path: where from.
        format: in which format.
        dtype: float32 or float64; by default that of the points (as far as JAX allows it).

    Raises:
        MeshFileError: no elements, none with a thickness, types that are not supported, coordinates that
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
    numbering, kept, element = collected(cells, names, parts, notes)
    points, plane = _in_space(points, numbering, dim)
    open_, facing = without_cohesive(points, names, numbering, notes)
    placement = placed(cells, parts, element, open_)
    full = [b for b, rows in enumerate(open_) if rows.any()]
    names, parts = [names[b] for b in full], [parts[b] for b in full]
    numbering = [numbering[b][open_[b]] for b in full]

    blocks = oriented(points, names, numbering, notes)
    count_orphans(len(points), cells, notes)
    labels = make_labels(source, cells, dim, parts, [kept[b][open_[b]] for b in full])
    mesh = Mesh(_cast(points, dtype), blocks, labels)
    fixed = held_nodes(source, len(points))
    together = find_coupled(
        points,
        mesh,
        [cell for k, cell in enumerate(cells) if k not in chosen],
        getattr(source, "gmsh_periodic", None),
        np.eye(3)[: mesh.dim] if plane is None else plane.axes,
        facing,
    )
    held = fixed | together.held
    mesh = mesh.with_labels(replace(labels, held=held if held.any() else None, links=together.links))
    notes += together.notes + _stretch(mesh)
    if dtype is not None and mesh.points.dtype != np.dtype(dtype):
        notes.append(f"{np.dtype(dtype)} was asked for, but JAX runs without jax_enable_x64: float32 is used")
    return MeshFile(
        mesh=mesh,
        source=source,
        path=None if path is None else Path(path),
        format=format,
        notes=tuple(notes),
        fixed=fixed,
        named_sets=make_named_sets(source, len(points)),
        placement=tuple(placement),
        plane=plane,
    )


def to_meshio(
    file: Any,
    points: Any = None,
    *,
    point_data: Mapping[str, Any] | None = None,
    cell_data: Mapping[str, Any] | None = None,
) -> meshio.Mesh:
    """A `meshio.Mesh` with other coordinates; all else is the source's, in the source's order.

    Coordinates that are equal to those of `file.mesh` are written as they were read, so a float32 run
    leaves what it didn't move untouched; so are nodes outside of all elements, and what is normal to
    the plane of a plane mesh.

    Args:
        file: what was read, or what `smooth` returned, whose coordinates are taken then.
        points: new coordinates ``[nodes, dim]``; None for the old ones.
        point_data: more arrays ``{name: [nodes, …]}``.
        cell_data: more arrays, ``{name: {type: [elements, …]}}`` or a list with one array a block of
            `file.mesh`; cells that are not elements of it get NaN.

    Raises:
        ValueError: arrays whose shape doesn't fit the mesh.
    """
    if not isinstance(file, MeshFile):
        mesh, file = as_mesh(file), as_file(file)
        points = mesh.points if points is None else points
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
    """A `Mesh` from whatever is one or has one: `Mesh`, `MeshFile`, what `smooth` and `run` return,
    `meshio.Mesh`, PyVista's and VTK's grids, scikit-fem's meshes, ``(points, {"tetra": nodes})``.

    A `Mesh` comes back as it is, its points traced by JAX or not; all else is read as files are, so
    that reversed elements are turned, and nodes that belong together are linked.

    Raises:
        ValueError: it is none of these, or not a mesh that can be smoothed.
    """
    return with_file(anything)[0]


def with_file(anything: Any) -> tuple[Mesh, MeshFile | None]:
    """What `as_mesh` gives, and what is known beside it; None for a `Mesh` and what was made of one."""
    if isinstance(anything, Mesh):
        return anything, None
    if isinstance(found := getattr(anything, "mesh", None), Mesh):
        known = anything if isinstance(anything, MeshFile) else getattr(anything, "file", None)
        return found, known
    source = as_source(anything)
    if source is None and isinstance(anything, (tuple, list)) and len(anything) == 2:
        source = _from_pair(*anything)
    if source is None:
        raise ValueError(
            f"can't take {type(anything).__name__} for a mesh; give a Mesh, a MeshFile (read(path)), "
            "a meshio.Mesh, a grid of PyVista, a mesh of scikit-fem or (points, {'tetra': connectivity})"
        )
    file = from_meshio(source)
    return file.mesh, file


def as_file(anything: Any) -> MeshFile:
    """A `MeshFile` from whatever `as_mesh` takes; of a bare `Mesh` the regions are its only data."""
    mesh, file = with_file(anything)
    return _bare_file(mesh) if file is None else file


def _bare_file(mesh: Mesh) -> MeshFile:
    blocks = [(name, np.asarray(nodes)) for name, nodes in zip(mesh.types, mesh.connectivity, strict=True)]
    source = meshio.Mesh(np.asarray(mesh.points), blocks)
    if mesh.labels is not None and len({int(r) for part in mesh.labels.regions for r in np.unique(part)}) > 1:
        source.cell_data["region"] = list(mesh.labels.regions)
    rows = tuple((b, np.arange(len(nodes))) for b, (_, nodes) in enumerate(blocks))
    fixed = np.zeros(len(source.points), bool)
    return MeshFile(mesh, source, None, None, (), fixed, {}, rows)


# --- From the source ---------------------------------------------------------------------


def _from_pair(points: Any, blocks: Any) -> meshio.Mesh:
    """What a pair ``(points, {"tetra": nodes})`` says, as a file would say it."""
    if isinstance(points, Tracer):
        raise ValueError(
            "the numbering of elements can't be checked while JAX traces the points; build the mesh before, "
            "by as_mesh((points, blocks)), and trace mesh.with_points(points)"
        )
    pairs = blocks.items() if isinstance(blocks, Mapping) else blocks
    cells = [(str(name), np.asarray(nodes)) for name, nodes in pairs]
    for index, (name, nodes) in enumerate(cells):
        if name not in SYNONYMS and name != "vertex":
            tell_meshio(name)  # raises for unknown names
        if nodes.ndim != 2 or nodes.dtype.kind not in "iu":
            raise ValueError(
                f"block {index} ({name}): connectivity must be integers of shape [elements, k], "
                f"got {nodes.dtype} {list(nodes.shape)}"
            )
    return meshio.Mesh(np.asarray(points), cells)


def _stretch(mesh: Mesh) -> list[str]:
    """A note on elements that are stretched, if there are some."""
    number = sum(int(mask.sum()) for mask in stretched(mesh))
    if not number:
        return []
    layer = sum(int(mask.sum()) for mask in boundary_layers(mesh))
    held = f", {layer} of them in boundary layers, whose nodes are held" if layer else ""
    return [
        f"{number} elements are stretched beyond {STRETCHED:g}{held}; --freeze-aspect A (freeze_aspect=A) "
        "holds all those beyond A"
    ]


def _cast(points: np.ndarray, dtype: Any) -> np.ndarray:
    if dtype is None:
        return points if points.dtype.kind == "f" else points.astype(np.float64)
    if np.dtype(dtype) not in (np.float32, np.float64):
        raise ValueError(f"dtype must be float32 or float64, got {np.dtype(dtype)}")
    return points.astype(dtype)


def _in_space(points: np.ndarray, numbering, dim: int) -> tuple[np.ndarray, Plane | None]:
    """Points with as many coordinates as the elements have dimensions, and the plane they are in."""
    if dim == 3 and points.shape[1] == 2:
        raise MeshFileError("the file has volume elements but only two coordinates a node; it needs three")
    if dim == 3 or points.shape[1] == 2:
        return points, None
    plane = find_plane(points[np.unique(np.concatenate([nodes.ravel() for nodes in numbering]))])
    return (points, None) if plane is None else (plane.flatten(points), plane)


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
    if file.mesh.labels is not None and file.mesh.labels.links is not None:
        used |= file.mesh.labels.links.members(len(old))  # of cells without thickness, which are no elements
    coarse = np.float32 if np.float32 in (old.dtype, new.dtype) else np.float64
    changed = used[:, None] & (new.astype(coarse) != old.astype(coarse))
    if file.plane is not None:
        return file.plane.move(out, old, new, changed)
    return np.where(changed, new, out)


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
        elif (rows < 0).any():
            part = parts[block][rows].astype(np.float64)  # NaN needs a float
            part[rows < 0] = np.nan
            out.append(part)
        else:
            out.append(parts[block][rows])
    if any(block < 0 or (rows < 0).any() for block, rows in file.placement):
        out = [part.astype(np.float64) for part in out]
    return out
