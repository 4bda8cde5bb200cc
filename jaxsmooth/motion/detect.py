"""Finding how the nodes of a mesh may move."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np

from jaxsmooth.cells.table import element_type
from jaxsmooth.convert.meshfile import as_mesh
from jaxsmooth.mesh.layers import layer_nodes, nodes_of, stretched
from jaxsmooth.mesh.record import Labels
from jaxsmooth.mesh.topology import facet_keys, find_facets
from jaxsmooth.motion.base import Motion
from jaxsmooth.motion.coupled import couple
from jaxsmooth.motion.directions import Directions, Noise, facet_normals, unit_tangents
from jaxsmooth.motion.planar import Constraints, node_mask

__all__ = ["detect_constraints"]


def detect_constraints(
    mesh: Any,
    *,
    boundary: str = "slide",
    interfaces: str = "slide",
    feature_angle: float = 0.0,
    flatness: float | None = None,
    fixed: Any = None,
    layers: str = "hold",
    freeze_aspect: float | None = None,
) -> Motion:
    """Find how every node may move so that the shape of the domain is kept.

    Boundary nodes slide within flat faces and along straight edges and are held elsewhere.
    So do nodes of interfaces between regions (`Mesh.labels`), of embedded surfaces and lines
    that the mesh names, and of the borders between boundary cells of different tags.
    Nodes that belong together (`Labels.links`) move together.

    Args:
        mesh: a `Mesh`, or whatever else `as_mesh` takes.
        boundary: ``"slide"``, or ``"fixed"`` to hold every boundary node.
        interfaces: the same choice for interfaces between regions.
        feature_angle: degrees.  A straight fold shallower than this belongs to a curved face,
            whose nodes are held; by default every straight fold is an edge to slide along.
        flatness: angle in radians below which facets lie in one plane.  By default it follows
            from the precision of the coordinates and the size of each facet (1e-4 at least).
        fixed: nodes to hold besides those of `Labels.held`: a mask ``[nodes]`` or indices.
        layers: ``"hold"`` to hold the nodes of boundary layers (`layer_nodes`), whose elements are
            stretched on purpose, or ``"free"``.
        freeze_aspect: hold the nodes of all elements of a greater aspect ratio (`aspect_ratios`).

    Returns:
        `Constraints`, or `Coupled` ones where nodes follow others.

    Raises:
        ValueError: for an unknown choice, a mask of another length, or an aspect ratio below 1.
    """
    for name, choice in (("boundary", boundary), ("interfaces", interfaces)):
        if choice not in ("slide", "fixed"):
            raise ValueError(f"{name} must be 'slide' or 'fixed', got {choice!r}")
    if layers not in ("hold", "free"):
        raise ValueError(f"layers must be 'hold' or 'free', got {layers!r}")
    if freeze_aspect is not None and not freeze_aspect >= 1:
        raise ValueError(f"freeze_aspect must be 1 or more, got {freeze_aspect}")
    mesh = as_mesh(mesh)
    points = np.asarray(mesh.points, np.float64)
    count, dim = points.shape
    noise = Noise.of(np.asarray(mesh.points))
    held = node_mask(fixed, count)
    size = float(np.ptp(points, axis=0).max())
    normals, tangents = Directions(count, dim, size), Directions(count, dim, size)

    all_facets = find_facets(mesh)
    if layers == "hold":
        held |= layer_nodes(mesh, all_facets)
    if freeze_aspect is not None:
        held |= nodes_of(mesh, stretched(mesh, freeze_aspect))
    for facets in all_facets:
        outer = facets.partner < 0
        between = ~outer & (facets.partner != facets.region)
        for chosen, choice in ((outer, boundary), (between, interfaces)):
            nodes = facets.nodes[chosen]
            if choice == "fixed":
                held[nodes] = True
            else:
                normals.add(nodes, facet_normals(facets.type, points[nodes], noise.at(nodes), flatness))
    if mesh.labels is not None:
        if mesh.labels.held is not None:
            held |= node_mask(mesh.labels.held, count)
        _add_features(mesh.labels, points, noise, flatness, normals, tangents, held)

    projectors = np.tile(np.eye(dim), (count, 1, 1))
    on_facets, free = normals.null_space()
    if feature_angle > 0:
        free[normals.fold_angles(on_facets, free) < np.deg2rad(feature_angle)] = 0
    projectors[on_facets] = free
    on_lines, line = tangents.common_line()
    stays = np.einsum("nij,njk,nki->n", projectors[on_lines], line, line) > 1 - 1e-6
    projectors[on_lines] = line * stays[:, None, None]
    projectors[held] = 0
    return couple(Constraints(jnp.asarray(projectors, mesh.points.dtype)), mesh)


def _add_features(
    labels: Labels,
    points: np.ndarray,
    noise: Noise,
    flatness: float | None,
    normals: Directions,
    tangents: Directions,
    held: np.ndarray,
) -> None:
    """Tagged cells of lower dimension: keep their surfaces, lines, borders and vertices."""
    count, dim = points.shape
    edges, edge_tags, ends, end_tags = [], [], [], []
    for name, nodes, tags in zip(labels.feature_types, labels.features, labels.feature_tags, strict=True):
        if name == "vertex":
            held[nodes[:, 0]] = True
            continue
        kind = element_type(name)
        if kind.dim == 2 and dim == 3:
            normals.add(nodes, facet_normals(kind, points[nodes], noise.at(nodes), flatness))
            sides = nodes[:, kind.segments]
            edges.append(sides.reshape(-1, 2))
            edge_tags.append(np.repeat(tags, sides.shape[1]))
        elif kind.dim == 1:
            segments = nodes[:, kind.segments].reshape(-1, 2)
            tangents.add(segments, unit_tangents(points[segments], noise.at(segments), flatness))
            ends.append(nodes[:, :2].reshape(-1))
            end_tags.append(np.repeat(tags, 2))
    if edges:
        pairs, tags = np.concatenate(edges), np.concatenate(edge_tags)
        border = pairs[_on_border(facet_keys(pairs, count), tags)]
        tangents.add(border, unit_tangents(points[border], noise.at(border), flatness))
    if ends:
        nodes, tags = np.concatenate(ends), np.concatenate(end_tags)
        held[nodes[_on_border(nodes, tags)]] = True


def _on_border(keys: np.ndarray, tags: np.ndarray) -> np.ndarray:
    """True where a key occurs once, or with more than one tag."""
    _, group, number = np.unique(keys, return_inverse=True, return_counts=True)
    total = np.bincount(group, tags)
    square = np.bincount(group, tags.astype(float) ** 2)
    mixed = square * number - total**2 > 0.5
    return (mixed | (number == 1))[group]
