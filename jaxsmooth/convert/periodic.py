"""Periodic nodes: those that a file links, and those that are found by matching on request."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from scipy.spatial import cKDTree  # pyright: ignore[reportAttributeAccessIssue]  # compiled, no stub

from jaxsmooth.convert.meshfile import as_mesh
from jaxsmooth.convert.rigid import rotation_about
from jaxsmooth.mesh.links import NodeLinks
from jaxsmooth.mesh.topology import Facets, facet_keys, find_facets, lengths
from jaxsmooth.numerics.rounding import CLOSE, ROUNDINGS, coordinate_error

__all__ = ["find_periodic"]

_MESHERS = 1e-8  # of the size of a mesh: so exactly do meshers copy a face at least
_PLANES = 100  # faces of more planes than this are curved


def find_periodic(
    mesh: Any,
    along: Any = "",
    *,
    angle: float | None = None,
    axis: Any = "z",
    origin: Any = None,
    tolerance: float | None = None,
) -> NodeLinks:
    """Find boundary nodes that a translation or a rotation takes to others, facet by facet.

    With ``mesh.with_links(find_periodic(mesh, "xyz"))`` they move together in all runs.

    Args:
        mesh: a `Mesh`, or whatever else `as_mesh` takes.
        along: axes, such as ``"xy"``, along which the mesh repeats after its own extent; or vectors
            ``[m, dim]`` in units of length.
        angle: degrees after which the mesh repeats about an axis, such as 90 for a quarter of a disc.
        axis: of the rotation: ``"x"``, ``"y"``, ``"z"`` or a vector; in the plane it is normal to it.
        origin: a point of the axis ``[dim]``; by default zero.
        tolerance: how far nodes may be from the place of their partner; by default it follows from the
            precision of the coordinates and from the shortest edge of the boundary.

    Returns:
        The links: the second node of a pair does what the first does, turned by the rotation.

    Raises:
        ValueError: nothing is asked for, or faces do not match.
    """
    mesh = as_mesh(mesh)
    given = np.asarray(mesh.points)
    points = given.astype(np.float64)
    boundary = [facets.select(facets.partner < 0) for facets in find_facets(mesh)]
    nodes = np.unique(np.concatenate([facets.nodes.ravel() for facets in boundary]))
    if tolerance is None:
        size = np.ptp(points[nodes], axis=0).max()
        shortest = min(_shortest(points, facets) for facets in boundary)
        tolerance = max(ROUNDINGS * float(coordinate_error(given)[nodes].max()), _MESHERS * size)
        tolerance = min(tolerance, CLOSE * shortest)
    parts = []
    centre = np.zeros(mesh.dim) if origin is None else np.asarray(origin, np.float64)
    for rotation, shift, words in _maps(points[nodes], along, angle, axis):
        image = (points - centre) @ rotation.T + centre + shift
        pairs = _matched(points, image, boundary, nodes, tolerance, words)
        parts.append(NodeLinks.pairs(pairs[:, ::-1], rotation))
    found = NodeLinks.join(parts)
    if found is None:
        raise ValueError(
            "nothing to find: give axes or vectors that the mesh repeats along, or an angle, such as "
            'find_periodic(mesh, "xy") or find_periodic(mesh, angle=90)'
        )
    return found


def _maps(
    points: np.ndarray, along: Any, angle: float | None, axis: Any
) -> Iterator[tuple[np.ndarray, np.ndarray, str]]:
    """Rotation, translation and their name for all that is asked for."""
    dim = points.shape[1]
    if isinstance(along, str):
        if set(along) - set("xyz"[:dim]):
            raise ValueError(f"periodic axes must be some of {', '.join('xyz'[:dim])}, got {along!r}")
        extent = np.ptp(points, axis=0)
        vectors = [np.eye(dim)["xyz".index(name)] * extent["xyz".index(name)] for name in along]
    else:
        vectors = [np.asarray(vector, np.float64) for vector in along]
    for vector in vectors:
        if vector.shape != (dim,) or not np.isfinite(vector).all() or not vector.any():
            raise ValueError(f"a translation must have {dim} components, not all 0, got {vector.tolist()}")
        yield np.eye(dim), vector, f"the translation by {vector.tolist()}"
    if angle is not None:
        yield rotation_about(axis, angle, dim), np.zeros(dim), f"the rotation by {angle:g} degrees"


def _shortest(points: np.ndarray, facets: Facets) -> float:
    ends = facets.nodes[:, facets.type.segments].reshape(-1, 2)
    return float(lengths(points, ends).min(initial=np.inf))


def _matched(
    points: np.ndarray,
    image: np.ndarray,
    boundary: Sequence[Facets],
    nodes: np.ndarray,
    tolerance: float,
    words: str,
) -> np.ndarray:
    """Nodes and their partners ``[m, 2]`` on facets whose images are facets."""
    distance, index = cKDTree(points[nodes]).query(image[nodes])
    partner = np.full(len(points), -1)
    partner[nodes] = np.where(distance <= tolerance, nodes[index], -1)
    chosen = []
    for facets in boundary:
        corners = facets.nodes[:, : facets.type.corners]
        whole = np.all(partner[facets.nodes] >= 0, axis=1)
        keys = facet_keys(np.concatenate([partner[corners[whole]], corners]), len(points))
        known = np.isin(keys[: whole.sum()], keys[whole.sum() :])
        whole[whole] = known & (partner[corners[whole]] != corners[whole]).any(axis=1)
        chosen.append(whole)
    if not any(part.any() for part in chosen):
        raise ValueError(
            f"the faces do not match: no boundary facet lies on another one after {words}, within "
            f"{tolerance:.1e}; check it, and mesh the two faces alike"
        )
    for facets, first in zip(boundary, chosen, strict=True):
        ends = facets.nodes[first]
        _check_faces(points, facets, first, points[ends], tolerance, words, "has no partner")
        back = np.isin(_keys(facets.nodes, facets, points), _keys(partner[ends], facets, points))
        _check_faces(points, facets, back, points[partner[ends]], tolerance, words, "is nobody's partner")
    ends = np.unique(np.concatenate([f.nodes[c].ravel() for f, c in zip(boundary, chosen, strict=True)]))
    return np.stack([ends, partner[ends]], axis=1)


def _keys(nodes: np.ndarray, facets: Facets, points: np.ndarray) -> np.ndarray:
    """Codes of facets that do not depend on which others there are."""
    weights = np.random.default_rng(0).integers(2**63, size=len(points), dtype=np.uint64)
    return weights[nodes[:, : facets.type.corners]].sum(axis=1)


def _check_faces(
    points: np.ndarray,
    facets: Facets,
    matched: np.ndarray,
    places: np.ndarray,
    tolerance: float,
    words: str,
    what: str,
) -> None:
    """Facets in the planes of matched ones have to be matched too."""
    normals = _normals(places)
    known = np.isfinite(normals).all(axis=1)
    planes = np.concatenate([normals, np.einsum("md,md->m", normals, places[:, 0])[:, None]], axis=1)[known]
    planes = planes[
        np.unique(np.round(planes / (np.abs(planes).max(initial=1) * 1e-6)), axis=0, return_index=True)[1]
    ]
    if len(planes) > _PLANES:
        return
    rest = np.flatnonzero(~matched)
    own = _normals(points[facets.nodes[rest]])
    for plane in planes:
        away = np.abs(points[facets.nodes[rest]] @ plane[:-1] - plane[-1]).max(axis=1)
        wrong = np.flatnonzero((away <= tolerance) & (own @ plane[:-1] > 0))
        if len(wrong):
            facet = facets.nodes[rest[wrong[0]]]
            raise ValueError(
                f"the faces do not match: the facet of nodes {facet.tolist()} {what} after {words}, within "
                f"{tolerance:.1e} ({len(wrong)} such facets there); mesh the two faces alike"
            )


def _normals(places: np.ndarray) -> np.ndarray:
    """Unit normals of facets ``[m, k, dim]`` by their first corners."""
    along = places[:, 1] - places[:, 0]
    if places.shape[-1] == 2:
        normals = np.stack([along[:, 1], -along[:, 0]], axis=1)
    else:
        normals = np.cross(along, places[:, 2] - places[:, 0])
    size = np.linalg.norm(normals, axis=1)[:, None]
    return np.divide(normals, size, out=np.full(normals.shape, np.nan), where=size > 0)
