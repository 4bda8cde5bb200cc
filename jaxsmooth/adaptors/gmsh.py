"""The current model of Gmsh: its mesh, smoothed in place, the boundary on its CAD.

gmsh.model.mesh.generate(3)
js.gmsh.smooth_model()
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxsmooth.convert.meshfile import MeshFile, MeshFileError, to_meshio
from jaxsmooth.convert.planes import Plane
from jaxsmooth.files.io import read
from jaxsmooth.mesh.layers import layer_nodes
from jaxsmooth.mesh.record import Mesh
from jaxsmooth.mesh.topology import find_facets
from jaxsmooth.methods import Method
from jaxsmooth.motion.base import Motion
from jaxsmooth.motion.coupled import couple
from jaxsmooth.motion.curved import Carrier, Sliding
from jaxsmooth.motion.detect import detect_constraints
from jaxsmooth.motion.planar import node_mask
from jaxsmooth.numerics.small import Frame
from jaxsmooth.runs.driver import SmoothResult, smooth

__all__ = ["OnModel", "model_constraints", "read_model", "smooth_model", "write_model"]

Places = Float[Array, "sliding dim"]


def smooth_model(
    method: Method | None = None, *, fixed: Any = None, layers: str = "hold", **options: Any
) -> SmoothResult:
    """Smooth the mesh of the current model where it is; nodes slide on the faces and curves of its CAD.

    Groups, periodic links and high-order nodes are kept as they are in a file.

    Args:
        method: as for `smooth`.
        fixed: nodes to hold, see `model_constraints`.
        layers: ``"hold"`` or ``"free"``: boundary layers.
        **options: of `smooth`; `constraints` replace those of the CAD.

    Raises:
        MeshFileError: the model has no mesh that can be smoothed.
        ImportError: Gmsh is not installed.
    """
    file = read_model()
    if "constraints" not in options:
        options["constraints"] = model_constraints(file, fixed=fixed, layers=layers)
    result = smooth(file, method, **options)
    write_model(result)
    return result


def _gmsh() -> Any:
    try:
        import gmsh
    except ImportError as missing:
        raise ImportError("models need Gmsh; install it with: pip install gmsh") from missing
    if not gmsh.isInitialized():
        raise ValueError("Gmsh has no model; call gmsh.initialize() and make one")
    return gmsh


def read_model() -> MeshFile:
    """The mesh of the current model, as `read` gives it of the file that Gmsh writes of it.

    Nodes are in the order of ``gmsh.model.mesh.getNodes()``.

    Raises:
        MeshFileError: there is no mesh, or none that can be smoothed.
    """
    gmsh = _gmsh()
    tags, places, _ = gmsh.model.mesh.getNodes()
    if not len(tags):
        raise MeshFileError("the current model has no mesh; call gmsh.model.mesh.generate() first")
    with tempfile.TemporaryDirectory() as folder, _plain_output(gmsh):
        path = Path(folder) / "model.msh"
        gmsh.write(str(path))
        file = read(path)
    places = places.reshape(-1, 3)
    if not np.array_equal(places, np.asarray(file.source.points)):
        raise MeshFileError(
            "Gmsh writes other nodes than it has in memory; classify them anew "
            "(gmsh.model.mesh.reclassifyNodes())"
        )
    return replace(file, path=None, original=None, format=None)


_PLAIN = {
    "Mesh.SaveAll": 1,
    "Mesh.SaveParametric": 0,
    "Mesh.MshFileVersion": 4.1,
    "Mesh.Binary": 1,
    "Mesh.ScalingFactor": 1,
    "General.Terminal": 0,
}


@contextmanager
def _plain_output(gmsh: Any) -> Iterator[None]:
    """All of the mesh, in full precision; the options are put back."""
    before = {name: gmsh.option.getNumber(name) for name in _PLAIN}
    try:
        for name, value in _PLAIN.items():
            gmsh.option.setNumber(name, value)
        yield
    finally:
        for name, value in before.items():
            gmsh.option.setNumber(name, value)


def write_model(result: Any) -> None:
    """Give the nodes of the current model the coordinates of a result of its mesh.

    Args:
        result: what `smooth` made of `read_model()`.

    Raises:
        ValueError: the model has another number of nodes.
    """
    gmsh = _gmsh()
    points = np.asarray(to_meshio(result).points, float)
    tags, old, _ = gmsh.model.mesh.getNodes()
    old = old.reshape(-1, 3)
    if old.shape != points.shape:
        raise ValueError(f"the model has {len(old)} nodes, the result {len(points)}; smooth its present mesh")
    place = {int(tag): index for index, tag in enumerate(tags)}
    for dim, entity, index in _entities(gmsh, place):
        index = index[(points[index] != old[index]).any(axis=1)]
        width = dim if dim in (1, 2) and not _discrete(gmsh, dim, entity) else 0
        where = np.zeros((len(index), 0))
        if width and len(index):
            where = _nearest(gmsh, dim, entity, points[index])[1].reshape(-1, width)
        for node, parameters in zip(index, where, strict=True):
            gmsh.model.mesh.setNode(tags[node], points[node], parameters)


def _entities(gmsh: Any, place: dict[int, int]) -> Iterator[tuple[int, int, np.ndarray]]:
    """Dimension, tag and nodes ``[m]`` of every entity that has nodes of its own."""
    for dim, tag in gmsh.model.getEntities():
        own = gmsh.model.mesh.getNodes(dim, tag)[0]
        if len(own):
            yield dim, tag, np.array([place[int(node)] for node in own])


def _discrete(gmsh: Any, dim: int, tag: int) -> bool:
    return gmsh.model.getType(dim, tag).lower().startswith("discrete")


def _nearest(gmsh: Any, dim: int, tag: int, places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The nearest points ``[m, 3]`` of a face or a curve, and their parameters ``[m·dim]``."""
    near, where = gmsh.model.getClosestPoint(dim, tag, places.ravel())
    if dim == 1:  # of curves of OpenCASCADE Gmsh (4.15) leaves the parameters unset
        where = gmsh.model.getParametrization(dim, tag, near)
    return near.reshape(-1, 3), where


