"""Several methods on one mesh, side by side, and which of them to take."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from textwrap import wrap
from typing import Any

from rich.console import Console
from rich.table import Table

from jaxsmooth.mesh.record import Mesh
from jaxsmooth.metrics.summary import POOR
from jaxsmooth.motion.base import Motion
from jaxsmooth.report.report import finite, movable_elements, summarise
from jaxsmooth.runs.driver import SmoothResult

__all__ = [
    "columns",
    "compare_row",
    "print_advice",
    "print_head",
    "print_movable",
    "print_row",
    "recommend",
]

_CLOSE = 1e-3  # of the average quality: what nobody sees in a solution
_CHEAP = 0.5  # part of the time of the best method, below which a quicker one is worth a word
_WIDTHS = {"q_min": 9, "q_avg": 8, "q<0.2": 9, "inverted": 10, "sj_min": 10, "seconds": 9}
_NAME = 25


def compare_row(
    name: str, mesh: Mesh, result: SmoothResult | None, constraints: Motion, seconds: dict
) -> dict[str, Any]:
    """One row of ``compare``: statistics over all and over movable elements, steps, seconds."""
    final = mesh if result is None else result.mesh
    masks = movable_elements(mesh, constraints)
    return finite(
        {
            "method": name,
            "all": summarise(final),
            "movable": summarise(final, masks),
            "steps": 0 if result is None else len(result.history) - 1,
            "status": "" if result is None else str(result.status),
            "seconds": seconds.get("smooth", 0.0),
            "compile_seconds": seconds.get("compile", 0.0),
        }
    )


# --- Which to take ---------------------------------------------------------------------


def recommend(rows: Sequence[dict[str, Any]]) -> tuple[str, list[str]]:
    """The method to take, or ``input``, and the reasons.

    The fewest inverted elements come first, then the fewest poor ones, then the average quality.  Of those
    equal in the first two and within 0.001 of the best average the quickest is taken, and of equally quick
    ones the first.  Only methods that are better than the input by this order are looked at.

    Args:
        rows: of `compare_row`, that of the input first.
    """
    first, *others = rows
    better = [row for row in others if _order(row) > _order(first)]
    if not better:
        return "input", ["Take none of them: no method makes this mesh better."]
    best = _best(better)
    return best["method"], [_reason(first, best), *_cheaper(best, better)]


def _order(row: dict[str, Any]) -> tuple[float, float, float]:
    """Larger is better."""
    numbers = row["all"]
    average = numbers["q_avg"]
    return -numbers["inverted"], -numbers["q_below_0.2"], -1.0 if average is None else average


def _best(rows: list[dict[str, Any]]) -> dict[str, Any]:
    top = max(_order(row) for row in rows)
    close = [row for row in rows if _order(row)[:2] == top[:2] and _order(row)[2] >= top[2] - _CLOSE]
    return min(close, key=lambda row: row["seconds"])


def _reason(first: dict[str, Any], best: dict[str, Any]) -> str:
    old, new = first["all"], best["all"]
    parts = []
    if old["inverted"] or new["inverted"]:
        parts.append(f"{new['inverted']:,} inverted elements ({old['inverted']:,} before)")
    parts.append(f"{new['q_below_0.2']:,} below q = {POOR} ({old['q_below_0.2']:,} before)")
    parts.append(f"q_avg {_number(new['q_avg'])} ({_number(old['q_avg'])})")
    cost = f"{best['seconds']:.2f} s, once compiled in {best['compile_seconds']:.1f} s"
    return f"Take {best['method']}: {', '.join(parts)}; it takes {cost}."


def _cheaper(best: dict[str, Any], better: list[dict[str, Any]]) -> list[str]:
    """The best of those that make the mesh better too, in less than half of the time."""
    quick = [row for row in better if row["seconds"] < _CHEAP * best["seconds"]]
    if not quick:
        return []
    row = _best(quick)
    numbers = row["all"]
    remain = f"{numbers['inverted']:,} inverted and " if numbers["inverted"] else ""
    return [
        f"In a hurry: {row['method']} takes {row['seconds']:.2f} s and leaves {remain}"
        f"{numbers['q_below_0.2']:,} below q = {POOR}, q_avg {_number(numbers['q_avg'])}."
    ]


# --- Tables ----------------------------------------------------------------------------


def _number(value: float | None) -> str:
    return "–" if value is None else f"{value:.4g}"


def _cells(row: Mapping[str, Any], part: str) -> dict[str, str]:
    numbers = row[part]
    return {
        "q_min": _number(numbers.get("q_min")),
        "q_avg": _number(numbers.get("q_avg")),
        "q<0.2": f"{numbers.get('q_below_0.2', 0):,}",
        "inverted": f"{numbers.get('inverted', 0):,}",
        "sj_min": _number(numbers.get("scaled_jacobian_min")),
        "steps": str(row["steps"]),
        "seconds": f"{row['seconds']:.2f}",
        "compile": f"{row['compile_seconds']:.1f}",
    }


def columns(rows: Sequence[Mapping[str, Any]]) -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
    """Heads and cells of the table over all elements, with steps and compilation."""
    names = (*_WIDTHS, "steps", "compile")
    return ("method", *names), [(row["method"], *(_cells(row, "all")[n] for n in names)) for row in rows]


def print_head(out: Console) -> None:
    """The names of the columns of `print_row`."""
    out.print("all elements", style="bold")
    heads = "".join(f"{name:>{width}}" for name, width in _WIDTHS.items())
    out.print(f"{'method':{_NAME}}{heads}", style="bold")


def print_row(out: Console, row: dict[str, Any]) -> None:
    """What a method made of all elements, as soon as it has."""
    cells = _cells(row, "all")
    out.print(f"{row['method']:{_NAME}}" + "".join(f"{cells[n]:>{w}}" for n, w in _WIDTHS.items()))


def print_movable(out: Console, rows: list[dict[str, Any]]) -> None:
    """The table over the elements with a node that may move."""
    title = "with a node that may move"
    table = Table(box=None, pad_edge=False, title=title, title_justify="left", title_style="bold")
    heads = ("q_min", "q_avg", "q<0.2", "steps", "compile")
    for name in ("method", *heads):
        table.add_column(name, justify="left" if name == "method" else "right", no_wrap=True)
    for row in rows:
        cells = _cells(row, "movable")
        table.add_row(row["method"], *(cells[name] for name in heads))
    out.print(table)
    out.print("seconds are without compilation", style="dim")


def print_advice(out: Console, sentences: list[str]) -> None:
    """What `recommend` says, in lines of 80 columns."""
    for sentence in sentences:
        for line in wrap(sentence, 80):
            out.print(line)
