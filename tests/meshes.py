"""Tiny meshes and tables that the tests share; nothing here is computed by jaxsmooth.

Node order is VTK's, typed in from its documentation (linear wedges as in meshio and Gmsh).
"""

import numpy as np

KINDS_2D = ("triangle", "triangle6", "quad", "quad8", "quad9")
KINDS_3D = (
    "tetra",
    "tetra10",
    "pyramid",
    "pyramid13",
    "pyramid14",
    "wedge",
    "wedge15",
    "wedge18",
    "hexahedron",
    "hexahedron20",
    "hexahedron27",
)
KINDS = KINDS_2D + KINDS_3D
LINEAR = {
    "triangle": "triangle",
    "triangle6": "triangle",
    "quad": "quad",
    "quad8": "quad",
    "quad9": "quad",
    "tetra": "tetra",
    "tetra10": "tetra",
    "pyramid": "pyramid",
    "pyramid13": "pyramid",
    "pyramid14": "pyramid",
    "wedge": "wedge",
    "wedge15": "wedge",
    "wedge18": "wedge",
    "hexahedron": "hexahedron",
    "hexahedron20": "hexahedron",
    "hexahedron27": "hexahedron",
}
CORNERS = {"triangle": 3, "quad": 4, "tetra": 4, "pyramid": 5, "wedge": 6, "hexahedron": 8}
EDGES = {
    "triangle": [(0, 1), (1, 2), (2, 0)],
    "quad": [(0, 1), (1, 2), (2, 3), (3, 0)],
    "tetra": [(0, 1), (1, 2), (2, 0), (0, 3), (1, 3), (2, 3)],
    "pyramid": [(0, 1), (1, 2), (2, 3), (3, 0), (0, 4), (1, 4), (2, 4), (3, 4)],
    "wedge": [(0, 1), (1, 2), (2, 0), (3, 4), (4, 5), (5, 3), (0, 3), (1, 4), (2, 5)],
    "hexahedron": [
        *((0, 1), (1, 2), (2, 3), (3, 0), (4, 5), (5, 6), (6, 7), (7, 4)),
        *((0, 4), (1, 5), (2, 6), (3, 7)),
    ],
}
FACES = {  # outward, the order of the face nodes of the hexahedron27
    "tetra": [(0, 2, 1), (0, 1, 3), (1, 2, 3), (2, 0, 3)],
    "pyramid": [(0, 3, 2, 1), (0, 1, 4), (1, 2, 4), (2, 3, 4), (3, 0, 4)],
    "wedge": [(0, 2, 1), (3, 4, 5), (0, 1, 4, 3), (1, 2, 5, 4), (2, 0, 3, 5)],
    "hexahedron": [(0, 4, 7, 3), (1, 2, 6, 5), (0, 1, 5, 4), (2, 3, 7, 6), (0, 3, 2, 1), (4, 5, 6, 7)],
}
# Rotations of a type onto itself, as permutations of its corners.
SYMMETRIES = {
    "triangle": [(1, 2, 0)],
    "quad": [(1, 2, 3, 0)],
    "tetra": [(1, 2, 0, 3), (1, 0, 3, 2)],
    "pyramid": [(1, 2, 3, 0, 4)],
    "wedge": [(1, 2, 0, 4, 5, 3), (3, 5, 4, 0, 2, 1)],
    "hexahedron": [(1, 2, 3, 0, 5, 6, 7, 4), (3, 2, 6, 7, 0, 1, 5, 4)],
}
# A mirror of a type onto itself.
MIRRORS = {
    "triangle": (1, 0, 2),
    "quad": (1, 0, 3, 2),
    "tetra": (1, 0, 2, 3),
    "pyramid": (1, 0, 3, 2, 4),
    "wedge": (3, 4, 5, 0, 1, 2),
    "hexahedron": (4, 5, 6, 7, 0, 1, 2, 3),
}


def dim_of(kind):
    return 2 if kind in KINDS_2D else 3


def groups(kind):
    """The corners whose mean is each node: one tuple of corners a node."""
    base = LINEAR[kind]
    found = [(c,) for c in range(CORNERS[base])]
    if kind != base:
        found += EDGES[base]
    if kind in ("pyramid14", "wedge18", "hexahedron27"):
        found += [face for face in FACES[base] if len(face) == 4]
    if kind in ("quad9", "hexahedron27"):
        found.append(tuple(range(CORNERS[base])))
    return found


