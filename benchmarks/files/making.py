"""Files of all formats, made by Gmsh, VTK, meshio, netCDF and by hand."""

from __future__ import annotations

import contextlib
import importlib.util
import tempfile
from collections.abc import Callable
from pathlib import Path

import meshio
import numpy as np

__all__ = ["MAKERS", "make"]


def _gmsh_model(dim: int = 3, order: int = 1, partition: bool = False, view: bool = False) -> None:
    """A block with a core of another material and named groups; periodic in x, if it is linear."""
    import gmsh

    gmsh.model.add("part")
    occ = gmsh.model.occ
    if dim == 2:
        occ.fragment([(2, occ.addRectangle(0, 0, 0, 1, 1))], [(2, occ.addDisk(0.5, 0.5, 0, 0.25, 0.25))])
    else:
        occ.fragment([(3, occ.addBox(0, 0, 0, 1, 1, 1))], [(3, occ.addCylinder(0.5, 0.5, 0, 0, 0, 1, 0.25))])
    occ.synchronize()
    for k, (_, tag) in enumerate(gmsh.model.getEntities(dim)):
        gmsh.model.addPhysicalGroup(dim, [tag], name=f"material {k}")
    sides = [[tag for d, tag in gmsh.model.getEntities(dim - 1) if _on_side(d, tag, x)] for x in (0.0, 1.0)]
    gmsh.model.addPhysicalGroup(dim - 1, sides[0], name="left")
    if order == 1:  # Gmsh says of corner nodes only that they belong together
        gmsh.model.mesh.setPeriodic(
            dim - 1, sides[1], sides[0], [1, 0, 0, 1, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]
        )
    gmsh.option.setNumber("Mesh.MeshSizeMax", 0.4)
    gmsh.model.mesh.generate(dim)
    gmsh.model.mesh.setOrder(order)
    if partition:
        gmsh.model.mesh.partition(2)
    if view:
        tags = gmsh.model.mesh.getNodes()[0]
        shown = gmsh.view.add("heat")
        gmsh.view.addHomogeneousModelData(shown, 0, "part", "NodeData", tags, np.sin(tags.astype(float)))


def _on_side(dim: int, tag: int, x: float) -> bool:
    import gmsh

    box = gmsh.model.getBoundingBox(dim, tag)
    return abs(box[0] - x) < 1e-6 and abs(box[3] - x) < 1e-6


def _by_gmsh(*, model: dict | None = None, **options: float) -> Callable[[Path], None]:
    def make(path: Path) -> None:
        import gmsh

        gmsh.initialize(interruptible=False)
        gmsh.clear()  # forgets errors of earlier models, after which meshes keep their order
        try:
            gmsh.option.setNumber("General.Terminal", 0)
            _gmsh_model(**(model or {}))
            for name, value in options.items():
                gmsh.option.setNumber("Mesh." + name, value)
            gmsh.write(str(path))
            gmsh.option.setNumber("PostProcessing.SaveMesh", 0)
            for tag in gmsh.view.getTags():
                gmsh.view.write(tag, str(path), True)
        finally:
            gmsh.finalize()

    return make


def _grid(count: int = 3) -> meshio.Mesh:
    """A cube of count³ hexahedra, one side of it as quadrilaterals, with all sorts of data."""
    n = count + 1
    points = np.stack(np.meshgrid(*3 * [np.linspace(0, 1, n)], indexing="ij"), -1).reshape(-1, 3)
    points += 0.02 * np.sin(37.0 * np.arange(points.size).reshape(points.shape))
    first = np.array(
        [[i * n * n + j * n + k for k in range(count)] for i in range(count) for j in range(count)]
    )
    corner = first.ravel()[:, None]
    hexahedra = corner + np.array([0, n * n, n * n + n, n, 1, n * n + 1, n * n + n + 1, n + 1])
    sides = hexahedra[: count * count][:, [0, 4, 7, 3]]
    return meshio.Mesh(
        points,
        [("hexahedron", hexahedra), ("quad", sides)],
        point_data={"heat": points[:, 0] ** 2, "flow": points[:, ::-1].copy()},
        cell_data={"material": [np.arange(len(hexahedra)) % 2, np.full(len(sides), 7)]},
    )


