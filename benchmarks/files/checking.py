"""What becomes of a file that is written with other coordinates: compared with it, and read by others."""

from __future__ import annotations

import contextlib
import io
import re
from dataclasses import dataclass
from pathlib import Path

import meshio
import numpy as np
from scipy.spatial import cKDTree

import jaxsmooth as js

__all__ = ["READERS", "Row", "check", "moved", "same_beside"]


@dataclass(frozen=True)
class Row:
    """What became of one file.

    Attributes:
        name: of the file.
        format: as it was read.
        nodes: how many it has.
        same: whether all that is not a coordinate is the same, byte by byte.
        error: largest difference between coordinates asked for and read again, of the largest one.
        readers: other programs that read it, and find these coordinates.
        notes: what was said on writing.
    """

    name: str
    format: str
    nodes: int
    same: bool
    error: float
    readers: tuple[str, ...]
    notes: tuple[str, ...]


def moved(file: js.MeshFile) -> np.ndarray:
    """Coordinates with every third node moved by a thousandth of the size, unless it is held or linked."""
    points = np.array(file.mesh.points)
    used = np.unique(np.concatenate([np.asarray(nodes).ravel() for nodes in file.mesh.connectivity]))
    labels, stays = file.mesh.labels, np.zeros(len(points), bool)
    if labels.held is not None:
        stays |= np.asarray(labels.held)
    if labels.links is not None:  # periodic nodes, say: Gmsh puts them where their partners are
        stays[labels.links.nodes] = stays[labels.links.parents] = True
    rows = used[::3][~stays[used[::3]]]
    random = np.random.default_rng(0)
    points[rows] += 1e-3 * np.ptp(points[used], axis=0).max() * random.uniform(-1, 1, points[rows].shape)
    return points


def check(path: Path, folder: Path) -> Row:
    """Read a file, write it with other coordinates into a folder, and compare."""
    file = js.read(path)
    points = moved(file)
    output = folder / f"out-{path.name}"
    notes = js.write(output, file, points)
    again = js.read(output)
    size = np.abs(np.asarray(again.mesh.points)).max()
    error = float(np.abs(np.asarray(again.mesh.points) - points).max() / size)
    wanted = np.asarray(again.source.points)
    readers = tuple(
        name for name, reader in READERS.items() if _agrees(reader, output, wanted, float(size), len(wanted))
    )
    return Row(
        path.name,
        file.format or "",
        len(wanted),
        same_beside(path, output, len(wanted)),
        error,
        readers,
        notes,
    )


def same_beside(path: Path, output: Path, nodes: int) -> bool:
    """Whether two files, and those beside them that they name, differ in coordinates only."""
    a, b = path.read_bytes(), output.read_bytes()
    if path.suffix == ".xdmf":  # the names of files beside it differ
        stem = path.stem.encode()
        beside = sorted(path.parent.glob(f"{path.stem}*.h5"))
        pairs = [(one, output.with_name(one.name.replace(path.stem, output.stem, 1))) for one in beside]
        if not all(_same_binary(one.read_bytes(), other.read_bytes(), nodes) for one, other in pairs):
            return False
        b = b.replace(output.stem.encode() + b".h5", stem + b".h5")
    if path.suffix == ".vtu" and b"compressor" in a:
        return _without_points(a) == _without_points(b)
    if path.suffix == ".npz":
        one, other = (dict(np.load(p)) for p in (path, output))
        return one.keys() == other.keys() and all(
            np.array_equal(one[key], other[key]) != (key == "points") for key in one
        )
    text = b"\0" not in a and b'"raw"' not in a
    return (
        _same_text(a, b)
        if text and b"base64" not in a and b'"binary"' not in a
        else _same_binary(a, b, nodes)
    )


def _without_points(content: bytes) -> tuple[bytes, ...]:
    """A VTU file without its points, and without the offsets of appended data."""
    head, mark, data = content.partition(b"<AppendedData")
    inline = re.sub(rb"(<Points>\s*<DataArray[^>]*>)[^<]*", rb"\1", head)
    plain = re.sub(rb'offset="\d+"', b"", inline)
    offsets = sorted({int(n) for n in re.findall(rb'offset="(\d+)"', head)})
    if not mark:
        return (plain,)
    start = data.index(b"_") + 1
    own = int(re.search(rb'<Points>\s*<DataArray[^>]*offset="(\d+)"', head)[1])
    ends = [*offsets[1:], data.rindex(b"</AppendedData>") - start]
    parts = [data[start + a : start + b] for a, b in zip(offsets, ends, strict=True) if a != own]
    return (plain, data[:start], *parts, data[data.rindex(b"</AppendedData>") :])


_NUMBER = re.compile(rb"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eEdD][+-]?\d+|[+-]\d+)?")


