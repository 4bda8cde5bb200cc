"""Sections of the HTML report: numbers, histogram, tables."""

from __future__ import annotations

import html
import math
import platform
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from importlib.metadata import version
from typing import Any

import jax
import numpy as np

import jaxsmooth
from jaxsmooth.mesh.record import Mesh
from jaxsmooth.metrics.summary import POOR, evaluated
from jaxsmooth.metrics.validity import inverted
from jaxsmooth.report.holding import REASONS, Holding
from jaxsmooth.report.scene import COLOURS
from jaxsmooth.runs.driver import SmoothResult

__all__ = ["cards", "histogram", "nodes", "parts", "run", "steps", "table", "worst"]

_WORST = 12


def cards(result: SmoothResult) -> str:
    first, last = result.history[0].statistics, result.history[-1].statistics
    rows = (
        ("least quality", f"{first.q_min:.3f}", f"{last.q_min:.3f}", last.q_min - first.q_min),
        ("average quality", f"{first.q_avg:.3f}", f"{last.q_avg:.3f}", last.q_avg - first.q_avg),
        (f"elements below {POOR}", f"{first.below:,}", f"{last.below:,}", first.below - last.below),
        ("inverted elements", f"{first.inverted:,}", f"{last.inverted:,}", first.inverted - last.inverted),
        (
            "least scaled Jacobian",
            f"{first.scaled_jacobian_min:.3f}",
            f"{last.scaled_jacobian_min:.3f}",
            last.scaled_jacobian_min - first.scaled_jacobian_min,
        ),
    )
    return "".join(
        f'<div class="card"><small>{name}</small><span>{old} → </span>'
        f'<b class="{"good" if gain > 1e-6 else "bad" if gain < -1e-6 else ""}">{new}</b></div>'
        for name, old, new, gain in rows
    )


# --- Histogram ----------------------------------------------------------------------------------------

_WIDTH, _HEIGHT, _LEFT, _FOOT = 480, 200, 50, 34


def histogram(before: Mesh, after: Mesh) -> str:
    """Elements by quality, logarithmic: the few worst are what counts."""
    counts = [
        np.histogram(np.clip(np.concatenate(evaluated(m).quality), 0, 1), np.linspace(0, 1, 21))[0].tolist()
        for m in (before, after)
    ]
    decades = max(math.ceil(math.log10(max(max(part) for part in counts) + 1)), 1)
    wide, high = (_WIDTH - _LEFT - 8) / 20, _HEIGHT - _FOOT - 8

    def top(count: int) -> float:
        return 8 + high * (1 - (math.log10(count) + 0.3) / (decades + 0.3)) if count else 8 + high

    out = []
    for decade in range(decades + 1):
        y = top(10**decade)
        out.append(f'<line x1="{_LEFT}" x2="{_WIDTH - 8}" y1="{y:.1f}" y2="{y:.1f}" stroke="var(--line)"/>')
        label = f"{10**decade:,}"
        out.append(f'<text x="{_LEFT - 5}" y="{y + 4:.1f}" text-anchor="end">{label}</text>')
    for i, count in enumerate(counts[1]):
        x, y = _LEFT + i * wide + 1, top(count)
        out.append(
            f'<rect x="{x:.1f}" y="{y:.1f}" width="{wide - 2:.1f}" height="{8 + high - y:.1f}" rx="2" '
            f'fill="#1f6f8b" opacity=".85"><title>after: {count:,}</title></rect>'
        )
    steps = " ".join(
        f"{_LEFT + (i + side) * wide:.1f},{top(count):.1f}"
        for i, count in enumerate(counts[0])
        for side in (0, 1)
    )
    out.append(f'<polyline points="{steps}" fill="none" stroke="#d9542f" stroke-width="2"/>')
    for tenth in range(0, 11, 2):
        x = _LEFT + 2 * tenth * wide
        out.append(f'<text x="{x:.1f}" y="{_HEIGHT - 16}" text-anchor="middle">{tenth / 10:g}</text>')
    out.append(f'<text x="{_LEFT}" y="{_HEIGHT - 2}">quality</text>')
    return f'<svg viewBox="0 0 {_WIDTH} {_HEIGHT}" role="img" aria-label="histogram">{"".join(out)}</svg>'


# --- Tables -------------------------------------------------------------------------------------------


def table(heads: Sequence[str], rows: Sequence[Sequence[Any]]) -> str:
    def line(cells: Sequence[Any], tag: str) -> str:
        return "<tr>" + "".join(f"<{tag}>{html.escape(str(c))}</{tag}>" for c in cells) + "</tr>"

    body = "".join(line(row, "td") for row in rows)
    return f'<div class="scroll"><table>{line(heads, "th")}{body}</table></div>'


