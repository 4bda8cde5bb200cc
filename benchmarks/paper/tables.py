"""Tables in Markdown and CSV: measured next to printed."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.paper.examples import Outcome
from benchmarks.paper.printed import COMPARISON, ELEMENTS, EVOLUTION, METRIC_ROWS, SHAPES
from jaxsmooth.cells.table import element_type
from jaxsmooth.mesh.record import Mesh
from jaxsmooth.metrics.table import METRICS, quality

__all__ = ["Table", "comparison", "evolution", "metrics", "timing", "write_csv"]

MARGIN = 0.01  # a quality is reached from this much below the printed value on


@dataclass(frozen=True)
class Table:
    """A heading, column names, and rows of text."""

    name: str
    title: str
    columns: Sequence[str]
    rows: list[list[str]]

    def markdown(self) -> str:
        """The table with its heading."""
        lines = [self.columns, ["---"] * len(self.columns), *self.rows]
        return "\n".join([f"### {self.title}", "", *("| " + " | ".join(line) + " |" for line in lines), ""])


def write_csv(table: Table, folder: Path) -> None:
    """Write ``NAME.csv``."""
    with (folder / f"{table.name}.csv").open("w", newline="", encoding="utf-8") as stream:
        csv.writer(stream).writerows([table.columns, *table.rows])


def metrics() -> list[Table]:
    """Tables 1 and 2: the metrics on the shapes of Figs. 1 and 2, the printed values in brackets."""
    tables = []
    for number, dim in ((1, 2), (2, 3)):
        rows = []
        for kind, author, name, printed in METRIC_ROWS:
            if element_type(kind).dim != dim:
                continue
            shapes = np.array([SHAPES[kind][column] for column in "abcd"], float)
            mesh = Mesh(np.concatenate(shapes), {kind: np.arange(shapes[..., 0].size).reshape(4, -1)})
            found = np.asarray(quality(mesh, METRICS[name])[0])
            cells = [f"{ours:.3f} ({paper:.3f})" for ours, paper in zip(found, printed, strict=True)]
            agrees = np.abs(found - printed).max() < 1e-3  # printed to three decimals
            rows.append([kind, author, *cells, name, _mark(agrees)])
        title = f"Table {number}: quality metrics in {dim}D, measured (paper)"
        tables.append(
            Table(f"table{number}", title, ("element", "author", *"abcd", "metric here", "agrees"), rows)
        )
    return tables


def evolution(key: str, title: str, outcome: Outcome) -> Table:
    """Tables 3–6: the quality along the iterations."""
    printed = EVOLUTION.get(key)
    columns = ["iteration"]
    for name in ("q_min", "q_max", "q_avg", "σ"):
        columns += [name, "paper"] if printed else [name]
    rows = []
    for index, record in enumerate(outcome.records):
        stats = record.statistics
        row = [str(index)]
        values = (stats.q_min, stats.q_max, stats.q_avg, stats.q_std)
        for column, value in enumerate(values):
            digits = 5 if column == 3 else 3
            row.append(f"{value:.{digits}f}")
            if printed:
                paper = printed[index][column]
                row.append("–" if paper is None else f"{paper:.{digits}f}")
        if printed:
            pairs = [(values[c], printed[index][c]) for c in (0, 2) if printed[index][c] is not None]
            row.append("–" if index == 0 else _mark(all(ours >= paper - MARGIN for ours, paper in pairs)))
        rows.append(row)
    if printed:
        columns.append(f"q_min, q_avg ≥ paper − {MARGIN}")
    return Table(f"example{key}", title, columns, rows)


def comparison(key: str, title: str, outcomes: list[Outcome]) -> Table:
    """Tables 7 and 8, and their like for Example 4: methods after three iterations."""
    printed = COMPARISON.get(key, {})
    before = outcomes[0].records[0].statistics
    start = printed.get("initial mesh", (None, None, None))
    columns = (
        *("method", "q_min", "q_avg", "paper", "q < 0.2", "paper", "left", "paper"),
        *("inverted", "s a step", "paper", "compile s"),
    )

    def paper(value: float | None, digits: int) -> str:
        return "–" if value is None else f"{value:.{digits}f}"

    def share(count: int | None, total: int | None) -> str:
        return f"{count / total:.1%}" if count is not None and total else "–"

    first = [
        f"{before.q_min:.3f}",
        f"{before.q_avg:.3f}",
        paper(start[0], 3),
        str(before.below),
        paper(start[1], 0),
    ]
    rows = [["initial mesh", *first, "–", "–", str(before.inverted), "–", "–", "–"]]
    for outcome in outcomes:
        stats = outcome.records[-1].statistics
        average, count, seconds = printed.get(outcome.label, (None, None, None))
        rows.append(
            [
                outcome.label,
                *(f"{stats.q_min:.3f}", f"{stats.q_avg:.3f}", paper(average, 3)),
                *(
                    str(stats.below),
                    paper(count, 0),
                    share(stats.below, before.below),
                    share(count, start[1]),
                ),
                *(str(stats.inverted), f"{outcome.step_seconds:.3f}", paper(seconds, 2)),
                f"{outcome.compile_seconds:.1f}",
            ]
        )
    elements = sum(len(block) for block in outcomes[0].meshes[0].connectivity)
    heading = (
        f"{title}: methods compared after three iterations ({elements:,} elements, paper {ELEMENTS[key]:,})"
    )
    return Table(f"comparison{key}", heading, columns, rows)


def timing(results: dict[str, list[Outcome]]) -> Table:
    """Time of a step and of compilation, for every run."""
    rows = [
        [
            key,
            str(sum(len(b) for b in o.meshes[0].connectivity)),
            o.label,
            f"{o.step_seconds:.4f}",
            f"{o.compile_seconds:.1f}",
        ]
        for key, outcomes in results.items()
        for o in outcomes
    ]
    return Table("timing", "Time", ("example", "elements", "method", "s a step", "compile s"), rows)


def _mark(reached: bool) -> str:
    return "yes" if reached else "**no**"
