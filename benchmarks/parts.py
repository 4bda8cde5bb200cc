"""Three machine parts as CAD models, meshed by Gmsh's 3D Delaunay without any optimisation.

`rocker_arm` and `swing_frame` stand in for Examples 5 and 6 of the paper, whose meshes are not
published; `bracket` is the demo that ships with the package.  Lengths are in millimetres.

How the paper's iteration 0 is matched (Tables 7 and 8), tuned by the mesh size:

* flat faces are meshed by 2D Delaunay, curved ones by Frontal-Delaunay: slivers then gather where
  nodes are free or slide, and not where a curved face holds all four of them;
* the surface meshes of Examples 5 and 6 are not smoothed either;
* the swing frame's inside is coarser than its skin, and its inner nodes are displaced at random.

    python -m benchmarks.parts    # writes jaxsmooth/demo/bracket.vtu
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import gmsh
import meshio
import numpy as np

__all__ = ["DEMO", "GMSH", "bracket", "quality", "rocker_arm", "swing_frame", "write_demo"]

DEMO = Path(__file__).parents[1] / "jaxsmooth" / "demo" / "bracket.vtu"
GMSH = "4.15.2"  # the release that made the demo; another may place nodes differently

occ = gmsh.model.occ

Part = tuple[np.ndarray, np.ndarray]  # points [nodes, 3], tetrahedra [elements, 4]
Solid = tuple[int, int]  # Gmsh's (dimension, tag)
Spot = tuple[float, float]

FACES = [[1, 2, 3], [0, 3, 2], [0, 1, 3], [0, 2, 1]]

# One thread and a fixed seed make the mesh reproducible; no optimisation keeps Delaunay's slivers.
OPTIONS = {
    "General.NumThreads": 1,
    "General.Terminal": 0,
    "Mesh.Algorithm3D": 1,
    "Mesh.ElementOrder": 1,
    "Mesh.Optimize": 0,
    "Mesh.OptimizeNetgen": 0,
    "Mesh.OptimizeThreshold": 0,
    "Mesh.RandomSeed": 1,
}
DELAUNAY, FRONTAL = 5, 6  # Gmsh's numbers of its surface algorithms


def rocker_arm() -> Part:
    """A bent rocker arm: pivot hub, push-rod end and valve end, each with its bore (Example 5)."""
    return _generate(_rocker_arm, size=2.78, smooth_surface=False)


def swing_frame() -> Part:
    """An excavator's swing frame: hinge lugs, bridge, boom cheeks, cylinder lug (Example 6)."""
    points, tetra = _generate(_swing_frame, size=5.4, inner_size=9.0, smooth_surface=False)
    return _displaced(points, tetra, amplitude=0.2), tetra


def bracket() -> Part:
    """An L-bracket with a filleted corner, two ribs, a bored boss and bolt holes (the demo)."""
    return _generate(_bracket, size=3.4)


def quality(points: np.ndarray, tetra: np.ndarray) -> np.ndarray:
    """The paper's quality of tetrahedra ``[elements]`` (Eqs. 2 and 4), negative where inverted.

    Kept apart from the package's own so that these meshes are checked independently of it.
    """
    corners = points[tetra]
    volume = np.linalg.det(corners[:, 1:] - corners[:, :1]) / 6
    a, b, c = np.moveaxis(corners[:, FACES], 2, 0)
    surface = np.linalg.norm(np.cross(b - a, c - a), axis=2).sum(axis=1) / 2
    ideal = np.sqrt(3) * (6 * np.sqrt(2) * np.abs(volume)) ** (2 / 3)
    return np.sign(volume) * (ideal / surface) ** 2


def write_demo(path: Path = DEMO) -> None:
    """Write the bracket as a compressed binary VTU."""
    points, tetra = bracket()
    path.parent.mkdir(parents=True, exist_ok=True)
    meshio.write(path, meshio.Mesh(points, {"tetra": tetra}), file_format="vtu")


# --- the parts -----------------------------------------------------------------------------------
# Pieces that are fused differ a little in radius or height on purpose: tangent or coplanar faces
# would leave needle-like facets that no volume mesher can fill well.


def _rocker_arm() -> None:
    push = _link((-46, -9), 9, (0, 0), 14, -8.5, 8.5)
    valve = _link((0, 0), 15, (60, -15), 10.5, -7.5, 7.5)
    hub = _cylinder((0, 0), 16.5, -12.5, 12.5)
    bores = [((0, 0), 8), ((-46, -9), 4.5), ((60, -15), 5)]
    _cut(_fuse(push, valve, hub), *[_cylinder(spot, radius, -20, 20) for spot, radius in bores])


