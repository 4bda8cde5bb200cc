"""The facts of ``jaxsmooth info``: what a file holds, and what smoothing would do with it."""

from __future__ import annotations

from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from jaxsmooth.convert.chosen import tags_of
from jaxsmooth.convert.meshfile import MeshFile
from jaxsmooth.convert.regions import plain
from jaxsmooth.mesh.topology import find_facets
from jaxsmooth.metrics.summary import statistics
from jaxsmooth.motion.base import Motion
from jaxsmooth.report.advice import advice, print_held
from jaxsmooth.report.holding import Holding
from jaxsmooth.report.report import counts, print_constraints, print_notes

__all__ = ["facts", "print_facts"]


_TAGS = 60  # that are printed; the JSON has all


def facts(file: MeshFile, motion: Motion, held: Holding) -> dict[str, Any]:
    """All of them, as they stand in the JSON."""
    mesh, source = file.mesh, file.source
    points = np.asarray(source.points, np.float64)
    state = statistics(mesh)
    sides = find_facets(mesh)
    links = motion.at(mesh.points).links
    return {
        "input": None if file.path is None else str(file.path),
        "format": file.format,
        "dim": mesh.dim,
        **counts(mesh),
        "cells": _cells(file),
        "bounds": [points.min(axis=0).tolist(), points.max(axis=0).tolist()],
        "boundary_facets": int(sum((part.partner < 0).sum() for part in sides)),
        "regions": _regions(file),
        "reversed": _reversed(file),
        "tags": [
            {"dimension": dim, "data": name, "tag": tag, "nodes": len(nodes)}
            for (dim, name, tag), nodes in tags_of(file).items()
        ],
        "sets": {name: int(np.sum(nodes)) for name, nodes in file.named_sets.items()},
        "point_data": {name: _shape(values) for name, values in source.point_data.items()},
        "cell_data": {name: _shape(values[0]) for name, values in source.cell_data.items() if len(values)},
        "linked_nodes": 0 if links is None else len(links.dependent),
        "node_freedom": dict(held.counts()),
        "advice": advice(held),
        "quality": {
            "q_min": state.q_min,
            "q_avg": state.q_avg,
            "q_below_0.2": state.below,
            "inverted": state.inverted,
            "scaled_jacobian_min": state.scaled_jacobian_min,
        },
        "notes": list(file.notes),
    }


def _reversed(file: MeshFile) -> dict[str, int]:
    """Elements that the file numbers the other way round, by type."""
    found = {}
    for cells, (block, rows) in zip(file.source.cells, file.placement, strict=True):
        if block < 0:
            continue
        there = rows >= 0
        mine = np.asarray(file.mesh.connectivity[block])[rows[there]]
        turned = int((mine != plain(cells.data)[there]).any(axis=1).sum())
        name = file.mesh.types[block]
        found[name] = found.get(name, 0) + turned
    return {name: number for name, number in found.items() if number}


def _shape(values: Any) -> str:
    values = np.asarray(values)
    return f"{values.dtype}" + (f" × {values.shape[1]}" if values.ndim > 1 else "")


def _cells(file: MeshFile) -> dict[str, int]:
    """Numbers of cells by type, those of lower dimension included."""
    found: dict[str, int] = {}
    for cells in file.source.cells:
        found[cells.type] = found.get(cells.type, 0) + len(cells.data)
    return found


def _regions(file: MeshFile) -> dict[str, int]:
    """Numbers of elements by region, where there are several."""
    if file.mesh.labels is None:
        return {}
    names, numbers = np.unique(np.concatenate(file.mesh.labels.regions), return_counts=True)
    found = {str(name): int(number) for name, number in zip(names, numbers, strict=True)}
    return found if len(found) > 1 else {}


def print_facts(out: Console, file: MeshFile, motion: Motion, held: Holding, row: dict[str, Any]) -> None:
    """The facts as a table, then what nodes may do, and the notes."""
    table = Table(box=None, pad_edge=False, show_header=False)
    table.add_column(no_wrap=True)
    table.add_column(overflow="fold")
    elements = ", ".join(f"{number:,} {name}" for name, number in row["elements"].items())
    others = {name: n for name, n in row["cells"].items() if name not in row["elements"]}
    low, high = row["bounds"]
    flat = row["dim"] == 2 or file.mesh.surface
    table.add_row("format", str(row["format"]))
    table.add_row("nodes", f"{row['nodes']:,} in {len(low)}D")
    table.add_row(
        "elements", f"{elements}, {'surface in 3D' if file.mesh.surface else str(row['dim']) + 'D'}"
    )
    if others:
        table.add_row("other cells", ", ".join(f"{number:,} {name}" for name, number in others.items()))
    table.add_row("from", ", ".join(f"{x:.6g}" for x in low))
    table.add_row("to", ", ".join(f"{x:.6g}" for x in high))
    table.add_row("boundary", f"{row['boundary_facets']:,} {'sides' if flat else 'faces'}")
    turned = ", ".join(f"{number:,} {name}" for name, number in row["reversed"].items())
    table.add_row("orientation", f"{turned} the other way round" if turned else "as usual")
    table.add_row("linked", f"{row['linked_nodes']:,} nodes follow others")
    if row["tags"]:
        words = [f"{tag['dimension']}:{tag['tag']} ({tag['nodes']:,} nodes)" for tag in row["tags"]]
        more = f", and {len(words) - _TAGS:,} more" if len(words) > _TAGS else ""
        table.add_row("tags", ", ".join(words[:_TAGS]) + more)
    for title, key, unit in (("regions", "regions", "elements"), ("sets", "sets", "nodes")):
        if row[key]:
            table.add_row(title, ", ".join(f"{name} ({n:,} {unit})" for name, n in row[key].items()))
    for title, key in (("point data", "point_data"), ("cell data", "cell_data")):
        if row[key]:
            table.add_row(title, ", ".join(f"{name} ({kind})" for name, kind in row[key].items()))
    q = row["quality"]
    values = f"q_min {q['q_min']:.4f}, q_avg {q['q_avg']:.4f}, {q['q_below_0.2']:,} below 0.2"
    table.add_row("quality", f"{values}, {q['inverted']:,} inverted")
    out.print(f"{row['input']}")
    out.print(table)
    print_notes(out, file.notes)
    print_constraints(out, motion, file.mesh)
    print_held(out, held)