def _same_text(a: bytes, b: bytes) -> bool:
    """Whether lines differ in numbers only, and in the blanks before them; what stands there then is no
    whole number, such as those of nodes are."""
    before, after = a.split(b"\n"), b.split(b"\n")
    if len(before) != len(after):
        return False
    for one, other in zip(before, after, strict=True):
        if one == other:
            continue
        words = [_words(one), _words(other)]
        if len(words[0]) != len(words[1]):
            return False
        for old, new in zip(*words, strict=True):
            if old != new and not (_NUMBER.fullmatch(old) and _NUMBER.fullmatch(new) and b"." in new):
                return False
    return True


def _words(line: bytes) -> list[bytes]:
    """Words of a line and what separates them but for blanks; of Nastran's cards by columns."""
    if line.startswith((b"GRID ", b"GRID*", b"*  ")):
        width = 16 if b"*" in line[:5] else 8
        return [line[:8], *(line[k : k + width].strip() for k in range(8, len(line), width))]
    return re.findall(rb"[^\s,<>]+|[,<>]|\r", line)


def _same_binary(a: bytes, b: bytes, nodes: int) -> bool:
    """Whether no more bytes differ than coordinates have, and all in a stretch that nodes have."""
    if a.startswith(b"\x89HDF") and len(a) != len(b):
        return _same_arrays(a, b)
    if len(a) != len(b):
        return False
    differ = np.flatnonzero(np.frombuffer(a, np.uint8) != np.frombuffer(b, np.uint8))
    return 0 < len(differ) <= 24 * nodes and differ[-1] - differ[0] <= 64 * nodes


def _same_arrays(a: bytes, b: bytes) -> bool:
    """Whether two HDF5 files with compressed arrays differ in one of them only, or in those of x, y and z."""
    import h5py

    with h5py.File(io.BytesIO(a)) as one, h5py.File(io.BytesIO(b)) as other:
        names: list[str] = []
        one.visit(names.append)
        found: list[str] = []
        other.visit(found.append)
        arrays = [name for name in names if isinstance(one[name], h5py.Dataset)]
        differ = [name for name in arrays if not np.array_equal(one[name][()], other[name][()])]
        attributes = all(_shown(one[n].attrs) == _shown(other[n].attrs) for n in names)
    few = len(differ) == 1 or differ == ["coordx", "coordy", "coordz"]
    return names == found and attributes and few


def _shown(attributes) -> str:
    return repr({name: np.asarray(value).tolist() for name, value in sorted(attributes.items())})


# --- Other readers -------------------------------------------------------------------------


def _read_gmsh(path: Path) -> np.ndarray:
    import gmsh

    if path.suffix not in (".msh", ".mesh", ".meshb", ".su2", ".bdf", ".nas", ".unv", ".inp", ".med"):
        raise ValueError
    gmsh.initialize(interruptible=False)
    try:
        gmsh.option.setNumber("General.Terminal", 0)
        gmsh.merge(str(path))
        tags, points, _ = gmsh.model.mesh.getNodes()
        return points.reshape(-1, 3)[np.argsort(tags)]
    finally:
        gmsh.finalize()


def _read_vtk(path: Path) -> np.ndarray:
    import vtk
    from vtk.util.numpy_support import vtk_to_numpy

    if path.suffix not in (".vtu", ".vtk", ".e", ".exo"):
        raise ValueError
    if path.suffix in (".e", ".exo"):
        reader = vtk.vtkExodusIIReader()
        reader.SetFileName(str(path))
        reader.Update()
        block = reader.GetOutput().GetBlock(0).GetBlock(0)
        return vtk_to_numpy(block.GetPoints().GetData())
    reader = vtk.vtkXMLUnstructuredGridReader() if path.suffix == ".vtu" else vtk.vtkUnstructuredGridReader()
    reader.SetFileName(str(path))
    reader.Update()
    return vtk_to_numpy(reader.GetOutput().GetPoints().GetData())


def _read_meshio(path: Path) -> np.ndarray:
    return meshio.read(path, file_format="gmsh" if path.suffix == ".msh" else None).points


READERS = {"Gmsh": _read_gmsh, "VTK": _read_vtk, "meshio": _read_meshio}


def _agrees(reader, path: Path, wanted: np.ndarray, size: float, count: int) -> bool:
    """Whether another program finds the coordinates, in any order (it may leave out nodes without cells)."""
    try:
        with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
            found = np.asarray(reader(path), float)
    except BaseException:  # whatever a program does with a file that isn't its own
        return False
    wanted = np.pad(wanted, ((0, 0), (0, found.shape[1] - wanted.shape[1])))
    away, _ = cKDTree(wanted).query(found)
    return bool(len(found) <= count and len(found) > 0.5 * count and away.max() <= 2e-7 * size)
