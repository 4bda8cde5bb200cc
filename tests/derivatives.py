"""Derivatives against differences, for the tests that take them."""

import jax

import jaxsmooth as js


def objective(mesh, weights):
    """A smooth function of all coordinates and of the quality of all elements."""
    return (mesh.points * weights).sum() + js.quality_mean(mesh)


def check(function, at, direction, step=1e-6, rtol=1e-6):
    """Reverse and forward derivatives against a fourth-order central difference."""
    both = jax.jit(jax.value_and_grad(function))

    def value(offset):
        return float(both(jax.tree.map(lambda a, d: a + offset * d, at, direction))[0])

    values = [value(k * step) for k in (-2, -1, 1, 2)]
    expected = (values[0] - 8 * values[1] + 8 * values[2] - values[3]) / (12 * step)
    gradient = both(at)[1]
    found = sum(jax.tree.leaves(jax.tree.map(lambda g, d: (g * d).sum(), gradient, direction)))
    # rounding of the values bounds what a difference can show
    floor = 1e-15 * max(map(abs, values)) / step
    assert abs(float(found) - expected) <= rtol * abs(expected) + floor, (float(found), expected)
    return gradient
