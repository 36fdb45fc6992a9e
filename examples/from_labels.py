"""# From a segmentation to moment arms

Three commands lead from a volume of labels, as segmentation programs write it, to a report of
moment arms:

    rbfmuscle new hip.nii.gz --labels names.json
    rbfmuscle check hip_scene/scene.toml --picture
    rbfmuscle run hip_scene/scene.toml -o out

The volume here is made of the embedded hip first, so that this page needs no data; take your own in
its place.
"""

import json
import shutil
import sys

import nibabel
import numpy as np
from pictures import folder

import rbfmuscle as rm
from rbfmuscle.cli import main
from rbfmuscle.recording import Run

out = folder("from_labels")
VOXEL = 1.5

# A label volume: bones and two muscles of the embedded hip, numbered from 1, in voxels of 1.5 mm.
phantom = rm.phantom_scene()
parts = [*phantom.bones, *phantom.muscles[1:3]]
low = np.min([part.mesh.bounds[0] for part in parts], axis=0) - 4 * VOXEL
high = np.max([part.mesh.bounds[1] for part in parts], axis=0) + 4 * VOXEL
labels = np.zeros(np.ceil((high - low) / VOXEL).astype(int) + 1, dtype=np.uint8)
for number, part in enumerate(parts, start=1):
    first, last = (
        np.round((bound - low) / VOXEL).astype(int) + k
        for bound, k in zip(part.mesh.bounds, (-1, 2))
    )
    box = labels[tuple(slice(a, b) for a, b in zip(first, last))]
    places = low + VOXEL * (first + np.stack(np.indices(box.shape), axis=-1).reshape(-1, 3))
    inside = rm.BoneSDF.from_mesh(part.mesh).distance(places).reshape(box.shape) < 0.0
    box[inside & (box == 0)] = number
# NIfTI's axes point to the right, to the front and up; those of the phantom to the left, to the
# back and up.
affine = np.diag([-VOXEL, -VOXEL, VOXEL, 1.0])
affine[:3, 3] = low * [-1.0, -1.0, 1.0]
nibabel.save(nibabel.Nifti1Image(labels, affine), out / "hip.nii.gz")
names = {str(number): part.name for number, part in enumerate(parts, start=1)}
(out / "names.json").write_text(json.dumps(names))


def command(*words):
    """What you would type."""
    print("$ rbfmuscle", *(str(word).replace(f"{out}/", "") for word in words), flush=True)
    try:
        main([str(word) for word in words])
    except SystemExit as end:
        assert end.code == 0, end.code
    sys.stdout.flush()


# Surfaces without steps, and a scene in which every guess is marked.
command("new", out / "hip.nii.gz", "--labels", out / "names.json", "--force")

# Look at the guesses before anything runs: patches, joint axes, ends far from their bone.
command("check", out / "hip_scene" / "scene.toml", "--picture")
shutil.copy(out / "hip_scene" / "scene.png", out / "guesses.png")

# Moment arms follow from the lengths along the motion; out/report.html draws them.
arms = ["--frames", "0:9:4"]
command("run", out / "hip_scene" / "scene.toml", "-o", out / "run", *arms)

# The check of this page: the same through the meshes that the labels were made of. The surfaces are
# less than a voxel apart, but each scene has guessed patches of its own, and arms differ by some
# millimetres: correct the guesses.
meshes = out / "meshes"
meshes.mkdir(exist_ok=True)
for part in parts:
    part.mesh.export(meshes / f"{part.name}.ply")
command("new", meshes, "--units", "mm", "--force")
found = Run.load(out / "run")
true = rm.simulate(rm.Scene.load(meshes / "scene.toml"), frames="0:9:4")
worst = 0.0
for muscle in true:
    off = found.series(muscle.name, "moment_arm")[1] - muscle.values("moment_arm")
    print(
        f"{muscle.name}: moment arms from the labels differ by "
        f"{np.sqrt(np.mean(off**2)):.2f} mm RMS"
    )
    worst = max(worst, np.sqrt(np.mean(off**2)))
assert worst < 5.0