def _by_meshio(file_format: str, **options) -> Callable[[Path], None]:
    def make(path: Path) -> None:
        mesh = _grid()
        if file_format in ("exodus", "med", "medit", "nastran"):
            mesh.point_data = {}
            own = {"exodus": None, "med": "cell_tags", "medit": "medit:ref", "nastran": "nastran:ref"}[
                file_format
            ]
            mesh.cell_data = {own: mesh.cell_data["material"]} if own else {}
        meshio.write(path, mesh, file_format=file_format, **options)

    return make


def _add_text(vtk, grid) -> None:
    names, bits = vtk.vtkStringArray(), vtk.vtkBitArray()
    for array, name in ((names, "label"), (bits, "flag")):
        array.SetName(name)
        grid.GetCellData().AddArray(array)
    for k in range(grid.GetNumberOfCells()):
        names.InsertNextValue(f"cell {k}")
        bits.InsertNextValue(k % 2)
    for name, made in (("material", vtk.vtkIntArray()), ("kind", vtk.vtkUnsignedCharArray())):
        made.SetName(name)
        grid.GetCellData().AddArray(made)
        for k in range(grid.GetNumberOfCells()):
            made.InsertNextValue(k % 3)
    time = vtk.vtkDoubleArray()
    time.SetName("TimeValue")
    time.InsertNextValue(0.25)
    grid.GetFieldData().AddArray(time)


def _by_vtk(legacy: bool = False, single: bool = False, **modes) -> Callable[[Path], None]:
    """Through VTK's own writers, with text and bits among the data."""

    def make(path: Path) -> None:
        import vtk
        from vtk.util.numpy_support import numpy_to_vtk

        source, grid = _grid(), vtk.vtkUnstructuredGrid()
        points = vtk.vtkPoints()
        points.SetData(numpy_to_vtk(source.points.astype(np.float32 if single else np.float64), deep=True))
        grid.SetPoints(points)
        for cells, code in zip(source.cells, (vtk.VTK_HEXAHEDRON, vtk.VTK_QUAD), strict=True):
            for nodes in cells.data:
                grid.InsertNextCell(code, len(nodes), nodes.tolist())
        for name, values in source.point_data.items():
            array = numpy_to_vtk(values, deep=True)
            array.SetName(name)
            grid.GetPointData().AddArray(array)
        _add_text(vtk, grid)
        writer = vtk.vtkUnstructuredGridWriter() if legacy else vtk.vtkXMLUnstructuredGridWriter()
        for name, value in modes.items():
            getattr(writer, name)(*([] if value is None else [value]))
        writer.SetFileName(str(path))
        writer.SetInputData(grid)
        writer.Write()

    return make


def _exodus(format: str, **filters) -> Callable[[Path], None]:
    """As most programs write Exodus: a variable for each coordinate, and a side set."""

    def make(path: Path) -> None:
        import netCDF4

        with tempfile.TemporaryDirectory() as folder:
            source = Path(folder) / "a.e"
            _by_meshio("exodus")(source)
            with netCDF4.Dataset(source) as old, netCDF4.Dataset(path, "w", format=format) as new:
                _copy_exodus(old, new, filters)

    return make


def _copy_exodus(old, new, filters: dict) -> None:
    old.set_auto_mask(False)
    new.setncatts({name: old.getncattr(name) for name in old.ncattrs() if not name.startswith("_")})
    new.setncattr("file_size", np.int32(1))  # says that they are separate
    for name, size in old.dimensions.items():
        if len(size):
            new.createDimension(name, None if name == "time_step" else len(size))
    for axis, values in zip("xyz", old.variables["coord"][:], strict=True):
        new.createVariable(f"coord{axis}", "f8", ("num_nodes",), **filters)[:] = values
    for name, array in old.variables.items():
        if name == "coord":
            continue
        kind = "i4" if array.dtype == np.int64 else array.dtype
        made = new.createVariable(name, kind, array.dimensions)
        made.setncatts({key: array.getncattr(key) for key in array.ncattrs()})
        made[:] = array[:]
    new.createDimension("num_side_ss1", 2)
    new.createVariable("side_ss1", "i4", ("num_side_ss1",))[:] = [1, 2]


