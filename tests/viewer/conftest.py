"""What the tests of the viewer share."""

import pytest

import rbfmuscle as rm


@pytest.fixture(scope="package")
def run_folder(tmp_path_factory):
    """The folder of a run of the phantom, three frames to 40 degrees."""
    folder = tmp_path_factory.mktemp("run")
    scene = rm.phantom_scene(end=40.0, step=20.0, spacing=6.0)
    rm.simulate(scene, model="pbd").save(folder, pictures=False)
    return folder
