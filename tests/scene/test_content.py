"""Scenes and their parts are compared and hashed by all that they hold."""

import copy
from dataclasses import fields, is_dataclass

import numpy as np
import pytest
import trimesh
from pydantic import BaseModel
from rich_scene import rich

import rbfmuscle as rm
from rbfmuscle.scene.meshes.repair import InputOrder
from rbfmuscle.scene.options import ContractionTable
from rbfmuscle.studies.sweep import scene_content

# Where files lie, and what follows from attachments and joints.
LEFT_OUT = {("Scene", "path"), ("Bone", "source"), ("Muscle", "source"), ("Muscle", "tendons")}


def full():
    """A scene in which every field has a value, lists and tables included."""
    scene = rich()
    scene.missing_bones = ["patella"]
    scene.notes = ["a note"]
    scene.superior, scene.anterior = [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]
    scene.motion.times = [0.1 * number for number in range(len(scene.motion))]
    scene.motion.notes = ["a column is not used"]
    for bone in scene.bones:
        bone.notes = ["a hole was closed"]
    for muscle in scene.muscles:
        muscle.notes = ["a hole was closed"]
        muscle.options = {"centres": 90, "kernel": "cubic"}
        muscle.fibres = [np.array([[-40.0, 0.1, 20.0], [40.0, 0.2, 20.0]])]
        muscle.aponeuroses = [np.arange(5), np.arange(5, 9)]
        mesh = muscle.mesh
        order = np.arange(len(mesh.vertices))
        muscle.given = InputOrder(mesh.faces, order)
        muscle.contraction = ContractionTable(activation=[0.0, 0.5], fibre_stretch_at_rest=1.1)
    return scene


def places(value, way=()):
    """Ways to all fields and items of a value, in names and numbers, each with its owner's type."""
    if isinstance(value, BaseModel) or is_dataclass(value):
        names = (
            type(value).model_fields
            if isinstance(value, BaseModel)
            else [each.name for each in fields(value)]
        )
        items = [(name, getattr(value, name)) for name in names]
    elif isinstance(value, dict):
        items = list(value.items())
    elif isinstance(value, (list, tuple)):
        items = list(enumerate(value))
    else:
        return
    for key, item in items:
        owner = type(value).__name__
        yield (*way, key), owner
        if (owner, key) not in LEFT_OUT:
            yield from places(item, (*way, key))


def other(value):
    """Another value of the same sort."""
    if isinstance(value, trimesh.Trimesh):
        return value.copy().apply_translation([0.0, 0.0, 1.0])
    if isinstance(value, np.ndarray):  # as many, but not the same
        return value + 1 if value.size else np.ones_like(value, shape=(1, 3))
    if isinstance(value, bool):
        return not value
    if isinstance(value, (int, float)):
        return value + 1
    if isinstance(value, str):
        return value + "x"
    if isinstance(value, (list, tuple)):
        return type(value)(value[1:]) if value and type(value) in (list, tuple) else None
    if isinstance(value, dict):
        return dict(list(value.items())[1:]) if value else {"x": 1.0}
    return 1.0 if value is None else None


def changed(value, way):
    """A copy of a scene, or of a part of it, with another value in one place."""
    if not way:
        return other(value)
    key = way[0]
    if isinstance(value, (list, tuple)):
        items = [changed(item, way[1:]) if k == key else item for k, item in enumerate(value)]
        return type(value)(*items) if hasattr(value, "_fields") else type(value)(items)
    if isinstance(value, dict):
        return value | {key: changed(value[key], way[1:])}
    found = copy.copy(value)
    object.__setattr__(found, key, changed(getattr(value, key), way[1:]))
    return found


def test_every_field_of_a_scene_changes_its_key_and_makes_it_another_scene():
    scene = full()
    key = scene_content(scene)
    ways = list(places(scene))
    assert len(ways) > 200
    unseen, wrong = [], []
    for way, owner in ways:
        told = scene_content(changed(scene, way)) != key
        if told == ((owner, way[-1]) in LEFT_OUT):
            (wrong if told else unseen).append(".".join(map(str, way)))
    assert not unseen and not wrong
    assert changed(scene, ("name",)) != scene


@pytest.mark.parametrize("part", ["bones", "joints", "muscles", "couplings"])
def test_parts_are_equal_by_what_they_hold(part):
    one, two = (getattr(rich(), part) for _ in range(2))
    assert one == two and one[0] == two[0]
    assert one[0] != "another sort of thing"


def test_attachments_and_scenes_are_equal_by_what_they_hold():
    one, two = rich(), rich()
    assert one == two and one.motion == two.motion
    assert one.muscles[1].attachments == two.muscles[1].attachments
    assert one.muscles[1].attachments[0] != one.muscles[1].attachments[1]
    two.muscles[1].attachments[0].vertices = one.muscles[1].attachments[0].vertices[1:]
    assert one != two and one.muscles[1] != two.muscles[1]


def test_a_saved_scene_is_equal_where_numbers_survive_as_text(tmp_path):
    scene = rich()
    assert rm.Scene.load(scene.save(tmp_path / "arm.toml")) == scene
