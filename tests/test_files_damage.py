"""Damaged files: refused in one sentence, or read as the whole file is; nothing is lost in silence."""

import dataclasses
import importlib.util

import jax
import meshio
import numpy as np
import pytest

from jaxsmooth.convert.meshfile import from_meshio
from jaxsmooth.files.io import MeshFileError, read, write


@pytest.fixture(autouse=True)
def double_precision():
    with jax.enable_x64(True):
        yield


def plane():
    """Four quadrilaterals, two of them split, with tagged boundary lines."""
    x, y = np.meshgrid(np.arange(3.0), np.arange(5.0) / 3)
    points = np.stack([x.ravel(), y.ravel()], axis=1)
    corner = np.array([0, 1, 3, 4, 6, 7, 9, 10])
    quads = np.stack([corner, corner + 1, corner + 4, corner + 3], axis=1)
    triangles = np.concatenate([quads[4:, [0, 1, 2]], quads[4:, [0, 2, 3]]])
    lines = np.array([[0, 1], [1, 2], [12, 13], [13, 14]])
    return meshio.Mesh(
        points,
        [("triangle", triangles), ("quad", quads[:4]), ("line", lines)],
        point_data={"u": points[:, 0] / 7},
        cell_data={"gmsh:physical": [np.full(8, 11), np.full(4, 12), np.array([21, 21, 22, 22])]},
    )


def solid():
    """Two cubes, one of them split into pyramids and those into tetrahedra, with a few faces."""
    grid = np.stack(np.meshgrid(*3 * [np.arange(2.0)], indexing="ij"), -1).reshape(-1, 3)
    cube = [0, 4, 6, 2, 1, 5, 7, 3]
    points = np.concatenate([grid, grid[4:] + np.array([1.0, 0, 0]), np.full((1, 3), 0.5)])
    next_cube = [4, 8, 10, 6, 5, 9, 11, 7]
    faces = np.array(cube)[
        [[0, 3, 2, 1], [4, 5, 6, 7], [0, 1, 5, 4], [2, 3, 7, 6], [0, 4, 7, 3], [1, 2, 6, 5]]
    ]
    tetra = np.concatenate([faces[:, [0, 2, 1]], faces[:, [0, 3, 2]]])
    tetra = np.column_stack([tetra, np.full(len(tetra), 12)])
    return meshio.Mesh(
        points,
        [("tetra", tetra), ("hexahedron", [next_cube]), ("triangle", tetra[:3, :3])],
        point_data={"u": points[:, 0] / 7},
        cell_data={"gmsh:physical": [np.full(12, 11), np.array([12]), np.array([21, 21, 22])]},
    )


def anew(file):
    """The file without its bytes, so that it is written by the format's writer."""
    return dataclasses.replace(file, original=None)


FORMATS = {
    "vtu": ".vtu",
    "vtk:ascii": ".vtk",
    "vtk:binary": ".vtk",
    "vtk42:ascii": ".vtk",
    "vtk42:binary": ".vtk",
    "gmsh22:ascii": ".msh",
    "gmsh22:binary": ".msh",
    "gmsh:ascii": ".msh",
    "gmsh:binary": ".msh",
    "medit": ".mesh",
    "meditb": ".meshb",
    "su2": ".su2",
    "npz": ".npz",
    "nastran": ".bdf",
    "avsucd": ".avs",
    "ugrid": ".ugrid",
    "abaqus": ".inp",
    "xdmf": ".xdmf",
    "exodus": ".e",
    "netgen": ".vol",
    "unv": ".unv",
}
NEEDS = {"xdmf": "h5py", "exodus": "netCDF4"}


def written(tmp_path, name, source):
    """A file of this format, and what is in it."""
    if name in NEEDS and importlib.util.find_spec(NEEDS[name]) is None:
        pytest.skip(f"needs {NEEDS[name]}")
    path = tmp_path / ("whole" + FORMATS[name])
    write(path, from_meshio(source), file_format="medit" if name == "meditb" else name)
    return path, content(read(path))


def content(file):
    """Coordinates, and every cell with its type."""
    cells = [(c.type, *row) for c in file.source.cells for row in np.asarray(c.data).tolist()]
    return np.asarray(file.source.points), sorted(cells)


def check(path, whole):
    """Refused in one sentence, or the same; returns the sentence or None."""
    try:
        points, cells = content(read(path))
    except MeshFileError as error:
        return str(error)
    assert np.array_equal(points, whole[0])
    assert cells == whole[1]
    return None


