"""The command line.  Thin: parse, call the library, print.  ``--help`` never loads JAX."""

from __future__ import annotations

import argparse
import contextlib
import json
import math
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from jaxsmooth import __version__
from jaxsmooth.files.outputs import Outputs, ending
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
_METHODS = (
    "elastic, elastic-extended, laplacian, smart-laplacian, weighted-laplacian, smart-weighted-laplacian, "
    "optimize"
)
_GOALS = ("average", "worst", "balanced")


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
            return _run_command(_parser().parse_args(arguments), outputs)
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
        _set_up_jax(getattr(options, "precision", "float64"))
        return options.run(options, outputs)
    except Exception as error:
        text = sentence(error)
        if text is None:
            raise
        complain(text)
        return BAD_INPUT


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="jaxsmooth",
        description="Improve finite-element meshes by moving their nodes.",
        epilog="exit codes: 0 done; 2 bad input or usage, nothing written; "
        "3 done, but inverted elements remain; 130 interrupted",
    )
    parser.add_argument("--version", action="version", version=f"jaxsmooth {__version__}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    command = commands.add_parser("smooth", help="read a mesh, smooth it, write it")
    command.add_argument("input", metavar="IN", help="mesh file in any format that meshio reads, or .npz")
    command.add_argument("output", metavar="OUT", help="where to write; the name chooses the format")
    help = f"one of {_METHODS} (default: elastic)"
    command.add_argument("--method", default="elastic", metavar="NAME", help=help)
    command.add_argument("--force", action="store_true", help="allow OUT to be IN (default: refuse)")
    help = "write a report with pictures; needs matplotlib (default: none)"
    command.add_argument("--report", metavar="FILE.html", help=help)
    _add_run_options(command)
    command.set_defaults(run=_smooth)

    command = commands.add_parser("quality", help="print quality statistics of a mesh")
    command.add_argument("input", metavar="IN", help="mesh file")
    help = "a quality metric; repeatable (default: all)"
    command.add_argument("--metric", action="append", metavar="NAME", help=help)
    help = "write the numbers, - for standard output (default: none)"
    command.add_argument("--json", metavar="FILE", help=help)
    _add_precision(command)
    command.set_defaults(run=_quality)

    command = commands.add_parser("compare", help="run several methods on a mesh, side by side")
    command.add_argument("input", metavar="IN", help="mesh file; it is only read")
    help = f"some of {_METHODS} (default: all)"
    command.add_argument("--methods", default=None, metavar="A,B,…", help=help)
    _add_run_options(command)
    command.set_defaults(run=_compare)

    command = commands.add_parser("demo", help="smooth the mesh that ships with the package")
    help = "folder for its files (default: jaxsmooth-demo)"
    command.add_argument("directory", nargs="?", default="jaxsmooth-demo", metavar="DIR", help=help)
    command.set_defaults(run=_demo)
    return parser


def _add_precision(command: argparse.ArgumentParser) -> None:
    help = "of the computation (default: float64)"
    command.add_argument("--precision", choices=("float64", "float32"), default="float64", help=help)


def _add_run_options(command: argparse.ArgumentParser) -> None:
    add = command.add_argument
    help = (
        "make exactly N steps: the run ends earlier only where no node can move or nothing would get better "
        "(default: at most 10, and the end when a step changes little)"
    )
    add("--steps", type=int, default=None, metavar="N", help=help)
    help = f"of the method optimize: one of {', '.join(_GOALS)} (default: balanced)"
    add("--goal", choices=_GOALS, default=None, metavar="NAME", help=help)
    choices = ("slide", "planar", "fixed")
    help = "boundary nodes slide on faces and edges, planar: on flat and straight ones only, or are fixed"
    add("--boundary", choices=choices, default="slide", help=f"{help} (default: slide)")
    help = "the same for the nodes between materials (default: slide)"
    add("--interfaces", choices=choices, default="slide", help=help)
    help = "folds sharper than this are edges (default: 50; with planar 0: all straight ones)"
    add("--feature-angle", type=float, default=None, metavar="DEG", help=help)
    help = "distance that nodes keep to the facets of the input, over the length of edges (default: 0.01)"
    add("--surface-tolerance", type=float, default=0.01, metavar="PART", help=help)
    help = "hold the nodes of elements stretched beyond A, a number above 1 (default: none)"
    add("--freeze-aspect", type=float, default=None, metavar="A", help=help)
    help = "hold the nodes of a named set; repeatable (default: none but those that the file marks)"
    add("--fix", action="append", default=[], metavar="NAME", help=help)
    help = "write history and timings, - for standard output (default: none)"
    add("--json", metavar="FILE", help=help)
    help = "print only errors, what OUT can't hold, and what stays inverted (default: progress and a table)"
    add("-q", "--quiet", action="store_true", help=help)
    _add_precision(command)


def _set_up_jax(precision: str) -> None:
    import jax

    jax.config.update("jax_enable_x64", precision == "float64")
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
        write_to(outputs, options.output, file, result, force=options.force)
    report.print_comparison(out, file.mesh, result)
    if options.report is not None:
        outputs.text(options.report, report.html_page(Path(options.input).name, file.mesh, result))
    if options.json is not None:
        notes, seconds = (*file.notes, *notes), clock.split()
        row = report.as_json(options.input, options.output, options.method, result, seconds, notes)
        _write_json(outputs, options.json, row)
    inverted = result.history[-1].statistics.inverted
    remain = f"; {inverted:,} inverted elements remain" if inverted else ""
    _finish(out, outputs, f"{result.status}{remain}; wrote {{}} in {sum(clock.seconds.values()):.1f} s")
    if inverted and out.quiet:
        complain(f"{options.output}: {inverted:,} inverted elements remain")
    return INVERTED if inverted else DONE


def _quality(options: argparse.Namespace, outputs: Outputs) -> int:
    from jaxsmooth.files.io import read
    from jaxsmooth.metrics.table import METRICS, metric
    from jaxsmooth.report import report

    names = options.metric or list(METRICS)
    for name in names:
        metric(name)
    _check_side_files(options)
    file = read(options.input)
    table = report.quality_rows(file.mesh, names)
    out = report.console(quiet=options.json == "-")
    report.print_file(out, file)
    report.print_quality(out, table)
    if options.json is not None:
        content = {"input": options.input, **report.counts(file.mesh), "quality": table, "notes": file.notes}
        _write_json(outputs, options.json, content)
        _finish(out, outputs, "wrote {}")
    return DONE if table[0]["inverted"] == 0 else INVERTED


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
    from jaxsmooth.files.io import check_output
    from jaxsmooth.files.reading import format_of_suffix

    _check_run_options(options)
    check_output(options.output, options.input, force=options.force)
    format_of_suffix(Path(options.output))
    if options.report == "-":
        raise ValueError("--report -: a report can't go to standard output; name a file")
    _check_side_files(options, OUT=options.output)
    if options.report is not None:
        import jaxsmooth.report.pictures  # noqa: F401  it says what is missing


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

    sides = {"--json": options.json, "--report": getattr(options, "report", None)}
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
    return detect_constraints(
        file.mesh,
        boundary=options.boundary,
        interfaces=options.interfaces,
        feature_angle=options.feature_angle,
        surface_tolerance=options.surface_tolerance,
        fixed=fixed,
        **frozen,
    )


def _print_losses(out: Console, notes: Sequence[str], output: str) -> None:
    """What the output can't hold is said even to those who asked for silence."""
    from jaxsmooth.report import report

    report.print_notes(out, notes)
    for note in notes if out.quiet else ():
        complain(f"{output}: {note}")


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
