"""Derivatives against differences: `python -m benchmarks.derivatives` writes DERIVATIVES.md.

For every element type a few elements, and programs that serve all of their meshes: value and gradient by
reverse mode, slope by forward mode, and Hessian products of the energy.  Differences are of order four.
"""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_disable_most_optimizations", True)  # compiling is most of it
sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from meshes import KINDS, dim_of, ideal, mixed_2d, mixed_3d  # noqa: E402

import jaxsmooth as js  # noqa: E402

OUT = Path(__file__).with_name("DERIVATIVES.md")
INPUTS = ("interior", "boundary", "alpha", "beta", "poisson", "size")
PLACES = INPUTS[:2]
STEPS = (1e-3, 1e-4, 1e-5)  # of the differences, the best counts: near flat elements one is too long
FLOOR = 1e-3  # of the value, below which a derivative counts as that
GUARDED = ("triangle", "quad8", "tetra", "hexahedron", "quad, triangle")
ONLY_ENERGY = (  # where a step compiles for half a minute and more
    *("tetra10", "pyramid13", "pyramid14", "wedge15", "wedge18", "hexahedron20", "hexahedron27"),
    "hexahedron, wedge, pyramid, tetra",
)

HEAD = """# Derivatives

Written by `python -m benchmarks.derivatives`, in float64. Errors against differences of order four (the
best of those with steps of 1e-3, 1e-4 and 1e-5), over the norms of gradient and direction (over a thousandth
of the value where these are smaller): by nodes that are free, by nodes that are held, by α, β, ν, and the
size of the target; of products of the Hessian with a direction of all nodes, over the largest entry; of
forward against reverse mode; and of the value beside the gradient against the plain one.

A type has two elements that share a node: displaced at random (`regular`), `ideal`, the second one
`flat`, or mirrored (`inverted`). Two types and more are the mixed meshes of the tests. `energy` is
`js.energy` with `js.GivenSize`, regularised to be finite for all; `extended` an unguarded step of
`js.Elastic(extended=True)` with `js.GivenSize`; `guarded` a step of `js.Elastic()`; Laplacians have
their names. After steps the derivative is that of a sum of all coordinates and the mean quality.

| type | function | mesh | free | held | α | β | ν | size | Hessian | forward | value |
|---|---|---|---|---|---|---|---|---|---|---|---|
"""

REST = """
First derivatives are within 1e-6 and Hessian products within 1e-5, but for steps at some flat elements,
up to 9e-5. By numbers longer differences agree better there: the linear systems are badly conditioned,
and rounding limits what can be seen. By nodes differences converge slowly in 3D, where the quality is a
power 4/3 of the determinant. The energy's barrier takes the least of several corners: its second
derivative jumps where another one becomes the least, and a difference across that says nothing.
`extended` has a kink where all elements are ideal, for its weights (1 − q) / (1 − q_min) are 0 / 0
there, and is not in the table. Accepted fractions of guarded moves are constants: the differences are
between meshes where they are the same. No difference is one-sided.

Left out, for they compile for long: unguarded steps of quadratic types in 3D
([test_gradients.py](../tests/test_gradients.py) has one of every sort) and of the mixed mesh in 3D, guarded
steps of most types, Hessian products of steps. Elsewhere are surfaces
([test_given.py](../tests/test_given.py)), `optimum` ([test_energy.py](../tests/test_energy.py)),
`fixed_point` ([test_derivatives.py](../tests/test_derivatives.py)), and boundaries that turn
([test_following.py](../tests/test_following.py)).

## A shape optimisation by L-BFGS with line search

The plate of the third notebook ([shape.py](shape.py)), 20 iterations. A mesh is valid if the least
determinant of all is positive; seconds are without compiling.

| mesh by | objective | it rose | least determinant | seconds |
|---|---|---|---|---|
"""


