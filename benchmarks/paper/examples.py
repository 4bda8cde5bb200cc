"""The six examples and their variants: meshes, methods, and what a run of them records."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import partial

import jax
import numpy as np

from benchmarks.paper import meshes
from benchmarks.paper.macro import concave_solid
from jaxsmooth.guards.acceptance import AcceptanceRule
from jaxsmooth.mesh.record import Mesh
from jaxsmooth.methods import METHODS
from jaxsmooth.metrics.evaluation import evaluate
from jaxsmooth.motion.detect import detect_constraints
from jaxsmooth.runs.driver import StepRecord, smooth

__all__ = ["EXAMPLES", "Example", "Outcome", "quality_values", "run", "runnable"]

Stage = tuple[str, int]  # method, number of steps
ELASTIC = "elastic"
REPEATS = 3  # of a step; the fastest counts, as other work may share the machine
LAPLACIANS = ("laplacian", "smart-laplacian", "smart-weighted-laplacian")


@dataclass(frozen=True)
class Example:
    """One mesh of the paper and how it is smoothed.

    Attributes:
        key: the example's number, with a suffix for a variant.
        title: for headings.
        build: makes the raw mesh.
        stages: the run that the paper's table follows.
        compared: other methods, three steps each.
        needs_gmsh: whether `build` does.
    """

    key: str
    title: str
    build: Callable[[], meshes.Raw]
    stages: tuple[Stage, ...]
    compared: tuple[str, ...] = ()
    needs_gmsh: bool = False


@dataclass(frozen=True)
class Outcome:
    """A run: the mesh and its record after every step, and what was compiled for how long."""

    label: str
    meshes: list[Mesh] = field(default_factory=list)
    records: list[StepRecord] = field(default_factory=list)
    compile_seconds: float = 0.0

    @property
    def step_seconds(self) -> float:
        """Median time of a step, compiled."""
        return float(np.median([row.seconds for row in self.records[1:]]))


def _part(name: str) -> meshes.Raw:
    from benchmarks import parts  # Gmsh is asked for only where it is needed

    points, tetra = getattr(parts, name)()
    return points, {"tetra": tetra}


EXAMPLES: dict[str, Example] = {
    row.key: row
    for row in (
        Example("1", "Example 1: distorted triangles", meshes.distorted_triangles, ((ELASTIC, 5),)),
        Example("2", "Example 2: triangles and quadrilaterals", meshes.hybrid, ((ELASTIC, 4),)),
        Example(
            "2-quadratic",
            "Example 2 with 6- and 8-node elements",
            lambda: meshes.quadratic(*meshes.hybrid()),
            ((ELASTIC, 4),),
        ),
        Example("3", "Example 3: unstructured triangles, two holes", meshes.two_holes, ((ELASTIC, 4),)),
        Example("3-extruded", "Example 3 extruded to wedges", meshes.extruded, ((ELASTIC, 2),)),
        Example(
            "4",
            "Example 4: concave solid of hexahedra",
            concave_solid,
            ((ELASTIC, 2), ("elastic-extended", 1)),
            (ELASTIC, *LAPLACIANS),
        ),
        Example(
            "5",
            "Example 5: rocker arm",
            partial(_part, "rocker_arm"),
            ((ELASTIC, 3),),
            ("elastic-extended", *LAPLACIANS),
            needs_gmsh=True,
        ),
        Example(
            "6",
            "Example 6: swing frame",
            partial(_part, "swing_frame"),
            ((ELASTIC, 3),),
            ("elastic-extended", *LAPLACIANS),
            needs_gmsh=True,
        ),
    )
}


def runnable(numbers: list[str] | None = None, quick: bool = False) -> list[Example]:
    """The examples with these numbers and their variants; `quick` leaves out those that need Gmsh."""
    chosen = [e for e in EXAMPLES.values() if numbers is None or e.key.split("-")[0] in numbers]
    return [e for e in chosen if not (quick and e.needs_gmsh)]


def run(example: Example, mesh: Mesh | None = None) -> Iterator[Outcome]:
    """The run of the paper's table, then those of the methods it is compared with."""
    mesh = Mesh(*example.build()) if mesh is None else mesh
    constraints = detect_constraints(mesh)
    plans = [("+".join(name for name, _ in example.stages), example.stages)]
    plans += [(name, ((name, 3),)) for name in example.compared]
    for label, stages in plans:
        outcome = Outcome(label, [mesh])
        compiling = 0.0
        for name, steps in stages:
            method = METHODS[name]()
            # every step counts, as in the paper
            every = {"steps": 1, "constraints": constraints, "accept": AcceptanceRule.anything()}
            # what the first step took more than its repetitions is compilation
            first = smooth(outcome.meshes[-1], method, **every).history
            compiling += first[1].seconds
            for index in range(steps):
                here = outcome.meshes[-1]
                results = [smooth(here, method, **every) for _ in range(REPEATS)]
                start, record = results[0].history
                record = replace(
                    record, step=len(outcome.meshes), seconds=min(r.history[1].seconds for r in results)
                )
                compiling -= record.seconds if index == 0 else 0.0
                if not outcome.records:
                    outcome.records.append(start)
                outcome.meshes.append(results[0].mesh)
                outcome.records.append(record)
        yield Outcome(label, outcome.meshes, outcome.records, max(compiling, 0.0))


_evaluate = jax.jit(evaluate)


def quality_values(mesh: Mesh) -> np.ndarray:
    """Quality of all elements, block after block."""
    return np.concatenate([np.asarray(part) for part in _evaluate(mesh.with_labels(None)).quality])