@pytest.mark.parametrize("source", [plane, solid])
@pytest.mark.parametrize("name", FORMATS)
def test_cut_files(tmp_path, name, source):
    path, whole = written(tmp_path, name, source())
    data = path.read_bytes()
    size = len(data)
    lengths = {*np.linspace(1, size - 20, 8 if name == "exodus" else 30).astype(int), *range(size - 12, size)}
    lines = [k + 1 for k, byte in enumerate(data) if byte == 10]
    lengths |= {*lines[:: -(-len(lines) // 20)], *lines[-10:]} if name != "exodus" else set()
    refused = 0
    for length in sorted(lengths):
        cut = tmp_path / ("cut" + path.suffix)
        cut.write_bytes(data[:length])
        sentence = check(cut, whole)
        assert sentence is None or "\n" not in sentence
        refused += sentence is not None
    assert refused > len(lengths) / 2


EDITS = [
    ("su2", "NELEM= 12", "NELEM= 11", "NELEM"),
    ("su2", "NPOIN= 15", "NPOIN= 16", "NPOIN"),
    ("su2", "MARKER_ELEMS= 2", "MARKER_ELEMS= 1", "MARKER_ELEMS"),
    ("su2", "NMARK= 2", "NMARK= 3", "NMARK"),
    ("su2", "NMARK= 2\n", "", "NMARK"),
    ("vtk42:ascii", "CELL_TYPES 16", "CELL_TYPES 15", "damaged|Unknown section"),
    ("vtk42:ascii", "POINTS 15", "POINTS 14", "damaged|Unknown section"),
    ("vtk42:ascii", "CELL_DATA 16", "CELL_DATA 8", "CELL_DATA says 8, the file has 16"),
    ("vtk:ascii", "CELL_TYPES 16", "CELL_TYPES 15", "Unknown section"),
    ("vtu", 'NumberOfCells="16"', 'NumberOfCells="17"', "damaged"),
    ("vtu", 'NumberOfPoints="15"', 'NumberOfPoints="14"', "shape"),
    ("gmsh22:ascii", "$Nodes\n15\n", "$Nodes\n14\n", "more numbers than its counts"),
    ("gmsh22:ascii", "$Nodes\n15\n1 ", "$Nodes\n15\n0 ", "node with the tag 0"),
    ("gmsh22:ascii", "$Nodes\n15\n1 ", "$Nodes\n15\n-1 ", "node with the tag -1"),
    ("gmsh22:ascii", "$Nodes\n15\n1 ", "$Nodes\n15\n2 ", "two nodes with the tag 2"),
    ("gmsh22:ascii", "$Nodes\n15\n1 ", "$Nodes\n15\n77 ", "refers to node 1, which"),
    ("gmsh22:ascii", "$Elements\n16\n", "$Elements\n15\n", "more"),
    ("gmsh22:ascii", "$Elements\n16\n", "$Elements\n17\n", "ends early"),
    ("gmsh:ascii", "$Elements\n4 16 ", "$Elements\n4 17 ", "16 elements and says 17"),
    ("gmsh:ascii", " 15 1 15\n", " 16 1 15\n", "15 nodes and says 16"),
    ("gmsh:ascii", "15\n1\n2\n3\n", "15\n0\n2\n3\n", "node with the tag 0"),
    ("medit", "Vertices\n15\n", "Vertices\n14\n", "Vertices has"),
    ("medit", "Triangles\n8\n", "Triangles\n7\n", "Triangles has"),
    ("medit", "\nEnd\n", "\n", "keyword End"),
    ("ugrid", "15 8 4 0", "15 8 5 0", "counts need"),
    ("nastran", "ENDDATA", "", "ENDDATA"),
    ("unv", "    -1\n  2412", "  2412", "line of -1"),
    (
        "unv",
        "7         3\n         7         8        11\n",
        "7         3\n         7         8\n",
        "equally|six",
    ),
    (
        "unv",
        "\n         7         8        11\n",
        "\n         7         8        77\n",
        "refers to node 77, which",
    ),
    ("abaqus", "15 nodes, 16 elements", "15 nodes, 17 elements", "has 15 nodes, 16 elements and says"),
]


@pytest.mark.parametrize(("name", "old", "new", "sentence"), EDITS)
def test_wrong_counts_and_tags(tmp_path, name, old, new, sentence):
    path, _ = written(tmp_path, name, plane())
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(MeshFileError, match=sentence) as caught:
        read(path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ["gmsh22:binary", "gmsh:binary"])
def test_wrong_tags_in_binary_files(tmp_path, name):
    """The tag of the first node becomes 0, then the count of the elements one more."""
    path, _ = written(tmp_path, name, plane())
    data = path.read_bytes()
    one, other = (np.array(n, "<i4" if "22" in name else "<u8").tobytes() for n in (1, 0))
    start = data.index(b"$Nodes\n") + 7
    first = data.index(one, start + (3 if "22" in name else 4 * 8 + 3 * 4 + 8))
    path.write_bytes(data[:first] + other + data[first + len(one) :])
    with pytest.raises(MeshFileError, match="tag 0"):
        read(path)
    start = data.index(b"$Elements\n") + 10
    if "22" in name:
        changed = data[:start] + b"17" + data[start + 2 :]
    else:
        changed = data[: start + 8] + np.array(17, "<u8").tobytes() + data[start + 16 :]
    path.write_bytes(changed)
    with pytest.raises(MeshFileError, match=r"ends early|says 17"):
        read(path)


def test_boundary_cells_of_missing_nodes(tmp_path):
    path, _ = written(tmp_path, "su2", plane())
    path.write_text(path.read_text().replace("3 0 1\n", "3 0 99\n"))
    with pytest.raises(MeshFileError, match=r"line 0 of cell block 2 .*out of range"):
        read(path)