def extend(kind, corners):
    """Permutation of all nodes of a type that goes with one of its corners."""
    sets = [frozenset(g) for g in groups(kind)]
    return np.array([sets.index(frozenset(corners[c] for c in g)) for g in sets])


def nodes_from_corners(kind, corners):
    """All nodes ``[k, dim]`` of a straight element with these corners."""
    corners = np.asarray(corners, float)
    return np.array([corners[list(g)].mean(axis=0) for g in groups(kind)])


def ideal_corners(base):
    """Corners of the ideal elements with edges of length 1."""
    s3 = np.sqrt(3)
    triangle = [(0, 0), (1, 0), (0.5, s3 / 2)]
    square = [(0, 0), (1, 0), (1, 1), (0, 1)]
    return np.array(
        {
            "triangle": triangle,
            "quad": square,
            "tetra": [*((x, y, 0) for x, y in triangle), (0.5, s3 / 6, np.sqrt(2 / 3))],
            "pyramid": [*((x, y, 0) for x, y in square), (0.5, 0.5, np.sqrt(0.5))],
            "wedge": [(x, y, z) for z in (0, 1) for x, y in triangle],
            "hexahedron": [(x, y, z) for z in (0, 1) for x, y in square],
        }[base],
        float,
    )


# Measure of the ideal element with edges of length 1.
UNIT_MEASURE = {
    "triangle": np.sqrt(3) / 4,
    "quad": 1.0,
    "tetra": 1 / (6 * np.sqrt(2)),
    "pyramid": np.sqrt(2) / 6,
    "wedge": np.sqrt(3) / 4,
    "hexahedron": 1.0,
}


def ideal(kind, size=1.0):
    """The ideal element of a type, by the length of its edges."""
    return size * nodes_from_corners(kind, ideal_corners(LINEAR[kind]))


def distorted(kind, amplitude=0.12, seed=0):
    """An ideal element with every node displaced: valid, curved if quadratic, nothing symmetric."""
    nodes = ideal(kind)
    if kind != LINEAR[kind]:
        amplitude = amplitude / 3
    return nodes + amplitude * np.random.default_rng(seed).uniform(-1, 1, nodes.shape)


def rotation_matrix(dim, seed=0):
    """A random proper rotation."""
    q, r = np.linalg.qr(np.random.default_rng(seed).normal(size=(dim, dim)))
    q = q * np.sign(np.diag(r))
    q[:, 0] *= np.linalg.det(q)
    return q


# --- Meshes ----------------------------------------------------------------------------


_QUAD_SPLITS = {"quad": [(0, 1, 2, 3)], "triangle": [(0, 1, 2), (0, 2, 3)]}
_CUBE_SPLITS = {
    "hexahedron": [tuple(range(8))],
    "wedge": [(0, 1, 2, 4, 5, 6), (0, 2, 3, 4, 6, 7)],
    # every face of the cube, seen from inside, and the centre
    "pyramid": [(*face[::-1], 8) for face in FACES["hexahedron"]],
    "tetra": [(0, 1, 2, 6), (0, 2, 3, 6), (0, 3, 7, 6), (0, 7, 4, 6), (0, 4, 5, 6), (0, 5, 1, 6)],
}


def _cells(shape):
    """Corners of the cells of a grid, with the centre of each cell as one more node."""
    shape = np.array(shape)
    lattice = np.array(list(np.ndindex(*(shape + 1))), float) / shape
    number = np.arange(len(lattice)).reshape(shape + 1)
    corners = ideal_corners("quad" if len(shape) == 2 else "hexahedron").astype(int)
    cells = np.array([[number[tuple(c + o)] for o in corners] for c in np.ndindex(*shape)])
    centres = lattice[cells].mean(axis=1)
    cells = np.c_[cells, len(lattice) + np.arange(len(cells))]
    return np.concatenate([lattice, centres]), cells


def _compact(points, blocks):
    used = np.unique(np.concatenate([nodes.ravel() for nodes in blocks.values()]))
    number = np.full(len(points), -1)
    number[used] = np.arange(len(used))
    return points[used], {name: number[nodes] for name, nodes in blocks.items()}


