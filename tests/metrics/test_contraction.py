"""What is measured of muscles that contract, on shapes whose answer is known."""

import numpy as np
import pytest
import trimesh
from contraction_scenes import MUSCLE, spindle_scene
from scipy.spatial.transform import Rotation

import rbfmuscle as rm
from rbfmuscle.metrics.centreline import belly_measures


def test_run_reports_what_contracts():
    region = {"length": 100.0, "strain": 0.08}
    run = rm.simulate(
        spindle_scene(spacing=5.0, frames=2, model="arap-volume", tendon_region=region)
    )
    assert run.values(MUSCLE, "activation") == pytest.approx([0.0, 0.5, 1.0])
    for quantity in ("csa_max", "belly_thickness"):
        assert np.diff(run.values(MUSCLE, quantity))[-1] > 0.0, quantity
    assert run.values(MUSCLE, "csa_place") == pytest.approx([0.5] * 3, abs=0.02)
    assert {row.unit for row in run.metrics if row.quantity == "csa_max"} == {"mm^2"}


AXES = np.array([30.0, 6.0, 4.0])
TURN = Rotation.from_rotvec([0.5, -1.0, 0.3]).as_matrix()


def belly(turn=TURN, shift=(7.0, -3.0, 11.0), scale=1.0):
    mesh = trimesh.creation.icosphere(subdivisions=4)
    return scale * (np.array(mesh.vertices) * AXES @ turn.T + shift), np.array(mesh.faces)


@pytest.mark.parametrize("scale", [1.0, 0.001])
@pytest.mark.parametrize(("back", "ahead"), [(30.0, 30.0), (20.0, 40.0)])
def test_greatest_section_of_an_ellipsoid_is_its_middle(scale, back, ahead):
    vertices, faces = belly(scale=scale)
    middle, way = scale * np.array([7.0, -3.0, 11.0]), TURN[:, 0] * scale
    found = belly_measures(vertices, faces, middle - back * way, middle + ahead * way)
    # The triangles lie up to 0.3 % within the ellipsoid.
    assert found["csa_max"] == pytest.approx(np.pi * 24.0 * scale**2, rel=6e-3)
    assert found["csa_place"] == pytest.approx(back / (back + ahead), abs=2e-3)
    assert found["belly_thickness"] == pytest.approx(8.0 * scale, rel=6e-3)


def test_a_belly_looked_at_from_the_other_end_is_the_same():
    vertices, faces = belly(turn=np.eye(3), shift=(0.0, 0.0, 0.0))
    bulge = 1.0 + 0.5 * np.exp(-((vertices[:, 0] - 10.0) ** 2) / 40.0)
    vertices = vertices * np.column_stack([np.ones(len(vertices)), bulge, bulge])
    ends = np.array([-25.0, 0.0, 0.0]), np.array([35.0, 0.0, 0.0])
    one, other = (
        belly_measures(vertices, faces, *ends),
        belly_measures(vertices, faces, *ends[::-1]),
    )
    assert one["csa_max"] == pytest.approx(other["csa_max"], rel=1e-9)
    assert one["csa_place"] == pytest.approx(1.0 - other["csa_place"], abs=1e-9)
    assert one["belly_thickness"] == pytest.approx(other["belly_thickness"], rel=1e-9)
    x = np.linspace(-30.0, 30.0, 6001)
    area = (
        np.pi
        * 24.0
        * (1.0 - (x / 30.0) ** 2)
        * (1.0 + 0.5 * np.exp(-((x - 10.0) ** 2) / 40.0)) ** 2
    )
    # Triangles within the surface, and a parabola through three stations: 1 % together.
    assert one["csa_max"] == pytest.approx(area.max(), rel=0.02)
    assert one["csa_place"] == pytest.approx((x[area.argmax()] + 25.0) / 60.0, abs=0.01)
