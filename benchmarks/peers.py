"""Other smoothers on the same mesh, with the same held boundary and one evaluator.

    python -m benchmarks.peers [FILE …] [--tools NAME,…] [--out TABLE.md]

Every tool runs in a process of its own and only moves nodes.  Those that are not installed, or do
not know the element types, are left out.  A file holds the nodes of its point data `fixed`, else
its whole boundary; without a file a jiggled grid of hexahedra and the demo mesh are used.
Seconds are those of the optimiser's call, for jaxsmooth of a whole run of `smooth` with its defaults, the
second (the first compiles).  The last table says of each mesh by which tools `balanced` is beaten: in
the average quality, in the elements below 0.2, in the inverted ones, or in the least scaled Jacobian.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

PASSES = 5  # of Gmsh and Netgen
LAPLACE_PASSES = 20
OURS = "optimize, balanced"
TUNED = ("bracket", "rocker_gmsh_13k", "tet33k", "hexbend24", "mixed15")  # on which its weights were chosen
GMSH_TYPES = {"triangle": 2, "quad": 3, "tetra": 4, "hexahedron": 5, "wedge": 6, "pyramid": 7}

Blocks = dict[str, np.ndarray]
Result = tuple[np.ndarray, float]


def jaxsmooth(**options) -> Callable[..., Result]:
    """A method of this package: `method`, or options of `Optimize`."""

    def run(points: np.ndarray, blocks: Blocks, held: np.ndarray) -> Result:
        import jax

        jax.config.update("jax_enable_x64", True)
        import jaxsmooth as js
        from jaxsmooth.methods import METHODS, Optimize
        from jaxsmooth.methods.optimize import minimise

        mesh = js.Mesh(points, blocks)
        constraints = js.Constraints.hold(mesh, held)
        name = options.get("method")
        choice = {k: v for k, v in options.items() if k != "method"}
        if "minimiser" in choice:
            choice["minimiser"] = getattr(minimise, choice["minimiser"])()
        method = METHODS[name]() if name else Optimize(**choice)
        for _ in range(2):
            start = time.perf_counter()
            result = js.smooth(mesh, method, constraints=constraints)
            seconds = time.perf_counter() - start
        return np.asarray(result.mesh.points), seconds

    return run


def gmsh(points: np.ndarray, blocks: Blocks, held: np.ndarray) -> Result:
    """Gmsh's Relocate2D or Relocate3D: held nodes are classified on the boundary."""
    import gmsh

    dim = points.shape[1]
    gmsh.initialize(readConfigFiles=False, interruptible=False)
    gmsh.option.setNumber("General.Terminal", 0)
    tags = np.arange(1, len(points) + 1)
    space = np.c_[points, np.zeros((len(points), 3 - dim))]
    gmsh.model.addDiscreteEntity(dim - 1, 1)
    gmsh.model.addDiscreteEntity(dim, 1, [1])
    for entity, chosen in ((dim - 1, held), (dim, ~held)):
        gmsh.model.mesh.addNodes(entity, 1, tags[chosen], space[chosen].ravel())
    for name, nodes in blocks.items():
        gmsh.model.mesh.addElementsByType(1, GMSH_TYPES[name], [], (nodes + 1).ravel())
    start = time.perf_counter()
    gmsh.model.mesh.optimize(f"Relocate{dim}D", niter=PASSES)
    seconds = time.perf_counter() - start
    found, xyz, _ = gmsh.model.mesh.getNodes()
    place = np.zeros(int(found.max()) + 1, int)
    place[found.astype(int)] = np.arange(len(found))
    moved = points.copy()
    for name, nodes in blocks.items():  # Gmsh may have renumbered the nodes
        _, ends = gmsh.model.mesh.getElementsByType(GMSH_TYPES[name])
        moved[nodes.ravel()] = xyz.reshape(-1, 3)[place[ends.astype(int)], :dim]
    return moved, seconds


