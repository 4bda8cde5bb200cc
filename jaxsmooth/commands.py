"""What the commands do: read, call the library, print, write."""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

from jaxsmooth import choices
from jaxsmooth.convert.meshfile import MeshFile
from jaxsmooth.files import io
from jaxsmooth.files.formats.table import format_of_suffix
from jaxsmooth.files.outputs import Outputs
from jaxsmooth.methods import METHODS
from jaxsmooth.metrics.table import USUAL
from jaxsmooth.motion.detect import detect_constraints
from jaxsmooth.report import advice, compared, quality, report
from jaxsmooth.report.holding import holding
from jaxsmooth.report.progress import working
from jaxsmooth.report.terminal import complain, sentence, write_to_standard_output
from jaxsmooth.runs.driver import SmoothResult, StepRecord

__all__ = ["BAD_INPUT", "DONE", "INVERTED", "SOME_FAILED", "compare", "demo", "info", "measure", "smooth"]

DONE, BAD_INPUT, INVERTED, SOME_FAILED = 0, 2, 3, 4


# --- smooth ----------------------------------------------------------------------------


def smooth(options: argparse.Namespace, outputs: Outputs) -> int:
    """``jaxsmooth smooth``."""
    choices.chosen_method(options.method, options.goal)
    choices.check_run_options(options)
    choices.check_format(options.format)
    if options.report == "-":
        raise ValueError("--report -: a report can't go to standard output; name a file")
    if options.out_dir is not None:
        return _smooth_several(options, outputs)
    source, target = map(Path, options.files)
    io.check_output(target, source, force=options.force)
    if options.format is None:
        format_of_suffix(target)
    _check_side_files(options, source, OUT=str(target))
    out = report.console(quiet=options.quiet or options.json == "-")
    done = _smooth_one(options, source, target, out, outputs)
    if options.report is not None:
        _write_report(outputs, options, source, done)
    if options.json is not None:
        _write_json(outputs, options.json, done.row)
    inverted = done.inverted
    remain = f"; {inverted:,} inverted elements remain" if inverted else ""
    _finish(out, outputs, f"{done.result.status}{remain}; wrote {{}} in {sum(done.seconds.values()):.1f} s")
    if inverted and out.quiet:
        complain(f"{target}: {inverted:,} inverted elements remain")
    return INVERTED if inverted else DONE


@dataclass(frozen=True)
class _Done:
    """A mesh that was smoothed, its row in the JSON, and seconds by phase."""

    file: MeshFile
    result: SmoothResult
    row: dict[str, Any]
    seconds: dict[str, float]

    @property
    def inverted(self) -> int:
        return self.result.history[-1].statistics.inverted


def _smooth_one(
    options: argparse.Namespace, source: Path, target: Path, out: Console, outputs: Outputs
) -> _Done:
    """From file to file; the output is put in place when the outputs are committed."""
    with working(out) as say:
        return _from_file_to_file(options, source, target, out, outputs, say)


def _from_file_to_file(
    options: argparse.Namespace,
    source: Path,
    target: Path,
    out: Console,
    outputs: Outputs,
    say: Callable[[str], None],
) -> _Done:
    clock = report.Clock()
    say(f"reading {source.name}")
    with clock("read"):
        file = io.read(source)
    asked: dict[str, Any] = {"file_format": choices.format_for(options.format, file.format)}
    asked["force"] = options.force
    io.check_types(file.mesh.types, target, io.output_format(target, file, asked["file_format"]))
    report.print_file(out, file)
    with clock("write"), Outputs() as trial:  # what a writer refuses, it refuses before the work
        notes = io.write_to(trial, target, file, **asked)
    _print_losses(out, notes, str(target))
    say("finding what nodes may do")
    with clock("constraints"):
        constraints = choices.constraints_of(file, options)
        held = holding(file.mesh, constraints, choices.held_by_option(file, options))
    report.print_constraints(out, constraints, file.mesh)
    advice.print_held(out, held)
    method = choices.chosen_method(options.method, options.goal)
    say("evaluating the mesh")

    def after(row: StepRecord) -> None:
        report.print_step(out, row)
        say(f"step {row.step + 1}" if row.step else "compiling, and step 1")

    with clock("smooth"):
        result = choices.run_method(file, method, options.steps, constraints, after)
    say(f"writing {target.name}")
    data = {}
    if options.quality_data:
        data["cell_data"] = quality.cell_data(result.mesh, quality.measured(result.mesh, USUAL))
    with clock("write"):
        said = io.write_to(outputs, target, file, result, **asked, **data)
    late = tuple(note for note in said if note not in notes)  # on the coordinates themselves
    _print_losses(out, late, str(target))
    report.print_comparison(out, file.mesh, result)
    worst = advice.worst_elements(file, result.mesh, held)
    advice.print_worst(out, worst)
    tangled = advice.still_inverted(file, result.mesh, constraints, held)
    advice.print_inverted(out, tangled)
    losses, notes = [*notes, *late], (*file.notes, *notes, *late)
    row = report.as_json(str(source), str(target), options.method, result, clock.split(), notes)
    row |= {
        "node_freedom": dict(held.counts()),
        "advice": advice.advice(held),
        "worst": worst,
        "still_inverted": tangled,
        "losses": losses,
    }
    return _Done(file, result, row, clock.seconds)


