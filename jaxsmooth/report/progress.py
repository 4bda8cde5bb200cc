"""What is going on, while it goes on: a line on terminals and in notebooks, nothing where output is piped."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

from jaxsmooth.runs.driver import StepRecord

__all__ = ["progress", "working"]


def _shown(out: Console) -> bool:
    return (out.is_terminal or out.is_jupyter) and not out.quiet


def _after(row: StepRecord) -> str:
    q = row.statistics
    solved = f", {row.solver_iterations:,} solver iterations" if row.solver_iterations else ""
    tangled = f", {q.inverted:,} inverted" if q.inverted else ""
    return f"q_min {q.q_min:.3f}, q_avg {q.q_avg:.3f}{tangled}{solved}"


@contextmanager
def working(out: Console) -> Iterator[Callable[[str], None]]:
    """A line with a clock; it is given a function that says what is being done."""
    columns = SpinnerColumn(), TextColumn("{task.description}"), TimeElapsedColumn()
    with Progress(*columns, console=out, transient=True, disable=not _shown(out)) as shown:
        task = shown.add_task("", total=None)
        yield lambda text: shown.update(task, description=text, refresh=True)


@contextmanager
def progress(steps: int = 10, out: Console | None = None) -> Iterator[Callable[[StepRecord], None]]:
    """A bar for a run of `smooth`: ``with progress() as show: smooth(mesh, callback=show)``.

    Args:
        steps: the largest number of steps, as `smooth` is told.
        out: where it is drawn: by default standard output, on a terminal or in a notebook, and nowhere else.

    Yields:
        The callback.
    """
    out = Console() if out is None else out
    columns = SpinnerColumn(), BarColumn(), TextColumn("{task.description}"), TimeElapsedColumn()
    with Progress(*columns, console=out, transient=True, disable=not _shown(out)) as shown:
        task = shown.add_task("reading and compiling", total=max(steps, 1))

        def show(row: StepRecord) -> None:
            doing = "compiling and step 1" if row.step == 0 else f"step {row.step + 1}"
            doing = "done" if row.step >= steps else doing
            shown.update(task, completed=row.step, description=f"{doing} ({_after(row)})")

        yield show
