"""The command line.  Thin: parse, call the library, print.  ``--help`` never loads JAX."""

from __future__ import annotations

import argparse
import contextlib
import json
import math
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from jaxsmooth.files.outputs import Outputs, ending
from jaxsmooth.options import parser
from jaxsmooth.report.terminal import (
    close_standard_output,
    complain,
    prepare_streams,
    sentence,
    write_to_standard_output,
)

if TYPE_CHECKING:
    from rich.console import Console

    from jaxsmooth.convert.meshfile import MeshFile
    from jaxsmooth.methods import Method
    from jaxsmooth.motion.base import Motion

__all__ = ["main"]

DONE, BAD_INPUT, INVERTED, INTERRUPTED = 0, 2, 3, 130


def main(arguments: list[str] | None = None) -> int:
    """Run the command line.

    Args:
        arguments: its words; None for those of this process, which an interrupt then ends.

    Returns:
        The exit code: 0 done; 2 bad input or usage, nothing written; 3 done, but inverted elements
        remain; 130 interrupted.
    """
    prepare_streams()
    outputs = Outputs()
    program = contextlib.nullcontext()
    if arguments is None:
        program = ending(lambda: _interrupted(outputs), INTERRUPTED)
    try:
        with program, outputs:
            return _run_command(parser(_COMMANDS).parse_args(arguments), outputs)
    except KeyboardInterrupt:
        _interrupted(outputs)
        return INTERRUPTED
    finally:
        close_standard_output()


def _interrupted(outputs: Outputs) -> None:
    outputs.discard()
    written = f"all was done, and {', '.join(outputs.written)} written" if outputs.written else ""
    complain(f"interrupted; {written or 'nothing was written'}")


def _run_command(options: argparse.Namespace, outputs: Outputs) -> int:
    try:
        _check_input(options)
        _set_up_jax(options)
        return options.run(options, outputs)
    except Exception as error:
        text = sentence(error)
        if text is None:
            raise
        complain(text)
        return BAD_INPUT


def _check_input(options: argparse.Namespace) -> None:
    """A file that is not there is missed at once, before JAX is loaded."""
    path = getattr(options, "input", None)
    if path is not None and not os.path.exists(path):
        raise FileNotFoundError(f"{path}: there is no such file; check the name")


def _set_up_jax(options: argparse.Namespace) -> None:
    # XLA reports processor features of kept programs as errors; it reads this when it is loaded
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
    import jax

    from jaxsmooth.cache import keep_compiled

    jax.config.update("jax_enable_x64", options.precision == "float64")
    if not options.no_cache:
        keep_compiled()
    try:
        jax.default_backend()
    except (RuntimeError, AssertionError) as error:
        asked = os.environ.get("JAX_PLATFORMS", "")
        raise ValueError(f"JAX finds no device for JAX_PLATFORMS={asked!r}; unset it, or say cpu") from error


# --- Commands --------------------------------------------------------------------------


def _smooth(options: argparse.Namespace, outputs: Outputs) -> int:
    from jaxsmooth.files.io import check_types, output_format, read, write_to
    from jaxsmooth.report import report

    method = _method(options.method, options.goal)
    _check_before_smoothing(options)
    out = report.console(quiet=options.quiet or options.json == "-")
    clock = report.Clock()
    with clock("read"):
        file = read(options.input)
    check_types(file.mesh.types, Path(options.output), output_format(options.output, file))
    report.print_file(out, file)
    with clock("write"), Outputs() as trial:  # what a writer refuses, it refuses before the work
        notes = write_to(trial, options.output, file, force=options.force)
    _print_losses(out, notes, options.output)
    with clock("constraints"):
        constraints = _constraints(file, options)
    report.print_constraints(out, constraints, file.mesh)
    with clock("smooth"):
        result = _run(file, method, options.steps, constraints, lambda row: report.print_step(out, row))
    with clock("write"):
        said = write_to(outputs, options.output, file, result, force=options.force)
    late = tuple(note for note in said if note not in notes)  # on the coordinates themselves
    _print_losses(out, late, options.output)
    report.print_comparison(out, file.mesh, result)
    if options.report is not None:
        _write_report(outputs, options, file, result, clock.split())
    if options.json is not None:
        notes, seconds = (*file.notes, *notes, *late), clock.split()
        row = report.as_json(options.input, options.output, options.method, result, seconds, notes)
        _write_json(outputs, options.json, row)
    inverted = result.history[-1].statistics.inverted
    remain = f"; {inverted:,} inverted elements remain" if inverted else ""
    _finish(out, outputs, f"{result.status}{remain}; wrote {{}} in {sum(clock.seconds.values()):.1f} s")
    if inverted and out.quiet:
        complain(f"{options.output}: {inverted:,} inverted elements remain")
    return INVERTED if inverted else DONE


