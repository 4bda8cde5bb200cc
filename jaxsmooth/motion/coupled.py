"""Nodes that move together: periodic ones, those of one place, and those that hang on larger elements.

`NodeLinks` say of single nodes what they depend on.  Here this is brought into the form of `Links`, in which
every node either leads or follows leaders: nodes joined by rigid links become groups, ``u_node = Q v``
with one displacement v for a group, and groups that hang on others are expressed by those that do not.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.sparse import coo_matrix, csr_matrix
from scipy.sparse.csgraph import connected_components

from jaxsmooth.mesh.links import NodeLinks
from jaxsmooth.mesh.record import Mesh
from jaxsmooth.motion.base import Motion
from jaxsmooth.motion.planar import Constraints
from jaxsmooth.numerics.admissible import Admissible, Links
from jaxsmooth.numerics.small import Frame

__all__ = ["Coupled", "couple"]

_ANGLE = 1e-3  # radians: directions that differ by less are one and the same
_EQUAL = 1e-6  # of rotations and weights, which files have to so many digits
_SNAP = 1e-12  # components of a direction, and weights, below this are rounding
_LEVELS = 12  # squarings: so many powers of two of nodes may hang on one another

Field = Float[Array, "nodes dim"]


class Coupled(Motion):
    """A motion some of whose nodes follow others.

    `couple` makes one from what a mesh says.  In a record made by hand leaders must not be admitted what
    their followers are not: only the leaders' tangents count.

    Attributes:
        base: what the leading nodes may do.
        links: which nodes follow them.
    """

    base: Motion
    links: Links

    @property
    def freedom(self) -> np.ndarray:
        """Free directions of every node ``[nodes]``, where `base` has them as `Constraints` do."""
        free = self.base.freedom.copy()  # pyright: ignore[reportAttributeAccessIssue]  # see above
        free[np.asarray(self.links.dependent)] = free[np.asarray(self.links.parents)].max(axis=1)
        return free

    def at(self, points: Field) -> Admissible:
        """The tangents of the leading nodes, and the links."""
        projectors = _uncoupled(self.base.at(points)).projectors
        return Admissible(projectors.at[self.links.dependent].set(0), self.links)

    def retract(self, points: Field, move: Field) -> Field:
        """The leading nodes go first; ``x + R Σ weight · (new − old)`` is where the others end."""
        return self.links.carried(points, self.base.retract(points, move))

    def within(self, frame: Frame) -> Coupled:
        """The links are between displacements, the same in every frame."""
        return Coupled(self.base.within(frame), self.links)


def couple(motion: Motion, mesh: Mesh, links: NodeLinks | None = None) -> Motion:
    """Let nodes of a mesh move together.

    Of nodes that belong together none may do what another one may not: tangents are intersected, at the
    present points.  So a held node holds its group; a group that is linked to itself by a rotation (nodes
    on its axis) moves along the axis only; and nodes that others hang on keep to what these may do.
    Groups that depend on each other in a way that fits no single rotation are held.

    Args:
        motion: what the nodes may do by themselves.
        mesh: the mesh.
        links: by default `mesh.labels.links`.

    Returns:
        `Coupled`, or, where no node has to follow another, `motion` with more nodes held.

    Raises:
        ValueError: for a motion that has dependent nodes already.
    """
    if links is None and mesh.labels is not None:
        links = mesh.labels.links
    if links is None or len(links.nodes) == 0:
        return motion
    tangents = np.array(_uncoupled(motion.at(mesh.points)).projectors, np.float64)
    groups, hanging = _resolve(links, len(mesh.points))
    bound, projectors, still = _limits(groups, hanging, tangents)
    dtype = mesh.points.dtype
    if isinstance(motion, Constraints):
        tangents[bound] = projectors
        motion = Constraints(jnp.asarray(tangents, dtype))
    elif len(bound):
        limits = np.tile(np.eye(mesh.dim), (len(mesh.points), 1, 1))
        limits[bound] = projectors
        motion = motion & Constraints(jnp.asarray(limits, dtype))
    following = _links(groups, hanging, still, dtype)
    return Coupled(motion, following) if len(following.dependent) else motion


def _uncoupled(tangents: Admissible) -> Admissible:
    if tangents.links is not None:
        raise ValueError("a motion with dependent nodes can't be coupled again; give it all links at once")
    return tangents


class _Groups(NamedTuple):
    """Nodes joined by rigid links.

    Attributes:
        of: group of every node ``[nodes]``.
        turn: Q of every node ``[nodes, dim, dim]``.
        leader: the node of every group that has Q = I ``[groups]``.
        barred: what its links keep a group from, as a sum of squares ``[groups, dim, dim]``: only the null
            space of it is left.
    """

    of: np.ndarray
    turn: np.ndarray
    leader: np.ndarray
    barred: np.ndarray


class _Hanging(NamedTuple):
    """Groups that hang on others, which do not: ``v = S Σ weight · v_parent``.

    Attributes:
        groups: ``[m]``.
        parents: groups ``[m, p]``; where there are fewer, the first again.
        weights: ``[m, p]``.
        turn: S ``[m, dim, dim]``.
    """

    groups: np.ndarray
    parents: np.ndarray
    weights: np.ndarray
    turn: np.ndarray


# --- Who leads -------------------------------------------------------------------------------------


def _resolve(links: NodeLinks, count: int) -> tuple[_Groups, _Hanging]:
    rigid = links.rigid
    groups, rest = _grouped(links.select(rigid), count), links.select(~rigid)
    while True:  # every round with objections takes a group out of those that hang
        hanging, wrong = _expressed(groups, rest)
        if not wrong.any():
            return groups, hanging
        own = groups.of[rest.nodes]
        gone = np.isin(own, own[wrong])
        groups.barred[own[gone]] += np.eye(links.rotations.shape[-1])
        groups.barred[groups.of[rest.parents[gone]]] += np.eye(links.rotations.shape[-1])
        rest = rest.select(~gone)


def _grouped(links: NodeLinks, count: int) -> _Groups:
    """Follow rigid links from the lowest node of each group outwards."""
    dim = links.rotations.shape[-1]
    one, other, rotation = links.nodes, links.parents[:, 0], links.rotations
    graph = coo_matrix((np.ones(len(one), np.int8), (one, other)), shape=(count, count))
    number, of = connected_components(graph, directed=False)
    leader = np.full(number, count)
    np.minimum.at(leader, of, np.arange(count))
    turn, known = np.tile(np.eye(dim), (count, 1, 1)), np.zeros(count, bool)
    known[leader] = True
    start, end = np.concatenate([other, one]), np.concatenate([one, other])
    both = np.concatenate([rotation, rotation.swapaxes(1, 2)])
    while (new := known[start] & ~known[end]).any():
        turn[end[new]] = both[new] @ turn[start[new]]
        known[end[new]] = True
    # v = C v by every link; along its cycle a group moves within the null space of C − I
    cycle = turn[one].swapaxes(1, 2) @ rotation @ turn[other] - np.eye(dim)
    cycle[np.abs(cycle) < _EQUAL] = 0
    barred = np.zeros((number, dim, dim))
    np.add.at(barred, of[one], cycle.swapaxes(1, 2) @ cycle)
    return _Groups(of, turn, leader, barred)


def _expressed(groups: _Groups, links: NodeLinks) -> tuple[_Hanging, np.ndarray]:
    """Groups that hang expressed by those that do not, and the links that this contradicts ``[links]``.

    Every link says ``v = Σ w Qᵀ R Q_parent v_parent``.  With the first link of each group that hangs, and
    the identity for all others, that is a matrix; its powers map to those that do not hang.
    """
    dim = links.rotations.shape[-1]
    if len(links.nodes) == 0:
        nothing = np.zeros(0, int)
        empty = _Hanging(nothing, np.zeros((0, 1), int), np.zeros((0, 1)), np.zeros((0, dim, dim)))
        return empty, np.zeros(0, bool)
    involved, places = np.unique(
        groups.of[np.concatenate([links.nodes[:, None], links.parents], axis=1)], return_inverse=True
    )
    places = places.reshape(len(links.nodes), -1)
    own, count = places[:, 0], len(involved)
    turn = groups.turn[links.nodes].swapaxes(1, 2) @ links.rotations
    blocks = turn[:, None] @ groups.turn[links.parents] * links.weights[..., None, None]
    said = _block_matrix(
        np.repeat(np.arange(len(own)), places.shape[1] - 1),
        places[:, 1:].ravel(),
        blocks.reshape(-1, dim, dim),
        (len(own), count),
    )
    hangs, first = np.unique(own, return_index=True)
    stays = np.setdiff1d(np.arange(count), hangs)
    identity = _block_matrix(stays, stays, np.tile(np.eye(dim), (len(stays), 1, 1)), (count, count))
    place = _block_matrix(hangs, first, np.tile(np.eye(dim), (len(hangs), 1, 1)), (count, len(own)))
    power = place @ said + identity
    for _ in range(_LEVELS):
        if not np.isin(power.indices // dim, hangs).any():
            break
        power = power @ power
        power.data[np.abs(power.data) < _SNAP] = 0
        power.eliminate_zeros()
    hanging, wrong = _factors(power[_entries(hangs, dim)].tocsr(), hangs, dim)
    apart = np.abs((said @ power - power[_entries(own, dim)]).tocsr()).max(axis=1).toarray()
    apart = (apart.reshape(-1, dim) > _EQUAL).any(axis=1)
    return _Hanging(involved[hangs], involved[hanging.parents], hanging.weights, hanging.turn), (
        apart | np.isin(own, hangs[wrong])
    )


def _block_matrix(rows: np.ndarray, columns: np.ndarray, blocks: np.ndarray, shape: tuple[int, int]):
    """A matrix of `shape` blocks ``[m, dim, dim]``, which are added where they meet."""
    dim = blocks.shape[-1]
    i = np.broadcast_to(rows[:, None, None] * dim + np.arange(dim)[:, None], blocks.shape)
    j = np.broadcast_to(columns[:, None, None] * dim + np.arange(dim), blocks.shape)
    size = (shape[0] * dim, shape[1] * dim)
    found = csr_matrix((blocks.ravel(), (i.ravel(), j.ravel())), size)
    found.eliminate_zeros()
    return found


def _entries(blocks: np.ndarray, dim: int) -> np.ndarray:
    return (blocks[:, None] * dim + np.arange(dim)).ravel()


def _factors(rows: csr_matrix, hangs: np.ndarray, dim: int) -> tuple[_Hanging, np.ndarray]:
    """Rows of blocks ``weight · S``, and a mask ``[m]`` of those that have no common S."""
    matrix = rows.tobsr((dim, dim))
    row, data = np.repeat(np.arange(len(hangs)), np.diff(matrix.indptr)), matrix.data
    size = np.sqrt((data**2).sum(axis=(1, 2)) / dim)
    order = np.lexsort((-size, row))  # the largest of every row comes first
    order = order[size[order] > _SNAP]
    row, column, data, size = row[order], matrix.indices[order], data[order], size[order]
    number = np.bincount(row, minlength=len(hangs))
    start = np.cumsum(number) - number
    turn, some = np.tile(np.eye(dim), (len(hangs), 1, 1)), number > 0
    turn[some] = data[start[some]] / size[start[some], None, None]
    turn[np.abs(turn - np.eye(dim)).max(axis=(1, 2)) < _SNAP] = np.eye(dim)
    weight = np.einsum("mij,mij->m", data, turn[row]) / dim
    uneven = np.abs(data - weight[:, None, None] * turn[row]).max(axis=(1, 2)) > _EQUAL
    straight = np.abs(turn @ turn.swapaxes(1, 2) - np.eye(dim)).max(axis=(1, 2)) < _EQUAL
    wrong = ~straight | ~some | (np.bincount(row, uneven, minlength=len(hangs)) > 0)
    wrong |= np.bincount(row, np.isin(column, hangs), minlength=len(hangs)) > 0  # they go round in a circle
    parents = np.tile(column[np.minimum(start, len(column) - 1)][:, None], number.max(initial=1))
    weights = np.zeros(parents.shape)
    slot = np.arange(len(row)) - start[row]
    parents[row, slot], weights[row, slot] = column, weight
    return _Hanging(hangs, parents, weights, turn), wrong


# --- What they may do --------------------------------------------------------------------------------


def _limits(groups: _Groups, hanging: _Hanging, tangents: np.ndarray) -> tuple[np.ndarray, ...]:
    """Nodes from which the links take some freedom, their projectors, and the groups that stay ``[groups]``.

    Tangents of the nodes that follow, turned back, bind those that they follow.
    """
    dim, number = tangents.shape[-1], len(groups.leader)
    identity, leads = np.eye(dim), hanging.weights != 0
    linked = (np.bincount(groups.of) > 1) | groups.barred.any(axis=(1, 2))
    linked[hanging.groups] = linked[hanging.parents] = True
    barred, nodes = groups.barred.copy(), np.flatnonzero(linked[groups.of])
    turn = groups.turn[nodes]
    np.add.at(barred, groups.of[nodes], turn.swapaxes(1, 2) @ (identity - tangents[nodes]) @ turn)
    own = identity - _null_space(barred[hanging.groups])
    own = hanging.turn.swapaxes(1, 2) @ own @ hanging.turn
    np.add.at(barred, hanging.parents[leads], np.repeat(own, leads.sum(axis=1), axis=0))
    allowed = np.tile(identity, (number, 1, 1))
    allowed[linked] = _null_space(barred[linked])
    still = ~np.any(allowed, axis=(1, 2))
    still[hanging.groups] = (still[hanging.parents] | ~leads).all(axis=1)
    less = linked & (still | (_rank(allowed) < _rank(tangents[groups.leader])))
    bound = np.union1d(groups.leader[less], nodes[still[groups.of[nodes]]])
    return bound, np.where(still[groups.of[bound], None, None], 0, allowed[groups.of[bound]]), still


def _null_space(squares: np.ndarray) -> np.ndarray:
    """Projectors onto the null space of sums of squares of unit size ``[m, dim, dim]``."""
    values, vectors = np.linalg.eigh(squares)
    vectors = np.where(np.abs(vectors) < _SNAP, 0, vectors) * (values < _ANGLE**2 / 2)[:, None, :]
    return vectors @ vectors.swapaxes(1, 2)


def _rank(projectors: np.ndarray) -> np.ndarray:
    return np.rint(np.trace(projectors, axis1=1, axis2=2)).astype(int)


def _links(groups: _Groups, hanging: _Hanging, still: np.ndarray, dtype) -> Links:
    """The nodes that follow others, but for those that stay."""
    nodes = np.arange(len(groups.of))
    place = np.full(len(groups.leader), -1)
    place[hanging.groups] = np.arange(len(hanging.groups))
    hangs = place[groups.of] >= 0
    moves = ~still[groups.of]
    rigid = nodes[moves & ~hangs & (nodes != groups.leader[groups.of])]
    hung = nodes[moves & hangs]
    own, width = place[groups.of[hung]], hanging.parents.shape[1]
    parents = [np.tile(groups.of[rigid, None], width), hanging.parents[own]]
    weights = [np.tile(np.eye(1, width), (len(rigid), 1)), hanging.weights[own]]
    turns = [groups.turn[rigid], groups.turn[hung] @ hanging.turn[own]]
    return Links(
        jnp.asarray(np.concatenate([rigid, hung]), jnp.int32),
        jnp.asarray(groups.leader[np.concatenate(parents)], jnp.int32),
        jnp.asarray(np.concatenate(weights), dtype),
        jnp.asarray(np.concatenate(turns), dtype),
    )
