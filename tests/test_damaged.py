"""Nothing that is smoothed comes back worse: every method on damaged meshes of every type.

The environment variable JAXSMOOTH_EXAMPLES sets the number of meshes; `tests/damage.py` runs more,
and finds the simplest case of a harm.
"""

import os

import numpy as np
import pytest
from damage import GUARDED, QUICK, SHAPES, Damage, complaints, damaged, harm, random_damage

EXAMPLES = max(int(os.environ.get("JAXSMOOTH_EXAMPLES", "300")) // len(SHAPES), 1)
CASES = [
    (shape, method)
    for shape in SHAPES
    for method in GUARDED
    if method == "elastic" or shape in QUICK  # the program does all
]


@pytest.mark.parametrize(("shape", "method"), CASES)
def test_never_worse(shape, method):
    damages = [random_damage(seed) for seed in range(EXAMPLES)]
    harmed = [(damage, found) for damage in damages if (found := harm(shape, method, damage))]
    assert harmed == []


def test_the_damage_is_of_every_sort():
    """Valid and tangled meshes, stretched ones and flat ones: the check would be idle without."""
    cases = [damaged("quad", random_damage(seed)) for seed in range(40)]
    inverted = [complaints(damaged("quad", Damage()), case.mesh) != [] for case in cases]
    assert 0.2 < np.mean(inverted) <= 1


def test_complaints():
    """Each sort of harm is noticed."""
    good, bad = damaged("quad", Damage()), damaged("quad", Damage(jiggle=0.4))
    assert complaints(good, good.mesh) == []
    words = " ".join(complaints(good, bad.mesh))
    assert all(word in words for word in ("inverted", "poor", "q_min", "q_avg", "scaled_jacobian"))
    points = np.array(good.mesh.points)
    points[0] -= 1e-6
    assert "left its side" in complaints(good, good.mesh.with_points(points))[0]
    points[0] = np.nan
    assert complaints(good, good.mesh.with_points(points)) == ["not finite"]