def _quality(options: argparse.Namespace, outputs: Outputs) -> int:
    from jaxsmooth.files.io import read, write_to
    from jaxsmooth.report import quality, report

    names, options.input = quality.requested(options.metric, options.input)
    if options.csv == "-":
        raise ValueError("--csv -: the rows can't go to standard output; name a file")
    data = {"--quality-data": options.quality_data} if options.quality_data is not None else {}
    _check_side_files(options, **data)
    file = read(options.input)
    values = quality.measured(file.mesh, quality.chosen_metrics(names, file.mesh))
    rows = quality.quality_rows(file.mesh, values)
    out = report.console(quiet=options.json == "-")
    report.print_file(out, file)
    quality.print_report(out, file, values, rows)
    if options.csv is not None:
        outputs.text(options.csv, quality.csv_text(file, values))
    if options.quality_data is not None:
        notes = write_to(outputs, options.quality_data, file, cell_data=quality.cell_data(file.mesh, values))
        _print_losses(out, notes, options.quality_data)
    if options.json is not None:
        content = {"input": options.input, **report.counts(file.mesh), "quality": rows, "notes": file.notes}
        _write_json(outputs, options.json, content)
    if options.json or options.csv or data:
        _finish(out, outputs, "wrote {}")
    return DONE if rows[0]["inverted"] == 0 else INVERTED


def _compare(options: argparse.Namespace, outputs: Outputs) -> int:
    from jaxsmooth.files.io import read
    from jaxsmooth.methods import METHODS
    from jaxsmooth.report import report

    names = list(METHODS) if options.methods is None else [n.strip() for n in options.methods.split(",")]
    if options.goal is not None and "optimize" not in names:
        raise ValueError("--goal is for the method optimize; add it to --methods, or leave --goal out")
    methods = {name: _method(name, options.goal if name == "optimize" else None) for name in names}
    _check_run_options(options)
    _check_side_files(options)
    out = report.console(quiet=options.quiet or options.json == "-")
    file = read(options.input)
    report.print_file(out, file)
    constraints = _constraints(file, options)
    report.print_constraints(out, constraints, file.mesh)
    rows = [report.compare_row("input", file.mesh, None, constraints, {})]
    for name, method in methods.items():
        clock = report.Clock()
        with clock("smooth"):
            result = _run(file, method, options.steps, constraints, None)
        rows.append(report.compare_row(name, file.mesh, result, constraints, clock.split()))
    report.print_compare(out, rows)
    if options.json is not None:
        content = {"input": options.input, **report.counts(file.mesh), "methods": rows, "notes": file.notes}
        _write_json(outputs, options.json, content)
        _finish(out, outputs, "wrote {}")
    return DONE


def _demo(options: argparse.Namespace, outputs: Outputs) -> int:
    from jaxsmooth import demo

    demo.run(Path(options.directory), outputs)
    return DONE


# --- Checks before the work ------------------------------------------------------------


def _check_before_smoothing(options: argparse.Namespace) -> None:
    from jaxsmooth.files.formats.table import format_of_suffix
    from jaxsmooth.files.io import check_output

    _check_run_options(options)
    check_output(options.output, options.input, force=options.force)
    format_of_suffix(Path(options.output))
    if options.report == "-":
        raise ValueError("--report -: a report can't go to standard output; name a file")
    _check_side_files(options, OUT=options.output)


def _check_run_options(options: argparse.Namespace) -> None:
    if options.steps is not None and options.steps < 0:
        raise ValueError(f"--steps must be 0 or more, got {options.steps}")
    if options.feature_angle is not None and not 0 <= options.feature_angle <= 180:
        raise ValueError(f"--feature-angle must be 0 to 180 degrees, got {options.feature_angle:g}")
    aspect = options.freeze_aspect
    if aspect is not None and not (math.isfinite(aspect) and aspect > 1):
        raise ValueError(f"--freeze-aspect must be a number above 1, got {aspect:g}")


