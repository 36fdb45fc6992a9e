"""Small scenes built in code: an elbow with one muscle, and one that has a part of every sort."""

import numpy as np
import trimesh

import rbfmuscle as rm
from rbfmuscle.scene.options import GuessTable


def built():
    """An elbow and one muscle."""
    scene = rm.Scene("arm", units="mm")
    for name, middle in (("upper", -50.0), ("lower", 50.0)):
        box = trimesh.creation.box((80, 20, 20)).apply_translation([middle, 0, 0])
        scene.add_bone(name, box)
    scene.add_joint("elbow", "upper", "lower", (0, 0, 0), {"flexion": (0, -1, 0)})
    mesh = trimesh.creation.icosphere(subdivisions=3, radius=1.0)
    mesh.apply_scale([60, 10, 8]).apply_translation([0, 0, 20])
    attach = [{"bone": "upper", "near": 4}, {"bone": "lower", "near": 4}]
    return scene.add_muscle("biceps", mesh, attach=attach)


def rich():
    """A scene with a part of every sort, at coordinates that single precision would round."""
    scene = built()
    scene.bones[0].mesh.vertices += 1e-9
    scene.add_bone("tip")
    scene.add_joint("wrist", "lower", "tip", type="slide", centre=[90, 0, 0], axes={"x": [1, 0, 0]})
    scene.add_coupling("wrist.x", ["elbow.flexion"], linear=[0.125, 0.0])
    biceps = scene.muscles[0]
    line = np.array([[-40.0, 0.1, 20.0], [40.0, 0.2, 20.0]])
    vertices = biceps.mesh.vertices[:, 0]
    attach = [
        {"bone": "upper", "vertices": np.flatnonzero(vertices < -50)},
        {"bone": "upper", "vertices": np.flatnonzero(np.abs(vertices) < 5), "via": True},
        {
            "bone": "lower",
            "vertices": np.flatnonzero(vertices > 50),
            "tendon": {"to": [70.0, 0.0, 11.0], "via": [{"bone": "lower", "point": [65, 0, 18]}]},
        },
    ]
    raised = biceps.mesh.copy().apply_translation([0, 0, 30])
    keys = {"activation": [0.0, 0.5], "fibre_stretch_at_rest": 1.1}
    scene.add_muscle("second", raised, attach=attach, model={"name": "rbf", "centres": 90}, **keys)
    scene.muscles[0].fibres = [line]
    scene.set_motion(ramp={"elbow.flexion": {"from": 0, "to": 30, "step": 10}})
    scene = scene.with_options({"detect.tunnelling.angle": 120.0, "neighbours": False})
    scene.doubts = ["a doubt"]
    scene.joints[1].guess = GuessTable(confidence=0.5, reason="its axis")
    scene.muscles[1].attachments[2].guess = GuessTable(confidence=0.4, reason="its end")
    return scene
