"""The command line.  Thin: parse, call the library, print.  ``--help`` never loads JAX."""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from jaxsmooth import __version__

if TYPE_CHECKING:
    from jaxsmooth.constraints import Constraints
    from jaxsmooth.meshfile import MeshFile
    from jaxsmooth.methods import Method

__all__ = ["main"]

DONE, BAD_INPUT, INVERTED = 0, 2, 3
_METHODS = (
    "elastic, elastic-extended, laplacian, smart-laplacian, weighted-laplacian, smart-weighted-laplacian, "
    "optimize"
)


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; returns the exit code (0 done, 2 bad input, 3 inverted remain)."""
    options = _parser().parse_args(arguments)
    try:
        _set_up_jax(getattr(options, "precision", "float64"))
        return options.run(options)
    except (ValueError, OSError, ImportError) as error:
        print(f"jaxsmooth: {_sentence(error)}", file=sys.stderr)
        return BAD_INPUT
    except KeyboardInterrupt:
        print("jaxsmooth: interrupted; nothing was written", file=sys.stderr)
        return 130


def _sentence(error: BaseException) -> str:
    if isinstance(error, OSError) and error.filename:
        return f"{error.filename}: {error.strerror}"
    return str(error)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="jaxsmooth",
        description="Improve finite-element meshes by moving their nodes.",
        epilog="exit codes: 0 done; 2 bad input or usage; 3 done, but inverted elements remain",
    )
    parser.add_argument("--version", action="version", version=f"jaxsmooth {__version__}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    command = commands.add_parser("smooth", help="read a mesh, smooth it, write it")
    command.add_argument("input", metavar="IN", help="mesh file in any format that meshio reads, or .npz")
    command.add_argument("output", metavar="OUT", help="where to write; the name chooses the format")
    command.add_argument("--method", default="elastic", metavar="NAME", help=f"one of {_METHODS}")
    command.add_argument("--force", action="store_true", help="allow OUT to be IN")
    command.add_argument("--report", metavar="FILE.html", help="write a report with pictures")
    _add_run_options(command)
    command.set_defaults(run=_smooth)

    command = commands.add_parser("quality", help="print quality statistics of a mesh")
    command.add_argument("input", metavar="IN")
    command.add_argument("--metric", action="append", metavar="NAME", help="repeatable; all by default")
    command.add_argument("--json", metavar="FILE", help="write the numbers (- for standard output)")
    _add_precision(command)
    command.set_defaults(run=_quality)

    command = commands.add_parser("compare", help="run several methods on a mesh, side by side")
    command.add_argument("input", metavar="IN")
    command.add_argument("--methods", default=None, metavar="A,B,…", help=f"all by default: {_METHODS}")
    _add_run_options(command)
    command.set_defaults(run=_compare)

    command = commands.add_parser("demo", help="smooth the mesh that ships with the package")
    command.add_argument("directory", nargs="?", default="jaxsmooth-demo", metavar="DIR")
    command.set_defaults(run=_demo)
    return parser


def _add_precision(command: argparse.ArgumentParser) -> None:
    command.add_argument("--precision", choices=("float64", "float32"), default="float64")


def _add_run_options(command: argparse.ArgumentParser) -> None:
    command.add_argument("--steps", type=int, default=None, metavar="N", help="largest number of steps")
    command.add_argument("--boundary", choices=("slide", "fixed"), default="slide")
    command.add_argument("--interfaces", choices=("slide", "fixed"), default="slide")
    command.add_argument(
        "--feature-angle",
        type=float,
        default=0.0,
        metavar="DEG",
        help="hold straight folds shallower than this, as parts of curved faces (default 0)",
    )
    command.add_argument(
        "--fix", action="append", default=[], metavar="NAME", help="hold the nodes of a named set; repeatable"
    )
    command.add_argument("--json", metavar="FILE", help="write history and timings (- for standard output)")
    command.add_argument("-q", "--quiet", action="store_true", help="print errors only")
    _add_precision(command)


def _set_up_jax(precision: str) -> None:
    import jax

    jax.config.update("jax_enable_x64", precision == "float64")


# --- Commands --------------------------------------------------------------------------


def _smooth(options: argparse.Namespace) -> int:
    from jaxsmooth import report
    from jaxsmooth.io import check_output, check_types, output_format, read, write

    method = _method(options.method)
    check_output(options.output, options.input, force=options.force)
    for side in (options.json, options.report):
        if side not in (None, "-"):
            check_output(side, options.input)
    console = report.console(quiet=options.quiet or options.json == "-")
    clock = report.Clock()
    with clock("read"):
        file = read(options.input)
    check_types(file.mesh.types, Path(options.output), output_format(options.output, file))
    report.print_file(console, file)
    with clock("constraints"):
        constraints = _constraints(file, options)
    report.print_constraints(console, constraints)
    with clock("smooth"):
        result = _run(file, method, options.steps, constraints, lambda row: report.print_step(console, row))
    with clock("write"):
        notes = write(options.output, file, result, force=options.force)
    report.print_notes(console, notes)
    report.print_comparison(console, file.mesh, result)
    console.print(f"{result.status}; wrote {options.output} in {sum(clock.seconds.values()):.1f} s")
    if options.json:
        row = report.as_json(options.input, options.output, options.method, result, clock.split())
        _write_json(options.json, row)
    if options.report:
        report.write_html(options.report, Path(options.input).name, file.mesh, result)
    return _exit_code(result)


def _quality(options: argparse.Namespace) -> int:
    from jaxsmooth import report
    from jaxsmooth.io import check_output, read
    from jaxsmooth.metrics import METRICS, metric

    names = options.metric or list(METRICS)
    for name in names:
        metric(name)
    if options.json not in (None, "-"):
        check_output(options.json, options.input)
    file = read(options.input)
    table = report.quality_rows(file.mesh, names)
    console = report.console(quiet=options.json == "-")
    report.print_file(console, file)
    report.print_quality(console, table)
    if options.json:
        _write_json(options.json, {"input": options.input, **report.counts(file.mesh), "quality": table})
    return DONE if table[0]["inverted"] == 0 else INVERTED


def _compare(options: argparse.Namespace) -> int:
    from jaxsmooth import report
    from jaxsmooth.io import check_output, read
    from jaxsmooth.methods import METHODS

    names = list(METHODS) if options.methods is None else options.methods.split(",")
    methods = {name: _method(name) for name in names}
    if options.json not in (None, "-"):
        check_output(options.json, options.input)
    console = report.console(quiet=options.quiet or options.json == "-")
    file = read(options.input)
    report.print_file(console, file)
    constraints = _constraints(file, options)
    report.print_constraints(console, constraints)
    rows = [report.compare_row("input", file.mesh, None, constraints, {})]
    for name, method in methods.items():
        clock = report.Clock()
        with clock("smooth"):
            result = _run(file, method, options.steps, constraints, None)
        rows.append(report.compare_row(name, file.mesh, result, constraints, clock.split()))
    report.print_compare(console, rows)
    if options.json:
        _write_json(options.json, {"input": options.input, **report.counts(file.mesh), "methods": rows})
    return DONE


def _demo(options: argparse.Namespace) -> int:
    from jaxsmooth import demo

    return demo.run(Path(options.directory))


# --- Shared ----------------------------------------------------------------------------


def _method(name: str) -> Method:
    import difflib

    from jaxsmooth.methods import METHODS

    if name not in METHODS:
        near = difflib.get_close_matches(name, METHODS, n=2, cutoff=0.4)
        hint = f"did you mean {' or '.join(near)}?" if near else f"known are {', '.join(METHODS)}"
        raise ValueError(f"unknown method {name!r}; {hint}")
    return METHODS[name]()


def _run(file: MeshFile, method: Method, steps: int | None, constraints: Constraints, callback: Any):
    from jaxsmooth.smoothing import smooth

    limit = {} if steps is None else {"steps": steps}
    return smooth(file.mesh, method, constraints=constraints, callback=callback, **limit)


def _constraints(file: MeshFile, options: argparse.Namespace) -> Constraints:
    import difflib

    from jaxsmooth.constraints import detect_constraints

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
    return detect_constraints(
        file.mesh,
        boundary=options.boundary,
        interfaces=options.interfaces,
        feature_angle=options.feature_angle,
        fixed=fixed,
    )


def _exit_code(result: Any) -> int:
    return DONE if result.history[-1].statistics.inverted == 0 else INVERTED


def _write_json(path: str, content: dict[str, Any]) -> None:
    text = json.dumps(content, indent=1, allow_nan=False, default=str) + "\n"
    if path == "-":
        sys.stdout.write(text)
        return
    target = Path(path)
    temporary = target.with_name(f".{target.name}.{time.monotonic_ns()}")
    temporary.write_text(text)
    temporary.replace(target)


if __name__ == "__main__":
    sys.exit(main())
