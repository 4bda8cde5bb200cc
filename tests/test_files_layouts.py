"""Numbers in files where they stand: written as their neighbours are, in any layout."""

import numpy as np
import pytest

import jaxsmooth as js
from benchmarks.files.checking import same_beside
from jaxsmooth.files.formats.nastran import _fitted, _number
from jaxsmooth.files.formats.record import UnpatchableError
from jaxsmooth.files.numbers import Places, put_text, tokens

# --- Numbers in text -----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "value", "expected"),
    [
        ("0.5 1 2", 0.1, "0.1 1 2"),
        ("0.5 1 2", 1 / 3, "0.3333333333333333 1 2"),
        ("5e-1 1e0 2e0", 1 / 3, "3.3333333333333331e-01 1e0 2e0"),
        ("5E-01 1E+00 2E+00", 0.25, "2.5000000000000000E-01 1E+00 2E+00"),
        ("5.D-001 1.D+000 2.D+000", -0.25, "-2.5000000000000000D-001 1.D+000 2.D+000"),
        ("0.500 1.000 2.000", 0.25, "0.250 1.000 2.000"),
        ("0.500 1.000 2.000", 1e-7, "1e-07 1.000 2.000"),
        ("   0.500    1.000    2.000", 0.25, "   0.250    1.000    2.000"),
        ("   0.500    1.000    2.000", -0.25, "  -0.250    1.000    2.000"),
        ("       0.50000   1.00000", 0.123456789, "   0.123456789   1.00000"),
        ("  -0.500    1.000    2.000", 0.25, "   0.250    1.000    2.000"),
        ("-0.5 1 2", 0.25, "0.25 1 2"),
    ],
)
def test_numbers_are_written_as_their_neighbours(text, value, expected):
    content = text.encode()
    starts, ends = tokens(content)
    old = np.array([[float(content[s:e].replace(b"D", b"e")) for s, e in zip(starts, ends, strict=True)]])
    new = old.copy()
    new[0, 0] = value
    assert put_text(content, Places(starts[None], ends[None]), old, new).decode() == expected


@pytest.mark.parametrize("form", ["%r", "%.16e", "%.8f", "%22.14E", "%g"])
def test_numbers_are_exact_and_others_stay(form):
    random = np.random.default_rng(0)
    words = [form % value for value in (random.normal(size=90) * 10.0 ** random.integers(-9, 9, 90)).tolist()]
    content = " ".join(words).encode()
    starts, ends = tokens(content)
    places = Places(starts.reshape(30, 3), ends.reshape(30, 3))
    old = np.array(words, float).reshape(30, 3)
    new = np.where(random.random(old.shape) < 0.5, old, random.normal(size=old.shape))
    again = put_text(content, places, old, new)
    found = again.decode().split()
    assert np.array_equal(np.array(found, float).reshape(30, 3), new)
    kept = np.flatnonzero((old == new).ravel())
    assert [found[k] for k in kept] == [words[k].strip() for k in kept]
    with pytest.raises(UnpatchableError, match=r"node 7 .* not where they should be"):
        put_text(content, places, old + (np.arange(30) == 7)[:, None], new)


@pytest.mark.parametrize("width", [8, 16])
def test_narrow_fields_have_the_digits_that_fit(width):
    """No text of so many columns is nearer: half a unit of the last digit that has room."""
    random = np.random.default_rng(1)
    for value in (random.choice([-1, 1], 400) * 10 ** random.uniform(-12, 12, 400)).tolist():
        word = _fitted(value, width)
        assert len(word) <= width
        power = int(np.floor(np.log10(abs(value))))
        exponent = len(f"{power:+d}")  # columns for it, or for the zeros that it saves
        room = width - 1 - (value < 0) - (0 if 0 <= power < width - 2 else exponent)
        digits = max(room - (max(0, -1 - power) if -4 < power < 0 else 0), room - exponent, 1)
        assert abs(_number(word) - value) <= 0.51 * 10.0 ** (power - digits + 1)
    assert _fitted(0.123456789, 8) == b".1234568"
    assert _fitted(-1.5e-5, 8) == b"-1.5-5"


# --- Odd layouts ---------------------------------------------------------------------------

