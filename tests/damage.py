"""Small meshes with every kind of damage, and the check that smoothing makes none of them worse.

As a program it searches for meshes that a method harms:

    python tests/damage.py --examples 3000 --shapes tetra quad9 --methods elastic

The shapes are few, so that all meshes of one share their compiled functions.
"""

from __future__ import annotations

import argparse
from dataclasses import asdict, dataclass, fields, replace
from functools import cache

import jax
import numpy as np
from meshes import KINDS, grid, hexahedra_and_pyramids, jiggle, mixed_2d, mixed_3d, rotation_matrix

import jaxsmooth as js
from jaxsmooth.cells.table import element_type
from jaxsmooth.methods import METHODS
from jaxsmooth.metrics.validity import inverted

GUARDED = tuple(name for name in METHODS if name not in ("laplacian", "weighted-laplacian", "untangle"))
SHAPES = {
    **{kind: (lambda kind=kind: grid(kind)) for kind in KINDS},
    "mixed_2d": mixed_2d,
    "mixed_2d_quadratic": lambda: mixed_2d(order=2),
    "mixed_3d": mixed_3d,
    "hexahedra_and_pyramids": hexahedra_and_pyramids,
}
QUICK = ("triangle6", "quad", "mixed_2d", "tetra")  # where compiling `optimize` takes seconds only
_ROUNDING = 1e-9


@dataclass(frozen=True)
class Damage:
    """What is done to a mesh of the unit square or cube, in this order; as it is, by default.

    Attributes:
        jiggle: largest displacement of a node; those of the boundary stay in their sides.
        collapsed: pairs of nodes of one element that come to lie at one place.
        grading: exponent of the coordinates.
        mirrored: fraction of the elements that are numbered the wrong way round.
        renumbered: nodes and elements in random order.
        stretch: factor of the first coordinate.
        shear: of the first coordinate with the last.
        turned: rotated at random.
        size: factor of all coordinates.
        shift: distance from the origin, in sizes.
        seed: of everything that is random.
    """

    jiggle: float = 0.0
    collapsed: int = 0
    grading: float = 1.0
    mirrored: float = 0.0
    renumbered: bool = False
    stretch: float = 1.0
    shear: float = 0.0
    turned: bool = False
    size: float = 1.0
    shift: float = 0.0
    seed: int = 0


CHOICES = {
    "jiggle": (0.0, 0.05, 0.1, 0.2, 0.4, 0.8),
    "collapsed": (0, 0, 0, 1, 3),
    "grading": (1.0, 1.0, 2.0, 4.0),
    "mirrored": (0.0, 0.0, 0.0, 0.0, 0.3, 1.0),
    "renumbered": (False, True),
    "stretch": (1.0, 1.0, 1e-3, 0.03, 30.0, 1e3),
    "shear": (0.0, 0.0, 0.5, 3.0),
    "turned": (False, True),
    "size": (1.0, 1e-9, 1e-4, 1e4, 1e9),
    "shift": (0.0, 0.0, 1.0, 100.0),
}


def random_damage(seed: int) -> Damage:
    """One choice of everything."""
    rng = np.random.default_rng(seed)
    return Damage(**{name: values[rng.integers(len(values))] for name, values in CHOICES.items()}, seed=seed)


@dataclass(frozen=True)
class Damaged:
    """A damaged mesh, and the planes of its box: nodes, unit normal and distance of each."""

    mesh: js.Mesh
    planes: tuple[tuple[np.ndarray, np.ndarray, float], ...]


def damaged(shape: str, damage: Damage) -> Damaged:
    """The mesh of a shape with its damage done."""
    rng = np.random.default_rng(damage.seed)
    points, blocks = SHAPES[shape]()
    sides = [(axis, np.isclose(points[:, axis], end)) for axis in range(points.shape[1]) for end in (0, 1)]
    inside = (points > 1e-9) & (points < 1 - 1e-9)
    points = jiggle(points, damage.jiggle, damage.seed)
    for _ in range(damage.collapsed):
        nodes = list(blocks.values())[rng.integers(len(blocks))]
        a, b = rng.choice(nodes[rng.integers(len(nodes))], 2, replace=False)
        points[a] = np.where(inside[a], points[b], points[a])
    points = np.sign(points) * np.abs(points) ** damage.grading
    blocks = {kind: _mirror(kind, nodes, damage.mirrored, rng) for kind, nodes in blocks.items()}
    if damage.renumbered:
        points, blocks, sides = _renumber(points, blocks, sides, rng)
    matrix, offset = _placement(points.shape[1], damage)
    points = points @ matrix.T + offset
    normals = np.linalg.inv(matrix)
    planes = []
    for axis, chosen in sides:
        normal = normals[axis] / np.linalg.norm(normals[axis])
        nodes = np.flatnonzero(chosen)
        planes.append((nodes, normal, float(np.mean(points[nodes] @ normal))))
    return Damaged(js.Mesh(points, blocks), tuple(planes))