def worst(before: Mesh, result: SmoothResult, held: Holding, rows: list[tuple[int, np.ndarray]]) -> str:
    """The worst elements that are left; a click shows them."""
    q = [[np.asarray(part) for part in evaluated(mesh).quality] for mesh in (before, result.mesh)]
    shown = np.concatenate([q[1][b][chosen] for b, chosen in rows])
    block = np.concatenate([np.full(len(chosen), b) for b, chosen in rows])
    number = np.concatenate([chosen for _, chosen in rows])
    points = np.asarray(result.mesh.points, np.float64)
    lines = []
    for place in np.argsort(shown, kind="stable")[:_WORST]:
        b, e = int(block[place]), int(number[place])
        kind, nodes = before.blocks[b][0], np.asarray(before.connectivity[b])[e]
        centre = ", ".join(f"{x:.4g}" for x in points[nodes[: kind.corners]].mean(axis=0))
        cells = (f"{kind.name} {e}", f"{q[0][b][e]:.3f}", f"{q[1][b][e]:.3f}", centre)
        words = html.escape(held.of(nodes))
        lines.append(
            f'<tr data-element="{place}">'
            + "".join(f"<td>{cell}</td>" for cell in cells)
            + f'<td class="words">{words}</td></tr>'
        )
    heads = "".join(f"<th>{name}</th>" for name in ("element", "q before", "after", "place"))
    head = f'{heads}<th style="text-align:left">its nodes</th>'
    return f'<div class="scroll"><table><tr>{head}</tr>{"".join(lines)}</table></div>'


def parts(before: Mesh, result: SmoothResult) -> str:
    """Statistics by type and by region."""
    sides = []
    for mesh in (before, result.mesh):
        evaluation = evaluated(mesh)
        sides.append([np.asarray(part, float) for part in evaluation.quality])
        sides.append([np.asarray(part) for part in inverted(mesh, evaluation.jacobian)])
    regions = [np.zeros(len(nodes), int) for nodes in before.connectivity]
    if before.labels is not None and before.labels.regions:
        regions = [np.asarray(part) for part in before.labels.regions]
    names = _region_names(before, result)
    several, rows = len(np.unique(np.concatenate(regions))) > 1, []
    for b, name in enumerate(before.types):
        for region in np.unique(regions[b]):
            mask = regions[b] == region
            old, bad, new, worse = (side[b][mask] for side in sides)
            label = f"{name}, {names.get(int(region), f'region {region}')}" if several else name
            pairs = ((old.min(), new.min()), (old.mean(), new.mean()))
            numbers = [f"{x:.3f} → {y:.3f}" for x, y in pairs]
            poor = f"{int((old < POOR).sum()):,} → {int((new < POOR).sum()):,}"
            rows.append((label, f"{mask.sum():,}", *numbers, poor, f"{bad.sum():,} → {worse.sum():,}"))
    heads = ("type and region", "elements", "q_min", "q_avg", f"q < {POOR}", "inverted")
    return table(heads, rows)


def _region_names(before: Mesh, result: SmoothResult) -> dict[int, str]:
    """Names of physical groups by their tags."""
    known = {} if result.file is None else result.file.source.field_data
    pairs = {name: np.ravel(entry) for name, entry in known.items() if np.size(entry) == 2}
    return {int(tag): str(name) for name, (tag, dim) in pairs.items() if dim == before.element_dim}


def nodes(held: Holding) -> str:
    total = len(held.reason)
    rows = "".join(
        f'<tr><td><span class="dot" style="background:{COLOURS[REASONS.index(name)]}"></span>{name}</td>'
        f"<td>{number:,}</td><td>{100 * number / total:.1f} %</td></tr>"
        for name, number in held.counts()
    )
    return f"<table><tr><th>nodes</th><th>number</th><th>share</th></tr>{rows}</table>"


def steps(result: SmoothResult) -> str:
    heads = ("step", "q_min", "q_avg", "q_max", "σ", f"q < {POOR}", "inverted", "iterations", "seconds")
    rows = []
    for row in result.history:
        s = asdict(row.statistics)
        numbers = [f"{s[key]:.4f}" for key in ("q_min", "q_avg", "q_max", "q_std")]
        tail = (f"{s['below']:,}", f"{s['inverted']:,}", row.solver_iterations, f"{row.seconds:.2f}")
        rows.append((row.step, *numbers, *tail))
    return table(heads, rows)


def run(result: SmoothResult, settings: Mapping[str, Any], seconds: Mapping[str, float]) -> str:
    device = jax.devices()[0]
    times = ", ".join(f"{name} {value:.1f} s" for name, value in seconds.items())
    facts = {
        **{name: value for name, value in settings.items() if value not in (None, "", [], False)},
        **({"time": times} if times else {}),
        "precision": result.mesh.points.dtype,
        "device": f"{device.device_kind} ({jax.default_backend()})",
        "versions": f"jaxsmooth {jaxsmooth.__version__}, JAX {version('jax')}, NumPy {np.__version__}, "
        f"Python {platform.python_version()}",
    }
    pairs = (f"<dt>{html.escape(str(k))}</dt><dd>{html.escape(str(v))}</dd>" for k, v in facts.items())
    return f"<dl>{''.join(pairs)}</dl>"
