"""Many meshes in one call: meshes of different sizes padded to one shape."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial, reduce
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxsmooth.cells.table import element_type
from jaxsmooth.convert.meshfile import as_mesh
from jaxsmooth.mesh.record import Mesh
from jaxsmooth.methods import Elastic, Method
from jaxsmooth.metrics.record import Metric
from jaxsmooth.metrics.shape import SHAPE
from jaxsmooth.metrics.table import as_metric, quality
from jaxsmooth.motion.base import Motion
from jaxsmooth.motion.detect import detect_constraints
from jaxsmooth.motion.planar import Constraints
from jaxsmooth.runs.pure import Run, method_state, run

__all__ = ["Batch", "stack"]


class Batch(eqx.Module):
    """Meshes with a leading batch axis on every leaf, for `jax.vmap`.

    Ghost elements fill the blocks: each is an ideal element on held nodes of its own, apart from
    the mesh, so that it neither pulls nor offends and no method needs to know of it.

    Attributes:
        mesh: points ``[batch, nodes, dim]``, connectivity ``[batch, elements, k]``.
        constraints: projectors ``[batch, nodes, dim, dim]``; ghost nodes are held.
        nodes: true for the nodes of the meshes ``[batch, nodes]``.
        elements: one mask ``[batch, elements]`` a block.
    """

    mesh: Mesh
    constraints: Constraints
    nodes: Bool[Array, "batch nodes"]
    elements: tuple[Bool[Array, "_ _"], ...]

    def points(self, mesh: Mesh | None = None) -> list[Float[Array, "nodes dim"]]:
        """The points of each mesh without ghosts, of `mesh` or of the batch itself."""
        points = (self.mesh if mesh is None else mesh).points
        counts = np.asarray(self.nodes).sum(axis=1)
        return [points[i, :count] for i, count in enumerate(counts)]

    def mean(self, values: tuple[Float[Array, "_ _"], ...]) -> Float[Array, " _"]:
        """Mean over the real elements of each mesh, of values given block by block."""
        sums = [jnp.where(m, v, 0).sum(axis=1) for m, v in zip(self.elements, values, strict=True)]
        return reduce(jnp.add, sums) / reduce(jnp.add, [m.sum(axis=1) for m in self.elements])

    def quality_mean(self, mesh: Mesh | None = None, metric: Metric | str = SHAPE) -> Float[Array, " batch"]:
        """Mean of a metric over the real elements that have it, of each mesh of `mesh` or of the batch."""
        mesh, metric = self.mesh if mesh is None else mesh, as_metric(metric)
        kinds = [element_type(name) for name in mesh.types]
        values = jax.vmap(partial(quality, metric=metric))(mesh)
        known = [metric.applies_to(kind) & mask for kind, mask in zip(kinds, self.elements, strict=True)]
        sums = [jnp.where(m, v, 0).sum(axis=1) for m, v in zip(known, values, strict=True)]
        return reduce(jnp.add, sums) / reduce(jnp.add, [m.sum(axis=1) for m in known])

    def run(self, method: Method | None = None, *, steps: int = 3, state: Any = None) -> Run:
        """`run` for all meshes at once, by any method: a `Run` with a batch axis on every leaf.

        `state` is what ``method.init(batch.mesh)`` has made, for methods that need it, where the connectivity
        is traced.
        """
        method = Elastic() if method is None else method
        state = method_state(method, self.mesh) if state is None else state

        def one(mesh, constraints, state):
            return run(mesh, method, constraints=constraints, steps=steps, state=state)

        return jax.vmap(one)(self.mesh, self.constraints, state)


def stack(meshes: Sequence[Any], constraints: Sequence[Motion] | None = None) -> Batch:
    """Pad meshes of one dimension to a common shape and stack them.

    Args:
        meshes: each a `Mesh` or whatever else `as_mesh` takes; their blocks may differ in size and type.
        constraints: theirs, `Constraints` each; by default those of flat faces and straight edges
            (``boundary="planar"``).

    Returns:
        The batch.

    Raises:
        ValueError: for no meshes, meshes of different dimensions, or motions that can't be padded.
    """
    meshes = [as_mesh(mesh) for mesh in meshes]
    if not meshes or len({mesh.dim for mesh in meshes}) > 1:
        raise ValueError("stack needs meshes of one dimension, at least one")
    if any(mesh.surface for mesh in meshes):
        raise ValueError("stack takes no surfaces in space; smooth them one by one")
    if constraints is None:
        constraints = [detect_constraints(m, boundary="planar", interfaces="planar") for m in meshes]
    motions: list[Constraints] = []
    for index, motion in enumerate(constraints):
        if not isinstance(motion, Constraints):
            raise ValueError(
                f"stack pads Constraints, and mesh {index} has {type(motion).__name__}; detect them with "
                "boundary='planar', and hold the nodes that move together: "
                "Constraints.hold(mesh, mesh.labels.links.members(len(mesh.points)))"
            )
        motions.append(motion)
    types = sorted({name for mesh in meshes for name in mesh.types})
    kinds = [element_type(name) for name in types]
    joined = [{name: [] for name in types} for _ in meshes]
    for blocks, mesh in zip(joined, meshes, strict=True):
        for name, nodes in zip(mesh.types, mesh.connectivity, strict=True):
            blocks[name].append(np.asarray(nodes))
    sizes = {name: max(sum(map(len, blocks[name])) for blocks in joined) for name in types}
    real = max(len(mesh.points) for mesh in meshes)
    starts = real + np.cumsum([0, *(kind.k for kind in kinds)])
    dim = meshes[0].dim

    rows = []
    for mesh, held, blocks in zip(meshes, motions, joined, strict=True):
        count = len(mesh.points)
        dtype = mesh.points.dtype
        ghosts = np.concatenate([kind.ideal for kind in kinds]).astype(dtype)
        filler = np.zeros((real - count, dim), dtype)
        points = jnp.concatenate([mesh.points, filler, ghosts])
        projectors = jnp.zeros((len(points), dim, dim), dtype).at[:count].set(held.projectors)
        connectivity, masks = [], []
        for name, kind, start in zip(types, kinds, starts, strict=False):
            nodes = np.concatenate([np.zeros((0, kind.k), np.int32), *blocks[name]])
            ghost = np.tile(np.arange(start, start + kind.k), (sizes[name] - len(nodes), 1))
            connectivity.append(np.concatenate([nodes, ghost]).astype(np.int32))
            masks.append(np.arange(sizes[name]) < len(nodes))
        rows.append((points, projectors, np.arange(len(points)) < count, connectivity, masks))
    points, projectors, nodes, connectivity, masks = zip(*rows, strict=True)
    mesh = eqx.tree_at(
        lambda m: (m.points, m.connectivity),
        Mesh(points[0], list(zip(types, connectivity[0], strict=True))),
        (jnp.stack(points), tuple(jnp.asarray(np.stack(c)) for c in zip(*connectivity, strict=True))),
    )
    return Batch(
        mesh,
        Constraints(jnp.stack(projectors)),
        jnp.asarray(np.stack(nodes)),
        tuple(jnp.asarray(np.stack(m)) for m in zip(*masks, strict=True)),
    )
