"""Nodes that belong together though no element says so: found when a mesh is read, and held.

Moved apart they would open a contact, tear a periodic pair, leave a hanging node off the edge that
it interpolates, or spoil cells that are not smoothed themselves.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from jaxsmooth.cells.table import TYPES, element_type
from jaxsmooth.convert.hanging import find_contacts, find_hanging
from jaxsmooth.mesh.record import Mesh
from jaxsmooth.mesh.topology import facet_keys, find_facets, pair_codes

__all__ = ["find_coupled"]

Cells = Sequence[tuple[str, np.ndarray]]


def find_coupled(
    points: np.ndarray, mesh: Mesh, cells: Cells, links: Any, known: np.ndarray
) -> tuple[np.ndarray, list[str]]:
    """Nodes that have to stay where they are for the sake of others.

    Args:
        points: coordinates ``[nodes, dim]`` as the file has them.
        mesh: the elements that are smoothed.
        cells: the file's cells that are not among them, by type.
        links: periodic links as meshio has them, ``[dim, tags, affine, pairs [n, 2]]`` each, or None.
        known: nodes that need not be mentioned again ``[nodes]``.

    Returns:
        A mask ``[nodes]``, and a sentence for every kind that was found.
    """
    used = np.zeros(len(points), bool)
    for nodes in mesh.connectivity:
        used[np.asarray(nodes)] = True
    arrays = [(name, np.asarray(data)) for name, data in cells if not name.startswith("poly")]
    cells = [
        (name, nodes.astype(np.int64))
        for name, nodes in arrays
        if nodes.size and nodes.min() >= 0 and nodes.max() < len(points)
    ]
    held, notes = np.zeros(len(points), bool), []
    for mask, sentence in _kinds(mesh, points, used, cells, links):
        mask = mask & used
        held |= mask
        if (mask & ~known).any():
            notes.append(sentence.format(nodes=int(mask.sum())))
    return held, notes


def _kinds(mesh: Mesh, points: np.ndarray, used: np.ndarray, cells: Cells, links: Any) -> Iterator:
    blocks = [(kind, np.asarray(nodes)) for kind, nodes in mesh.blocks]
    facets = find_facets(mesh)
    boundary = [part.select(part.partner < 0) for part in facets]
    yield _linked(links, len(points)), "{nodes} nodes are linked in periodic pairs; they are held"

    yield (
        find_contacts(points, blocks, boundary),
        "{nodes} boundary nodes lie in the same place as others that are not theirs (parts in contact); "
        "they are held, so that they stay together",
    )
    hanging, parents = find_hanging(points, blocks, boundary)
    yield (
        hanging | parents,
        f"{int(hanging.sum())} nodes hang on an edge or a face of a larger element; they and its nodes are "
        "held, {nodes} in all",
    )
    count, mask = _shells(mesh.dim, facets, cells, len(points))
    yield (
        mask,
        f"{count} shell cells are no boundary of the solid and no interface; their {{nodes}} nodes in the "
        "solid are held, so that these cells keep their shape",
    )
    count, mask = _loose(blocks, cells, used)
    yield (
        mask,
        f"{count} cells of lower dimension are no edges of the elements; their {{nodes}} nodes in the mesh "
        "are held",
    )


def _linked(links: Any, count: int) -> np.ndarray:
    mask = np.zeros(count, bool)
    for link in links or ():
        mask[np.asarray(link[3]).astype(np.int64).ravel()] = True
    return mask


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
