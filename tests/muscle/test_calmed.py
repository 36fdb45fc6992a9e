"""A material that is no sound surface is shown as it is on the whole."""

import numpy as np
import pytest
from spindle_scene import build_scene

from rbfmuscle.bones.sdf import BoneSDF
from rbfmuscle.geometry.crossing import crossing_faces
from rbfmuscle.geometry.surfaces import mesh_volume
from rbfmuscle.implicit.extraction.material import project_to_level_set
from rbfmuscle.muscle.drawing import Configuration
from rbfmuscle.muscle.muscle import RBFMuscle
from rbfmuscle.simulation.contact import BoneContacts


@pytest.fixture(scope="module")
def drawn():
    """A spindle's model and what it meets."""
    scene = build_scene()
    model = RBFMuscle(scene.muscles[0], scene)
    fields = {bone.name: BoneSDF.from_mesh(bone.mesh, cache=False) for bone in scene.bones}
    return model, BoneContacts(list(fields), list(fields.values()), contact_bone=model.contact_bone)


def no_fit():
    raise ValueError("no field")


def test_a_tangle_of_the_material_is_shown_as_a_sound_surface(drawn):
    model, contacts = drawn
    shown, volume = model.drawer.shown, model.rest.mesh_volume
    tangled = shown.rest.copy()
    # The lower half inside out.
    tangled[tangled[:, 2] < 0.0] *= [-1.0, 1.0, 1.0]
    alone = project_to_level_set(shown.mesh, tangled, None, volume=volume)
    assert crossing_faces(alone.vertices, alone.faces).sum() > 20
    now = Configuration(model.points, model.normals(), model.contact_points(), tangled)
    surface = model.drawer.draw(no_fit, now, contacts)
    assert not crossing_faces(surface.vertices, np.asarray(surface.faces)).any()
    assert mesh_volume(surface.vertices, np.asarray(surface.faces)) == pytest.approx(volume, rel=1e-10)
    assert contacts.nearest(surface.vertices)[0].min() > -0.05
    assert surface.quantities["unfitted_fraction"] == 1.0
    # Far from the tangle it is where the material is.
    far = shown.rest[:, 2] > 15.0
    assert np.linalg.norm(surface.vertices - tangled, axis=1)[far].max() < 6.0
