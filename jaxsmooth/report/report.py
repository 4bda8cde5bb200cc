"""What people see: progress lines, tables, JSON."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import jax
import numpy as np
from rich.console import Console
from rich.table import Table

from jaxsmooth.convert.meshfile import MeshFile
from jaxsmooth.mesh.record import Mesh
from jaxsmooth.mesh.topology import signed_measures
from jaxsmooth.metrics.summary import POOR, corners, evaluated
from jaxsmooth.metrics.validity import inverted
from jaxsmooth.motion.base import Motion
from jaxsmooth.motion.curved import Sliding
from jaxsmooth.runs.driver import SmoothResult, StepRecord

__all__ = [
    "Clock",
    "as_json",
    "console",
    "counts",
    "finite",
    "movable_elements",
    "print_comparison",
]


class Clock:
    """Wall seconds by phase, and the part of them that JAX spent on compiling."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._compiled: dict[str, float] = {}

    @contextmanager
    def __call__(self, phase: str) -> Iterator[None]:
        start, compiled = time.perf_counter(), _compile_seconds()
        yield
        for total, spent in (
            (self.seconds, time.perf_counter() - start),
            (self._compiled, _compile_seconds() - compiled),
        ):
            total[phase] = total.get(phase, 0.0) + spent

    def split(self) -> dict[str, float]:
        """The phases with compilation taken out of them and shown as a phase of its own."""
        parts = {k: max(v - self._compiled[k], 0.0) for k, v in self.seconds.items()}
        return {**parts, "compile": sum(self._compiled.values())}


_compiling = [0.0]


def _compile_seconds() -> float:
    if not _compiling[1:]:

        def listen(event: str, duration_secs: float, **_: Any) -> None:
            if event in ("/jax/core/compile/backend_compile_duration", _LOWERING):
                _compiling[0] += duration_secs

        jax.monitoring.register_event_duration_secs_listener(listen)
        _compiling.append(1.0)
    return _compiling[0]


_LOWERING = "/jax/core/compile/jaxpr_to_mlir_module_duration"


# --- Numbers ---------------------------------------------------------------------------


def movable_elements(mesh: Mesh, constraints: Motion) -> tuple[np.ndarray, ...]:
    """Masks ``[elements]``, one a block, of the elements with a node that may move."""
    free = constraints.at(mesh.points).freedom > 0
    return tuple(np.any(free[np.asarray(nodes)], axis=1) for nodes in mesh.connectivity)


def summarise(mesh: Mesh, masks: tuple[np.ndarray, ...] | None = None) -> dict[str, float]:
    """The statistics of the final table, over all or over chosen elements."""
    evaluation = evaluated(mesh)
    sides = evaluation.quality, corners(mesh.bare, evaluation), inverted(mesh, evaluation.jacobian)
    chosen = masks or (slice(None),) * len(mesh.blocks)
    q, scaled, tangled = (
        np.concatenate([np.asarray(part)[mask] for part, mask in zip(side, chosen, strict=True)])
        for side in sides
    )
    if len(q) == 0:
        return {}
    q = q.astype(np.float64)
    return {
        "q_min": q.min(),
        "q_avg": q.mean(),
        "q_max": q.max(),
        "q_std": q.std(ddof=1) if len(q) > 1 else 0.0,
        "q_below_0.2": int((q < POOR).sum()),
        "inverted": int(tangled.sum()),
        "scaled_jacobian_min": scaled.min(),
    }


def counts(mesh: Mesh) -> dict[str, Any]:
    """Numbers of nodes and of elements by type."""
    sizes = {name: len(nodes) for name, nodes in zip(mesh.types, mesh.connectivity, strict=True)}
    return {"nodes": len(mesh.points), "elements": sizes}


def as_json(
    source: str,
    output: str,
    method: str,
    result: SmoothResult,
    seconds: dict,
    notes: Sequence[str] = (),
) -> dict[str, Any]:
    """The documented JSON of ``smooth``; `notes` are those of the reader and of the writer."""
    return finite(
        {
            "input": str(source),
            "output": str(output),
            "method": method,
            "precision": str(result.mesh.points.dtype),
            "device": jax.default_backend(),
            **counts(result.mesh),
            "status": str(result.status),
            "steps": [row.as_json() for row in result.history],
            "seconds": seconds,
            "notes": list(notes),
        }
    )


def finite(value: Any) -> Any:
    """JSON has no NaN: null stands for it."""
    if isinstance(value, dict):
        return {k: finite(v) for k, v in value.items()}
    if isinstance(value, list):
        return [finite(v) for v in value]
    if isinstance(value, float | np.floating):
        return float(value) if math.isfinite(value) else None
    return value


