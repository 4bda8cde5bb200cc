"""The report of ``jaxsmooth quality``: statistics, histogram, worst elements, tables of all elements."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Mapping, Sequence
from textwrap import wrap
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from jaxsmooth.cells.table import element_type
from jaxsmooth.convert.meshfile import MeshFile, to_meshio
from jaxsmooth.mesh.record import Mesh
from jaxsmooth.metrics.record import Metric
from jaxsmooth.metrics.table import METRICS, USUAL, named, quality
from jaxsmooth.metrics.validity import inverted
from jaxsmooth.report.holding import Holding

__all__ = [
    "cell_data",
    "centroids",
    "chosen_metrics",
    "csv_text",
    "histogram",
    "measured",
    "print_report",
    "print_worst",
    "quality_rows",
    "requested",
    "worst",
    "worst_rows",
]

Values = dict[Metric, tuple[np.ndarray, ...]]
"""Of every metric one array ``[elements]`` a block; NaN in blocks that it is not for."""

_BINS = 10
_BAR = 48  # characters of the longest bar
_WORST = 5


def requested(words: Sequence[str], path: str | None) -> tuple[list[str], str]:
    """Names of metrics, and the file: the last word where it stands behind ``--metric``.

    Raises:
        ValueError: there is no file, or an unknown name.
    """
    words = [*words]
    if path is None:
        if len(words) < 2:
            raise ValueError("quality needs a mesh file; name it before the options")
        path = words.pop()
    names = [name for word in words for name in word.split(",")]
    for name in set(names) - {"all"}:
        named(name)
    return names, path


def chosen_metrics(names: Sequence[str], mesh: Mesh) -> tuple[Metric, ...]:
    """Metrics by name: the usual ones if there is none, with ``all`` those that are for the mesh."""
    if not names:
        return USUAL
    if "all" in names:
        return tuple(row for row in METRICS.values() if any(row.applies_to(kind) for kind, _ in mesh.blocks))
    return tuple(dict.fromkeys(named(name) for name in names))


def measured(mesh: Mesh, metrics: Sequence[Metric]) -> Values:
    """The metrics of all elements.  Raises `ValueError` for one that is for none of them."""
    return {row: tuple(np.asarray(part, np.float64) for part in quality(mesh, row)) for row in metrics}


def quality_rows(mesh: Mesh, values: Values) -> list[dict[str, Any]]:
    """One row of statistics for every metric and every element block that it is for."""
    tangled = sum(int(part.sum()) for part in inverted(mesh))
    rows = []
    for metric, parts in values.items():
        low, high = metric.acceptable
        for name, part in zip(mesh.types, parts, strict=True):
            if not metric.applies_to(element_type(name)):
                continue
            finite = np.isfinite(part).all()
            numbers = {
                "min": part.min(),
                "avg": part.mean() if finite else math.nan,
                "max": part.max(),
                "std": part.std(ddof=1) if finite and len(part) > 1 else 0.0 if finite else math.nan,
            }
            unacceptable = int((~((part >= low) & (part <= high))).sum())
            rows.append(
                {
                    "metric": metric.name,
                    "type": name,
                    "elements": len(part),
                    **{key: float(value) if math.isfinite(value) else None for key, value in numbers.items()},
                    "unacceptable": unacceptable,
                    "inverted": tangled,
                }
            )
    return rows


def print_report(
    out: Console, values: Values, rows: list[dict[str, Any]], worst: list[dict[str, Any]]
) -> None:
    """The table, and of the first metric the histogram and the worst elements."""
    _print_table(out, rows)
    metric, parts = next(iter(values.items()))
    _print_histogram(out, metric, parts)
    print_worst(out, metric, worst)


def _print_table(out: Console, rows: list[dict[str, Any]]) -> None:
    """The table of statistics; a mesh of several types has a row for each below the name of the metric."""
    table = Table(box=None, pad_edge=False)
    for name in ("metric", "min", "avg", "max", "std", "unacceptable"):
        table.add_column(name, justify="left" if name == "metric" else "right", no_wrap=True)
    several = len({row["type"] for row in rows}) > 1
    before = ""
    for row in rows:
        numbers = [_number(row[name]) for name in ("min", "avg", "max", "std")]
        if several and row["metric"] != before:
            table.add_row(row["metric"])
        label = f"  {row['type']}" if several else row["metric"]
        table.add_row(label, *numbers, f"{row['unacceptable']:,}")
        before = row["metric"]
    out.print(table)
    if rows and rows[0]["inverted"]:
        out.print(f"{rows[0]['inverted']:,} elements are inverted", style="red")


def _number(value: float | None) -> str:
    return "–" if value is None else f"{value:.4g}"


# --- Histogram and worst elements ---------------------------------------------------------------------


def histogram(metric: Metric, values: np.ndarray) -> list[tuple[str, int]]:
    """Ten bins closed on the right, and what lies outside: labels and counts.

    A metric whose range ends at 0 or below and at 1 has bins from 0 to 1; others from the least to the
    greatest finite value.
    """
    values = values[~np.isnan(values)]
    finite = values[np.isfinite(values)]
    low, high = (0.0, 1.0) if metric.range[0] <= 0 and metric.range[1] == 1 else _span(finite)
    edges = np.linspace(low, high, _BINS + 1)
    place = np.searchsorted(edges, values, side="left")  # 0 up to the first edge, 1 in the first bin
    if low != 0.0 or high != 1.0:
        place = np.where(values == low, 1, place)  # the least value belongs to the first bin
    counts = np.bincount(place, minlength=_BINS + 2)
    inner = [(f"{a:.4g} … {b:.4g}", int(n)) for a, b, n in zip(edges, edges[1:], counts[1:-1], strict=False)]
    below = [(f"≤ {low:.4g}", int(counts[0]))] if counts[0] else []
    above = [(f"> {high:.4g}", int(counts[-1]))] if counts[-1] else []
    return below + inner + above


def _span(finite: np.ndarray) -> tuple[float, float]:
    if not len(finite):
        return 0.0, 1.0
    low, high = float(finite.min()), float(finite.max())
    return (low, high) if high > low else (low, low + max(abs(low), 1.0))


def _print_histogram(out: Console, metric: Metric, parts: Sequence[np.ndarray]) -> None:
    """The histogram of a metric over all elements that have it."""
    rows = histogram(metric, np.concatenate(list(parts)))
    most = max(count for _, count in rows)
    unit = f" in {metric.units}" if metric.units in ("degrees", "length") else ""
    out.print(f"\n{metric.name}{unit}: {metric.summary}")
    for label, count in rows:
        bar = "#" * math.ceil(_BAR * count / max(most, 1))
        out.print(f"{label:>19} {count:>9,} {bar}")


def worst(metric: Metric, parts: Sequence[np.ndarray], count: int = _WORST) -> list[tuple[int, int, float]]:
    """The worst elements: block, element in it, value; the least ones where neither end is better."""
    block = np.repeat(np.arange(len(parts)), [len(part) for part in parts])
    element = np.concatenate([np.arange(len(part)) for part in parts])
    values = np.concatenate(list(parts))
    order = -values if metric.larger_is_better is False else values  # NaN is sorted to the end
    first = np.argsort(order, kind="stable")[:count]
    return [(int(block[i]), int(element[i]), float(values[i])) for i in first if not np.isnan(values[i])]


def worst_rows(
    file: MeshFile, metric: Metric, parts: Sequence[np.ndarray], held: Holding, points: Any = None
) -> list[dict[str, Any]]:
    """The worst elements by a metric: type, number in it from 0, value, centroid, and what holds the nodes.

    `points` are coordinates in place of those of the file."""
    found = worst(metric, parts)
    points = np.asarray(to_meshio(file, points).points, np.float64)
    rows = []
    for block, element, value in found:
        kind, nodes = file.mesh.blocks[block][0], np.asarray(file.mesh.connectivity[block][element])
        place = points[nodes[: kind.corners]].mean(axis=0).tolist()
        number = value if math.isfinite(value) else None
        row = {"type": kind.name, "element": element, "metric": metric.name, "value": number}
        rows.append({**row, "place": place, "nodes": held.of(nodes)})
    return rows


def print_worst(out: Console, metric: Metric, rows: list[dict[str, Any]]) -> None:
    """The worst elements, with their place and what holds them."""
    out.print(f"\nworst by {metric.name} (numbered from 0 in their type)")
    for row in rows:
        place = ", ".join(f"{x:.6g}" for x in row["place"])
        out.print(f"{row['type']:>12} {row['element']:>9} {_number(row['value']):>11}   at ({place})")
        for line in wrap(f"nodes: {row['nodes']}", 64):
            out.print(f"{'':>12} {line}", style="dim")


def centroids(file: MeshFile, mesh: Mesh | None = None) -> list[np.ndarray]:
    """Means of the corners ``[elements, dim]`` of every block: in the file, or of a mesh in its place."""
    points = np.asarray(
        file.source.points if mesh is None else to_meshio(file, mesh.points).points, np.float64
    )
    corners = [
        np.asarray(nodes)[:, : element_type(name).corners]
        for name, nodes in zip(file.mesh.types, file.mesh.connectivity, strict=True)
    ]
    return [points[nodes].mean(axis=1) for nodes in corners]


# --- Files --------------------------------------------------------------------------------------------


def csv_text(file: MeshFile, values: Values) -> str:
    """A row an element: type, number in it from 0, region, centroid, metrics; empty where there is none."""
    mesh, places = file.mesh, centroids(file)
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    axes = ("x", "y", "z")[: places[0].shape[1]]
    writer.writerow(["type", "element", "region", *axes, *(metric.name for metric in values)])
    for block, name in enumerate(mesh.types):
        count = len(mesh.connectivity[block])
        regions = mesh.labels.regions[block].tolist() if mesh.labels is not None else [""] * count
        columns = [*places[block].T.tolist(), *(_cells(parts[block]) for parts in values.values())]
        writer.writerows(zip([name] * count, range(count), regions, *columns, strict=True))
    return stream.getvalue()


def _cells(part: np.ndarray) -> list[float | str]:
    return ["" if math.isnan(value) else value for value in part.tolist()]


def cell_data(mesh: Mesh, values: Values) -> Mapping[str, Mapping[str, np.ndarray]]:
    """The metrics as `jaxsmooth.files.io.write` takes them: ``{name: {type: [elements]}}``."""
    return {metric.name: dict(zip(mesh.types, parts, strict=True)) for metric, parts in values.items()}
