"""What jaxsmooth uses of meshio, with the types its objects have once they are made.

meshio annotates what may be given; its arrays are NumPy's afterwards.
"""

from os import PathLike
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

class CellBlock:
    type: str
    data: np.ndarray  # but for polyhedra (a list)
    dim: int
    tags: list[str]
    def __init__(
        self, cell_type: str, data: list[Any] | np.ndarray, tags: list[str] | None = None
    ) -> None: ...
    def __len__(self) -> int: ...

class Mesh:
    points: np.ndarray
    cells: list[CellBlock]
    point_data: dict[str, np.ndarray]
    cell_data: dict[str, list[np.ndarray]]
    field_data: dict[str, Any]
    point_sets: dict[str, Any]  # left as they are given
    cell_sets: dict[str, list[Any]]  # left as they are given; None in blocks without members
    gmsh_periodic: Any
    info: Any
    def __init__(
        self,
        points: ArrayLike,
        cells: dict[str, Any] | list[Any],
        point_data: dict[str, Any] | None = None,
        cell_data: dict[str, Any] | None = None,
        field_data: dict[str, Any] | None = None,
        point_sets: dict[str, Any] | None = None,
        cell_sets: dict[str, Any] | None = None,
        gmsh_periodic: Any = None,
        info: Any = None,
    ) -> None: ...
    def copy(self) -> Mesh: ...

class ReadError(Exception): ...
class WriteError(Exception): ...

def read(filename: str | PathLike[str], file_format: str | None = None) -> Mesh: ...
def write(
    filename: str | PathLike[str], mesh: Mesh, file_format: str | None = None, **kwargs: Any
) -> None: ...