def _time_series(path: Path) -> None:
    source = _grid()
    # the numbers go to the working directory
    with contextlib.chdir(path.parent), meshio.xdmf.TimeSeriesWriter(path.name) as writer:
        writer.write_points_cells(source.points, source.cells)
        for time in (0.0, 0.5, 1.0):
            writer.write_data(time, point_data={"heat": time * source.points[:, 0]})


def _text(content: str) -> Callable[[Path], None]:
    def make(path: Path) -> None:
        path.write_bytes(content.encode())

    return make


def _npz(path: Path) -> None:
    source = _grid()
    np.savez_compressed(
        path, points=source.points, hexahedron=source.cells[0].data, words=np.array(["a", "b"])
    )


UGRID = """5 4 0 1 0 0 0
 0.0 0.0 0.0   1.0 0.0 0.0
 1.0 1.0 0.0   0.0 0.0 1.0
 5 5 5
 1 3 2  1 2 4  2 3 4  1 4 3
 1 2 3 4
 1 2 3 4
"""

SMALL_NASTRAN = """SOL 101
CEND
$ loads of the first case
BEGIN BULK
MAT1    1       2.1+11          .3
$ nodes
GRID    1               0.      0.      0.
GRID    2               1.      0.      0.
GRID*   3                               1.0             1.0
*       0.0
GRID,4,,0.,1.,0.
GRID    15              .5      .5      1.-3            345
GRID    16              .4      .5      1.0
CTETRA  1       1       1       2       3       16
CTETRA  2       1       1       3       4       16
FORCE   7       2               10.     0.      0.      1.
ENDDATA
"""

ABAQUS = """*HEADING
 a part in two places, turned
** made by hand
*PART, NAME=BLADE
*NODE, NSET=ALL
   1,  0.000,   0.000,  0.000
   2,  1.000,   0.000,  0.000
   5,  1.000,   1.000,  0.000
   9,  0.000,   1.000,
*ELEMENT, TYPE=CPS3, ELSET=E
 11, 1, 2, 5
 12, 1, 5, 9
*ELSET, ELSET=E2, GENERATE
 11, 12, 1
*SOLID SECTION, ELSET=E, MATERIAL=STEEL
 1.,
*END PART
*ASSEMBLY, NAME=A
*INSTANCE, NAME=I1, PART=BLADE
 3., 0., 0.
 3., 0., 0., 3., 0., 1., 30.
*END INSTANCE
*SURFACE, NAME=TOP, TYPE=ELEMENT
 E2, S1
*END ASSEMBLY
*MATERIAL, NAME=STEEL
*ELASTIC
 210000., .3
*STEP
*STATIC
*CLOAD
 I1.2, 1, 5.
*END STEP
"""

_XML = {"SetDataModeToAscii": None}
_BINARY = {"SetDataModeToBinary": None}
_RAW = {"SetDataModeToAppended": None, "EncodeAppendedDataOff": None}
_BASE64 = {"SetDataModeToAppended": None, "EncodeAppendedDataOn": None}
_NONE, _LZMA = {"SetCompressorTypeToNone": None}, {"SetCompressorTypeToLZMA": None}
_SHORT = {"SetHeaderTypeToUInt32": None}