def bases() -> Iterator[tuple[str, js.Mesh, dict[str, np.ndarray]]]:
    """Name, mesh, and the places of its nodes in every state."""
    for kind in KINDS:
        one, dim, rng = ideal(kind), dim_of(kind), np.random.default_rng(5)
        one = one - one[0]
        k = len(one)
        turn = np.diag([-1.0, -1.0, 1.0][:dim])
        shear = np.eye(dim)
        shear[-1] = [0.4, 0.3, 0.0][-dim:] if dim == 3 else [0.4, 0.0]
        mirror = np.diag([1.0, 1.0, -1.0][3 - dim :])
        nodes = np.stack([np.arange(k), np.r_[0, np.arange(k, 2 * k - 1)]])
        noise = 0.06 * rng.uniform(-1, 1, (2 * k - 1, dim))
        both = [np.concatenate([one, (one @ m @ turn)[1:]]) for m in (np.eye(dim), shear, mirror)]
        places = {
            "regular": both[0] + noise,
            "ideal": both[0],
            "flat": both[1] + np.where(np.arange(2 * k - 1)[:, None] < k, noise, 0),
            "inverted": both[2] + noise,
        }
        yield kind, js.Mesh(places["regular"], {kind: nodes}), places
    for points, blocks in (mixed_2d(0.1), mixed_3d(0.1)):
        yield ", ".join(blocks), js.Mesh(points, blocks), {"regular": points}


def functions(name: str, mesh: js.Mesh) -> Iterator[tuple[str, tuple[str, ...], Callable]]:
    """Name, the inputs that it depends on, and the function of them and of the places of the nodes."""
    rng = np.random.default_rng(7)
    held, free = halves(mesh)
    motion = js.Constraints.hold(mesh, held)
    weights = rng.normal(size=mesh.points.shape)

    def placed(at, base):
        return mesh.with_points(base.at[held].add(at["boundary"]).at[free].add(at["interior"]))

    def energy(at, base):
        target = js.GivenSize(size=at["size"], weight=0.3)
        return js.energy(placed(at, base), target=target, regularisation=0.3)

    def after(method, at, base):
        done = js.step(placed(at, base), method, motion)
        return (done.points * weights).sum() + js.quality_mean(done)

    def extended(at, base):
        sized, material = js.GivenSize(size=at["size"]), js.Material(1.0, at["poisson"])
        rest = {"target": sized, "material": material, "guard": None, "tolerance": 1e-13}
        return after(js.Elastic(extended=True, alpha=at["alpha"], beta=at["beta"], **rest), at, base)

    def own(at, base):
        material = js.Material(1.0, at["poisson"])
        return after(js.Elastic(alpha=at["alpha"], material=material, tolerance=1e-13), at, base)

    yield "energy", ("interior", "boundary", "size"), energy
    if name not in ONLY_ENERGY:
        yield "extended", INPUTS, extended
    if name in GUARDED:
        yield "guarded", ("interior", "boundary", "alpha", "poisson"), own
    if name == "quad, triangle":
        for what, method in (
            ("Laplacian", js.Laplacian()),
            ("weighted Laplacian", js.Laplacian(weighted=True)),
            ("smart Laplacian", js.Laplacian(smart=True)),
        ):
            yield what, INPUTS[:2], partial(after, method)


