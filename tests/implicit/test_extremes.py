"""The extremes: right within a bound, or a warning or error that says why. Never silently wrong."""

import warnings
from importlib import import_module

import numpy as np
import pytest
import trimesh

from rbfmuscle.implicit.field import FieldFit, RBFField
from rbfmuscle.implicit.kernels import KERNELS
from rbfmuscle.implicit.placement import sample_surface
from rbfmuscle.implicit.selection import spacing
from rbfmuscle.scene.phantom import phantom_scene
from rbfmuscle.validation import NumericalWarning

WITH_EPSILON = [name for name, kernel in KERNELS.items() if kernel.has_epsilon]


def watched(call, *arguments):
    """Result and whether anything was said."""
    with warnings.catch_warnings(record=True) as heard:
        warnings.simplefilter("always")
        try:
            return call(*arguments), bool(heard)
        except np.linalg.LinAlgError as error:
            assert "singular fit" in str(error) or "no Cholesky factor" in str(error)
            return None, True


def test_almost_coinciding_centres_are_named():
    points = np.array(trimesh.creation.icosphere(1).vertices)
    points[10] = points[20] + [1e-12, 0, 0]
    with pytest.warns(NumericalWarning, match="centres 10 and 20"):
        RBFField.fit(points, points[:, 2], kernel="wendland_c4", epsilon=3.0)


def test_nothing_is_wrong_without_a_word(monkeypatch):
    extremes = import_module("extremes")
    # Fits of thousands of unknowns take most of the time.
    monkeypatch.setattr(extremes, "COUNTS", {4: 1.0, 10: 1.0, 50: 0.5, 300: 0.05})
    names = ("cubic", "inverse_multiquadric", "matern_12", "wendland_c2")
    rows = list(extremes.study([KERNELS[name] for name in names]))
    outcomes = {(case, kernel): outcome for case, kernel, outcome, *_ in rows}
    assert "silent" not in outcomes.values()
    assert all(outcome == "right" or len(said) > 5 for _, _, outcome, _, said in rows)
    assert outcomes["1e6 from the origin", "cubic"] == "right"
    assert outcomes["two centres in one place", "cubic"] == "refused"
    assert outcomes["epsilon h = 1000", "wendland_c2"] == "warned"


@pytest.fixture(scope="module")
def muscle():
    """Centres, normals and vertices of a muscle of the phantom."""
    mesh = phantom_scene().muscle("adductor_posterior").mesh
    sample = sample_surface(mesh.vertices, mesh.faces, 120)
    return sample.points, sample.normals, np.asarray(mesh.vertices)


def missed(field, vertices, reach):
    """RMS distance of vertices from the surface to first order, in units of the spacing."""
    value, gradient = field.value_and_gradient(vertices)
    return (
        np.sqrt((np.minimum(np.abs(value / np.linalg.norm(gradient, axis=1)), reach) ** 2).mean())
        / reach
    )


@pytest.mark.parametrize("kernel", WITH_EPSILON)
@pytest.mark.parametrize("shape", [1e-3, 0.1, 1.0, 1e3])
def test_flat_and_peaked_kernels_on_a_muscle_are_right_or_say_so(muscle, kernel, shape):
    points, normals, vertices = muscle
    reach = spacing(points).mean()
    field, said = watched(FieldFit(KERNELS[kernel], shape / reach).fit, points, normals)
    assert said or missed(field, vertices, reach) < 0.2
    assert field is None or np.isfinite(field(vertices)).all()


def test_a_muscle_with_two_centres_almost_in_one_place_is_right_or_says_so(muscle):
    points, normals, vertices = (part.copy() for part in muscle)
    reach = spacing(points).mean()
    for apart in (1e-3, 1e-6, 1e-9):
        points[10], normals[10] = points[20] + apart * reach * normals[20][[1, 2, 0]], normals[20]
        field, said = watched(RBFField.fit_hermite, points, normals)
        assert said or missed(field, vertices, reach) < 0.2
