"""What several test files share."""

import os
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent


def _find_hip():
    places = [os.environ.get("RBFMUSCLE_DATA"), ROOT.parent / "shared" / "data"]
    return next((Path(p) / "hip" for p in places if p and (Path(p) / "hip").is_dir()), None)


@pytest.fixture(scope="session")
def hip_data():
    """Folder of the real hip; the test is skipped where it is absent."""
    folder = _find_hip()
    if folder is None:
        pytest.skip("the real hip is not here (set RBFMUSCLE_DATA to the folder that holds hip/)")
    return folder


@pytest.fixture(scope="session")
def hip_scene(hip_data):
    """The flexion scene of the real hip, loaded once; copy before changing it."""
    from rbfmuscle.sim.scene import Scene

    return Scene.load(hip_data / "flexion.toml")