def halves(mesh: js.Mesh) -> tuple[np.ndarray, np.ndarray]:
    """The nodes that are held, and the others: of every element enough that it can't turn."""
    count = len(mesh.points)
    if len(mesh.types) == 1:
        held = np.r_[: mesh.dim, (count + 1) // 2 : (count + 1) // 2 + mesh.dim - 1]
    else:
        held = np.sort(np.random.default_rng(3).permutation(count)[: count // 2])
    return held, np.setdiff1d(np.arange(count), held)


def start(mesh: js.Mesh, inputs: tuple[str, ...]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Where derivatives are taken, and in which direction of every input."""
    held, free = halves(mesh)
    rng = np.random.default_rng(11)
    size = 0.8 * float(np.mean([np.abs(part).mean() for part in js.quality(mesh, metric="measure")]))
    numbers = {"alpha": 0.9, "beta": 1.8, "poisson": 0.2, "size": size}
    at = {key: jnp.asarray(value) for key, value in numbers.items()}
    at |= {"interior": jnp.zeros((len(free), mesh.dim)), "boundary": jnp.zeros((len(held), mesh.dim))}
    at = {key: at[key] for key in inputs}
    ways = {key: rng.normal(size=value.shape) if value.ndim else 0.3 * value for key, value in at.items()}
    return at, jax.tree.map(jnp.asarray, ways)


def order_four(values: list[Any], step: float) -> Any:
    """The difference of order four, of values at −2, −1, 1 and 2 steps."""
    return jax.tree.map(lambda a, b, c, d: (a - 8 * b + 8 * c - d) / (12 * step), *values)


def row(function: Callable, second: bool, mesh: js.Mesh, inputs: tuple[str, ...]) -> Callable:
    """A function of the places of nodes that gives the errors, as cells of a row."""

    @jax.jit
    def first(at, base):
        return jax.value_and_grad(function)(at, base)

    @jax.jit
    def along(at, way, base):
        inner = jax.value_and_grad(function) if second else function
        return jax.jvp(lambda at: inner(at, base), (at,), (way,))[1]

    plain = jax.jit(function)
    at, ways = start(mesh, inputs)
    every = {key: way * (key in PLACES) for key, way in ways.items()}

    def errors(base):
        (value, gradient), cells, forward = first(at, base), dict.fromkeys(INPUTS, ""), []
        for key in inputs:
            way = {k: w if k == key else jnp.zeros_like(w) for k, w in ways.items()}
            differences = [
                order_four([first(moved(at, way, k * step), base)[0] for k in (-2, -1, 1, 2)], step)
                for step in STEPS
            ]
            found = (gradient[key] * way[key]).sum()
            scale = jnp.linalg.norm(gradient[key]) * jnp.linalg.norm(way[key])
            scale = jnp.maximum(scale, FLOOR * jnp.abs(value))
            cells[key] = min(float(jnp.abs(found - part) / scale) for part in differences)
            slope = along(at, way, base)
            forward.append(float(jnp.abs(found - (slope[0] if second else slope)) / scale))
        bend = ""
        if second:
            found = along(at, every, base)[1]
            most = max(float(jnp.abs(found[key]).max()) for key in inputs)
            bend = min(bent(first, at, every, base, found, step) / most for step in STEPS)
        apart = float(jnp.abs(plain(at, base) - value) / jnp.abs(value))
        same = "same" if apart == 0 else apart
        return [*cells.values(), bend, max(forward), same]

    return errors


def bent(first: Callable, at: Any, way: Any, base: Any, found: Any, step: float) -> float:
    """The largest distance of a product of the Hessian from the difference of gradients."""
    expected = order_four([first(moved(at, way, k * step), base)[1] for k in (-2, -1, 1, 2)], step)
    return max(
        float(jnp.abs(a - b).max()) for a, b in zip(*map(jax.tree.leaves, (found, expected)), strict=True)
    )


def moved(at: dict[str, Any], way: dict[str, Any], step: float) -> dict[str, Any]:
    return jax.tree.map(lambda a, w: a + step * w, at, way)


def shown(cell: float | str) -> str:
    return cell if isinstance(cell, str) else f"{cell:.0e}"


def checks(names: list[str]) -> Iterator[tuple[str, float]]:
    """Rows of the table, and the seconds that each took."""
    for name, mesh, places in bases():
        if names and name not in names:
            continue
        for what, inputs, function in functions(name, mesh):
            errors = row(function, what == "energy", mesh, inputs)
            for state, points in places.items():
                if (what, state) == ("extended", "ideal"):
                    continue  # the weights (1 − q) / (1 − q_min) have no derivative there
                begin = time.perf_counter()
                cells = " | ".join(map(shown, errors(jnp.asarray(points))))
                yield f"| {name} | {what} | {state} | {cells} |", time.perf_counter() - begin
        jax.clear_caches()


def main() -> None:
    lines = []
    for line, seconds in checks(sys.argv[1:]):
        print(line, f"{seconds:.0f} s", flush=True)
        lines.append(line)
    if not sys.argv[1:]:
        # in a process of its own, compiled as for users
        shapes = [sys.executable, "-m", "benchmarks.shape"]
        shaped = subprocess.run(shapes, check=True, capture_output=True, text=True).stdout
        OUT.write_text(HEAD + "\n".join(lines) + "\n" + REST + shaped)


if __name__ == "__main__":
    main()
