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
    "cells.table": ("element_type",),
    "convert.meshfile": ("MeshFile", "as_mesh", "from_meshio"),
    "files.io": ("read", "write"),
    "guards.acceptance": ("AcceptanceRule", "Status"),
    "guards.base": ("Guard",),
    "guards.patch": ("PatchGuard",),
    "mesh.layers": ("boundary_layers", "stretched"),
    "mesh.record": ("Labels", "Mesh"),
    "methods": ("METHODS", "Elastic", "Laplacian", "Method", "Optimize"),
    "methods.elastic.elasticity": ("Material",),
    "methods.optimize.goals": ("Goal", "Stage"),
    "methods.optimize.minimise": ("Minimiser",),
    "metrics.evaluation": ("Evaluation", "evaluate"),
    "metrics.summary": ("Statistics", "statistics"),
    "metrics.table": ("METRICS", "quality", "quality_mean"),
    "motion.base": ("Motion",),
    "motion.curved": ("Sliding",),
    "motion.detect": ("detect_constraints",),
    "motion.given": ("host_nearest", "on_surface"),
    "motion.planar": ("Constraints",),
    "runs.batch": ("Batch", "stack"),
    "runs.driver": ("SmoothResult", "smooth"),
    "runs.pure": ("FixedPoint", "Run", "fixed_point", "run", "step"),
    "targets": ("FreeSize", "GivenSize", "OwnSize", "Target"),
}
_HOME = {name: home for home, names in _HOMES.items() for name in names}
__all__ = sorted(_HOME)

if TYPE_CHECKING:
    from jaxsmooth.cells.table import element_type
    from jaxsmooth.convert.meshfile import MeshFile, as_mesh, from_meshio
    from jaxsmooth.files.io import read, write
    from jaxsmooth.guards.acceptance import AcceptanceRule, Status
    from jaxsmooth.guards.base import Guard
    from jaxsmooth.guards.patch import PatchGuard
    from jaxsmooth.mesh.layers import boundary_layers, stretched
    from jaxsmooth.mesh.record import Labels, Mesh
    from jaxsmooth.methods import METHODS, Elastic, Laplacian, Method, Optimize
    from jaxsmooth.methods.elastic.elasticity import Material
    from jaxsmooth.methods.optimize.goals import Goal, Stage
    from jaxsmooth.methods.optimize.minimise import Minimiser
    from jaxsmooth.metrics.evaluation import Evaluation, evaluate
    from jaxsmooth.metrics.summary import Statistics, statistics
    from jaxsmooth.metrics.table import METRICS, quality, quality_mean
    from jaxsmooth.motion.base import Motion
    from jaxsmooth.motion.curved import Sliding
    from jaxsmooth.motion.detect import detect_constraints
    from jaxsmooth.motion.given import host_nearest, on_surface
    from jaxsmooth.motion.planar import Constraints
    from jaxsmooth.runs.batch import Batch, stack
    from jaxsmooth.runs.driver import SmoothResult, smooth
    from jaxsmooth.runs.pure import FixedPoint, Run, fixed_point, run, step
    from jaxsmooth.targets import FreeSize, GivenSize, OwnSize, Target


def __getattr__(name: str):
    if name not in _HOME:
        raise AttributeError(f"module 'jaxsmooth' has no attribute {name!r}")
    value = getattr(import_module(f"jaxsmooth.{_HOME[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return [*globals(), *__all__]
