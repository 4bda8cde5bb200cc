"""The mesh that ships with the package, a bracket of tetrahedra with slivers, and its demo."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rich.console import Console

    from jaxsmooth.files.outputs import Outputs

__all__ = ["MESH", "run"]

MESH = Path(__file__).with_name("bracket.vtu")
_TITLE = "jaxsmooth demo"


def run(directory: Path, outputs: Outputs) -> None:
    """Smooth the demo mesh; write the result and a report to `directory`, with matplotlib also a picture.

    The files are committed to `outputs`; without matplotlib a line says what is missing.
    """
    from jaxsmooth.convert.meshfile import as_mesh
    from jaxsmooth.files.io import check_output, read, write_to
    from jaxsmooth.methods import Elastic
    from jaxsmooth.report import report
    from jaxsmooth.report.page import html_page
    from jaxsmooth.runs.driver import smooth

    out = report.console()
    names = ["bracket-smooth.vtu", "report.html"]
    draw = _before_after(out)
    if draw is not None:
        names.append("before-after.png")
    outputs.folder(directory)
    mesh_path, page_path, *picture_paths = paths = [directory / name for name in names]
    for path in paths:
        check_output(path)
    file = read(MESH)
    report.print_file(out, file)
    result = smooth(file, Elastic(extended=True), callback=lambda row: report.print_step(out, row))
    report.print_constraints(out, result.constraints, result.mesh)
    write_to(outputs, mesh_path, file, result, cell_data={"quality": result.quality})
    before = as_mesh(file)
    if draw is not None:
        figure = draw(before, result.mesh, f"{_TITLE}: a bracket, elastic-extended")
        with outputs.file(picture_paths[0]) as part:
            figure.savefig(part, dpi=130)
    outputs.text(page_path, html_page(_TITLE, before, result, settings={"method": "elastic-extended"}))
    report.print_comparison(out, before, result)
    outputs.commit()
    out.print(f"{result.status}; wrote {', '.join(names)} to {directory}/")


def _before_after(out: Console) -> Callable[..., Any] | None:
    """What draws the picture; without matplotlib nothing does."""
    try:
        from jaxsmooth.report.pictures import before_after
    except ImportError as missing:
        out.print(f"no picture: {missing}", style="yellow")
        return None
    return before_after
