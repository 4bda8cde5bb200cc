"""Verdict's metrics against VTK's, which are Verdict's own code."""

from functools import lru_cache

import jax
import numpy as np
import pytest

pytest.importorskip("vtk")

import vtk

from jaxsmooth.cells.table import element_type
from jaxsmooth.mesh.record import Mesh
from jaxsmooth.metrics.shape import MEASURE
from jaxsmooth.metrics.table import METRICS, quality
from jaxsmooth.metrics.verdict_angles import ANGLES
from jaxsmooth.metrics.verdict_ratios import RATIOS

PREFIX = {
    "triangle": "Triangle",
    "quad": "Quad",
    "tetra": "Tet",
    "pyramid": "Pyramid",
    "wedge": "Wedge",
    "hexahedron": "Hex",
}
CELLS = {name: f"vtk{name.capitalize()}" for name in PREFIX}
SPECIAL = {
    "verdict_edge_ratio": "EdgeRatio",
    "verdict_shape": "Shape",
    "verdict_scaled_jacobian": "ScaledJacobian",
    "min_dihedral_angle": "MinAngle",
}
# Bugs of VTK 9.7, so that its values depend on the numbering; these have tests of their own below.
DEPEND_ON_NUMBERING = {
    ("tetra", "min_dihedral_angle"),
    ("tetra", "collapse_ratio"),
    ("pyramid", "verdict_shape"),
    ("hexahedron", "verdict_edge_ratio"),
}
# 0/0 in VTK: what it is here, as the records say.
UNDEFINED = {
    ("triangle", "normalized_inradius"): 0,
    ("quad", "aspect_ratio"): np.inf,
    ("quad", "distortion"): 2,
    ("tetra", "equiangle_skew"): 1,
    ("pyramid", "equiangle_skew"): 1,  # the arccos of more than 1
    ("tetra", "equivolume_skew"): 1,
    ("tetra", "squish_index"): 1,
    ("wedge", "verdict_scaled_jacobian"): None,  # of the other corners
    ("hexahedron", "dimension"): 0,
}
IN_DEGREES = {"min_angle", "max_angle"}


def vtk_name(name, metric):
    words = "".join(word.capitalize() for word in metric.split("_"))
    other = {"measure": ("Area", "Volume"), "mean_aspect_frobenius": ("MedAspectFrobenius",)}
    for candidate in (SPECIAL.get(metric, words), *other.get(metric, ())):
        if hasattr(vtk.vtkMeshQuality, PREFIX[name] + candidate):
            return PREFIX[name] + candidate
    return None


def cell(name, corners):
    made = getattr(vtk, CELLS[name])()
    for k, spot in enumerate(corners):
        made.GetPoints().SetPoint(k, *spot, *[0.0] * (3 - len(spot)))
    return made


def by_vtk(name, metric, elements):
    function = getattr(vtk.vtkMeshQuality, vtk_name(name, metric))
    values = np.array([function(cell(name, element)) for element in elements])
    values[values >= 1e29], values[values <= -1e29] = np.inf, -np.inf
    return values


@lru_cache
def compiled(name, metric):
    return jax.jit(jax.vmap(lambda x: METRICS[metric](element_type(name), x)))


def here(name, metric, elements):
    values = np.array(compiled(name, metric)(elements))
    return np.abs(values) if metric == "measure" and name in ("triangle", "quad") else values


def agree(found, expected, tolerance):
    """Whether values agree, infinite ones too."""
    both = np.isfinite(found) & np.isfinite(expected)
    gap = np.where(both, found, 0) - np.where(both, expected, 0)
    return np.where(
        both, np.abs(gap) <= tolerance * np.maximum(np.abs(np.where(both, expected, 1)), 1), found == expected
    )


@lru_cache
def random_elements(name):
    """Valid and distorted ones, tangled ones, and those with all corners anywhere: many are inverted."""
    rng = np.random.default_rng(0)
    ideal = element_type(name).ideal
    amplitude = np.repeat([0.2, 0.6], 350)[:, None, None]
    near = ideal + amplitude * rng.uniform(-1, 1, (700, *ideal.shape))
    return np.concatenate([near, rng.uniform(-1, 1, (300, *ideal.shape))])


