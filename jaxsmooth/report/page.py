"""The HTML report: one file that needs no network, with meshes to turn and to cut, side by side."""

from __future__ import annotations

import html
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from jaxsmooth.files.outputs import Outputs
from jaxsmooth.mesh.record import Mesh
from jaxsmooth.report import sections
from jaxsmooth.report.compared import columns, recommend
from jaxsmooth.report.holding import holding
from jaxsmooth.report.report import comparison
from jaxsmooth.report.scene import scene
from jaxsmooth.runs.driver import SmoothResult

__all__ = ["html_comparison", "html_page", "write_html"]

_ASSETS = Path(__file__).parent / "assets"
_COLUMNS = ("", "all before", "all after", "movable before", "movable after")
_WORST = "Worst elements that are left; click to see one"


def write_html(path: str | Path, title: str, before: Mesh, result: SmoothResult, **more: Any) -> None:
    """Write `html_page` to a file, complete or not at all."""
    with Outputs() as outputs:
        outputs.text(path, html_page(title, before, result, **more))
        outputs.commit()


def html_page(
    title: str,
    before: Mesh,
    result: SmoothResult,
    *,
    settings: Mapping[str, Any] | None = None,
    seconds: Mapping[str, float] | None = None,
    notes: Sequence[str] = (),
) -> str:
    """A report in one page: the meshes, tables, what was held, the steps.

    Args:
        title: its heading; any text.
        before: the input.
        result: what `smooth` made of it.
        settings: method and options, by name.
        seconds: of the phases, compilation apart.
        notes: what was found in the file.
    """
    held = holding(before, result.constraints)
    drawn = scene({"before": before, "after": result.mesh}, held)
    rows = drawn.pop("rows")
    steps = result.history[-1].step
    body = (
        _columns(
            ("Quality before (line) and after (bars)", sections.histogram(before, result.mesh)),
            ("Before and after", sections.table(_COLUMNS, comparison(before, result))),
        ),
        _section(_WORST, sections.worst(before, result, held, rows)),
        _section("By type and region", sections.parts(before, result)),
        _columns(
            ("What the nodes may do", sections.nodes(held)),
            ("Run", sections.run(result, settings or {}, seconds or {})),
        ),
        _section("Steps", sections.steps(result)),
    )
    status = f"{_sizes(before)}. {steps} step{'s' * (steps != 1)}: {result.status}."
    return _filled(title, status, sections.cards(result), drawn, body, notes)


def html_comparison(
    title: str,
    before: Mesh,
    results: Mapping[str, SmoothResult],
    rows: Sequence[dict[str, Any]],
    *,
    settings: Mapping[str, Any] | None = None,
    notes: Sequence[str] = (),
) -> str:
    """Several methods on one mesh in one page: any two of their meshes side by side, and a table.

    Args:
        title: its heading; any text.
        before: the input.
        results: by method, of `smooth` with the same constraints.
        rows: of `compare_row`, that of the input first, then as in `results`.
        settings: options, by name.
        notes: what was found in the file.
    """
    best, words = recommend(rows)
    best = best if best in results else next(iter(results))
    shown = results[best]
    held = holding(before, shown.constraints)
    drawn = scene({"input": before, **{name: result.mesh for name, result in results.items()}}, held)
    drawn["right"] = 1 + list(results).index(best)
    chosen = drawn.pop("rows")
    heads, lines = columns(rows)
    body = (
        _section("Methods, over all elements", sections.table(heads, lines)),
        _columns(
            (
                f"Quality of the input (line) and by {best} (bars)",
                sections.histogram(before, shown.mesh),
            ),
            ("What the nodes may do", sections.nodes(held)),
        ),
        _section(f"{_WORST} ({best})", sections.worst(before, shown, held, chosen)),
        _section("Run", sections.run(shown, settings or {}, {})),
    )
    advice = f"<p>{html.escape(' '.join(words))}</p>"
    return _filled(title, f"{_sizes(before)}.", advice, drawn, body, notes)


def _sizes(mesh: Mesh) -> str:
    sizes = [f"{len(nodes):,} {name}" for name, nodes in zip(mesh.types, mesh.connectivity, strict=True)]
    return f"{', '.join(sizes)}; {len(mesh.points):,} nodes"


def _section(title: str, content: str) -> str:
    return f"<section><h2>{html.escape(title)}</h2>{content}</section>"


def _columns(*parts: tuple[str, str]) -> str:
    return f'<div class="columns">{"".join(_section(*part) for part in parts)}</div>'


def _filled(
    title: str, status: str, lead: str, drawn: dict[str, Any], body: Sequence[str], notes: Sequence[str]
) -> str:
    """The template with everything in its place."""
    items = "".join(f"<li>{html.escape(note)}</li>" for note in notes) or "<li>none</li>"
    values = {
        "TITLE": html.escape(title),
        "STYLE": (_ASSETS / "style.css").read_text(),
        "STATUS": html.escape(status),
        "LEAD": lead,
        "BODY": "\n".join([*body, _section("Notes", f"<ul>{items}</ul>")]),
        "SCENE": json.dumps(drawn, separators=(",", ":")).replace("<", "\\u003c"),
        "VIEWER": (_ASSETS / "viewer.js").read_text(),
    }
    page = (_ASSETS / "page.html").read_text()
    head, *parts = page.split("{{")
    pieces = [part.partition("}}") for part in parts]
    text = head + "".join(values[name] + rest for name, _, rest in pieces)
    return text.encode("utf-8", "replace").decode()  # names of files may be any bytes