def _swing_frame() -> None:
    # Cheeks are drawn flat, bored, then turned up: (x, y) becomes (x, z) and z becomes -y.
    cheeks = []
    for low in (-70, 46):
        high = low + 24
        arm = _link((32, 52), 40, (118, 30), 24, low, high)
        boom = _link((32, 60), 37, (125, 125), 22, low, high)
        bores = [_cylinder((118, 30), 11, low - 1, high + 1), _cylinder((125, 125), 10, low - 1, high + 1)]
        cheeks.append(_cut(_fuse(arm, boom), *bores))
    occ.rotate(cheeks, 0, 0, 0, 1, 0, 0, np.pi / 2)
    bridge = _box((-10, -58, 0), (40, 58, 104))
    hinge = [_link((-80, 0), 38, (-18, 0), 50, low, low + 28) for low in (4, 72)]
    lug = _link((14, -40), 24, (14, -112), 19, 38, 62)
    holes = [_cylinder((-80, 0), 20, -1, 105), _cylinder((14, -112), 9, 30, 70)]
    _cut(_fuse(bridge, *hinge, *cheeks, lug), *holes)


def _bracket() -> None:
    # The L is drawn in (x, z) with its inner fillet and pulled along y.
    foot, inner, top = [(0, 0), (76, 0), (76, 9), (19, 9)], (19, 19), [(9, 19), (9, 62), (0, 62)]
    profile = [occ.addPoint(x, -34, z) for x, z in (*foot, *top)]
    centre = occ.addPoint(inner[0], -34, inner[1])
    lines = [occ.addLine(profile[i], profile[i + 1]) for i in (0, 1, 2, 4, 5)]
    arc = occ.addCircleArc(profile[3], centre, profile[4])
    loop = [*lines[:3], arc, *lines[3:], occ.addLine(profile[-1], profile[0])]
    body = _extrude(loop, (0, 68, 0))
    body = _round(body, 12, [(76, -34, 4.5), (76, 34, 4.5), (4.5, -34, 62), (4.5, 34, 62)])
    ribs = []
    for y in (-28.5, 20.5):
        triangle = [occ.addPoint(x, y, z) for x, z in ((4, 4), (58, 4), (58, 8), (8, 52), (4, 52))]
        sides = [occ.addLine(a, b) for a, b in zip(triangle, triangle[1:] + triangle[:1], strict=True)]
        ribs.append(_extrude(sides, (0, 8, 0)))
    boss = (3, occ.addCylinder(2, 0, 38, 17, 0, 0, 14))
    bore = (3, occ.addCylinder(-1, 0, 38, 30, 0, 0, 7.5))
    bolts = [_cylinder((x, y), 4.5, -1, 20) for x, y in ((34, -9), (34, 9))]
    slots = [_link((60, y), 4.5, (66, y), 4.5, -1, 20) for y in (-20, 20)]
    _cut(_fuse(body, boss, *ribs), bore, *bolts, *slots)


# --- CAD and meshing -----------------------------------------------------------------------------


def _generate(
    build: Callable[[], None], size: float, inner_size: float | None = None, smooth_surface: bool = True
) -> Part:
    """Build a solid in a Gmsh session of its own and mesh it.

    Args:
        build: adds the solid to the current model.
        size: edge length on the boundary, and inside too unless `inner_size` is given.
        inner_size: edge length inside.
        smooth_surface: keep Gmsh's Laplacian step on the surface meshes.

    Raises:
        RuntimeError: if Gmsh finds no inside, as it may when it cannot close the surface mesh.
    """
    with _session():
        build()
        occ.synchronize()
        for face in gmsh.model.getEntities(2):
            flat = gmsh.model.getType(*face) == "Plane"
            gmsh.model.mesh.setAlgorithm(*face, DELAUNAY if flat else FRONTAL)
        gmsh.option.setNumber("Mesh.MeshSizeMax", inner_size or size)
        gmsh.option.setNumber("Mesh.Smoothing", int(smooth_surface))
        if inner_size:
            gmsh.option.setNumber("Mesh.MeshSizeExtendFromBoundary", 0)
            gmsh.model.mesh.setSizeCallback(lambda dim, *_: inner_size if dim == 3 else size)
        gmsh.model.mesh.generate(3)
        points, tetra = _tetrahedra()
    if not len(tetra):
        raise RuntimeError(f"Gmsh made no tetrahedra for {build.__name__}; change the size a little")
    return points, tetra