def netgen(points: np.ndarray, blocks: Blocks, held: np.ndarray) -> Result:
    """Netgen's volume optimisation, node moves only (``optimize3d="m"``)."""
    from netgen import meshing

    mesh, numbers = meshing.Mesh(), []
    for point in points:
        numbers.append(mesh.Add(meshing.MeshPoint(meshing.Pnt(*point))))
    for nodes in blocks["tetra"]:  # Netgen's tetrahedra have the other orientation
        mesh.Add(meshing.Element3D(1, [numbers[i] for i in nodes[[0, 2, 1, 3]]]))
    face = mesh.Add(meshing.FaceDescriptor(surfnr=1, domin=1, domout=0, bc=1))
    for nodes in boundary_triangles(blocks["tetra"]):
        mesh.Add(meshing.Element2D(face, [numbers[i] for i in nodes]))
    start = time.perf_counter()
    mesh.OptimizeVolumeMesh(meshing.MeshingParameters(optimize3d="m", optsteps3d=PASSES))
    seconds = time.perf_counter() - start
    return np.array([mesh.Points()[n].p for n in numbers]), seconds


def mmg(points: np.ndarray, blocks: Blocks, held: np.ndarray) -> Result:
    """MMG with insertion, swaps and surface changes switched off."""
    from mmgpy import MmgMesh3D

    mesh = MmgMesh3D(points, blocks["tetra"].astype(np.int32))
    mesh.set_required_vertices(np.flatnonzero(held).astype(np.int32))
    start = time.perf_counter()
    mesh.remesh(noinsert=1, noswap=1, nosurf=1, optim=1, verbose=-1)
    return np.asarray(mesh.get_vertices()), time.perf_counter() - start


def vtk(points: np.ndarray, blocks: Blocks, held: np.ndarray) -> Result:
    """VTK's constrained smoothing filter along element edges, held nodes without neighbours."""
    import vtk
    from vtk.util.numpy_support import numpy_to_vtk, vtk_to_numpy

    from jaxsmooth.mesh.record import Mesh
    from jaxsmooth.mesh.topology import node_pairs

    pairs = node_pairs(Mesh(points, blocks))
    pairs = np.concatenate([pairs, pairs[:, ::-1]])
    pairs = pairs[~held[pairs[:, 0]]]
    pairs = pairs[np.argsort(pairs[:, 0], kind="stable")]
    offsets = np.r_[0, np.cumsum(np.bincount(pairs[:, 0], minlength=len(points)))]
    stencils = vtk.vtkCellArray()
    long = {"deep": 1, "array_type": vtk.VTK_ID_TYPE}
    stencils.SetData(numpy_to_vtk(offsets, **long), numpy_to_vtk(np.ascontiguousarray(pairs[:, 1]), **long))
    cloud, data = vtk.vtkPoints(), vtk.vtkPolyData()
    cloud.SetData(numpy_to_vtk(np.c_[points, np.zeros((len(points), 3 - points.shape[1]))], deep=1))
    data.SetPoints(cloud)
    smoother = vtk.vtkConstrainedSmoothingFilter()
    smoother.SetInputData(data)
    smoother.SetSmoothingStencils(stencils)
    smoother.SetNumberOfIterations(LAPLACE_PASSES)
    smoother.SetRelaxationFactor(1.0)
    smoother.SetConstraintStrategyToConstraintDistance()
    smoother.SetConstraintDistance(float(np.ptp(points)))
    smoother.SetOutputPointsPrecision(vtk.vtkAlgorithm.DOUBLE_PRECISION)
    start = time.perf_counter()
    smoother.Update()
    seconds = time.perf_counter() - start
    return vtk_to_numpy(smoother.GetOutput().GetPoints().GetData())[:, : points.shape[1]], seconds


def skfem(points: np.ndarray, blocks: Blocks, held: np.ndarray) -> Result:
    """scikit-fem's Laplacian smoothing of triangles."""
    from skfem import MeshTri

    mesh = MeshTri(points.T.copy(), blocks["triangle"].T.copy())
    start = time.perf_counter()
    moved = mesh.smoothed(np.flatnonzero(held))
    return moved.p.T, time.perf_counter() - start