# --- Console ---------------------------------------------------------------------------


class _Console(Console):
    def on_broken_pipe(self) -> None:
        """Whoever reads has read enough (``| head``); the work goes on."""
        self.quiet = True


def console(quiet: bool = False) -> Console:
    """Where people read: standard output; silent when `quiet`.  Names of files are printed as they are."""
    out = _Console(quiet=quiet, highlight=False, soft_wrap=True, markup=False, emoji=False)
    if not out.is_terminal:
        out.width = 160
    return out


def print_file(out: Console, file: MeshFile) -> None:
    """What was read, and what the reader noticed."""
    sizes = counts(file.mesh)
    elements = ", ".join(f"{number:,} {name}" for name, number in sizes["elements"].items())
    out.print(f"{file.path}: {sizes['nodes']:,} nodes; {elements}")
    print_notes(out, file.notes)


def print_notes(out: Console, notes: tuple[str, ...]) -> None:
    """What the reader or the writer noticed."""
    for note in notes:
        out.print(f"  note: {note}", style="yellow")


def print_constraints(out: Console, constraints: Motion, mesh: Mesh) -> None:
    """How many nodes are held, slide, or are free."""
    tangents, dim = constraints.at(mesh.points), mesh.dim
    freedom = tangents.freedom
    names = ("held", "sliding on an edge", "sliding on a face", "free")
    names = (*names[:dim], names[-1])
    parts = [f"{(freedom == value).sum():,} {name}" for value, name in enumerate(names)]
    if tangents.links is not None:
        parts.append(f"{len(tangents.links.dependent):,} of them following others")
    out.print(f"nodes: {', '.join(parts)}")
    if isinstance(constraints, Sliding):
        parts = [f"{number:,} {where}" for where, number in constraints.counts.items()]
        out.print(f"of those that slide: {', '.join(parts)}")


def print_step(out: Console, row: StepRecord) -> None:
    """The progress line of a step."""
    s = row.statistics
    solver = f" {row.solver_iterations:4d} it" if row.step else " " * 8
    out.print(
        f"step {row.step:2d} q_min {s.q_min:7.4f} q_avg {s.q_avg:6.4f} q<0.2 {s.below:6d}"
        f" inverted {s.inverted:5d}{solver} {row.seconds:5.2f} s"
    )


def print_done(out: Console, row: dict[str, Any]) -> None:
    """One line for one of several files: its row of the JSON."""
    first, last = row["steps"][0], row["steps"][-1]
    numbers = "  ".join(
        f"{label} {first[key]:{form}} → {last[key]:{form}}"
        for key, label, form in (
            ("q_min", "q_min", ".4f"),
            ("q_avg", "q_avg", ".4f"),
            ("q_below_0.2", "below 0.2", "d"),
        )
    )
    remain = f"  inverted {last['inverted']:,}" if last["inverted"] else ""
    out.print(f"{Path(row['input']).name}: {numbers}{remain}")


_ROWS = (
    ("q_min", "q_min", ".4f"),
    ("q_avg", "q_avg", ".4f"),
    ("q_max", "q_max", ".4f"),
    ("q_std", "σ", ".4f"),
    ("q_below_0.2", "q < 0.2", ",d"),
    ("inverted", "inverted", ",d"),
    ("scaled_jacobian_min", "scaled Jacobian, min", ".4f"),
)


def comparison(before: Mesh, result: SmoothResult) -> list[tuple[str, ...]]:
    """Rows of the before/after table: label, all before, all after, movable before, after."""
    masks = movable_elements(before, result.constraints)
    columns = [summarise(m, mask) for mask in (None, masks) for m in (before, result.mesh)]
    return [(label, *(format(c[key], style) if c else "–" for c in columns)) for key, label, style in _ROWS]


def print_comparison(out: Console, before: Mesh, result: SmoothResult) -> None:
    """The final table: before and after, over all and over movable elements."""
    table = Table(box=None, pad_edge=False)
    table.add_column("")
    for group in ("all", "movable"):
        for moment in ("before", "after"):
            table.add_column(f"{group}\n{moment}", justify="right")
    for row in comparison(before, result):
        table.add_row(*row)
    out.print(table)
    if isinstance(result.constraints, Sliding):
        first, last = (
            sum(
                signed_measures(kind, np.asarray(m.points), np.asarray(nodes)).sum()
                for kind, nodes in m.blocks
            )
            for m in (before, result.mesh)
        )
        what = "area" if before.element_dim == 2 else "volume"
        out.print(f"{what} changed by {(last - first) / first:+.2e}")