# --- What the nodes may do ----------------------------------------------------------------------------


def model_constraints(file: MeshFile, *, fixed: Any = None, layers: str = "hold") -> Motion:
    """What the CAD of the current model lets the nodes of its mesh do.

    Nodes of faces slide on them, those of curves along them, those of points are held; discrete entities,
    which have no shape but their mesh, are treated as `detect_constraints` does by default.

    Args:
        file: of `read_model`.
        fixed: nodes to hold: a mask ``[nodes]``, indices, or the name of a physical group.
        layers: ``"hold"`` to hold the nodes of boundary layers, or ``"free"``.

    Raises:
        ValueError: the group is unknown, or `layers` neither of the two.
    """
    gmsh, mesh = _gmsh(), file.mesh
    if isinstance(fixed, str):
        if fixed not in file.named_sets:
            raise ValueError(f"unknown group {fixed!r}; the model has {', '.join(file.named_sets) or 'none'}")
        fixed = file.named_sets[fixed]
    if layers not in ("hold", "free"):
        raise ValueError(f"layers must be 'hold' or 'free', got {layers!r}")
    held = node_mask(fixed, len(mesh.points))
    if mesh.labels is not None and mesh.labels.held is not None:
        held |= np.asarray(mesh.labels.held)
    if layers == "hold":
        held |= layer_nodes(mesh, find_facets(mesh))
    tags = gmsh.model.mesh.getNodes()[0]
    found = list(_entities(gmsh, {int(tag): index for index, tag in enumerate(tags)}))
    projectors = np.tile(np.eye(mesh.dim), (len(mesh.points), 1, 1))
    nodes, faces = [], []
    for dim, tag, index in found:
        if dim == mesh.dim:
            continue
        if dim and not _discrete(gmsh, dim, tag):
            index = index[~held[index]]
            nodes.append(index)
            faces.append(_Face(dim, tag, len(index)))
        elif dim:
            projectors[index] = _by_the_mesh(mesh)[index]
        else:
            projectors[index] = 0
    projectors[held] = 0
    dtype = mesh.points.dtype
    carriers = ()
    if sum(map(len, nodes)):
        shape = jax.tree_util.Partial(partial(_on_host, _Shape(tuple(faces), file.plane)))
        carriers = (OnModel(jnp.asarray(np.concatenate(nodes), jnp.int32), shape),)
    return couple(Sliding(jnp.asarray(projectors, dtype), carriers), mesh)


