"""What ``run.json`` says of the parts of a scene."""

import numpy as np

from rbfmuscle.geometry.surfaces import mesh_hash
from rbfmuscle.scene.bone import Bone
from rbfmuscle.scene.objects import Muscle


def record_muscle(muscle: Muscle) -> dict[str, object]:
    """A muscle by its name, options, attachments in numbers, and mesh."""
    keys = muscle.contraction
    return {
        "name": muscle.name,
        "model": {"name": muscle.model, **muscle.options},
        "attach": [
            {"bone": held.bone, "vertices": len(held.vertices)}
            | ({} if held.tendon is None else {"tendon": held.tendon.model_dump()})
            for held in muscle.attachments
        ],
        "fibres": len(muscle.fibres) if muscle.fibres else 0,
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