MSH = """$Comments
nobody's $Nodes
$EndComments
$MeshFormat
2.2 0 8
$EndMeshFormat
$Nodes
5
7 0 0 0
3 1 0 0
99 1 1 0
1 0 1 0
50 .4 .6 0
$EndNodes
$Elements
4
1 2 2 1 1 7 3 50
2 2 2 1 1 3 99 50
3 2 2 1 1 99 1 50
9 2 2 1 1 1 7 50
$EndElements
"""
SU2 = """% first
NDIME= 2 % two
NELEM=4
5 0 1 4
5 1 2 4
5 2 3 4
5 3 0 4
NPOIN=5 5 % nodes
0 0 0 % corner

1 0 1
1\t1 2
0 1 3
4e-1 6e-1 4
NMARK=1
MARKER_TAG= w
MARKER_ELEMS= 1
3 0 1
"""
NODES_LAST = """NDIME=2
NELEM= 4
5 0 1 4
5 1 2 4
5 2 3 4
5 3 0 4
NMARK= 0
NPOIN= 5
0 0
1 0
1 1
0 1
.4 .6
"""
MEDIT = """MeshVersionFormatted 2 Dimension 2 Vertices 5 0 0 1 1 0 1 1 1 1
0 1 1 .4 .6 2 # end
Triangles 4 1 2 5 1 2 3 5 1 3 4 5 2 4 1 5 2 RequiredVertices 1 1 End
"""
VTK = """# vtk DataFile Version 3.0
x
ASCII
DATASET UNSTRUCTURED_GRID
POINTS 5 float
0 0 0 1 0 0 1 1 0
0 1 0 .4 .6 0
CELLS 4 16
3 0 1 4
3 1 2 4
3 2 3 4
3 3 0 4
CELL_TYPES 4
5
5
5
5
"""
NASTRAN = """BEGIN BULK
GRID,1,,0.,0.,0.
GRID,2,,1.,0.,0.
GRID,3,,1.,1.,0.
GRID,4,0,0.,1.,0.,,
GRID,5,,.4,.6,0.
CTRIA3,1,1,1,2,5
CTRIA3,2,1,2,3,5
CTRIA3,3,1,3,4,5
CTRIA3,4,1,4,1,5
ENDDATA
"""
FLAT = "*NODE\n1, 0., 0.\n2, 1., 0.\n3, 1., 1.\n4, 0., 1.\n5, .4, .6\n"
PLATE = "*ELEMENT, TYPE=CPS3\n1, 1, 2, 5\n2, 2, 3, 5\n3, 3, 4, 5\n4, 4, 1, 5\n"
ODD = {
    "tabs.inp": FLAT.replace(", ", ",\t") + PLATE,
    "blank-lines.inp": FLAT.replace("3, 1.", "\n** between\n   3, 1.") + "\n\n" + PLATE,
    "fortran.inp": FLAT.replace(".4, .6", " 4.D-1 , 6.0d-1 , 0.D0,") + PLATE,
    "no-blanks.inp": (FLAT + PLATE).replace(" ", ""),
    "two-cards.inp": FLAT.replace("4, 0.", "*Node, nset = More\n4, 0.") + "*NSET, NSET=N\n5\n" + PLATE,
    "more-fields.inp": FLAT.replace("0., 0.\n", "0., 0., 0., 0., 0., 1.\n") + PLATE,
    "a.mesh": MEDIT,
    "a.su2": SU2,
    "nodes-last.su2": NODES_LAST,
    "a.msh": MSH,
    "a.vtk": VTK,
    "free.bdf": NASTRAN,
}


@pytest.mark.parametrize("end", ["\n", "\r\n"])
@pytest.mark.parametrize("name", ODD)
def test_odd_layouts(tmp_path, name, end):
    """The node in the middle moves, and its line is the only one that changes."""
    path, output = tmp_path / name, tmp_path / f"out-{name}"
    path.write_bytes(ODD[name].replace("\n", end).encode())
    file = js.read(path)
    points = np.array(file.mesh.points)
    points[4] += [0.1, -0.2]
    assert js.write(output, file, points) == ()
    tolerance = 1e-7 if points.dtype == np.float32 or name == "a.vtk" else 0
    assert np.allclose(js.read(output).mesh.points, points, rtol=0, atol=tolerance)
    lines = [one.read_bytes().split(b"\n") for one in (path, output)]
    differ = [k for k, (one, other) in enumerate(zip(*lines, strict=True)) if one != other]
    assert len(differ) == 1
    assert same_beside(path, output, 5)