def _smooth_several(options: argparse.Namespace, outputs: Outputs) -> int:
    """Each input into the folder; what fails is said, and does not stop the others."""
    if options.report is not None:
        raise ValueError("--report is for one input; leave it out, or --out-dir")
    folder, sources = Path(options.out_dir), choices.inputs_of(options.files)
    targets = [choices.output_name(source, folder, options.format) for source in sources]
    twice = {target for target in targets if targets.count(target) > 1}
    if twice:
        raise ValueError(f"{min(twice)}: several inputs would be written there; rename one of them")
    folder.mkdir(parents=True, exist_ok=True)
    sides = {} if options.json in (None, "-") else {"--json": options.json}
    io.check_distinct({**{str(path): str(path) for path in (*sources, *targets)}, **sides})
    for path in sides.values():
        io.check_output(path)
    out = report.console(quiet=options.quiet or options.json == "-")
    rows, failed, tangled = [], 0, 0
    with Progress(console=out, transient=True, disable=not out.is_terminal) as progress:
        task = progress.add_task("", total=len(sources))
        for source, target in zip(sources, targets, strict=True):
            progress.update(task, description=source.name)
            try:
                done = _smooth_one(options, source, target, report.console(quiet=True), outputs)
                outputs.commit()
            except Exception as error:
                text = sentence(error)
                if text is None:
                    raise
                outputs.discard()
                complain(text if str(source) in text else f"{source}: {text}")
                failed += 1
                rows.append({"input": str(source), "output": None, "error": text})
            else:
                tangled += done.inverted > 0
                rows.append(done.row)
                report.print_done(out, done.row)
            progress.advance(task)
    if options.json is not None:
        _write_json(outputs, options.json, {"files": rows})
        outputs.commit()
    out.print(f"{len(sources) - failed:,} of {len(sources):,} files written to {folder}")
    if failed:
        return SOME_FAILED if failed < len(sources) else BAD_INPUT
    return INVERTED if tangled else DONE


def _settings(options: argparse.Namespace, source: str | Path) -> dict[str, Any]:
    """The input, and the options that say what is done, by name."""
    left_out = ("command", "files", "out_dir", "json", "report", "quiet", "force", "precision", "no_cache")
    shown = {name.replace("_", " "): v for name, v in vars(options).items() if name not in left_out}
    return {"input": source, **{name: v for name, v in shown.items() if name != "input"}}


def _write_report(outputs: Outputs, options: argparse.Namespace, source: Path, done: _Done) -> None:
    from jaxsmooth.report.page import html_page

    settings = _settings(options, source) | {"output": options.files[1]}
    more = {"settings": settings, "seconds": done.row["seconds"], "notes": done.file.notes}
    outputs.text(options.report, html_page(source.name, done.file.mesh, done.result, **more))


# --- The others ------------------------------------------------------------------------


def measure(options: argparse.Namespace, outputs: Outputs) -> int:
    """``jaxsmooth quality``."""
    names, options.input = quality.requested(options.metric, options.input)
    if options.csv == "-":
        raise ValueError("--csv -: the rows can't go to standard output; name a file")
    data = {"--quality-data": options.quality_data} if options.quality_data is not None else {}
    _check_side_files(options, options.input, **data)
    file = io.read(options.input)
    values = quality.measured(file.mesh, quality.chosen_metrics(names, file.mesh))
    rows = quality.quality_rows(file.mesh, values)
    metric, parts = next(iter(values.items()))
    held = holding(file.mesh, detect_constraints(file))
    worst = quality.worst_rows(file, metric, parts, held)
    out, losses = report.console(quiet=options.json == "-"), ()
    report.print_file(out, file)
    quality.print_report(out, values, rows, worst)
    if options.csv is not None:
        outputs.text(options.csv, quality.csv_text(file, values))
    if options.quality_data is not None:
        losses = io.write_to(
            outputs, options.quality_data, file, cell_data=quality.cell_data(file.mesh, values)
        )
        _print_losses(out, losses, options.quality_data)
    if options.json is not None:
        content = {"input": options.input, **report.counts(file.mesh), "quality": rows, "worst": worst}
        content |= {"notes": [*file.notes, *losses], "losses": losses}
        _write_json(outputs, options.json, content)
    if options.json or options.csv or data:
        _finish(out, outputs, "wrote {}")
    return DONE if rows[0]["inverted"] == 0 else INVERTED