def raise_order(points, blocks, kinds):
    """Give straight elements the nodes of the quadratic types ``{linear: quadratic}``."""
    points, known, raised = [tuple(p) for p in points], {}, {}
    for base, nodes in blocks.items():
        rows = []
        for element in nodes:
            row = list(element)
            for g in groups(kinds[base])[CORNERS[base] :]:
                key = frozenset(int(element[c]) for c in g)
                if key not in known:
                    known[key] = len(points)
                    points.append(tuple(np.mean([points[n] for n in key], axis=0)))
                row.append(known[key])
            rows.append(row)
        raised[kinds[base]] = np.array(rows)
    return np.array(points), raised


def jiggle(points, amplitude, seed=1):
    """Displace the nodes of a unit square or cube; those on the boundary stay in their sides."""
    move = amplitude * np.random.default_rng(seed).uniform(-1, 1, points.shape)
    return points + move * ((points > 1e-9) & (points < 1 - 1e-9))


def grid(kind, shape=None, amplitude=0.0, seed=1):
    """Points and ``{kind: connectivity}`` of a structured mesh of the unit square or cube."""
    base = LINEAR[kind]
    splits = _QUAD_SPLITS if dim_of(kind) == 2 else _CUBE_SPLITS
    points, cells = _cells(shape or ((3, 3) if dim_of(kind) == 2 else (2, 2, 2)))
    blocks = {base: np.concatenate([cells[:, list(part)] for part in splits[base]])}
    points, blocks = _compact(points, blocks)
    if kind != base:
        points, blocks = raise_order(points, blocks, {base: kind})
    return jiggle(points, amplitude / (3 if kind != base else 1), seed), blocks


def mixed_2d(amplitude=0.0, order=1):
    """A square of 3 × 3 cells, some of them cut into triangles."""
    points, cells = _cells((3, 3))
    cut = np.arange(9) % 2 == 0
    blocks = {
        "quad": cells[~cut][:, :4],
        "triangle": np.concatenate([cells[cut][:, list(part)] for part in _QUAD_SPLITS["triangle"]]),
    }
    points, blocks = _compact(points, blocks)
    if order == 2:
        points, blocks = raise_order(points, blocks, {"quad": "quad8", "triangle": "triangle6"})
    return jiggle(points, amplitude / (3 if order == 2 else 1)), blocks


def mixed_3d(amplitude=0.0):
    """Four cubes: one hexahedron, two wedges, six pyramids, and pyramids with tetrahedra."""
    points, cells = _cells((2, 2, 1))
    hexahedron, wedge, pyramid, both = cells
    pyramids = [pyramid[list(part)] for part in _CUBE_SPLITS["pyramid"]]
    tetras = []
    for face, part in zip(FACES["hexahedron"], _CUBE_SPLITS["pyramid"], strict=True):
        corner = points[both[list(face)]]
        if np.ptp(corner, axis=0)[2] == 0:  # bottom and top belong to no other cell
            a, b, c, d, apex = both[list(part)]
            tetras += [(a, b, c, apex), (a, c, d, apex)]
        else:
            pyramids.append(both[list(part)])
    blocks = {
        "hexahedron": hexahedron[None, :8],
        "wedge": np.array([wedge[list(part)] for part in _CUBE_SPLITS["wedge"]]),
        "pyramid": np.array(pyramids),
        "tetra": np.array(tetras),
    }
    points, blocks = _compact(points, blocks)
    return jiggle(points, amplitude), blocks


def hexahedra_and_pyramids(amplitude=0.0):
    """Four cubes, two of them cut into pyramids: 20 nodes, two types, quick to compile."""
    points, cells = _cells((2, 2, 1))
    blocks = {
        "hexahedron": cells[[0, 3], :8],
        "pyramid": np.concatenate([cells[[1, 2]][:, list(part)] for part in _CUBE_SPLITS["pyramid"]]),
    }
    points, blocks = _compact(points, blocks)
    return jiggle(points, amplitude), blocks


def box_normals(points):
    """Outer normals of the unit square or cube at every node: a list of axes a node."""
    low, high = np.abs(points) < 1e-9, np.abs(points - 1) < 1e-9
    return [np.flatnonzero(side) for side in low | high]
