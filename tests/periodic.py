"""Small periodic meshes that Gmsh itself makes and links, in two of its formats."""

from contextlib import contextmanager

import numpy as np
import pytest

VERSIONS = {"gmsh": 4.1, "gmsh22": 2.2}


@contextmanager
def _model(size, path, version):
    gmsh = pytest.importorskip("gmsh")
    gmsh.initialize(interruptible=False)
    try:
        gmsh.option.setNumber("General.Terminal", 0)
        gmsh.option.setNumber("Mesh.MeshSizeMin", size)
        gmsh.option.setNumber("Mesh.MeshSizeMax", size)
        gmsh.option.setNumber("Mesh.MshFileVersion", VERSIONS[version])
        yield gmsh
        gmsh.write(str(path))
    finally:
        gmsh.finalize()


def _sides(gmsh, dim, low, high, axis):
    """Entities of one dimension less in the two faces of a box normal to an axis, in the same order."""
    found = []
    for place in (low[axis], high[axis]):
        corners = np.array([low, high], float) + np.array([[-1e-3], [1e-3]])
        corners[:, axis] = place - 1e-3, place + 1e-3
        tags = [tag for _, tag in gmsh.model.getEntitiesInBoundingBox(*corners.ravel(), dim)]
        centres = [np.delete(gmsh.model.occ.getCenterOfMass(dim, tag), axis) for tag in tags]
        found.append([tags[i] for i in np.lexsort(np.round(centres, 6).T)])
    return found


def box(path, version, size=0.5, dim=3):
    """A unit square or cube with a round inclusion across all faces, periodic along all axes."""
    with _model(size, path, version) as gmsh:
        occ, low = gmsh.model.occ, np.zeros(3)
        high = np.array([1.0, 1, 1 if dim == 3 else 0])
        if dim == 3:
            block = [(3, occ.addBox(0, 0, 0, 1, 1, 1))]
            balls = [(3, occ.addSphere(*c, 0.3)) for c in np.ndindex(2, 2, 2)]
        else:
            block = [(2, occ.addRectangle(0, 0, 0, 1, 1))]
            balls = [(2, occ.addDisk(*c, 0, 0.3, 0.3)) for c in np.ndindex(2, 2)]
        parts, origin = occ.fragment(block, balls)
        inside = {tag for part in origin[:1] for _, tag in part}
        occ.remove([part for part in parts if part[1] not in inside], recursive=True)
        occ.synchronize()
        matrix = {tag for _, tag in gmsh.model.getEntities(dim)} - {
            tag for part in origin[1:] for _, tag in part
        }
        for number, tags in enumerate((matrix, inside - matrix), start=1):
            gmsh.model.addPhysicalGroup(dim, sorted(tags), number)
        for axis in range(dim):
            first, second = _sides(gmsh, dim - 1, low, high, axis)
            shift = np.eye(4)
            shift[axis, 3] = 1
            gmsh.model.mesh.setPeriodic(dim - 1, second, first, shift.ravel().tolist())
            gmsh.model.addPhysicalGroup(dim - 1, first + second, 3 + axis)  # 2.2 knows no others
        gmsh.model.mesh.generate(dim)


def sector(path, version, size=0.4):
    """A quarter of a disc, periodic by a quarter turn about its centre."""
    with _model(size, path, version) as gmsh:
        occ = gmsh.model.occ
        ends = [occ.addPoint(*p, 0) for p in ((0, 0), (1, 0), (0, 1))]
        sides = [occ.addLine(ends[0], ends[1]), occ.addCircleArc(ends[1], ends[0], ends[2])]
        sides.append(occ.addLine(ends[0], ends[2]))
        occ.addPlaneSurface([occ.addCurveLoop([sides[0], sides[1], -sides[2]])])
        occ.synchronize()
        turn = [0, -1, 0, 0, 1, 0, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]
        gmsh.model.mesh.setPeriodic(1, [sides[2]], [sides[0]], turn)
        gmsh.model.mesh.generate(2)