def _check_side_files(options: argparse.Namespace, **meshes: str) -> None:
    """Whether JSON and report can be written, and are neither a mesh nor one another."""
    from jaxsmooth.files.io import check_distinct, check_output

    sides = {f"--{name}": getattr(options, name, None) for name in ("json", "report", "csv")}
    sides = {name: path for name, path in sides.items() if path not in (None, "-")}
    check_distinct({"IN": options.input, **sides})
    check_distinct({**meshes, **sides})
    for path in sides.values():
        check_output(path)


# --- Shared ----------------------------------------------------------------------------


def _method(name: str, goal: str | None) -> Method:
    import difflib

    from jaxsmooth.methods import METHODS, Optimize

    if name not in METHODS:
        near = difflib.get_close_matches(name, METHODS, n=2, cutoff=0.4)
        hint = f"did you mean {' or '.join(near)}?" if near else f"known are {', '.join(METHODS)}"
        raise ValueError(f"unknown method {name!r}; {hint}")
    if goal is None:
        return METHODS[name]()
    if name != "optimize":
        raise ValueError(f"--goal is for the method optimize, not for {name}; add --method optimize")
    return Optimize(goal=goal)


def _run(file: MeshFile, method: Method, steps: int | None, constraints: Motion, callback: Any):
    from jaxsmooth.runs.driver import smooth

    exactly = {} if steps is None else {"steps": steps, "tolerance_avg": 0.0}
    return smooth(file.mesh, method, constraints=constraints, callback=callback, **exactly)


def _constraints(file: MeshFile, options: argparse.Namespace) -> Motion:
    import difflib

    from jaxsmooth.convert.periodic import find_periodic
    from jaxsmooth.motion.detect import detect_constraints

    fixed = file.fixed.copy()
    for name in options.fix:
        if name == "fixed" and fixed.any():
            continue  # a file's own mark is heeded anyway
        if name not in file.named_sets:
            near = difflib.get_close_matches(name, file.named_sets, n=2, cutoff=0.4)
            known = ", ".join(file.named_sets) or "none"
            hint = f"did you mean {' or '.join(near)}?" if near else f"the file has {known}"
            raise ValueError(f"unknown set {name!r}; {hint}")
        fixed |= file.named_sets[name]
    frozen = {} if options.freeze_aspect is None else {"freeze_aspect": options.freeze_aspect}
    mesh = file.mesh
    if options.periodic:
        mesh = mesh.with_links(find_periodic(mesh, options.periodic))
    return detect_constraints(
        mesh,
        boundary=options.boundary,
        interfaces=options.interfaces,
        feature_angle=options.feature_angle,
        surface_tolerance=options.surface_tolerance,
        fixed=fixed,
        **frozen,
    )


def _print_losses(out: Console, notes: tuple[str, ...], output: str) -> None:
    """What the output can't hold is said even to those who asked for silence."""
    from jaxsmooth.report import report

    report.print_notes(out, notes)
    for note in notes if out.quiet else ():
        complain(f"{output}: {note}")


def _write_report(outputs: Outputs, options: argparse.Namespace, file: MeshFile, result: Any, seconds: dict):
    from jaxsmooth.report.page import html_page

    left_out = ("run", "json", "report", "quiet", "force", "precision", "no_cache")
    settings = {name.replace("_", " "): v for name, v in vars(options).items() if name not in left_out}
    title, more = Path(options.input).name, {"settings": settings, "seconds": seconds, "notes": file.notes}
    outputs.text(options.report, html_page(title, file.mesh, result, **more))


def _write_json(outputs: Outputs, path: str, content: dict[str, Any]) -> None:
    text = json.dumps(content, indent=1, allow_nan=False, default=str) + "\n"
    if path == "-":
        write_to_standard_output(text)
    else:
        outputs.text(path, text)


def _finish(out: Console, outputs: Outputs, message: str) -> None:
    """Put the files in place, then say so; by then a full disk under standard output undoes nothing."""
    outputs.commit()
    try:
        out.print(message.format(", ".join(outputs.written)))
    except OSError as error:
        complain(f"{', '.join(outputs.written)} written, but not standard output ({error.strerror})")


if __name__ == "__main__":
    sys.exit(main())


_COMMANDS = {"smooth": _smooth, "quality": _quality, "compare": _compare, "demo": _demo}
