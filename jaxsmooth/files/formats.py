"""Reading files through meshio: which format a file is in, and repairs where meshio (5.3.5) fails.

Formats are named as meshio names its writers, followed by ``:ascii`` or ``:binary`` where a format has
both: ``"gmsh22:ascii"``, ``"gmsh:binary"`` (that is 4.1), ``"vtk42:binary"``, ``"vtk"`` (5.1), ``"vtu"``.
"""

from __future__ import annotations

import contextlib
import io
import re
import tempfile
import warnings
from collections.abc import Iterator
from pathlib import Path
from xml.etree import ElementTree

import meshio
import numpy as np
from meshio._helpers import extension_to_filetypes

from jaxsmooth.elements import TYPES, element_type
from jaxsmooth.files.abaqus import is_abaqus, read_abaqus
from jaxsmooth.files.msh import read_msh_data, repaired_msh, sniff_msh
from jaxsmooth.files.su2 import name_markers
from jaxsmooth.meshfile import MeshFileError

__all__ = [
    "EXODUS_BLOCKS",
    "EXODUS_ORDER",
    "MEDIT_SETS",
    "NPZ_TYPES",
    "detect_format",
    "extend_exodus",
    "format_of_suffix",
    "quiet",
    "read_source",
    "stem_format",
]

NPZ_TYPES = ("vertex", *TYPES)


def stem_format(name: str) -> str:
    """The format without ``:ascii`` or ``:binary``."""
    return name.partition(":")[0]


def detect_format(path: Path) -> str:
    """The format of an existing file, by its suffix and its first bytes.

    Raises `MeshFileError` where nothing is known about the suffix."""
    with open(path, "rb") as stream:
        head = stream.read(4096)
    suffix = path.suffix.lower()
    if suffix == ".npz":
        return "npz"
    if suffix == ".msh":  # meshio tries ANSYS first
        return sniff_msh(head) or "ansys"
    if suffix == ".inp":  # AVS files have the same suffix
        return "abaqus" if is_abaqus(head) else "avsucd"
    if suffix == ".vtk":
        version = re.match(rb"# vtk DataFile Version (\d+)\.", head)
        lines = head.splitlines()
        kind = ":ascii" if len(lines) > 2 and lines[2].strip().upper() == b"ASCII" else ":binary"
        return ("vtk" if version and int(version[1]) >= 5 else "vtk42") + kind
    return format_of_suffix(path)


def format_of_suffix(path: Path) -> str:
    """The format that a file's name stands for.

    Raises `MeshFileError` where nothing is known about the suffix."""
    suffixes = [s.lower() for s in path.suffixes]
    if suffixes[-1:] == [".npz"]:
        return "npz"
    if suffixes[-1:] == [".msh"]:
        return "gmsh22:binary"  # holds any mixture of cells and tags
    for suffix in ("".join(suffixes[-2:]), "".join(suffixes[-1:])):
        if suffix in extension_to_filetypes:
            return extension_to_filetypes[suffix][0]
    raise MeshFileError(
        f"{path}: no mesh format is known for the suffix {path.suffix!r}; "
        "use .msh, .vtu, .vtk, .inp, .mesh, .xdmf, .npz or another that meshio reads"
    )


def read_source(path: Path) -> tuple[meshio.Mesh, str, list[str]]:
    """Read a file: the mesh, its format, and notes.

    Raises `MeshFileError`: not there, not readable, of an unknown format, or broken."""
    if not path.exists():
        raise MissingFileError(f"{path}: there is no such file; check the name")
    if not path.is_file():
        raise MeshFileError(f"{path}: this is a folder, not a file; name a mesh file in it")
    said, name = io.StringIO(), "?"
    try:
        name = detect_format(path)
        with quiet() as said:
            mesh, notes = _READERS.get(stem_format(name), _read_any)(path, stem_format(name))
    except MeshFileError:
        raise
    except PermissionError as error:
        raise MeshFileError(f"{path}: the file can't be read (permission denied)") from error
    except ModuleNotFoundError as error:
        raise MeshFileError(
            f"{path}: reading {stem_format(name)} files needs {error.name}; "
            "install it with: pip install 'jaxsmooth[io]'"
        ) from error
    except (Exception, SystemExit) as error:  # meshio's readers raise anything, and exit
        reason = _reason(error, said.getvalue())
        raise MeshFileError(f"{path}: not readable as {stem_format(name)}: {reason}") from error
    remarks = [line for line in _said(said.getvalue()) if "tags of string type" not in line]
    trouble = [line for line in remarks if "cannot handle" in line]
    if trouble:  # meshio drops such cells
        raise MeshFileError(f"{path}: cell type not supported: {trouble[0]}")
    return mesh, name, [*notes, *remarks]


class MissingFileError(MeshFileError, FileNotFoundError):
    """The file isn't there."""

    def __str__(self) -> str:
        return str(self.args[0])


@contextlib.contextmanager
def quiet() -> Iterator[io.StringIO]:
    """Catch what meshio prints, and silence its warnings; text that ends early is an error."""
    said = io.StringIO()
    with warnings.catch_warnings(), contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
        warnings.simplefilter("ignore")
        warnings.filterwarnings("error", message="string or file could not be read to its end")
        yield said


