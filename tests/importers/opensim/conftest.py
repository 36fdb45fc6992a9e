"""Models and reference values of OpenSim, where they are; and a small model that is always here."""

import shutil

import pytest
from conftest import ROOT, find_data


@pytest.fixture(scope="session")
def osim_data():
    """Folder of the OpenSim models; the test is skipped where it is absent."""
    return find_data("osim")


@pytest.fixture
def small(tmp_path):
    """The small model with its mesh: a hip, a knee that rolls, a cap that follows the knee."""
    for name in ("small.osim", "wedge.obj"):
        shutil.copy(ROOT / "tests" / "data" / name, tmp_path)
    return tmp_path / "small.osim"
