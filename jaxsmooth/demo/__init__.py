"""The mesh that ships with the package, a bracket of tetrahedra with slivers, and its demo."""

from pathlib import Path

__all__ = ["MESH", "run"]

MESH = Path(__file__).with_name("bracket.vtu")


def run(directory: Path) -> int:
    """Smooth the demo mesh; write the result, a picture and a report to `directory`.

    Returns the exit code of the command line.
    """
    from jaxsmooth import report
    from jaxsmooth.io import read, write
    from jaxsmooth.meshfile import as_mesh
    from jaxsmooth.methods import Elastic
    from jaxsmooth.pictures import before_after
    from jaxsmooth.smoothing import smooth

    directory.mkdir(parents=True, exist_ok=True)
    out = report.console()
    file = read(MESH)
    report.print_file(out, file)
    result = smooth(file, Elastic(extended=True), callback=lambda row: report.print_step(out, row))
    report.print_constraints(out, result.constraints)
    write(directory / "bracket-smooth.vtu", file, result, force=True, cell_data={"quality": result.quality})
    before = as_mesh(file)
    before_after(before, result.mesh, "jaxsmooth demo: a bracket, elastic-extended").savefig(
        directory / "before-after.png", dpi=130
    )
    report.write_html(directory / "report.html", "jaxsmooth demo", before, result)
    report.print_comparison(out, before, result)
    out.print(f"{result.status}; wrote bracket-smooth.vtu, before-after.png and report.html to {directory}/")
    return 0