def _said(text: str) -> list[str]:
    """Meshio's remarks, each on one line."""
    parts = re.split(r"(?:Warning|Info|Error):", re.sub(r"\x1b\[[0-9;]*m", "", text))
    return [" ".join(part.split()) for part in parts if part.strip()]


def _reason(error: BaseException, said: str) -> str:
    text = str(error).strip() if not isinstance(error, SystemExit) else " ".join(_said(said)[:1])
    text = " ".join(text.split())
    if isinstance(error, KeyError):
        text = f"it has something unknown, {text}"
    if len(text) > 200:
        text = text[:200] + "…"
    return text or "the file is damaged or of another format than its name says"


# --- Readers -----------------------------------------------------------------------------


def _read_any(path: Path, name: str) -> tuple[meshio.Mesh, list[str]]:
    return meshio.read(path, file_format=_reader(name)), []


def _reader(name: str) -> str:
    return {"gmsh22": "gmsh", "vtk42": "vtk"}.get(name, name)


def _read_copy(content: bytes, path: Path, name: str) -> meshio.Mesh:
    """Read repaired content: through a file, for NumPy wants one."""
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / ("mesh" + path.suffix)
        copy.write_bytes(content)
        return meshio.read(copy, file_format=_reader(name))


def _read_gmsh(path: Path, name: str) -> tuple[meshio.Mesh, list[str]]:
    content = path.read_bytes()
    repaired = repaired_msh(content)
    if repaired is content or repaired == content:
        return _read_any(path, name)
    mesh = _read_copy(repaired, path, name)
    mesh.cell_data.update(read_msh_data(content, mesh))
    return mesh, []


def _read_inp(path: Path, name: str) -> tuple[meshio.Mesh, list[str]]:
    return read_abaqus(path)


def _read_su2(path: Path, name: str) -> tuple[meshio.Mesh, list[str]]:
    content = path.read_bytes()
    plain = content.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    # NumPy's offsets and Python's disagree in files with CRLF
    mesh = _read_any(path, name)[0] if plain == content else _read_copy(plain, path, name)
    name_markers(mesh, plain)
    return mesh, []


_MEDIT_CELLS = {
    "Edges": 3,
    "Triangles": 4,
    "Quadrilaterals": 5,
    "Tetrahedra": 5,
    "Prisms": 7,
    "Pyramids": 6,
    "Hexahedra": 9,
    "Hexaedra": 9,
}
MEDIT_SETS = ("Corners", "RequiredVertices")


def _read_medit(path: Path, name: str) -> tuple[meshio.Mesh, list[str]]:
    if path.suffix.lower() == ".meshb":
        return _read_any(path, name)
    # meshio wants every count on a line of its own and knows few keywords
    text = re.sub(r"#.*", "", path.read_text(encoding="utf-8", errors="replace"))
    found = re.split(r"(?<![\w.])(?!nan\b|inf)([A-Za-z]\w+)", text)
    out, notes, sets = [], [], {}
    for key, body in zip(found[1::2], found[2::2], strict=True):
        if key == "MeshVersionFormatted":
            out.append(f"{key} {'1' if body.strip() == '1' else '2'}\n")
        elif key == "Dimension":
            out.append(f"{key} {body.strip()}\n")
        elif key == "Vertices" or key in _MEDIT_CELLS:
            count, _, rows = body.strip().partition("\n") if "\n" in body.strip() else (body, "", "")
            count, *same_line = count.split()
            if int(count):
                out.append(f"{key}\n{count}\n{' '.join(same_line)}\n{rows}\n")
        elif key in MEDIT_SETS:
            numbers = np.array(body.split(), dtype=np.int64)
            sets[key] = numbers[1:] - 1
        elif key.lower() != "end" and body.split() not in ([], ["0"]):
            notes.append(f"the section {key} of the Medit file is not kept")
    mesh = _read_copy("".join(out).encode() + b"End\n", path, name)
    mesh.point_sets = sets
    return mesh, notes


def _read_xdmf(path: Path, name: str) -> tuple[meshio.Mesh, list[str]]:
    """Mixed topologies are taken apart here: meshio knows only linear types in them."""
    from meshio.xdmf.common import meshio_to_xdmf_type, xdmf_idx_to_meshio_type
    from meshio.xdmf.main import XdmfReader

    root = ElementTree.parse(path).getroot()
    reader = XdmfReader(str(path))
    for grid in root.iter("Grid"):
        for topology in grid.findall("Topology"):
            kind = topology.get("Type", topology.get("TopologyType"))
            if kind != "Mixed":
                continue
            numbers = reader._read_data_item(topology[0], root)
            at = list(grid).index(topology)
            grid.remove(topology)
            for code, nodes in _split_mixed(np.asarray(numbers).ravel(), xdmf_idx_to_meshio_type):
                part = ElementTree.Element("Topology", Type=meshio_to_xdmf_type[code][0])
                size = f"{nodes.shape[0]} {nodes.shape[1]}"
                item = ElementTree.SubElement(
                    part, "DataItem", DataType="Int", Precision="8", Dimensions=size, Format="XML"
                )
                item.text = " ".join(map(str, nodes.ravel().tolist()))
                grid.insert(at, part)
                at += 1
    version = root.attrib.get("Version", "3")
    read = reader.read_xdmf2 if version.startswith("2") else reader.read_xdmf3
    return read(root), []


