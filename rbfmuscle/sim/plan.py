"""What a scene will build and do, found without building it."""

import numpy as np

from rbfmuscle.sim.reach import Pace, reached_bones, sampled_poses


def plan_scene(scene):
    """Return what a run of the scene would build.

    Parameters
    ----------
    scene : Scene

    Returns
    -------
    dict
        ``pairs``: muscles and bones that can meet. ``fields``: for each bone that any muscle can reach the
        size of the reached box [scene unit] and its share of the bone's own box. ``muscles``: model and size
        of the input. ``frames``, ``substeps``: of the motion. ``features``: what the scene switches on.

    Notes
    -----
    Boxes are those that the run itself takes: a muscle's box carried by the bones that it is attached to, so
    a pair may be listed that does not come to touch; a pair that is not listed costs nothing.
    """
    regions = reached_bones(scene)
    output = scene.output
    return {
        "units": scene.units,
        "pairs": [{"muscle": muscle, "bone": bone} for muscle, bone in regions],
        "fields": _fields(scene, regions),
        "muscles": [
            {
                "name": muscle.name,
                "model": muscle.model,
                "vertices": len(muscle.mesh.vertices),
                "settings": dict(muscle.options),
            }
            for muscle in scene.muscles
        ],
        "frames": len(scene.motion),
        "substeps": _substeps(scene),
        "poses_sampled": len(sampled_poses(scene)),
        "features": {
            "sliding": scene.sliding is not None and len(scene.muscles) > 1,
            "tunnelling": scene.detect is not None and scene.detect.tunnelling is not None,
            "metrics": bool(output.metrics),
            "surfaces": bool(output.surfaces),
            "report": bool(output.report),
            "preview": bool(output.preview),
        },
    }


def _fields(scene, regions):
    fields = []
    for bone in scene.bones:
        boxes = [box for (_, name), box in regions.items() if name == bone.name]
        if not boxes:
            continue
        own = np.asarray(bone.mesh.bounds, dtype=float)
        low = np.maximum(np.min([box[0] for box in boxes], axis=0), own[0])
        high = np.minimum(np.max([box[1] for box in boxes], axis=0), own[1])
        fields.append(
            {
                "bone": bone.name,
                "triangles": len(bone.mesh.faces),
                "size": (high - low).tolist(),
                "share": float(np.prod(high - low) / np.prod(own[1] - own[0])),
            }
        )
    return fields


def _substeps(scene):
    """Steps of the solver over the motion, from rest; tunnelling may halve some further."""
    pace, before, count = Pace(scene), {}, 0
    for after in scene.motion.frames:
        count += len(pace.split(before, after))
        before = after
    return count
