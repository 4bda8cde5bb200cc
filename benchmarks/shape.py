"""A shape optimisation by L-BFGS with line search on the plate of the third notebook.

`python -m benchmarks.shape` prints one line for meshes by `js.design` and one with `js.optimum` on top.
"""

import time

import jax
import jax.numpy as jnp
import numpy as np
import optax

import jaxsmooth as js

__all__ = ["optimise"]

AROUND, ACROSS = 24, 5
SPOT = np.array([0.68, 0.66])
START = np.array([0.36, 0.40, 0.13, 0.0, 0.0])  # centre, radius, two modes of the outline
ANGLES = 2 * np.pi * (np.arange(AROUND) + 0.5) / AROUND
DIRECTIONS = np.stack([np.cos(ANGLES), np.sin(ANGLES)], axis=1)
CHANNEL = np.arange(AROUND)


def plate():
    """A ring of triangles between the channel and the square."""
    sides = DIRECTIONS / np.abs(DIRECTIONS).max(axis=1, keepdims=True) / 2 + 0.5
    hole = START[:2] + START[2] * DIRECTIONS
    layers = np.linspace(0, 1, ACROSS + 1)[:, None, None]
    points = ((1 - layers) * hole + layers * sides).reshape(-1, 2)
    for corner in np.array([[0, 0], [1, 0], [1, 1], [0, 1]], float):
        last = points[-AROUND:]
        last[np.argmin(((last - corner) ** 2).sum(axis=1))] = corner
    a = np.arange(AROUND)
    b = (a + 1) % AROUND
    layer = np.concatenate([np.stack([a, a + AROUND, b], 1), np.stack([b, a + AROUND, b + AROUND], 1)])
    return js.Mesh(points, {"triangle": np.concatenate([layer + AROUND * i for i in range(ACROSS)])})


def outline(parameters):
    cx, cy, radius, mode2, mode3 = parameters
    r = radius * (1 + mode2 * jnp.cos(2 * ANGLES) + mode3 * jnp.sin(2 * ANGLES))
    return jnp.stack([cx, cy]) + r[:, None] * DIRECTIONS


def compliance(mesh):
    """100 times the mean temperature, weighted by the heating, with the channel at temperature 0."""
    triangles = mesh.connectivity[0]
    x = mesh.points[triangles]
    edges = x[:, jnp.array([2, 0, 1])] - x[:, jnp.array([1, 2, 0])]
    double = edges[:, 0, 0] * edges[:, 1, 1] - edges[:, 0, 1] * edges[:, 1, 0]
    local = jnp.einsum("eid,ejd->eij", edges, edges) / (2 * double)[:, None, None]
    source = jnp.exp(-((x.mean(axis=1) - SPOT) ** 2).sum(axis=-1) / 0.15**2) * double / 6
    count = len(mesh.points)
    stiffness = jnp.zeros((count, count)).at[triangles[:, :, None], triangles[:, None, :]].add(local)
    load = jnp.zeros(count).at[triangles].add(source[:, None])[AROUND:]
    return 100 * load @ jnp.linalg.solve(stiffness[AROUND:, AROUND:], load)


def optimise(how: str, iterations: int):
    """Minimise by L-BFGS, the mesh made by `js.design` or by `js.optimum`.

    Returns the first and the last objective, whether it ever rose, the least determinant of all accepted
    meshes, and seconds without compilation.
    """
    mesh = plate()
    constraints = js.detect_constraints(mesh, fixed=CHANNEL)
    shaped = js.design(mesh, CHANNEL, motion=constraints, steps=3 if how == "design" else 0)

    def smoothed(parameters):
        done = shaped(outline(parameters))
        return js.optimum(done, motion=constraints).mesh if how == "optimum" else done

    scale = jnp.array([1.0, 1.0, 0.1, 1.0, 1.0])

    def objective(y):
        parameters = START + scale * y
        done = smoothed(parameters)
        price = 40 * (parameters[2] - START[2]) ** 2 + 0.3 * (parameters[3:] ** 2).sum()
        return js.if_valid(compliance(js.as_mesh(done)) + price, done)

    search = optax.scale_by_backtracking_linesearch(20, store_grad=True)
    solver = optax.lbfgs(linesearch=search)
    both = optax.value_and_grad_from_state(objective)

    @jax.jit
    def iterate(y, state):
        value, gradient = both(y, state=state)
        updates, state = solver.update(gradient, state, y, value=value, grad=gradient, value_fn=objective)
        return optax.apply_updates(y, updates), state, value

    @jax.jit
    def look(y):
        return js.evaluate(js.as_mesh(smoothed(START + scale * y))).jacobian[0].min()

    y = jnp.zeros(5)
    state = solver.init(y)
    jax.block_until_ready((iterate(y, state), look(y)))
    values, least, seconds = [], np.inf, 0.0
    for _ in range(iterations + 1):
        least = min(least, float(look(y)))
        start = time.perf_counter()
        y, state, value = jax.block_until_ready(iterate(y, state))
        seconds += time.perf_counter() - start
        values.append(float(value))
    return values[0], values[-1], bool((np.diff(values) > 1e-12).any()), least, seconds


def main() -> None:
    jax.config.update("jax_enable_x64", True)
    for how in ("design", "optimum"):
        first, last, rose, least, seconds = optimise(how, 20)
        change = f"{first:.4f} → {last:.4f} | {'yes' if rose else 'never'}"
        print(f"| `js.{how}` | {change} | {least:.1e} | {seconds:.1f} |", flush=True)


if __name__ == "__main__":
    main()