def _split_mixed(numbers: np.ndarray, types: dict[int, str]) -> Iterator[tuple[str, np.ndarray]]:
    """Runs of cells of one type; points and lines have their node count behind the type."""
    at = 0
    while at < len(numbers):
        code = int(numbers[at])
        name = types.get(code)
        if name not in NPZ_TYPES:
            raise ValueError(f"cells of XDMF type {code} are not supported")
        skip = 2 if code in (1, 2) else 1
        width = skip + (1 if name == "vertex" else element_type(name).k)
        other = np.flatnonzero(numbers[at::width] != code)
        end = at + width * int(other[0]) if len(other) else len(numbers)
        yield name, numbers[at:end].reshape(-1, width)[:, skip:]
        at = end


def _read_exodus(path: Path, name: str) -> tuple[meshio.Mesh, list[str]]:
    """Exodus has its own order of mid-side nodes; meshio leaves it, and writes VTK's.

    Files of both kinds exist, so the nodes' places decide.  Element blocks are materials."""
    extend_exodus()
    mesh, notes = _read_any(path, name)
    mesh.points = np.ma.filled(mesh.points, np.nan)
    for k, cells in enumerate(mesh.cells):
        order = EXODUS_ORDER.get(cells.type)
        if order is None or not len(cells):
            continue
        nodes = np.ma.filled(cells.data, -1)
        turned = nodes[:, np.argsort(order)]
        if _bend(mesh.points, turned, cells.type) < _bend(mesh.points, nodes, cells.type):
            mesh.cells[k] = meshio.CellBlock(cells.type, turned)
    numbers = [np.full(len(cells), k + 1) for k, cells in enumerate(mesh.cells)]
    mesh.cell_data.setdefault(EXODUS_BLOCKS, numbers)
    return mesh, notes


def extend_exodus() -> None:
    """Add the names of Exodus types that meshio's tables lack, replacing none."""
    from meshio.exodus import _exodus

    for name, kind in _EXODUS_NAMES.items():
        _exodus.exodus_to_meshio_type.setdefault(name, kind)
        _exodus.meshio_to_exodus_type.setdefault(kind, name)


def _bend(points: np.ndarray, nodes: np.ndarray, name: str) -> float:
    """Mean distance of nodes from where straight elements have them."""
    kind = element_type(name)
    linear = element_type(kind.name.rstrip("0123456789"))
    shape = linear.shape_functions(kind.natural)
    straight = np.einsum("ac,ecd->ead", shape, points[nodes[:, : linear.k]])
    return float(np.linalg.norm(points[nodes] - straight, axis=-1).mean())


_HEX20 = [*range(12), 16, 17, 18, 19, 12, 13, 14, 15]
EXODUS_ORDER = {
    "wedge15": [*range(9), 12, 13, 14, 9, 10, 11],
    "hexahedron20": _HEX20,
    "hexahedron27": [*_HEX20, 26, 24, 25, 20, 21, 22, 23],
}
"""Nodes of VTK's element in Exodus' order."""

EXODUS_BLOCKS = "ElementBlockIds"

_EXODUS_NAMES = {
    "HEX8": "hexahedron",
    "TET": "tetra",
    "TET10": "tetra10",
    "PYRAMID5": "pyramid",
    "PYRAMID13": "pyramid13",
    "WEDGE6": "wedge",
    "WEDGE15": "wedge15",
}


def _read_npz(path: Path, name: str) -> tuple[meshio.Mesh, list[str]]:
    """``points``, one array a cell type, ``type/name`` for cell data; else point data."""
    notes = []
    with np.load(path, allow_pickle=False) as arrays:
        content = dict(arrays.items())
    if "points" not in content:
        raise ValueError("the archive has no array called 'points'")
    points = content.pop("points")
    names = [key for key in content if key in NPZ_TYPES]
    cells = [(key, content.pop(key)) for key in names]
    point_data, cell_data = {}, {}
    for key, values in content.items():
        kind, _, rest = key.partition("/")
        if kind in names and rest:
            cell_data.setdefault(rest, {})[kind] = values
        elif values.ndim and len(values) == len(points):
            point_data[key] = values
        else:
            notes.append(f"the array {key!r} is neither cells nor data of nodes or cells; it is not kept")
    filled = {
        key: [parts.get(kind, np.full(len(nodes), np.nan)) for kind, nodes in cells]
        for key, parts in cell_data.items()
    }
    return meshio.Mesh(points, cells, point_data=point_data, cell_data=filled), notes


_READERS = {
    "gmsh": _read_gmsh,
    "gmsh22": _read_gmsh,
    "abaqus": _read_inp,
    "su2": _read_su2,
    "medit": _read_medit,
    "xdmf": _read_xdmf,
    "exodus": _read_exodus,
    "npz": _read_npz,
}
