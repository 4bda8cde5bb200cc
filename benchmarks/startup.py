"""What a user waits for: whole processes of the command line.

    python -m benchmarks.startup [--cells 17] [--check]

Each command runs on a cube of tetrahedra three times: with an empty cache, with what that run has kept, and
on another cube of about the size.  Prints seconds and peak memory, and the ratio to Gmsh's whole process,
which opens, optimises and writes the first cube in the same run.  ``benchmarks/startup.json`` has the last
stored measurement; ``--check`` compares with it.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import jaxsmooth as js
from benchmarks.gradients import cube
from benchmarks.ratios import parser, settle

STORED = Path(__file__).with_suffix(".json")
COMMANDS = {
    "quality": ["quality", "{mesh}"],
    "elastic": ["smooth", "{mesh}", "{out}", "-q", "--method", "elastic"],
    "optimize": ["smooth", "{mesh}", "{out}", "-q", "--method", "optimize"],
}
GMSH = """
import gmsh, sys
gmsh.initialize()
gmsh.option.setNumber("General.Terminal", 0)
gmsh.open(sys.argv[1])
gmsh.model.mesh.optimize("")
gmsh.write(sys.argv[2])
"""


def main() -> int:
    """Measure, print, and store or compare."""
    arguments = parser(__doc__)
    arguments.add_argument("--cells", type=int, default=17, help="of a side: cells³ × 6 tetrahedra")
    options = arguments.parse_args()
    rows: dict[str, dict[str, float]] = {}
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        first, second = (_made(place / f"{seed}.msh", options.cells, seed) for seed in (0, 1))
        reference, _ = _process([sys.executable, "-c", GMSH, str(first), str(place / "gmsh.msh")], place)
        print(f"{6 * options.cells**3} tetrahedra; Gmsh {reference:.2f} s")
        for name, words in COMMANDS.items():
            cache = place / f"cache-{name}"
            for when, mesh in (("first run", first), ("second run", first), ("another mesh", second)):
                told = [word.format(mesh=mesh, out=place / "out.msh") for word in words]
                seconds, memory = _process([sys.executable, "-m", "jaxsmooth", *told], cache)
                ratio = seconds / reference
                rows[f"{name}, {when}"] = {"seconds": seconds, "megabytes": memory, "ratio": ratio}
                print(f"{name:9s} {when:13s} {seconds:6.2f} s {memory:5.0f} MB  {ratio:5.2f}", flush=True)
    return settle(STORED, rows, options.check)


def _made(path: Path, cells: int, seed: int) -> Path:
    points, tetra = cube(cells, amplitude=0.2, seed=seed)
    tetra = tetra[seed * len(tetra) // 50 :]  # some fewer: not the same shapes
    js.write(path, (points, {"tetra": tetra}), file_format="gmsh22")
    return path


def _process(words: list[str], cache: Path) -> tuple[float, float]:
    """Seconds and peak megabytes of a whole process; raises where it fails."""
    start = time.perf_counter()
    process = subprocess.Popen(
        words, env={**os.environ, "JAXSMOOTH_CACHE": str(cache)}, stdout=subprocess.DEVNULL
    )
    _, status, usage = os.wait4(process.pid, 0)
    seconds = time.perf_counter() - start
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise subprocess.CalledProcessError(process.returncode, words)
    return seconds, usage.ru_maxrss / 1024


if __name__ == "__main__":
    raise SystemExit(main())