def info(options: argparse.Namespace, outputs: Outputs) -> int:
    """``jaxsmooth info``."""
    from jaxsmooth.report.info import facts, print_facts

    choices.check_run_options(options)
    _check_side_files(options, options.input)
    out = report.console(quiet=options.json == "-")
    file = io.read(options.input)
    constraints = choices.constraints_of(file, options)
    held = holding(file.mesh, constraints, choices.held_by_option(file, options))
    row = facts(file, constraints, held)
    print_facts(out, file, constraints, held, row)
    if options.json is not None:
        _write_json(outputs, options.json, row)
        _finish(out, outputs, "wrote {}")
    return INVERTED if row["quality"]["inverted"] else DONE


def compare(options: argparse.Namespace, outputs: Outputs) -> int:
    """``jaxsmooth compare``."""
    names = list(METHODS) if options.methods is None else [n.strip() for n in options.methods.split(",")]
    if options.goal is not None and "optimize" not in names:
        raise ValueError("--goal is for the method optimize; add it to --methods, or leave --goal out")
    goals = {name: options.goal if name == "optimize" else None for name in names}
    methods = {name: choices.chosen_method(name, goal) for name, goal in goals.items()}
    choices.check_run_options(options)
    _check_side_files(options, options.input)
    out = report.console(quiet=options.quiet or options.json == "-")
    file = io.read(options.input)
    report.print_file(out, file)
    constraints = choices.constraints_of(file, options)
    report.print_constraints(out, constraints, file.mesh)
    rows = [compared.compare_row("input", file.mesh, None, constraints, {})]
    compared.print_head(out)
    compared.print_row(out, rows[0])
    results = {}
    columns = SpinnerColumn(), TextColumn("{task.description}"), TimeElapsedColumn()
    with Progress(*columns, console=out, transient=True, disable=not out.is_terminal) as progress:
        task = progress.add_task("", total=None)
        for name, method in methods.items():
            progress.reset(task, description=f"{name}: compiling and smoothing")
            clock = report.Clock()
            with clock("smooth"):
                result = choices.run_method(file, method, options.steps, constraints, None)
            results[name] = result
            rows.append(compared.compare_row(name, file.mesh, result, constraints, clock.split()))
            compared.print_row(out, rows[-1])
    compared.print_movable(out, rows)
    best, words = compared.recommend(rows)
    compared.print_advice(out, words)
    if options.json is not None:
        content = {"input": options.input, **report.counts(file.mesh), "methods": rows, "notes": file.notes}
        content |= {"best": best, "advice": words}
        _write_json(outputs, options.json, content)
    if options.report is not None:
        from jaxsmooth.report.page import html_comparison

        more = {"settings": _settings(options, options.input), "notes": file.notes}
        outputs.text(
            options.report, html_comparison(Path(options.input).name, file.mesh, results, rows, **more)
        )
    if options.json or options.report:
        _finish(out, outputs, "wrote {}")
    return DONE


def demo(options: argparse.Namespace, outputs: Outputs) -> int:
    """``jaxsmooth demo``."""
    from jaxsmooth.demo import run

    run(Path(options.directory), outputs)
    return DONE


# --- Shared ----------------------------------------------------------------------------


def _check_side_files(options: argparse.Namespace, source: str | Path, **meshes: str) -> None:
    """Whether JSON and report can be written, and are neither a mesh nor one another."""
    sides = {f"--{name}": getattr(options, name, None) for name in ("json", "report", "csv")}
    sides = {name: path for name, path in sides.items() if path not in (None, "-")}
    io.check_distinct({"IN": str(source), **sides})
    io.check_distinct({**meshes, **sides})
    for path in sides.values():
        io.check_output(path)


def _print_losses(out: Console, notes: tuple[str, ...], output: str) -> None:
    """What the output can't hold is said even to those who asked for silence."""
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
