"""Finding how the nodes of a mesh may move."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np

from jaxsmooth.cells.table import ElementType, element_type
from jaxsmooth.convert.meshfile import as_mesh
from jaxsmooth.mesh.layers import layer_nodes, nodes_of, stretched
from jaxsmooth.mesh.record import Labels, Mesh
from jaxsmooth.mesh.topology import facet_keys, find_facets, kept_facets
from jaxsmooth.metrics.summary import evaluated
from jaxsmooth.motion.base import Motion
from jaxsmooth.motion.coupled import couple
from jaxsmooth.motion.directions import Directions, Noise, facet_normals, unit_tangents
from jaxsmooth.motion.features import FEATURE_ANGLE
from jaxsmooth.motion.planar import Constraints, node_mask
from jaxsmooth.motion.sides import Segments, segments_of, unique_sides
from jaxsmooth.motion.sliding import Kept, find_sliding

__all__ = ["detect_constraints"]

Nearest = Callable[[Any], Any]


def detect_constraints(
    mesh: Any,
    *,
    boundary: str | None = None,
    interfaces: str | None = None,
    feature_angle: float | None = None,
    flatness: float | None = None,
    fixed: Any = None,
    layers: str = "hold",
    freeze_aspect: float | None = None,
    surface_tolerance: float = 0.01,
    surfaces: Mapping[str, Nearest] | Sequence[tuple[Any, Nearest]] = (),
) -> Motion:
    """Find how every node may move so that the shape of the domain is kept.

    Boundary nodes slide within flat faces and along straight edges, if asked for on curved faces and along
    curved edges too; others are held.  So do nodes of interfaces between regions (`Mesh.labels`), of
    embedded surfaces and lines that the mesh names, and of the borders between boundary cells of
    different tags.

    Nodes that belong together (`Labels.links`) move together.

    A surface is kept as the boundary of a solid is: nodes slide within it, those of its borders, folds and
    other edges along these.

    Curved faces are quadratic patches through the nodes, and quadratic facets as they are.

    Args:
        mesh: a `Mesh`, a `MeshFile`, or whatever else `as_mesh` takes.
        boundary: ``"planar"``, nodes slide on what is flat or straight, those of what is curved are held;
            ``"slide"``, they slide there too; or ``"fixed"`` to hold every boundary node.  By default
            planar, or slide if `surfaces` are given or the mesh is a surface.
        interfaces: the same choice for interfaces between regions.
        feature_angle: degrees.  A sharper fold, or bend of a curve, is an edge (a corner) of the shape; 50 by
            default.  With ``"planar"``: a straight fold that is shallower belongs to a curved face, whose
            nodes are held; by default every straight fold is an edge to slide along.
        flatness: angle in radians below which facets lie in one plane.  By default it follows
            from the precision of the coordinates and the size of each facet (1e-4 at least).
        fixed: nodes to hold besides those of `Labels.held`: a mask ``[nodes]`` or indices.
        layers: ``"hold"`` to hold the nodes of boundary layers (`layer_nodes`), whose elements are
            stretched on purpose, or ``"free"``.
        freeze_aspect: hold the nodes of all elements of a greater aspect ratio (`aspect_ratios`).
        surface_tolerance: how far nodes may get away from the facets that they were on, over the length of
            the edges there.  The surface through the nodes of coarse facets is farther away than that (by
            an eighth of the angle of the fold) and is cut off there.
        surfaces: functions that give the nearest points of surfaces, ``[m, dim] -> [m, dim]`` (see
            `on_surface`), by the name of a set of a `MeshFile`, or in pairs with a mask ``[nodes]`` or
            indices.  A facet is on such a surface if all its nodes are.

    Returns:
        `Constraints`; `Sliding` where a node slides on something curved; `Coupled` where nodes follow others.

    Raises:
        ValueError: for an unknown choice or set, a mask of another length, or a number out of range.
    """
    sets = getattr(mesh, "named_sets", {})
    mesh = as_mesh(mesh)
    usual = "slide" if surfaces or mesh.surface else "planar"
    boundary, interfaces = boundary or usual, interfaces or usual
    _check(boundary, interfaces, layers, freeze_aspect, surface_tolerance)
    points = np.asarray(mesh.points, np.float64)
    count, dim = points.shape
    noise = Noise.of(np.asarray(mesh.points))
    held = node_mask(fixed, count)
    size = float(np.ptp(points, axis=0).max())
    normals, tangents = Directions(count, dim, size), Directions(count, dim, size)
    functions = _functions(surfaces, sets, count)

    all_facets = kept_facets(mesh)
    if layers == "hold":
        held |= layer_nodes(mesh, all_facets)
    if freeze_aspect is not None:
        held |= nodes_of(mesh, stretched(mesh, freeze_aspect))
    bound, parts = np.zeros(count, bool), []
    for facets in all_facets:
        outer = facets.partner < 0
        between = ~outer & (facets.partner != facets.region)
        for chosen, choice in ((outer, boundary), (between, interfaces)):
            nodes = facets.nodes[chosen]
            if choice == "fixed":
                held[nodes] = True
                continue
            normals.add(nodes, facet_normals(facets.type, points[nodes], noise.at(nodes), flatness))
            if choice == "planar":
                bound[nodes] = True
                continue
            one = chosen & ((facets.partner < 0) | (facets.region < facets.partner))  # of two sides
            regions = np.stack([facets.region[one], facets.partner[one]], axis=1)
            parts.append((facets.type, facets.nodes[one], regions))
    if mesh.surface:
        _add_rims(mesh, points, noise, flatness, tangents)
    if mesh.labels is not None:
        if mesh.labels.held is not None:
            held |= node_mask(mesh.labels.held, count)
        _add_features(mesh.labels, points, noise, flatness, normals, tangents, held)

    curved = "slide" in (boundary, interfaces)
    projectors, flat = _planar(normals, tangents, 0.0 if boundary == "slide" else feature_angle or 0.0)
    if not curved:
        projectors[held] = 0
        return couple(Constraints(jnp.asarray(projectors, mesh.points.dtype)), mesh)
    bound |= _tangled(mesh) | _linked(mesh)
    tagged, tags, lines = _tagged(mesh.labels, points)
    masks = [mask for mask, _ in functions]
    sides = unique_sides([*parts, *tagged], tags, masks, count)
    kept = Kept(points, noise, projectors, flat, sides, lines, held, bound, functions)
    angle = FEATURE_ANGLE if feature_angle is None else feature_angle
    return couple(find_sliding(kept, angle, surface_tolerance, flatness, mesh.points.dtype), mesh)


def _check(
    boundary: str, interfaces: str, layers: str, freeze_aspect: float | None, tolerance: float
) -> None:
    for name, choice in (("boundary", boundary), ("interfaces", interfaces)):
        if choice not in ("slide", "planar", "fixed"):
            raise ValueError(f"{name} must be 'slide', 'planar' or 'fixed', got {choice!r}")
    if layers not in ("hold", "free"):
        raise ValueError(f"layers must be 'hold' or 'free', got {layers!r}")
    if freeze_aspect is not None and not freeze_aspect >= 1:
        raise ValueError(f"freeze_aspect must be 1 or more, got {freeze_aspect}")
    if not 0 <= tolerance <= 1:
        raise ValueError(f"surface_tolerance must be 0 to 1, got {tolerance}")


def _linked(mesh: Mesh) -> np.ndarray:
    """Nodes that follow others or lead them ``[nodes]``: facets that others hang on do not meet theirs."""
    found = np.zeros(len(mesh.points), bool)
    if mesh.labels is not None and mesh.labels.links is not None:
        found[mesh.labels.links.nodes] = found[mesh.labels.links.parents] = True
    return found


def _tangled(mesh: Mesh) -> np.ndarray:
    """Nodes of inverted elements with mid-side nodes ``[nodes]``.

    Moves of corners and mid-side nodes along the surface get into each other's way there: interior nodes
    alone untangle more.
    """
    found = np.zeros(len(mesh.points), bool)
    if all(kind.linear for kind, _ in mesh.blocks):
        return found
    for (kind, nodes), det in zip(mesh.blocks, evaluated(mesh.bare).jacobian, strict=True):
        if not kind.linear:
            found[np.asarray(nodes)[~(np.asarray(det) > 0)]] = True
    return found


def _functions(surfaces: Any, sets: Mapping[str, Any], count: int) -> list[tuple[np.ndarray, Nearest]]:
    """A mask ``[nodes]`` and a function for each given surface."""
    if not isinstance(surfaces, Mapping):
        return [(node_mask(nodes, count), nearest) for nodes, nearest in surfaces]
    for name in surfaces:
        if name not in sets:
            known = ", ".join(sets) or "none"
            raise ValueError(f"unknown set {name!r} in surfaces; the mesh has {known}")
    return [(node_mask(sets[name], count), nearest) for name, nearest in surfaces.items()]


def _planar(normals: Directions, tangents: Directions, feature_angle: float) -> tuple[np.ndarray, np.ndarray]:
    """Projectors of the planar rule ``[nodes, dim, dim]``, and the nodes whose facets lie in one plane."""
    count, dim = normals.count, normals.dim
    projectors = np.tile(np.eye(dim), (count, 1, 1))
    on_facets, free = normals.null_space()
    flat = np.zeros(count, bool)
    flat[on_facets] = np.rint(np.trace(free, axis1=1, axis2=2)) == dim - 1
    if feature_angle > 0:
        free[normals.fold_angles(on_facets, free) < np.deg2rad(feature_angle)] = 0
    projectors[on_facets] = free
    on_lines, line = tangents.common_line()
    stays = np.einsum("nij,njk,nki->n", projectors[on_lines], line, line) > 1 - 1e-6
    projectors[on_lines] = line * stays[:, None, None]
    return projectors, flat


def _tagged(
    labels: Labels | None, points: np.ndarray
) -> tuple[list[tuple[ElementType, np.ndarray, np.ndarray]], tuple[np.ndarray, np.ndarray], list[Segments]]:
    """Tagged surfaces as lists of facets, the keys and tags of their facets, and tagged lines."""
    surfaces, keys, tags, lines = [], [np.zeros(0, np.int64)], [np.zeros(0, int)], []
    if labels is not None:
        for name, nodes, tag in zip(labels.feature_types, labels.features, labels.feature_tags, strict=True):
            kind = None if name == "vertex" else element_type(name)
            if kind is not None and kind.dim == 1:
                lines.append(segments_of(kind, nodes, points))
            elif kind is not None and points.shape[1] == 3:
                surfaces.append((kind, nodes, np.full((len(nodes), 2), -2)))
                keys.append(facet_keys(nodes[:, : kind.corners], len(points)))
                tags.append(tag)
    return surfaces, (np.concatenate(keys), np.concatenate(tags)), lines


def _add_rims(
    mesh: Mesh, points: np.ndarray, noise: Noise, flatness: float | None, tangents: Directions
) -> None:
    """Keep the edges of a surface that do not lie between two elements of one region."""
    found = [(part.type, part.nodes, part.region) for part in find_facets(mesh)]
    keys = facet_keys(np.concatenate([nodes[:, :2] for _, nodes, _ in found]), len(points))
    regions = np.concatenate([region for *_, region in found])
    _, same, number = np.unique(keys, return_inverse=True, return_counts=True)
    rim = _on_border(keys, regions) | (number[same.reshape(-1)] > 2)
    start = 0
    for kind, nodes, _ in found:
        segments = nodes[rim[start : start + len(nodes)]][:, kind.segments].reshape(-1, 2)
        tangents.add(segments, unit_tangents(points[segments], noise.at(segments), flatness))
        start += len(nodes)


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