# name: (function, element types it knows; None for all)
TOOLS: dict[str, tuple[Callable[..., Result], set[str] | None]] = {
    "elastic": (jaxsmooth(method="elastic"), None),
    "elastic-extended": (jaxsmooth(method="elastic-extended"), None),
    "optimize, balanced": (jaxsmooth(goal="balanced"), None),
    "optimize, average": (jaxsmooth(goal="average"), None),
    "optimize, worst": (jaxsmooth(goal="worst"), None),
    "balanced by optimistix": (jaxsmooth(minimiser="Optimistix"), None),
    "balanced by jaxopt": (jaxsmooth(minimiser="Jaxopt"), None),
    "balanced by optax": (jaxsmooth(minimiser="Optax"), None),
    "gmsh": (gmsh, set(GMSH_TYPES)),
    "netgen": (netgen, {"tetra"}),
    "mmg": (mmg, {"tetra"}),
    "vtk": (vtk, None),
    "skfem": (skfem, {"triangle"}),
}


def boundary_triangles(tetra: np.ndarray) -> np.ndarray:
    """Faces of only one tetrahedron, outward."""
    faces = tetra[:, [[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]]].reshape(-1, 3)
    _, first, count = np.unique(np.sort(faces, axis=1), axis=0, return_index=True, return_counts=True)
    return faces[first[count == 1]]


def hexahedra(n: int = 12, amplitude: float = 0.35) -> tuple[np.ndarray, Blocks, np.ndarray]:
    """A bent bar of n³ hexahedra with its inner nodes displaced."""
    axis = np.arange(n + 1) / n
    grid = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    held = ((grid == 0) | (grid == 1)).any(axis=1)
    grid[~held] += amplitude / n * np.random.default_rng(0).uniform(-1, 1, (int((~held).sum()), 3))
    radius, angle = 0.5 + grid[:, 0], np.pi / 2 * grid[:, 1]
    points = np.stack([radius * np.cos(angle), radius * np.sin(angle), grid[:, 2]], axis=1)
    corner = np.arange((n + 1) ** 3).reshape((n + 1,) * 3)[:-1, :-1, :-1].reshape(-1, 1)
    x, y, z = (n + 1) ** 2, n + 1, 1
    return points, {"hexahedron": corner + np.array([0, x, x + y, y, z, x + z, x + y + z, y + z])}, held


def load(path: Path) -> tuple[np.ndarray, Blocks, np.ndarray]:
    """Points, blocks and held nodes of a file."""
    import jax

    jax.config.update("jax_enable_x64", True)
    import jaxsmooth as js

    file = js.read(path)
    fixed = file.fixed
    if fixed is None or not np.any(fixed):
        fixed = js.detect_constraints(file.mesh, boundary="fixed").freedom == 0
    blocks: Blocks = {}
    for name, nodes in zip(file.mesh.types, file.mesh.connectivity, strict=True):
        blocks[name] = np.concatenate([blocks[name], nodes]) if name in blocks else np.asarray(nodes)
    return np.asarray(file.mesh.points, float), blocks, np.asarray(fixed)


def measured(points: np.ndarray, blocks: Blocks, held: np.ndarray) -> dict[str, float]:
    """What a row says of a mesh."""
    import jaxsmooth as js
    from jaxsmooth.metrics.evaluation import evaluate

    mesh = js.Mesh(points, blocks)
    evaluation = evaluate(mesh)
    q = np.concatenate(evaluation.quality)
    movable = np.concatenate([(~held[nodes]).any(axis=1) for nodes in blocks.values()])
    stats = js.statistics(mesh, evaluation)
    return {
        "q_min": q[movable].min() if movable.any() else q.min(),
        "q_low": np.quantile(q[movable], 0.01) if movable.any() else q.min(),
        "q_avg": stats.q_avg,
        "below": stats.below,
        "corner": stats.scaled_jacobian_min,
        "inverted": stats.inverted,
    }


