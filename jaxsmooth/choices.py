"""From the words of the command line to what they stand for."""

from __future__ import annotations

import argparse
import difflib
import math
from pathlib import Path
from typing import Any

import numpy as np

from jaxsmooth.convert.chosen import chosen_nodes
from jaxsmooth.convert.meshfile import MeshFile
from jaxsmooth.convert.periodic import find_periodic
from jaxsmooth.files.formats.record import stem_format
from jaxsmooth.files.formats.table import FORMATS, format_named, format_of_suffix
from jaxsmooth.mesh.layers import nodes_of, stretched
from jaxsmooth.methods import METHODS, Method, Optimize
from jaxsmooth.motion import detect
from jaxsmooth.motion.base import Motion
from jaxsmooth.runs import driver

__all__ = [
    "check_format",
    "check_run_options",
    "chosen_method",
    "constraints_of",
    "format_for",
    "held_by_option",
    "inputs_of",
    "output_name",
    "run_method",
]


def chosen_method(name: str, goal: str | None) -> Method:
    """A method by its name.  Raises `ValueError` for an unknown one, and for a goal that it has not."""
    if name not in METHODS:
        near = difflib.get_close_matches(name, METHODS, n=2, cutoff=0.4)
        hint = f"did you mean {' or '.join(near)}?" if near else f"known are {', '.join(METHODS)}"
        raise ValueError(f"unknown method {name!r}; {hint}")
    if goal is None:
        return METHODS[name]()
    if name != "optimize":
        raise ValueError(f"--goal is for the method optimize, not for {name}; add --method optimize")
    return Optimize(goal=goal)


def check_run_options(options: argparse.Namespace) -> None:
    """Raises `ValueError` for numbers out of range."""
    if options.steps is not None and options.steps < 0:
        raise ValueError(f"--steps must be 0 or more, got {options.steps}")
    if options.feature_angle is not None and not 0 <= options.feature_angle <= 180:
        raise ValueError(f"--feature-angle must be 0 to 180 degrees, got {options.feature_angle:g}")
    aspect = options.freeze_aspect
    if aspect is not None and not (math.isfinite(aspect) and aspect > 1):
        raise ValueError(f"--freeze-aspect must be a number above 1, got {aspect:g}")


def held_by_option(file: MeshFile, options: argparse.Namespace) -> np.ndarray:
    """The nodes ``[nodes]`` that ``--fix`` and ``--freeze-aspect`` hold."""
    held = np.zeros(len(file.mesh.points), bool)
    for word in options.fix:
        if word != "fixed" or not file.fixed.any():  # a file's own mark is heeded anyway
            held |= chosen_nodes(file, word)
    if options.freeze_aspect is not None:
        held |= nodes_of(file.mesh, stretched(file.mesh, options.freeze_aspect))
    return held


def constraints_of(file: MeshFile, options: argparse.Namespace) -> Motion:
    """What the nodes of a file may do."""
    frozen = {} if options.freeze_aspect is None else {"freeze_aspect": options.freeze_aspect}
    mesh = file.mesh
    if options.periodic:
        mesh = mesh.with_links(find_periodic(mesh, options.periodic))
    return detect.detect_constraints(
        mesh,
        boundary=options.boundary,
        interfaces=options.interfaces,
        layers=options.layers,
        feature_angle=options.feature_angle,
        surface_tolerance=options.surface_tolerance,
        fixed=file.fixed | held_by_option(file, options),
        **frozen,
    )


def run_method(
    file: MeshFile, method: Method, steps: int | None, constraints: Motion, callback: Any
) -> driver.SmoothResult:
    """A run of exactly so many steps, or until it has converged."""
    exactly = {} if steps is None else {"steps": steps, "tolerance_avg": 0.0}
    return driver.smooth(file.mesh, method, constraints=constraints, callback=callback, **exactly)


def format_for(asked: str | None, old: str | None) -> str | None:
    """The format that was asked for: the input's own kind of it where the input is of that format."""
    if asked is None or ":" in asked:
        return asked
    return old if old is not None and stem_format(old) == asked else FORMATS[asked].full_name()


def inputs_of(words: list[str]) -> list[Path]:
    """Mesh files: those that are named, and of folders all whose name stands for a format.

    Raises:
        ValueError: a folder has none.
    """
    found: list[Path] = []
    for path in map(Path, words):
        inside = sorted(p for p in path.iterdir() if p.is_file() and _is_mesh(p)) if path.is_dir() else [path]
        if not inside:
            raise ValueError(f"{path}: no file in this folder has the name of a mesh format")
        found += inside
    return found


def _is_mesh(path: Path) -> bool:
    try:
        return bool(format_of_suffix(path))
    except ValueError:
        return False


def output_name(path: Path, folder: Path, file_format: str | None) -> Path:
    """Where the output of one of several inputs goes: under its own name, or that of another format."""
    return folder / (path.name if file_format is None else path.with_suffix(_suffix(file_format)).name)


def check_format(name: str | None) -> None:
    """Raises `ValueError` for an unknown format."""
    if name is not None:
        _suffix(name)


def _suffix(name: str) -> str:
    known = format_named(name)
    if known is None or (":" in name and name.partition(":")[2] not in known.variants):
        near = difflib.get_close_matches(name, FORMATS, n=2, cutoff=0.4)
        hint = f"did you mean {' or '.join(near)}?" if near else f"known are {', '.join(FORMATS)}"
        raise ValueError(f"unknown format {name!r}; {hint}")
    return known.suffixes[0]
