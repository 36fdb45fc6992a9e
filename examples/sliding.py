"""# Neighbours that slide

Two adductors lie on each other. Without `[sliding]` each knows the bones alone: in extension they
grow into one another. With it, they keep their distance and slide.
"""

import numpy as np
from pictures import draw, folder, plot

import rbfmuscle as rm
from rbfmuscle.geometry.mesh_distance import MeshDistance
from rbfmuscle.scene.options import SlidingOptions

out = folder("sliding")
scene = rm.phantom_scene()
scene.muscles = [muscle for muscle in scene.muscles if muscle.name.startswith("adductor")]
scene.set_motion(ramp={"hip.flexion": {"from": 0.0, "to": -20.0, "step": 4.0}})


def gap(run, frame):
    """Least distance of the two adductors [mm], negative where they overlap."""
    one, other = (muscle.surface(frame) for muscle in run)
    return MeshDistance(other.vertices, other.faces).signed(np.asarray(one.vertices)).min()


gaps = {}
for name, sliding in (("without", None), ("with", SlidingOptions())):
    scene.sliding = sliding
    run = rm.simulate(scene)
    gaps[name] = np.array([gap(run, k) for k in range(len(run.frames))])
    print(f"{name:8} sliding, gap [mm]:", np.round(gaps[name], 2))
    draw(run, out / f"{name}.png", views=["front", "back"])


def lines(axes):
    for name, values in gaps.items():
        axes.plot(4.0 * np.arange(len(values)), values, label=f"{name} [sliding]")
    axes.axhline(0.0, color="#999999", lw=0.8)
    axes.set(xlabel="extension [degree]", ylabel="gap [mm]")
    axes.legend()


plot(out / "gap.png", lines)

# The check of this page: without sliding they overlap, with it by less than a tenth of a
# millimetre.
assert gaps["without"].min() < -1.0
assert gaps["with"].min() > -0.1
