"""Gmsh's element types and node orders, from the chapter "MSH file format" of its manual."""

from __future__ import annotations

import meshio
import numpy as np

__all__ = ["CODES", "NODES_OF", "in_gmsh_order", "reorder_for_writing", "reorder_read"]

_FAMILIES = {
    "vertex": {15: 1},
    "line": {1: 2, 8: 3, 26: 4, 27: 5, 28: 6, 62: 7, 63: 8, 64: 9, 65: 10, 66: 11},
    "triangle": {2: 3, 9: 6, 21: 10, 23: 15, 25: 21, 42: 28, 43: 36, 44: 45, 45: 55, 46: 66},
    "quad": {3: 4, 16: 8, 10: 9, 36: 16, 37: 25, 38: 36, 47: 49, 48: 64, 49: 81, 50: 100, 51: 121},
    "tetra": {4: 4, 11: 10, 29: 20, 30: 35, 31: 56, 71: 84, 72: 120, 73: 165, 74: 220, 75: 286},
    "hexahedron": {5: 8, 17: 20, 12: 27, 92: 64, 93: 125, 94: 216, 95: 343, 96: 512, 97: 729, 98: 1000},
    "wedge": {6: 6, 18: 15, 13: 18, 90: 40, 91: 75, 106: 126, 107: 196, 108: 288, 109: 405, 110: 550},
    "pyramid": {7: 5, 19: 13, 14: 14},
}

NODES_OF = {code: nodes for family in _FAMILIES.values() for code, nodes in family.items()}
"""Number of nodes by Gmsh's number of the type."""

CODES = {
    name + str(nodes) * (k > 0): code
    for name, family in _FAMILIES.items()
    for k, (code, nodes) in enumerate(family.items())
}
"""Gmsh's number of the type by meshio's name."""

_HEX20 = [0, 1, 2, 3, 4, 5, 6, 7, 8, 11, 16, 9, 17, 10, 18, 19, 12, 15, 13, 14]
_ORDER = {
    "tetra10": [0, 1, 2, 3, 4, 5, 6, 7, 9, 8],
    "hexahedron20": _HEX20,
    "hexahedron27": [*_HEX20, 24, 22, 20, 21, 23, 25, 26],
    "wedge15": [0, 1, 2, 3, 4, 5, 6, 8, 12, 7, 13, 14, 9, 11, 10],
    "pyramid13": [0, 1, 2, 3, 4, 5, 8, 9, 6, 10, 7, 11, 12],
    "pyramid14": [0, 1, 2, 3, 4, 5, 8, 9, 6, 10, 7, 11, 12, 13],
    "wedge18": [0, 1, 2, 3, 4, 5, 6, 8, 12, 7, 13, 14, 9, 11, 10, 15, 17, 16],
}
"""Nodes of VTK's element in Gmsh's order, where the two differ."""


def in_gmsh_order(name: str, nodes: np.ndarray) -> np.ndarray:
    """The nodes ``[elements, k]`` of elements of a type, from VTK's order into Gmsh's."""
    return nodes[:, _ORDER[name]] if name in _ORDER else nodes


_LEFT = ("pyramid14", "wedge18")
"""Types whose nodes meshio (5.3.5) leaves in Gmsh's order."""


def reorder_read(mesh: meshio.Mesh) -> None:
    """Put the nodes that meshio has read in Gmsh's order into VTK's."""
    _reorder(mesh, {name: np.argsort(_ORDER[name]) for name in _LEFT})


def reorder_for_writing(mesh: meshio.Mesh) -> None:
    """Put the nodes that meshio writes as they are into Gmsh's order."""
    _reorder(mesh, {name: np.asarray(_ORDER[name]) for name in _LEFT})


def _reorder(mesh: meshio.Mesh, orders: dict[str, np.ndarray]) -> None:
    for k, cells in enumerate(mesh.cells):
        if cells.type in orders:
            mesh.cells[k] = meshio.CellBlock(cells.type, np.asarray(cells.data)[:, orders[cells.type]])
