"""Finite-element mesh smoothing in JAX: every element type, differentiable, on CPU and GPU.

    import jaxsmooth as js

    file = js.read("part.msh")
    result = js.smooth(file.mesh)
    js.write("part-smooth.vtu", file, result)

Names are imported when they are first used, so that ``jaxsmooth --help`` need not load JAX.
"""

from importlib import import_module
from typing import TYPE_CHECKING

__version__ = "0.1.0"

_HOMES = {
    "acceptance": ("AcceptanceRule", "Statistics", "Status"),
    "batch": ("Batch", "stack"),
    "constraints": ("Constraints", "detect_constraints"),
    "elasticity": ("Material",),
    "elements": ("element_type",),
    "io": ("read", "write"),
    "layers": ("boundary_layers", "stretched"),
    "mesh": ("Labels", "Mesh"),
    "meshfile": ("MeshFile", "as_mesh", "from_meshio"),
    "methods": ("METHODS", "Elastic", "Laplacian", "Method", "Optimize"),
    "patches": ("PatchGuard",),
    "metrics": ("METRICS", "quality", "quality_mean"),
    "runs": ("FixedPoint", "fixed_point", "run", "step"),
    "smoothing": ("SmoothResult", "smooth", "statistics"),
}
_HOME = {name: home for home, names in _HOMES.items() for name in names}
__all__ = sorted(_HOME)

if TYPE_CHECKING:
    from jaxsmooth.acceptance import AcceptanceRule, Statistics, Status
    from jaxsmooth.batch import Batch, stack
    from jaxsmooth.constraints import Constraints, detect_constraints
    from jaxsmooth.elasticity import Material
    from jaxsmooth.elements import element_type
    from jaxsmooth.io import read, write
    from jaxsmooth.layers import boundary_layers, stretched
    from jaxsmooth.mesh import Labels, Mesh
    from jaxsmooth.meshfile import MeshFile, as_mesh, from_meshio
    from jaxsmooth.methods import METHODS, Elastic, Laplacian, Method, Optimize
    from jaxsmooth.metrics import METRICS, quality, quality_mean
    from jaxsmooth.patches import PatchGuard
    from jaxsmooth.runs import FixedPoint, fixed_point, run, step
    from jaxsmooth.smoothing import SmoothResult, smooth, statistics


def __getattr__(name: str):
    if name not in _HOME:
        raise AttributeError(f"module 'jaxsmooth' has no attribute {name!r}")
    value = getattr(import_module(f"jaxsmooth.{_HOME[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return [*globals(), *__all__]
