"""Results as scikit-fem meshes.  The way in is `jaxsmooth.convert.foreign`."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from jaxsmooth.convert.foreign import FOREIGN
from jaxsmooth.convert.meshfile import as_file, as_mesh, to_meshio
from jaxsmooth.convert.regions import recall

__all__ = ["to_skfem"]


def to_skfem(anything: Any) -> Any:
    """A scikit-fem mesh.

    What came as one goes back with other nodes and all else as it was: numbering, subdomains, boundaries.
    Of anything else it has the elements, and the sets as scikit-fem reads them.

    Args:
        anything: what `smooth` returned, or whatever else `as_mesh` takes.

    Raises:
        NotImplementedError: by scikit-fem, for element types that it has not.
        ValueError: the mesh has elements of several types.
        ImportError: scikit-fem is not installed.
    """
    try:
        import skfem
        from skfem.io.meshio import from_meshio
    except ImportError as missing:
        message = "meshes of scikit-fem need it; install it with: pip install scikit-fem"
        raise ImportError(message) from missing
    mesh, file = as_mesh(anything), as_file(anything)
    moved = to_meshio(file, mesh.points)
    known = recall(file.source, FOREIGN)
    if isinstance(known, skfem.Mesh):
        return replace(known, doflocs=np.ascontiguousarray(moved.points.T))
    if len(mesh.types) > 1:
        raise ValueError(f"scikit-fem has meshes of one type; this one has {', '.join(mesh.types)}")
    return from_meshio(moved)
