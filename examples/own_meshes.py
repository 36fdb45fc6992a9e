"""# Your own meshes

From a folder of STL files to a run: `rbfmuscle new` guesses a scene file, `check` looks at it,
`run` runs it. The files here are written from the embedded hip first, so that this page needs no
data; take your own in their place.
"""

import sys
from pathlib import Path

from pictures import draw, folder

import rbfmuscle as rm
from rbfmuscle.cli import main

out = folder("own_meshes")

# Bones and muscles, one file each. Names such as "femur" or "gluteus" tell bones from muscles;
# others go by size.
meshes = out / "meshes"
meshes.mkdir(exist_ok=True)
phantom = rm.phantom_scene()
for part in [*phantom.bones, *phantom.muscles[:2]]:
    prefix = "muscle_" if part in phantom.muscles else ""
    part.mesh.export(meshes / f"{prefix}{part.name}.stl")


def command(*words):
    """What you would type."""
    print("$ rbfmuscle", *words, flush=True)
    try:
        main([str(word) for word in words])
    except SystemExit as end:
        assert end.code == 0, end.code
    sys.stdout.flush()


command("new", meshes, "--units", "mm", "--force")

# Every guess in the file is marked: the joint's centre, its axes, what is attached to what.
text = (meshes / "scene.toml").read_text(encoding="utf-8")
print("\n".join(line for line in text.splitlines() if "guess = " in line))

# The guessed axes are those of the files. Flexion of this hip is a turn about -x.
(meshes / "scene.toml").write_text(
    text.replace("rotation_x = [1, 0, 0]", "rotation_x = [-1, 0, 0]")
)

command("check", meshes / "scene.toml")
scene = rm.Scene.load(meshes / "scene.toml")
run = rm.simulate(scene, frames="0:16:5")
draw(run, out / "guessed.png")

# The check of this page: the ball joint was found where the phantom has it, and the muscles keep
# their volume.
distance = float((scene.joints[0].centre ** 2).sum() ** 0.5)
print(f"guessed joint centre: {distance:.2f} mm from the true one")
assert distance < 3.0
for muscle in run:
    assert abs(muscle.values("volume_error")).max() < 1e-3
assert Path(meshes / "scene.toml").exists()
