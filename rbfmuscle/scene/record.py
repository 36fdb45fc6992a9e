"""What ``run.json`` says of a scene."""

from __future__ import annotations

import numpy as np

from rbfmuscle.geometry.surfaces import mesh_hash
from rbfmuscle.scene.bone import Bone
from rbfmuscle.scene.joints.joint import all_coordinates
from rbfmuscle.scene.joints.tables import coupling_row, joint_row
from rbfmuscle.scene.objects import Muscle
from rbfmuscle.scene.scene import Scene


def record_scene(scene: Scene) -> dict[str, object]:
    """A scene as plain data: names, counts, options, sources and hashes."""
    known = all_coordinates(scene.joints)
    units = {name: coordinate.unit_sign(scene.units) for name, coordinate in known.items()}
    motion = scene.motion.options.model_dump(mode="json", by_alias=True, exclude_none=True)
    times = {} if scene.motion.times is None else {"times": scene.motion.times}
    return {
        "name": scene.name,
        "units": scene.units,
        "file": str(scene.path) if scene.path else None,
        "superior": scene.superior,
        "anterior": scene.anterior,
        "bones": [{"name": bone.name, **record_mesh(bone)} for bone in scene.bones],
        "meshless_bones": list(scene.meshless_bones),
        "missing_bones": list(scene.missing_bones),
        "doubts": list(scene.doubts),
        "guesses": [guess._asdict() for guess in scene.guesses],
        "notes": list(scene.notes),
        "joints": [joint_row(joint) for joint in scene.joints],
        "couplings": [coupling_row(coupling, scene.joints) for coupling in scene.couplings],
        "coordinate_units": {name: unit for name, unit in units.items() if unit != "°"},
        "motion": {**motion, "frames": len(scene.motion), "whole": scene.motion.whole, **times},
        "muscles": [record_muscle(muscle) for muscle in scene.muscles],
        "contact": scene.contact.model_dump(),
        "neighbours": scene.neighbours.model_dump() if scene.neighbours else False,
        "detect": scene.detect.model_dump(),
        "output": scene.output.model_dump(),
    }


def record_muscle(muscle: Muscle) -> dict[str, object]:
    """A muscle by its name, options, attachments in numbers, and mesh."""
    keys = muscle.contraction
    return {
        "name": muscle.name,
        "model": {"name": muscle.model, **muscle.options},
        "attach": [
            {"bone": held.bone, "vertices": len(held.vertices)}
            | ({} if held.tendon is None else {"tendon": held.tendon.model_dump()})
            | ({"via": True} if held.via else {})
            for held in muscle.attachments
        ],
        "fibres": len(muscle.fibres) if muscle.fibres else 0,
        "aponeuroses": [len(patch) for patch in muscle.aponeuroses],
        **({} if keys is None else keys.model_dump(exclude_none=True)),
        **record_mesh(muscle),
    }


def record_mesh(item: Bone | Muscle) -> dict[str, object]:
    """Source, size and hash of a mesh."""
    vertices = np.asarray(item.mesh.vertices)
    faces = np.asarray(item.mesh.faces)
    return {
        "mesh": item.source,
        "vertices": len(vertices),
        "triangles": len(faces),
        "volume": float(item.mesh.volume),
        "sha256": mesh_hash(vertices, faces),
        "mended": list(item.notes),
    }