def _by_the_mesh(mesh: Mesh) -> np.ndarray:
    """What the mesh itself lets its nodes do, each by itself: projectors ``[nodes, dim, dim]``."""
    alone = mesh if mesh.labels is None else mesh.with_labels(replace(mesh.labels, links=None))
    return np.asarray(detect_constraints(alone).at(mesh.points).projectors)


class _Face(NamedTuple):
    """A face or a curve, and how many of the nodes are on it."""

    dim: int
    tag: int
    number: int


class _Shape(NamedTuple):
    """What nodes are on, one entity after the other, and the plane of a plane mesh."""

    faces: tuple[_Face, ...]
    plane: Plane | None

    def look(self, places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The nearest points ``[m, dim]`` of places, and the projectors onto the tangents there."""
        gmsh, dim = _gmsh(), places.shape[1]
        axes = np.eye(3)[:dim] if self.plane is None else self.plane.axes
        origin = np.zeros(3) if self.plane is None else self.plane.origin
        points, tangents = np.empty(places.shape), np.empty((*places.shape, dim))
        start = 0
        for face in self.faces:
            rows = slice(start, start + face.number)
            start += face.number
            if not face.number:
                continue
            space = places[rows].astype(float) @ axes + origin
            near, where = _nearest(gmsh, face.dim, face.tag, space)
            points[rows] = (near - origin) @ axes.T
            slopes = gmsh.model.getDerivative(face.dim, face.tag, where)
            ways = slopes.reshape(-1, face.dim, 3) @ axes.T
            inverse = np.linalg.pinv(ways)  # of a pole, where one of the two vanishes, one is left
            tangents[rows] = inverse @ ways
        return points, tangents


def _on_host(shape: _Shape, places: Places) -> tuple[Places, Float[Array, "sliding dim dim"]]:
    sizes = (places.shape, (*places.shape, places.shape[1]))
    wanted = tuple(jax.ShapeDtypeStruct(size, places.dtype) for size in sizes)

    def call(here: Any) -> tuple[np.ndarray, ...]:
        here = np.asarray(here)
        return tuple(part.astype(here.dtype) for part in shape.look(here))

    return jax.pure_callback(call, wanted, places, vmap_method="sequential")


class OnModel(Carrier):
    """Nodes on the faces and curves of a CAD model.

    Attributes:
        nodes: that slide.
        shape: the nearest points of places ``[m, dim]`` and the projectors onto the tangents there.
        frame: of the coordinates of the nodes; None for those of the model.
    """

    nodes: Int[Array, " sliding"]
    shape: Any
    frame: Frame | None = None

    def foot(self, points: Places) -> Places:
        """The nearest points; their derivative is the projector, as on the surface itself."""
        return _foot(self, points)

    def tangents(self, points: Places) -> Float[Array, "sliding dim dim"]:
        """The projectors."""
        return self._look(points)[1]

    def within(self, frame: Frame) -> OnModel:
        """The same in the frame."""
        if self.frame is not None:  # frames one after the other
            origin = self.frame.origin + frame.origin / self.frame.scale
            frame = Frame(origin, self.frame.scale * frame.scale)
        return OnModel(self.nodes, self.shape, frame)

    def _look(self, points: Places) -> tuple[Places, Float[Array, "sliding dim dim"]]:
        points = jax.lax.stop_gradient(points)
        if self.frame is None:
            return self.shape(points)
        frame = jax.lax.stop_gradient(self.frame)
        found, tangents = self.shape(points / frame.scale + frame.origin)
        return frame.into(found), tangents


def _foot(carrier: OnModel, points: Places) -> Places:
    found, tangents = carrier._look(points)
    step = points - jax.lax.stop_gradient(points)
    return jax.lax.stop_gradient(found) + jnp.einsum("nij,nj->ni", jax.lax.stop_gradient(tangents), step)