def _mirror(kind, nodes, fraction, rng):
    chosen = rng.uniform(size=len(nodes)) < fraction
    return np.where(chosen[:, None], nodes[:, element_type(kind).mirror], nodes)


def _renumber(points, blocks, sides, rng):
    order = rng.permutation(len(points))
    number = np.argsort(order)
    blocks = {kind: rng.permutation(number[nodes]) for kind, nodes in blocks.items()}
    return points[order], blocks, [(axis, chosen[order]) for axis, chosen in sides]


def _placement(dim, damage):
    matrix = np.eye(dim)
    matrix[0] = matrix[0] * damage.stretch
    matrix[0, -1] += damage.shear
    if damage.turned:
        matrix = rotation_matrix(dim, damage.seed) @ matrix
    offset = damage.shift * np.linalg.norm(matrix) * np.ones(dim)
    return damage.size * matrix, damage.size * offset


def complaints(case: Damaged, result: js.Mesh, extended: bool = False) -> list[str]:
    """In what respects `result` is worse than the mesh that was smoothed."""
    points = np.asarray(result.points)
    if not np.isfinite(points).all():
        return ["not finite"]
    found = []
    size = np.ptp(np.asarray(case.mesh.points), axis=0).max()
    for nodes, normal, distance in case.planes:
        away = np.abs(points[nodes] @ normal - distance).max() / size
        if away > _ROUNDING * (1 + abs(distance) / size):
            found.append(f"a node left its side by {away:.0e} of the size")
    before, after = _counts(case.mesh), _counts(result)
    for name in ("inverted", "poor"):
        if after[name] > before[name]:
            found.append(f"{name}: {before[name]} -> {after[name]}")
    floors = {"q_min": 0.2, "scaled_jacobian": 0.1}
    if not extended and not before["inverted"] > after["inverted"] == 0:  # becoming valid may cost some
        floors["q_avg"] = np.inf
    for name, floor in floors.items():
        if after[name] < min(before[name], floor) - _ROUNDING:
            found.append(f"{name}: {before[name]:.6g} -> {after[name]:.6g}")
    return found


def _counts(mesh: js.Mesh) -> dict[str, float]:
    q = np.concatenate([np.asarray(part) for part in js.quality(mesh)])
    scaled = np.concatenate([np.asarray(part) for part in js.quality(mesh, "scaled_jacobian")])
    return {
        "inverted": int(sum(part.sum() for part in inverted(mesh))),
        "poor": int((q < 0.2).sum()),
        "q_min": float(q.min()),
        "q_avg": float(q.mean()),
        "scaled_jacobian": float(scaled.min()),
    }


@cache
def _method(name: str) -> js.Method:
    return METHODS[name]()


def harm(shape: str, method: str, damage: Damage, steps: int = 3) -> list[str]:
    """What a method makes worse on one damaged mesh."""
    case = damaged(shape, damage)
    result = js.smooth(case.mesh, _method(method), steps=steps, tolerance_avg=0)
    return complaints(case, result.mesh, extended="extended" in method)


def simplest(shape: str, method: str, damage: Damage) -> Damage:
    """Leave out every part of the damage that the harm does not need."""
    for field in fields(Damage):
        plainer = replace(damage, **{field.name: field.default})
        if plainer != damage and harm(shape, method, plainer):
            damage = plainer
    return damage


def main() -> int:
    """Search for harm, and show the simplest case of each shape and method."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("--examples", type=int, default=300, help="number of meshes, shared by the shapes")
    parser.add_argument("--shapes", nargs="+", choices=SHAPES, default=list(SHAPES))
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=list(GUARDED))
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    harmful = 0
    for shape in options.shapes:
        seeds = range(max(options.examples // len(options.shapes), 1))
        for method in options.methods:
            bad = [seed for seed in seeds if harm(shape, method, random_damage(seed))]
            harmful += len(bad)
            print(f"{shape:22s} {method:25s} {len(bad)} of {len(seeds)} worse", flush=True)
            for seed in bad[:1]:
                damage = simplest(shape, method, random_damage(seed))
                told = {
                    name: value for name, value in asdict(damage).items() if value != getattr(Damage, name)
                }
                print(f"    {told}: {'; '.join(harm(shape, method, damage))}", flush=True)
    return int(harmful > 0)


if __name__ == "__main__":
    raise SystemExit(main())
