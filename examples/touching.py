"""# Muscles that touch

Two adductors lie on each other. With `neighbours = false` each knows the bones alone: in extension
they grow into one another. As a scene has it unless it says otherwise, they press on each other and
slide.
"""

import numpy as np
from pictures import draw, folder, plot

import rbfmuscle as rm
from rbfmuscle.geometry.mesh_distance import MeshDistance
from rbfmuscle.scene.options import NeighbourOptions

out = folder("touching")
scene = rm.phantom_scene()
scene.muscles = [muscle for muscle in scene.muscles if muscle.name.startswith("adductor")]
scene.set_motion(ramp={"hip.flexion": {"from": 0.0, "to": -20.0, "step": 4.0}})


def gap(run, frame):
    """Least distance of the two adductors [mm], negative where they overlap."""
    one, other = (muscle.surface(frame) for muscle in run)
    return MeshDistance(other.vertices, other.faces).signed(np.asarray(one.vertices)).min()


gaps = {}
for name, neighbours in (("apart", None), ("touching", NeighbourOptions())):
    scene.neighbours = neighbours
    run = rm.simulate(scene)
    gaps[name] = np.array([gap(run, k) for k in range(len(run.frames))])
    print(f"{name:8} gap [mm]:", np.round(gaps[name], 2))
    draw(run, out / f"{name}.png", views=["front", "back"])


def lines(axes):
    for name, values in gaps.items():
        axes.plot(4.0 * np.arange(len(values)), values, label=name)
    axes.axhline(0.0, color="#999999", lw=0.8)
    axes.set(xlabel="extension [degree]", ylabel="gap [mm]")
    axes.legend()


plot(out / "gap.png", lines)

# The check of this page: unfelt they overlap, in touch by less than a third of a millimetre.
assert gaps["apart"].min() < -1.0
assert gaps["touching"].min() > -0.3