@lru_cache
def degenerate_elements(name):
    """Corners that coincide, are in a row or in a plane, as coordinates without rounding."""
    rng = np.random.default_rng(1)
    corners = element_type(name).natural
    anywhere = rng.integers(0, 3, (200, *corners.shape)).astype(float)
    joined = np.repeat(corners[None], 100, axis=0)
    for element, (a, b) in zip(joined, rng.integers(0, len(corners), (100, 2)), strict=True):
        element[a] = element[b]
    flat = joined[:50] * np.r_[np.ones(corners.shape[1] - 1), 0]
    found = np.concatenate([np.zeros((1, *corners.shape)), anywhere, joined, flat])
    if name == "quad":
        found[-20:, 3] = found[-20:, 2]  # which Verdict takes for triangles
    return found


METRICS_OF_VTK = [
    (name, metric.name)
    for name in PREFIX
    for metric in (MEASURE, *RATIOS, *ANGLES)
    if metric.applies_to(element_type(name)) and not metric.relative and vtk_name(name, metric.name)
]
CASES = [case for case in METRICS_OF_VTK if case not in DEPEND_ON_NUMBERING]


def test_no_metric_of_vtk_is_forgotten():
    ours = {vtk_name(*case) for case in METRICS_OF_VTK}
    theirs = {
        name
        for name in dir(vtk.vtkMeshQuality)
        for prefix in PREFIX.values()
        if name.startswith(prefix) and name[len(prefix)].isupper()
    }
    relative = {name for name in theirs if name.endswith(("RelativeSizeSquared", "AndSize"))}
    # lengths that are not normalised, of parts of the element, and our mean_ratio but for its sign
    other = {"TetInradius", "TetNormalizedInradius", "TetMeanRatio"}
    assert theirs - ours - relative == other


@pytest.mark.parametrize(("name", "metric"), CASES)
def test_random_elements(name, metric):
    elements = random_elements(name)
    assert len(elements) == 1000
    found, expected = here(name, metric, elements), by_vtk(name, metric, elements)
    tolerance = np.full(len(elements), 1e-12)
    if metric in IN_DEGREES:  # arccos loses digits at flat angles
        tolerance += 60 * 1e-15 / np.sin(np.radians(np.clip(found, 1e-7, 180 - 1e-7)))
    if metric == "oddy":  # their det g is a difference
        tolerance += 1e-15 * np.where(np.isfinite(expected), expected, 0)
    assert agree(found, expected, tolerance).all()
    assert np.isfinite(expected).mean() > 0.05


@pytest.mark.parametrize(("name", "metric"), CASES)
def test_degenerate_elements(name, metric):
    elements = degenerate_elements(name)
    found, expected = here(name, metric, elements), by_vtk(name, metric, elements)
    assert not np.isnan(found).any()
    for values in (found, expected):  # over what rounding leaves of zero
        values[values > 1e9] = np.inf
    compared = np.ones(len(elements), bool)
    if metric == "distortion" and name in ("wedge", "hexahedron"):  # over a volume of rounding size
        compared = here(name, "measure", elements) > 1e-9
    # arccos is off by 1e-6 degrees where three corners are in a row
    tolerance = {"min_angle": 2e-6, "max_angle": 2e-6, "equiangle_skew": 5e-8}.get(metric, 1e-12)
    same = agree(found, expected, tolerance)
    if (name, metric) in UNDEFINED:
        value = UNDEFINED[name, metric]
        assert value is None or agree(found, np.full(len(found), value), 1e-12)[~same].all()
        assert 0.1 < same.mean() < 1
    else:
        assert same[compared].all()


@pytest.mark.parametrize("name", ["triangle", "quad", "tetra", "hexahedron"])
def test_relative_size(name):
    """Against the filter, which finds the mean of the mesh; the unit there is the mean size of a type."""
    elements = random_elements(name)[:350]
    nodes = np.arange(elements[..., 0].size).reshape(len(elements), -1)
    points = elements.reshape(-1, elements.shape[-1])
    mesh = Mesh(points, {name: nodes})
    grid = vtk.vtkUnstructuredGrid()
    places = vtk.vtkPoints()
    places.SetDataTypeToDouble()
    for spot in points:
        places.InsertNextPoint(*spot, *[0.0] * (3 - len(spot)))
    grid.SetPoints(places)
    kind = cell(name, elements[0]).GetCellType()
    for row in np.asarray(mesh.connectivity[0]):
        grid.InsertNextCell(kind, len(row), row.tolist())
    for metric in ("relative_size_squared", "shape_and_size", "shear_and_size"):
        if not METRICS[metric].applies_to(element_type(name)):
            continue
        quality_filter = vtk.vtkMeshQuality()
        quality_filter.SetInputData(grid)
        words = "".join(word.capitalize() for word in metric.split("_"))
        getattr(quality_filter, f"Set{PREFIX[name]}QualityMeasureTo{words}")()
        quality_filter.Update()
        array = quality_filter.GetOutput().GetCellData().GetArray("Quality")
        expected = np.array([array.GetValue(i) for i in range(array.GetNumberOfTuples())])
        # scaled by a root with 11 digits
        np.testing.assert_allclose(quality(mesh, metric)[0], expected, rtol=1e-9, atol=1e-12)


