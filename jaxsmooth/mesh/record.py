"""The mesh record and its checks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, Float, Int

from jaxsmooth.cells.table import ElementType, element_type
from jaxsmooth.mesh.execution import Execution
from jaxsmooth.mesh.links import NodeLinks
from jaxsmooth.mesh.normals import reference_normals

__all__ = ["Labels", "Mesh", "check_size"]


class Labels(eqx.Module):
    """What a mesh says about its parts; boundary and interface detection respect it.

    Attributes:
        regions: one int array ``[elements]`` a block: the material or physical group.
        features: lower-dimensional cells of the file, ``[m, k]`` each.
        feature_types: their types (``vertex``, ``line``, ``triangle``, …).
        feature_tags: one int array ``[m]`` each: cells of different tags do not mix.
        held: nodes that must not move ``[nodes]``, or None: those that a file marks, and those of cells
            that are not smoothed themselves.
        links: nodes that move with others, or None.
    """

    regions: tuple[Int[np.ndarray, "_"], ...]
    features: tuple[Int[np.ndarray, "_ _"], ...] = ()
    feature_tags: tuple[Int[np.ndarray, "_"], ...] = ()
    feature_types: tuple[str, ...] = eqx.field(static=True, default=())
    held: Bool[np.ndarray, " nodes"] | None = None
    links: NodeLinks | None = None


class Mesh(eqx.Module):
    """A finite-element mesh: a frozen pytree whose only differentiable leaf is `points`.

    Attributes:
        points: coordinates of the nodes ``[nodes, dim]``; their dtype sets the precision.
        connectivity: one int32 array ``[elements, k]`` an element block.
        labels: regions and lower-dimensional cells, or None.
        normals: of a surface in space the normals ``[elements, 3]`` of what was given, one array a block,
            against which elements are valid or inverted; None for all other meshes.
        types: the element type of each block, by meshio's name (static).
        execution: how loops over the elements run (static).
    """

    points: Float[Array, "nodes dim"]
    connectivity: tuple[Int[Array, "_ _"], ...]
    labels: Labels | None
    normals: tuple[Float[Array, "_ 3"], ...] | None
    types: tuple[str, ...] = eqx.field(static=True)
    execution: Execution = eqx.field(static=True)

    def __init__(
        self,
        points: Any,
        blocks: Mapping[str, Any] | Sequence[tuple[str, Any]],
        labels: Labels | None = None,
        execution: Execution | None = None,
    ):
        """Check and build a mesh.

        Plane elements in space are a surface; neighbours have to be numbered alike (`as_mesh` sees to it).

        Args:
            points: ``[nodes, dim]`` coordinates, float32 or float64.
            blocks: ``{"tetra": [elements, k]}`` or a list of such pairs.
            labels: see `Labels`.
            execution: by default what suits JAX's default device.

        Raises:
            ValueError: naming the block, element or node that is wrong.
        """
        pairs = list(blocks.items()) if isinstance(blocks, Mapping) else list(blocks)
        pairs = [(name, np.asarray(nodes)) for name, nodes in pairs]
        if not pairs:
            raise ValueError("the mesh has no element blocks; give at least one, such as {'tetra': nodes}")
        points = _as_points(points)
        for index, (name, nodes) in enumerate(pairs):
            _check_block(index, name, nodes, points.shape)
        self.points = points
        self.connectivity = tuple(jnp.asarray(nodes.astype(np.int32)) for _, nodes in pairs)
        self.labels = labels
        self.normals = _normals(points, pairs)
        self.types = tuple(name for name, _ in pairs)
        self.execution = Execution.here() if execution is None else execution

    @property
    def dim(self) -> int:
        """Dimension of the space: 2 or 3; that of the elements too, but for surfaces."""
        return self.points.shape[1]

    @property
    def element_dim(self) -> int:
        """Dimension of the elements: 2 or 3."""
        return element_type(self.types[0]).dim

    @property
    def surface(self) -> bool:
        """Whether the elements are plane ones in space."""
        return self.normals is not None

    @property
    def blocks(self) -> list[tuple[ElementType, Int[Array, "elements k"]]]:
        """Element type and connectivity of every block."""
        return [(element_type(n), c) for n, c in zip(self.types, self.connectivity, strict=True)]

    def with_points(self, points: Float[Array | np.ndarray, "..."]) -> Mesh:
        """The same topology with other coordinates; `points` may be traced by JAX, or a batch."""
        return eqx.tree_at(lambda mesh: mesh.points, self, jnp.asarray(points))

    @property
    def bare(self) -> Mesh:
        """The mesh without labels, which are for the host: meshes of one shape share what is compiled."""
        return self.with_labels(None) if self.labels is not None else self

    def with_labels(self, labels: Labels | None) -> Mesh:
        """The same mesh with other labels."""
        return eqx.tree_at(lambda m: m.labels, self, labels, is_leaf=lambda x: x is None)

    def with_links(self, *links: NodeLinks) -> Mesh:
        """The same mesh with more links between its nodes, such as those of `find_periodic`.

        Raises:
            ValueError: for links of another dimension, or of nodes that the mesh has not.
        """
        for part in links:
            if part.rotations.shape[1:] != (self.dim, self.dim):
                raise ValueError(
                    f"the links are for {part.rotations.shape[-1]}D, the mesh is {self.dim}D; find them in it"
                )
            nodes = np.concatenate([part.nodes, part.parents.ravel()])
            if nodes.size and not (nodes.min() >= 0 and nodes.max() < len(self.points)):
                raise ValueError(f"a linked node is out of range; the mesh has {len(self.points)} nodes")
        labels = Labels(regions=()) if self.labels is None else self.labels
        known = () if labels.links is None else (labels.links,)
        return self.with_labels(replace(labels, links=NodeLinks.join([*known, *links])))


def _as_points(points: Any) -> Float[Array, "nodes dim"]:
    if isinstance(points, Tracer):
        return points
    array = np.asarray(points)
    if array.ndim != 2 or array.shape[1] not in (2, 3):
        raise ValueError(f"points must have shape [nodes, 2] or [nodes, 3], got {list(array.shape)}")
    if array.dtype.kind not in "fiu":
        raise ValueError(f"points must be real numbers, got dtype {array.dtype}")
    finite = np.isfinite(array).all(axis=1)
    if not finite.all():
        node = int(np.argmin(finite))
        raise ValueError(
            f"node {node} has a coordinate that is not finite ({array[node].tolist()}); "
            f"{int((~finite).sum())} such nodes in all; repair or remove them"
        )
    if not (isinstance(points, jax.Array) and array.dtype.kind == "f"):
        # jnp.asarray rejects the big-endian arrays that some readers return
        dtype = np.float32 if array.dtype.itemsize <= 4 and array.dtype.kind == "f" else np.float64
        points = jnp.asarray(array.astype(dtype, copy=False))
    check_size(array, np.finfo(points.dtype))
    return points


def check_size(points: np.ndarray, numbers: np.finfo) -> None:
    """Fourth powers of lengths must neither over- nor underflow (the metric of a solid has them).

    Raises ValueError."""
    size = float(np.ptp(points, axis=0).max()) if len(points) else 0.0
    if size and not float(numbers.tiny) ** 0.2 < size < float(numbers.max) ** 0.25 / 10:
        raise ValueError(
            f"the mesh has a size of {size:.0e}, which {numbers.dtype} can't compute with; choose other units"
        )


def _normals(points: Any, pairs: list[tuple[str, np.ndarray]]) -> tuple[Float[Array, "_ 3"], ...] | None:
    """Reference normals of a surface, None for other meshes."""
    blocks = [(element_type(name), nodes) for name, nodes in pairs]
    dims = {kind.dim for kind, _ in blocks}
    if len(dims) > 1:
        raise ValueError(
            f"the element blocks ({', '.join(name for name, _ in pairs)}) are of different dimensions; give "
            "the solid or the surface alone"
        )
    if dims == {points.shape[1]}:
        return None
    if isinstance(points, Tracer):
        raise ValueError(
            "the normals of a surface can't be found while JAX traces its points; build the mesh before, and "
            "trace mesh.with_points(points)"
        )
    found = reference_normals(np.asarray(points), blocks)
    return tuple(jnp.asarray(part, points.dtype) for part in found)


def _check_block(index: int, name: str, nodes: np.ndarray, points_shape: tuple[int, ...]) -> None:
    kind, where = element_type(name), f"block {index} ({name})"
    if kind.dim != points_shape[1] and (kind.dim, points_shape[1]) != (2, 3):
        raise ValueError(f"{where}: {kind.dim}D elements in {points_shape[1]}D space can't be smoothed")
    if nodes.ndim != 2 or nodes.shape[1] != kind.k or nodes.dtype.kind not in "iu":
        raise ValueError(
            f"{where}: connectivity must be integers of shape [elements, {kind.k}], "
            f"got {nodes.dtype} {list(nodes.shape)}"
        )
    if len(nodes) == 0:
        raise ValueError(f"{where} has no elements; leave it out")
    outside = (nodes < 0) | (nodes >= points_shape[0])
    if outside.any():
        element, column = np.argwhere(outside)[0]
        raise ValueError(
            f"{where}, element {element}: node index {nodes[element, column]} is out of range; "
            f"the mesh has {points_shape[0]} nodes"
        )
    ordered = np.sort(nodes, axis=1)
    repeated = ordered[:, 1:] == ordered[:, :-1]
    if repeated.any():
        element, column = np.argwhere(repeated)[0]
        raise ValueError(
            f"{where}, element {element}: node {ordered[element, column]} appears twice; "
            "split the degenerate element or use the type that fits it"
        )