MAKERS: dict[str, Callable[[Path], None]] = {
    "gmsh-2.2-ascii.msh": _by_gmsh(MshFileVersion=2.2, Binary=0),
    "gmsh-2.2-binary.msh": _by_gmsh(MshFileVersion=2.2, Binary=1),
    "gmsh-4.0-ascii.msh": _by_gmsh(MshFileVersion=4.0, Binary=0),
    "gmsh-4.1-ascii.msh": _by_gmsh(MshFileVersion=4.1, Binary=0),
    "gmsh-4.1-binary.msh": _by_gmsh(MshFileVersion=4.1, Binary=1),
    "gmsh-4.1-parametric-ascii.msh": _by_gmsh(SaveParametric=1, Binary=0),
    "gmsh-4.1-parametric-binary.msh": _by_gmsh(SaveParametric=1, Binary=1),
    "gmsh-4.1-partitioned.msh": _by_gmsh(model={"partition": True}, Binary=0),
    "gmsh-4.1-view.msh": _by_gmsh(model={"view": True}, Binary=1),
    "gmsh-4.1-second-order.msh": _by_gmsh(model={"order": 2}, Binary=0),
    "gmsh-4.1-plane.msh": _by_gmsh(model={"dim": 2}, Binary=0),
    "gmsh.inp": _by_gmsh(SaveGroupsOfNodes=1),
    "gmsh.su2": _by_gmsh(),
    "gmsh-plane.su2": _by_gmsh(model={"dim": 2}),
    "gmsh.mesh": _by_gmsh(),
    "gmsh.bdf": _by_gmsh(),
    "gmsh.unv": _by_gmsh(SaveGroupsOfNodes=1),
    "gmsh.vtk": _by_gmsh(),
    "gmsh.med": _by_gmsh(),
    "meshio.meshb": _by_meshio("medit"),
    "meshio-xml.xdmf": _by_meshio("xdmf", data_format="XML"),
    "meshio-hdf5.xdmf": _by_meshio("xdmf"),
    "meshio-series.xdmf": _time_series,
    "meshio.med": _by_meshio("med"),
    "meshio-netcdf4.e": _by_meshio("exodus"),
    "netcdf3.exo": _exodus("NETCDF3_64BIT_OFFSET"),
    "netcdf4-separate.e": _exodus("NETCDF4"),
    "netcdf4-compressed.e": _exodus("NETCDF4", zlib=True, shuffle=True, fletcher32=True),
    "meshio-zlib.vtu": _by_meshio("vtu"),
    "vtk-ascii.vtu": _by_vtk(**_XML),
    "vtk-base64.vtu": _by_vtk(**_BINARY, **_NONE),
    "vtk-base64-zlib.vtu": _by_vtk(**_BINARY, **_SHORT),
    "vtk-base64-lzma.vtu": _by_vtk(**_BINARY, **_LZMA),
    "vtk-raw.vtu": _by_vtk(**_RAW, **_NONE),
    "vtk-raw-zlib.vtu": _by_vtk(**_RAW),
    "vtk-raw-float32.vtu": _by_vtk(single=True, **_RAW, **_SHORT),
    "vtk-appended-base64.vtu": _by_vtk(**_BASE64, **_NONE),
    "vtk-appended-base64-zlib.vtu": _by_vtk(**_BASE64),
    "vtk-legacy-ascii.vtk": _by_vtk(legacy=True, SetFileTypeToASCII=None),
    "vtk-legacy-binary.vtk": _by_vtk(legacy=True, SetFileTypeToBinary=None),
    "vtk-legacy-4.2.vtk": _by_vtk(legacy=True, single=True, SetFileTypeToBinary=None, SetFileVersion=42),
    "meshio.avs": _by_meshio("avsucd"),
    "meshio.vol": _by_meshio("netgen"),
    "numpy.npz": _npz,
    "hand.ugrid": _text(UGRID),
    "hand-fields.nas": _text(SMALL_NASTRAN),
    "hand-assembly.inp": _text(ABAQUS),
    "hand-crlf.inp": _text(ABAQUS.replace("\n", "\r\n")),
}
"""How to make each file."""

_PACKAGES = {
    "gmsh": "gmsh",
    "vtk": "vtk",
    ".med": "h5py",
    ".xdmf": "h5py",
    ".e": "netCDF4",
    ".exo": "netCDF4",
}


def make(name: str, folder: Path) -> Path | None:
    """Make a file; None where a package for it is missing."""
    path = folder / name
    for part, package in _PACKAGES.items():
        if (name.startswith(part) or path.suffix == part) and importlib.util.find_spec(package) is None:
            return None
    MAKERS[name](path)
    return path