# --- Where VTK's values depend on the numbering ----------------------------------------------------


def test_dihedral_angles():
    elements = random_elements("tetra")
    pairs = [(0, 1, 2, 3), (0, 2, 1, 3), (1, 2, 0, 3), (0, 3, 1, 2), (1, 3, 0, 2), (2, 3, 0, 1)]
    angles = []
    for a, b, c, d in pairs:  # at the edge ab
        axis = elements[:, b] - elements[:, a]
        axis /= np.linalg.norm(axis, axis=1)[:, None]
        first, second = (
            x - (x * axis).sum(axis=1)[:, None] * axis
            for x in (elements[:, c] - elements[:, a], elements[:, d] - elements[:, a])
        )
        cosine = (first * second).sum(axis=1) / np.linalg.norm(first, axis=1) / np.linalg.norm(second, axis=1)
        angles.append(np.degrees(np.arccos(cosine)))
    angles = np.array(angles)
    np.testing.assert_allclose(here("tetra", "min_dihedral_angle", elements), angles.min(axis=0), rtol=1e-9)
    np.testing.assert_allclose(here("tetra", "max_dihedral_angle", elements), angles.max(axis=0), rtol=1e-9)
    angles[[1, 4]] = 180 - angles[[1, 4]]  # VTK's
    np.testing.assert_allclose(by_vtk("tetra", "min_dihedral_angle", elements), angles.min(axis=0), rtol=1e-9)


def test_collapse_ratio():
    """Where edges 12 and 13, which VTK exchanges, are equal."""
    elements = random_elements("tetra").copy()
    along = elements[:, 3] - elements[:, 1]
    along /= np.linalg.norm(along, axis=1)[:, None]
    length = np.linalg.norm(elements[:, 2] - elements[:, 1], axis=1)
    elements[:, 3] = elements[:, 1] + length[:, None] * along
    found = here("tetra", "collapse_ratio", elements)
    np.testing.assert_allclose(found, by_vtk("tetra", "collapse_ratio", elements), rtol=1e-12, atol=1e-13)


def test_shape_of_pyramids():
    """With a plane base, and a lateral edge the longest."""
    elements = random_elements("pyramid").copy()
    elements[:, :4, 2] = 0
    elements[:, 4] += [3, 0, 2]
    found = here("pyramid", "verdict_shape", elements)
    expected = by_vtk("pyramid", "verdict_shape", elements)
    convex = here("quad", "jacobian", elements[:, :4, :2]) > 0  # else corner 0 may have another normal
    np.testing.assert_allclose(found[convex], expected[convex], rtol=1e-12, atol=1e-13)
    assert (found[convex] > 0).mean() > 0.5


def test_edge_ratio_of_hexahedra():
    """Where the longest edge is among the first six."""
    elements = random_elements("hexahedron").copy()
    elements[:, [1, 2, 5, 6], 0] += 5
    edges = element_type("hexahedron").edges
    lengths = np.linalg.norm(elements[:, edges[:, 0]] - elements[:, edges[:, 1]], axis=-1)
    chosen = lengths.argmax(axis=1) < 6
    assert 300 < chosen.sum() < 1000
    found = here("hexahedron", "verdict_edge_ratio", elements)[chosen]
    expected = by_vtk("hexahedron", "verdict_edge_ratio", elements[chosen])
    np.testing.assert_allclose(found, expected, rtol=1e-12)


def test_mean_ratio_is_not_their_shape():
    """Both are 1 only on the ideal element, but on quadrilaterals and hexahedra they are two things."""
    for name in ("quad", "hexahedron"):
        elements = random_elements(name)[:350]
        gap = here(name, "mean_ratio", elements) - here(name, "verdict_shape", elements)
        assert gap.min() >= -1e-12
        assert gap.max() > 0.1
    for name in ("triangle", "tetra"):
        elements = random_elements(name)[:350]
        np.testing.assert_allclose(
            here(name, "mean_ratio", elements), here(name, "verdict_shape", elements), rtol=1e-12
        )
