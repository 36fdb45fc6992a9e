"""# RBF against PBD

The same scene, the same contacts, the same metrics: an implicit surface of some 150 centres against
a mesh of thousands of vertices.
"""

import numpy as np
from pictures import draw, folder, plot

import rbfmuscle as rm

out = folder("rbf_against_pbd")
scene = rm.phantom_scene()
runs = {model: rm.simulate(scene, model=model, frames="0:46:5") for model in ("rbf", "pbd")}

print(f"{'':24}{'rbf':>12}{'pbd':>12}")
for quantity in (
    "volume_error",
    "penetration_max",
    "bone_penetration_max",
    "edge_strain_rms",
    "time_frame",
):
    values = [
        max(np.abs(run.values(m.name, quantity)).max() for m in scene.muscles)
        for run in runs.values()
    ]
    print(f"{quantity:24}" + "".join(f"{value:12.3g}" for value in values))

for model, run in runs.items():
    draw(run, out / f"{model}.png")


def strains(axes):
    angles = 10.0 * np.arange(10)
    for (model, run), dashes in zip(runs.items(), ("-", "--")):
        for muscle, colour in zip(scene.muscles, ("#b5443f", "#2f6f8f", "#d99a2b", "#4f8a5b")):
            values = run.values(muscle.name, "edge_strain_rms")
            axes.plot(angles, values, dashes, color=colour, label=f"{muscle.name}, {model}")
    axes.set(xlabel="flexion [degree]", ylabel="change of edges, RMS")
    axes.legend(fontsize=7, ncols=2)


plot(out / "strain.png", strains)


def worst(model, quantity):
    """Greatest value of all muscles and frames."""
    return max(np.abs(runs[model].values(muscle.name, quantity)).max() for muscle in scene.muscles)


# The check of this page: both keep their volume; the RBF surface, cut by the bones, stays out of
# them to a hundredth of a millimetre, the mesh to half of one.
assert worst("rbf", "volume_error") < 1e-3
assert worst("pbd", "volume_error") < 1e-3
assert worst("rbf", "penetration_max") < 0.01
assert worst("pbd", "penetration_max") < 0.5