def row(name: str, found: dict[str, float], seconds: float | None) -> str:
    """One line of the table."""
    values = (
        f"{found['q_min']:.4f} | {found['q_low']:.4f} | {found['q_avg']:.5f} | {found['below']} | "
        f"{found['corner']:.4f} | {found['inverted']}"
    )
    return f"| {name} | {values} | {'' if seconds is None else f'{seconds:.2f}'} |"


def beaten(found: dict[str, dict[str, float]]) -> str:
    """By whom `OURS` is beaten, and in what, in one cell of a table; for differences of 1e-5 and more."""
    ours, parts = found[OURS], []
    for name, other in found.items():
        better = {
            "q_avg": other["q_avg"] - ours["q_avg"] > 1e-5,
            "q < 0.2": other["below"] < ours["below"],
            "inverted": other["inverted"] < ours["inverted"],
            "sj_min": min(other["corner"], 0.2) - ours["corner"] > 1e-5,
        }
        if name != OURS and any(better.values()):
            parts.append(f"{name} ({', '.join(key for key, is_so in better.items() if is_so)})")
    return "; ".join(parts) or "none"


HEAD = (
    "| tool | q_min movable | q 1 % movable | q_avg | q < 0.2 | sj_min | inverted | seconds |\n"
    "|---|---|---|---|---|---|---|---|"
)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("files", nargs="*", type=Path)
    parser.add_argument("--tools", default=",".join(name.replace(",", ";") for name in TOOLS))
    parser.add_argument("--out", type=Path)
    parser.add_argument("--worker", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.worker:
        path = options.files[0]
        data = dict(np.load(path))
        points, held = data.pop("points"), data.pop("held")
        moved, seconds = TOOLS[options.worker][0](points, data, held)
        np.savez(path.with_name("out.npz"), points=moved, seconds=seconds)
        return 0

    import jax

    jax.config.update("jax_enable_x64", True)
    from jaxsmooth.demo import MESH

    cases = {path.stem: load(path) for path in options.files}
    if not cases:
        cases = {"bent hexahedra": hexahedra(), "bracket": load(MESH)}
    chosen = [name.strip().replace(";", ",") for name in options.tools.split(",")]
    lines, summary = [], []
    for title, (points, blocks, held) in cases.items():
        sizes = ", ".join(f"{len(nodes)} {name}" for name, nodes in blocks.items())
        found = {"input": measured(points, blocks, held)}
        lines += [f"## {title}: {sizes}", "", HEAD, row("input", found["input"], None)]
        print("\n".join(lines[-4:]), flush=True)
        for name in chosen:
            known = TOOLS[name][1]
            if known is not None and not set(blocks) <= known:
                continue
            with tempfile.TemporaryDirectory() as folder:
                path = Path(folder) / "in.npz"
                np.savez(path, points=points, held=held, **blocks)
                command = [sys.executable, "-m", "benchmarks.peers", str(path), "--worker", name]
                done = subprocess.run(command, capture_output=True, text=True)
                if done.returncode:
                    reason = (done.stderr.strip().splitlines() or [f"exit code {done.returncode}"])[-1]
                    print(f"{name}: left out ({reason[:120]})", file=sys.stderr)
                    continue
                out = np.load(path.with_name("out.npz"))
            if len(out["points"]) != len(points):
                print(f"{name}: left out (it changed the number of nodes)", file=sys.stderr)
                continue
            found[name] = measured(out["points"], blocks, held)
            lines.append(row(name, found[name], float(out["seconds"])))
            print(lines[-1], flush=True)
        lines.append("")
        if OURS in found:
            half = "chosen on" if title in TUNED else "reported on"
            summary.append(f"| {title} | {half} | {beaten(found)} |")
    lines += [
        "## Who is better than the default goal",
        "",
        "| mesh | weights | by |",
        "|---|---|---|",
        *summary,
        "",
    ]
    print("\n".join(lines[-len(summary) - 5 :]))
    if options.out:
        options.out.write_text("\n".join(lines))
    return 0


if __name__ == "__main__":
    sys.exit(main())
