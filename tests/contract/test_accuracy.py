"""The estimate of the discretisation error."""

import numpy as np
import pytest

import rbfmuscle as rm

pytestmark = pytest.mark.numeric


@pytest.fixture
def bent():
    """One muscle of the phantom in two frames, the second bent."""
    scene = rm.phantom_scene()
    scene.muscles = [scene.muscle("adductor_posterior")]
    scene.set_motion(waypoints=[{}, {"hip.flexion": 30.0}], step=30.0)
    return scene


def test_error_is_the_distance_of_two_lattices_and_falls_with_the_nodes(bent):
    found = {}
    for nodes in (60, 240):
        (row,) = rm.discretisation_error(bent.with_options({"model.nodes": nodes}))
        assert (row.muscle, row.nodes, row.frame) == ("adductor_posterior", nodes, 1)
        assert 0.0 < row.rms < row.greatest
        found[nodes] = row
    assert found[240].rms < 0.7 * found[60].rms
    meshes = []
    for nodes in (60, 120):
        run = rm.simulate(bent.with_options({"model.nodes": nodes}))
        meshes.append(run.frames[-1].material_meshes["adductor_posterior"][0])
    away = np.linalg.norm(meshes[0] - meshes[1], axis=1)
    assert found[60].rms == pytest.approx(np.sqrt(np.mean(away**2)), rel=1e-6)
    assert found[60].greatest == pytest.approx(away.max(), rel=1e-6)


def test_frames_keep_their_numbers_and_mesh_models_have_no_lattice(bent):
    bent.set_motion(waypoints=[{}, {"hip.flexion": 30.0}], step=15.0)
    (row,) = rm.discretisation_error(bent.with_options({"model.nodes": 60}, frames="0:3:2"))
    assert row.frame == 2
    with pytest.raises(rm.UsageError, match="no RBF muscle"):
        rm.discretisation_error(bent.with_options(model="pbd"))