def _tetrahedra() -> Part:
    """Gmsh's tetrahedra, positively oriented, and their nodes."""
    tags, xyz, _ = gmsh.model.mesh.getNodes()
    _, nodes = gmsh.model.mesh.getElementsByType(4)
    order = np.argsort(tags)
    rows = order[np.searchsorted(tags[order], nodes)]
    used, tetra = np.unique(rows, return_inverse=True)  # drops nodes of no tetrahedron
    points, tetra = xyz.reshape(-1, 3)[used], tetra.reshape(-1, 4)
    corners = points[tetra]
    inverted = np.linalg.det(corners[:, 1:] - corners[:, :1]) < 0
    tetra[inverted, :2] = tetra[inverted, 1::-1]
    return points, tetra


def _displaced(points: np.ndarray, tetra: np.ndarray, amplitude: float) -> np.ndarray:
    """Move inner nodes at random by up to `amplitude` of their shortest edge along each axis.

    Moves around an element that would fall below a quality of 0.005 are taken back, so every
    element stays valid.  The seed is fixed.
    """
    ends = tetra[:, [[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]]].reshape(-1, 2)
    shortest = np.full(len(points), np.inf)
    np.minimum.at(shortest, ends.T, np.linalg.norm(points[ends[:, 0]] - points[ends[:, 1]], axis=1))
    faces = np.sort(tetra[:, FACES].reshape(-1, 3), axis=1)
    faces, count = np.unique(faces, axis=0, return_counts=True)
    shortest[faces[count == 1]] = 0
    move = amplitude * shortest[:, None] * np.random.default_rng(0).uniform(-1, 1, points.shape)
    floor = np.minimum(quality(points, tetra), 5e-3)
    while (bad := quality(points + move, tetra) < floor).any():
        move[tetra[bad]] = 0
    return points + move


@contextmanager
def _session() -> Iterator[None]:
    """A fresh Gmsh that ignores the user's configuration."""
    gmsh.initialize(readConfigFiles=False, interruptible=False)
    try:
        for name, value in OPTIONS.items():
            gmsh.option.setNumber(name, value)
        yield
    finally:
        gmsh.finalize()


def _box(low: tuple[float, float, float], high: tuple[float, float, float]) -> Solid:
    return 3, occ.addBox(*low, *np.subtract(high, low))


def _cylinder(spot: Spot, radius: float, low: float, high: float) -> Solid:
    return 3, occ.addCylinder(*spot, low, 0, 0, high - low, radius)


def _link(p: Spot, p_radius: float, q: Spot, q_radius: float, low: float, high: float) -> Solid:
    """Two circles and their outer tangents in the (x, y) plane, from z = `low` to `high`."""
    p, q = np.array(p, dtype=float), np.array(q, dtype=float)
    length = np.linalg.norm(q - p)
    along = (q - p) / length
    across = np.array([-along[1], along[0]])
    lean = (p_radius - q_radius) / length
    left, right = (lean * along + side * np.sqrt(1 - lean**2) * across for side in (1, -1))

    def end(centre: np.ndarray, radius: float, *directions: np.ndarray) -> tuple[int, list[int], int]:
        middle = occ.addPoint(*centre, low)
        a, b, c = (occ.addPoint(*(centre + radius * direction), low) for direction in directions)
        return a, [occ.addCircleArc(a, middle, b), occ.addCircleArc(b, middle, c)], c

    first, p_arcs, second = end(p, p_radius, left, -along, right)
    third, q_arcs, fourth = end(q, q_radius, right, along, left)
    return _extrude(
        [*p_arcs, occ.addLine(second, third), *q_arcs, occ.addLine(fourth, first)], (0, 0, high - low)
    )


def _extrude(curves: list[int], by: tuple[float, float, float]) -> Solid:
    face = occ.addPlaneSurface([occ.addCurveLoop(curves)])
    return next(entity for entity in occ.extrude([(2, face)], *by) if entity[0] == 3)


def _round(solid: Solid, radius: float, middles: list[tuple[float, float, float]]) -> Solid:
    """Fillet the straight edges whose midpoints are given."""
    occ.synchronize()
    edges = gmsh.model.getBoundary(gmsh.model.getBoundary([solid], oriented=False), False, False)
    curves = sorted({tag for _, tag in edges})
    centres = np.array([occ.getCenterOfMass(1, tag) for tag in curves])
    nearest = [curves[np.linalg.norm(centres - middle, axis=1).argmin()] for middle in middles]
    return occ.fillet([solid[1]], nearest, [radius])[0]


def _fuse(first: Solid, *others: Solid) -> Solid:
    return occ.fuse([first], list(others))[0][0]


def _cut(solid: Solid, *tools: Solid) -> Solid:
    return occ.cut([solid], list(tools))[0][0]


if __name__ == "__main__":
    write_demo()
    print(f"wrote {DEMO}")
