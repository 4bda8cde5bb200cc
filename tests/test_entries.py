"""Every function that takes a mesh takes it in every form, and reads it in the same way."""

import jax
import jax.numpy as jnp
import meshes
import meshio
import numpy as np
import pytest

import jaxsmooth as js

# Each element numbered from its lowest node to its highest, as scikit-fem does: half of them clockwise.
POINTS, _GRID = meshes.grid("triangle", (4, 4), 0.1)
SORTED = np.sort(_GRID["triangle"], axis=1)
MESH = js.Mesh(POINTS, _GRID)  # numbered counterclockwise
FORMS = {
    "tuple": (POINTS, {"triangle": SORTED}),
    "list of blocks": [POINTS.tolist(), [("triangle", SORTED)]],
    "meshio": meshio.Mesh(POINTS, {"triangle": SORTED}),
    "file": js.from_meshio(meshio.Mesh(POINTS, {"triangle": SORTED})),
}
HELD = js.detect_constraints(MESH)


@pytest.mark.parametrize("form", FORMS)
def test_sorted_numbering_is_not_inverted(form):
    given = FORMS[form]
    same = np.sort(np.asarray(js.as_mesh(given).connectivity[0]), axis=1)
    np.testing.assert_array_equal(same, SORTED)
    assert js.statistics(given).inverted == 0
    assert js.smooth(given, steps=1).history[-1].statistics.inverted == 0


def entries(mesh):
    yield js.quality(mesh)[0]
    yield js.quality_mean(mesh)
    yield js.detect_constraints(mesh).projectors
    yield js.run(mesh, constraints=HELD, steps=1).points
    yield js.step(mesh, js.Elastic(), HELD).points
    yield js.fixed_point(mesh, constraints=HELD, max_steps=1).mesh.points
    yield js.stack([mesh, mesh]).mesh.points


def test_every_entry_takes_every_form():
    expected = [np.asarray(part) for part in entries(MESH)]
    for form, given in FORMS.items():
        for found, value in zip(entries(given), expected, strict=True):
            np.testing.assert_allclose(found, value, rtol=1e-9, atol=1e-12, err_msg=form)


def test_a_mesh_passes_unchanged_even_when_traced():
    assert js.as_mesh(MESH) is MESH
    mean = jax.jit(lambda points: js.quality_mean(MESH.with_points(points)))(MESH.points)
    assert float(mean) == pytest.approx(float(js.quality_mean(MESH)), rel=1e-12)


@pytest.mark.parametrize("points", [POINTS.astype(np.float32), jnp.asarray(POINTS, jnp.float32)])
def test_precision_is_kept(points):
    assert js.as_mesh((points, {"triangle": SORTED})).points.dtype == np.float32


def test_wrong_pairs_are_refused_in_a_sentence():
    with pytest.raises(ValueError, match="element type 'triangel' is not supported"):
        js.as_mesh((POINTS, {"triangel": SORTED}))
    with pytest.raises(ValueError, match=r"block 0 \(triangle\): connectivity must be integers"):
        js.as_mesh((POINTS, {"triangle": SORTED.astype(float)}))
    with pytest.raises(ValueError, match="which is out of range"):
        js.as_mesh((POINTS, {"triangle": SORTED + 100}))
    with pytest.raises(ValueError, match=r"trace mesh\.with_points"):
        jax.jit(lambda points: js.quality_mean((points, {"triangle": SORTED})))(POINTS)
