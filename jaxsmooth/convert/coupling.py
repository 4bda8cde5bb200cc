"""Nodes that belong together though no element says so: found when a mesh is read.

Moved apart they would open a contact, tear a periodic pair, or leave a hanging node off the edge that
it interpolates; so they move together.  Nodes of cells that are not smoothed themselves are held.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from jaxsmooth.cells.table import TYPES, element_type
from jaxsmooth.convert.hanging import find_contacts, find_hanging
from jaxsmooth.convert.rigid import linked_pairs
from jaxsmooth.mesh.links import NodeLinks
from jaxsmooth.mesh.record import Mesh
from jaxsmooth.mesh.topology import facet_keys, find_facets, pair_codes

__all__ = ["find_coupled"]

Cells = Sequence[tuple[str, np.ndarray]]


class Coupling(NamedTuple):
    """Attributes: nodes that stay where they are ``[nodes]``; links; a sentence for every kind found."""

    held: np.ndarray
    links: NodeLinks | None
    notes: list[str]


def find_coupled(
    points: np.ndarray, mesh: Mesh, cells: Cells, periodic: Any, axes: np.ndarray, facing: np.ndarray
) -> Coupling:
    """Nodes that move together, and nodes that have to stay where they are for the sake of others.

    Args:
        points: coordinates ``[nodes, dim]`` as the file has them.
        mesh: the elements that are smoothed.
        cells: the file's cells that are not among them, by type.
        periodic: links as meshio has them, see `linked_pairs`, or None.
        axes: directions of the coordinates in space ``[dim, 3]``.
        facing: pairs of nodes ``[m, 2]`` that cells without thickness keep together.
    """
    used, count = np.zeros(len(points), bool), len(points)
    for nodes in mesh.connectivity:
        used[np.asarray(nodes)] = True
    blocks = [(kind, np.asarray(nodes)) for kind, nodes in mesh.blocks]
    facets = find_facets(mesh)
    boundary = [part.select(part.partner < 0) for part in facets]
    links, notes = [NodeLinks.pairs(facing, np.eye(mesh.dim))], []

    found, lost = linked_pairs(points, periodic, axes)
    lost &= used
    found = [part.select(used[part.nodes] & used[part.parents[:, 0]]) for part in found]
    if (mask := _members(found, count)).any():
        notes.append(f"{int(mask.sum())} nodes are linked in periodic pairs; they move together")
    if lost.any():
        notes.append(
            f"{int(lost.sum())} nodes are linked in periodic pairs that no translation or rotation explains; "
            "they are held"
        )
    links += found
    contacts = [NodeLinks.pairs(find_contacts(points, blocks, boundary), np.eye(mesh.dim))]
    if ((mask := _members(contacts, count)) & ~_members(links, count)).any():
        notes.append(
            f"{int(mask.sum())} boundary nodes lie in the same place as others that are not theirs (parts in "
            "contact); they move together"
        )
    links += contacts
    hanging = find_hanging(points, blocks, boundary)
    if hanging is not None:
        notes.append(
            f"{len(np.unique(hanging.nodes))} nodes hang on an edge or a face of a larger element; they move "
            "with its nodes"
        )
        links.append(hanging)
    held, sentences = _held(mesh.dim, blocks, facets, cells, used)
    return Coupling(held | lost, NodeLinks.join(links), notes + sentences)


def _members(links: Sequence[NodeLinks], count: int) -> np.ndarray:
    """Mask ``[nodes]`` of all nodes of links."""
    joined = NodeLinks.join(links)
    return np.zeros(count, bool) if joined is None else joined.members(count)


def _held(dim: int, blocks, facets, cells: Cells, used: np.ndarray) -> tuple[np.ndarray, list[str]]:
    """Nodes of shells and of loose cells."""
    arrays = [(name, np.asarray(data)) for name, data in cells if not name.startswith("poly")]
    cells = [
        (name, nodes.astype(np.int64))
        for name, nodes in arrays
        if nodes.size and nodes.min() >= 0 and nodes.max() < len(used)
    ]
    shells, shell = _shells(dim, facets, cells, len(used))
    lines, loose = _loose(blocks, cells, used)
    shell, loose, notes = shell & used, loose & used, []
    if shell.any():
        notes.append(
            f"{shells} shell cells are no boundary of the solid and no interface; their {int(shell.sum())} "
            "nodes in the solid are held, so that these cells keep their shape"
        )
    if loose.any():
        notes.append(
            f"{lines} cells of lower dimension are no edges of the elements; their {int(loose.sum())} nodes "
            "in the mesh are held"
        )
    return shell | loose, notes


def _shells(dim: int, facets, cells: Cells, count: int) -> tuple[int, np.ndarray]:
    """Cells of dimension 2 in a solid that are neither its boundary nor between two regions."""
    mask, number = np.zeros(count, bool), 0
    for name, nodes in cells:
        if dim < 3 or name not in TYPES or TYPES[name].dim != 2:
            continue
        corners = element_type(name).corners
        skin = [
            part.nodes[part.partner != part.region][:, :corners]
            for part in facets
            if part.type.corners == corners
        ]
        own = nodes[:, :corners]
        keys = facet_keys(np.concatenate([own, *skin]), count)
        loose = ~np.isin(keys[: len(own)], keys[len(own) :])
        mask[nodes[loose]] = True
        number += int(loose.sum())
    return number, mask


def _loose(blocks, cells: Cells, used: np.ndarray) -> tuple[int, np.ndarray]:
    """Lines that are no edges of elements, and cells of types without a meaning here."""
    count = len(used)
    mask, number = np.zeros(count, bool), 0
    for name, nodes in cells:
        if name == "vertex" or (name in TYPES and TYPES[name].dim != 1):
            continue
        loose = used[nodes].any(axis=1)
        if name in TYPES:
            segments = nodes[:, element_type(name).segments]
            loose &= ~np.isin(pair_codes(segments, count), _edges(blocks, nodes, count)).all(axis=1)
        mask[nodes[loose]] = True
        number += int(loose.sum())
    return number, mask


def _edges(blocks, lines: np.ndarray, count: int) -> np.ndarray:
    """All edges of the elements between nodes of lines, and their halves where they have a node."""
    wanted = np.zeros(count, bool)
    wanted[lines] = True
    found = [np.zeros(0, np.int64)]
    for kind, nodes in blocks:
        rows = nodes[wanted[nodes].sum(axis=1) > 1]
        for pairs in (kind.edges, kind.segments):
            found.append(pair_codes(rows[:, pairs], count).ravel())
    return np.concatenate(found)
