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
    "adaptors": ("gmsh",),
    "adaptors.pyvista": ("to_pyvista",),
    "adaptors.skfem": ("to_skfem",),
    "cache": ("keep_compiled",),
    "cells.table": ("element_type",),
    "convert.meshfile": ("MeshFile", "as_mesh", "from_meshio", "to_meshio"),
    "convert.periodic": ("find_periodic",),
    "files.io": ("read", "write"),
    "guards.acceptance": ("AcceptanceRule", "Status"),
    "guards.base": ("Guard",),
    "guards.patch": ("PatchGuard",),
    "mesh.layers": ("boundary_layers", "stretched"),
    "mesh.links": ("NodeLinks",),
    "mesh.record": ("Labels", "Mesh"),
    "methods": ("METHODS", "Elastic", "Laplacian", "Method", "Optimize", "Untangle"),
    "methods.elastic.elasticity": ("Material",),
    "methods.optimize.energy": ("Energy", "energy"),
    "methods.optimize.goals": ("Goal", "Stage", "When"),
    "methods.optimize.minimise": ("Minimiser",),
    "methods.optimize.problem": ("Aggregation",),
    "metrics.evaluation": ("Evaluation", "evaluate"),
    "metrics.record": ("Metric",),
    "metrics.summary": ("Statistics", "statistics"),
    "metrics.table": ("METRICS", "quality", "quality_least", "quality_mean"),
    "motion.base": ("Motion",),
    "motion.coupled": ("Coupled", "couple"),
    "motion.curved": ("Sliding",),
    "motion.detect": ("detect_constraints",),
    "motion.following": ("Following", "follow"),
    "motion.given": ("host_nearest", "on_surface"),
    "motion.planar": ("Constraints",),
    "report.progress": ("progress",),
    "runs.batch": ("Batch", "stack"),
    "runs.design": ("Design", "design", "filter_gradient"),
    "runs.driver": ("SmoothResult", "smooth"),
    "runs.optimum": ("Optimum", "optimum"),
    "runs.pure": ("FixedPoint", "Run", "fixed_point", "if_valid", "run", "step"),
    "targets": ("FreeSize", "GivenSize", "OwnSize", "Target"),
}
_MODULES = {"gmsh"}  # names of modules
_HOME = {name: home for home, names in _HOMES.items() for name in names}
__all__ = [
    "METHODS",
    "METRICS",
    "AcceptanceRule",
    "Aggregation",
    "Batch",
    "Constraints",
    "Coupled",
    "Design",
    "Elastic",
    "Energy",
    "Evaluation",
    "FixedPoint",
    "Following",
    "FreeSize",
    "GivenSize",
    "Goal",
    "Guard",
    "Labels",
    "Laplacian",
    "Material",
    "Mesh",
    "MeshFile",
    "Method",
    "Metric",
    "Minimiser",
    "Motion",
    "NodeLinks",
    "Optimize",
    "Optimum",
    "OwnSize",
    "PatchGuard",
    "Run",
    "Sliding",
    "SmoothResult",
    "Stage",
    "Statistics",
    "Status",
    "Target",
    "Untangle",
    "When",
    "as_mesh",
    "boundary_layers",
    "couple",
    "design",
    "detect_constraints",
    "element_type",
    "energy",
    "evaluate",
    "filter_gradient",
    "find_periodic",
    "fixed_point",
    "follow",
    "from_meshio",
    "gmsh",
    "host_nearest",
    "if_valid",
    "keep_compiled",
    "on_surface",
    "optimum",
    "progress",
    "quality",
    "quality_least",
    "quality_mean",
    "read",
    "run",
    "smooth",
    "stack",
    "statistics",
    "step",
    "stretched",
    "to_meshio",
    "to_pyvista",
    "to_skfem",
    "write",
]

if TYPE_CHECKING:
    from jaxsmooth.adaptors import gmsh
    from jaxsmooth.adaptors.pyvista import to_pyvista
    from jaxsmooth.adaptors.skfem import to_skfem
    from jaxsmooth.cache import keep_compiled
    from jaxsmooth.cells.table import element_type
    from jaxsmooth.convert.meshfile import MeshFile, as_mesh, from_meshio, to_meshio
    from jaxsmooth.convert.periodic import find_periodic
    from jaxsmooth.files.io import read, write
    from jaxsmooth.guards.acceptance import AcceptanceRule, Status
    from jaxsmooth.guards.base import Guard
    from jaxsmooth.guards.patch import PatchGuard
    from jaxsmooth.mesh.layers import boundary_layers, stretched
    from jaxsmooth.mesh.links import NodeLinks
    from jaxsmooth.mesh.record import Labels, Mesh
    from jaxsmooth.methods import METHODS, Elastic, Laplacian, Method, Optimize, Untangle
    from jaxsmooth.methods.elastic.elasticity import Material
    from jaxsmooth.methods.optimize.energy import Energy, energy
    from jaxsmooth.methods.optimize.goals import Goal, Stage, When
    from jaxsmooth.methods.optimize.minimise import Minimiser
    from jaxsmooth.methods.optimize.problem import Aggregation
    from jaxsmooth.metrics.evaluation import Evaluation, evaluate
    from jaxsmooth.metrics.record import Metric
    from jaxsmooth.metrics.summary import Statistics, statistics
    from jaxsmooth.metrics.table import METRICS, quality, quality_least, quality_mean
    from jaxsmooth.motion.base import Motion
    from jaxsmooth.motion.coupled import Coupled, couple
    from jaxsmooth.motion.curved import Sliding
    from jaxsmooth.motion.detect import detect_constraints
    from jaxsmooth.motion.following import Following, follow
    from jaxsmooth.motion.given import host_nearest, on_surface
    from jaxsmooth.motion.planar import Constraints
    from jaxsmooth.report.progress import progress
    from jaxsmooth.runs.batch import Batch, stack
    from jaxsmooth.runs.design import Design, design, filter_gradient
    from jaxsmooth.runs.driver import SmoothResult, smooth
    from jaxsmooth.runs.optimum import Optimum, optimum
    from jaxsmooth.runs.pure import FixedPoint, Run, fixed_point, if_valid, run, step
    from jaxsmooth.targets import FreeSize, GivenSize, OwnSize, Target


def __getattr__(name: str):
    if name not in _HOME:
        raise AttributeError(f"module 'jaxsmooth' has no attribute {name!r}")
    home = f"jaxsmooth.{_HOME[name]}"
    value = import_module(f"{home}.{name}") if name in _MODULES else getattr(import_module(home), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return [*globals(), *__all__]
