"""Every scene of the real hip and the whole leg: its meshes load, its settings hold, and its motion
splits into sub-steps.
"""

import itertools

import pytest

from rbfmuscle.models import check_models
from rbfmuscle.scene.check import check_initial
from rbfmuscle.scene.motion import completed
from rbfmuscle.scene.scene import Scene
from rbfmuscle.simulation.contact_pairs import find_contact_pairs
from rbfmuscle.simulation.substeps import PoseCache, SubSteps
from rbfmuscle.validation import SceneError

# Muscles and bones of each scene.
SCENES = {f"hip/{name}": (4, 3) for name in ("adduction", "apriori", "extension", "flexion")}
SCENES |= {"hip/external_rotation": (4, 3), "hip/internal_rotation": (4, 3), "hip/gluteus": (1, 3)}
SCENES |= {
    "leg/gait": (12, 15),
    "leg/hip_flexion": (8, 9),
    "leg/knee_flexion": (6, 10),
    "leg/leg": (38, 11),
}
SCENES |= {
    "leg/neighbours": (4, 7),
    "leg/quadriceps": (4, 6),
    "leg/slender": (4, 6),
    "leg/squat": (38, 21),
}


@pytest.fixture(scope="module")
def data(hip_data, leg_data):
    return hip_data.parent


def test_table_names_every_scene(data):
    files = [*(data / "hip").glob("*.toml"), *(data / "leg").glob("*.toml")]
    assert {f"{path.parent.name}/{path.stem}" for path in files} == set(SCENES)


# What scenes of earlier versions still say: the error that it is, and what stands in its place.
GONE = {
    'initial = "resolve"': ("'keep' or 'error', got 'resolve'", 'initial = "keep"'),
    "[sliding]\nthreshold = 2.0": (r"unknown key 'sliding'.*\[neighbours\]", "[neighbours]"),
}


def _load(path, folder):
    """The scene of a file, which may say what earlier versions took."""
    text = path.read_text()
    said = [known for known in GONE if known in text]
    if not said:
        return Scene.load(path)
    for known in said:
        error, now = GONE[known]
        with pytest.raises(SceneError, match=error):
            Scene.load(path)
        text = text.replace(known, now)
    for file in path.parent.iterdir():
        (folder / file.name).symlink_to(file)
    (folder / path.name).unlink()
    (folder / path.name).write_text(text)
    return Scene.load(folder / path.name)


@pytest.mark.parametrize("name", SCENES)
def test_scene_loads_and_its_motion_has_sub_steps(data, name, tmp_path):
    scene = _load(data / f"{name}.toml", tmp_path)
    check_models(scene)
    check_initial(scene)
    assert (len(scene.muscles), len(scene.bones)) == SCENES[name]
    pairs, poses = find_contact_pairs(scene), PoseCache(scene)
    met = {m.name: [bone for name, bone in pairs if name == m.name] for m in scene.muscles}
    assert any(met.values())
    cuts = [SubSteps(scene, m, bones=met[m.name], poses=poses) for m in scene.muscles]
    frames = [completed(scene, frame) for frame in scene.motion.frames]
    assert len(frames) > 1
    for before, after in itertools.pairwise(frames):
        assert any([cut.split(before, after) for cut in cuts])
