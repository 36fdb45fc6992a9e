"""A strap that a tendon joins to the limb that it moves."""

import trimesh
from toy_scene import held

import rbfmuscle as rm

END = "strap tendon 2 to limb"


def arm(model="pbd", **keys):
    """A limb that hangs on a trunk, and a strap before both that ends 40 mm above the limb."""
    scene = rm.Scene("arm", units="mm")
    for name, middle in (("trunk", 60.0), ("limb", -65.0)):
        mesh = trimesh.creation.cylinder(8.0, 120.0, sections=48)
        scene.add_bone(name, mesh.apply_translation([0.0, 0.0, middle]))
    axes = {"bend": [-1, 0, 0], "turn": [0, 0, 1]}
    scene.add_joint("elbow", "trunk", "limb", type="universal", centre=[0, 0, 0], axes=axes)
    belly = trimesh.creation.capsule(70.0, 9.0, count=[16, 16]).apply_translation(
        [0.0, -20.0, 15.0]
    )
    z = belly.vertices[:, 2]
    attach = held(trunk=z > z.max() - 6.0, limb=z < z.min() + 6.0)
    attach[1]["tendon"] = {"to": [0.0, -8.0, -70.0], **keys}
    return scene.add_muscle("strap", belly, attach=attach, model=model)
