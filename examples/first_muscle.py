"""# A first muscle

The embedded hip needs no data. Its extensor follows the femur through 60 degrees of flexion, as an implicit RBF
surface; then its volume, its depth in the bones and its length are printed.
"""

import numpy as np
from pictures import draw, folder

import rbfmuscle as rm

out = folder("first_muscle")

# Two bones, one joint, four muscles. `frames` takes every fifth frame of the motion, up to 60 degrees.
scene = rm.phantom_scene()
run = rm.simulate(scene, model="rbf", frames="0:31:5")
print(run)

# A surface is a trimesh.Trimesh, closed, its faces outward, in the scene's unit.
mesh = run["extensor"].surface(frame=-1)
print(f"extensor at 60 degrees: {len(mesh.vertices)} vertices, {mesh.volume / 1000:.1f} cm3")

for name in ("volume_error", "penetration_max", "bone_penetration_max", "length"):
    print(f"{name:22}", np.array2string(run["extensor"].values(name), precision=4, suppress_small=True))

draw(run, out / "rest.png", frame=0)
draw(run, out / "flexed.png")

# The check of this page: volume to 0.1 %, no part of the muscle deeper in a bone than half a millimetre.
assert np.abs(run["extensor"].values("volume_error")).max() < 1e-3
assert run["extensor"].values("penetration_max").max() < 0.5
assert mesh.is_watertight
assert mesh.volume > 0
