"""What a user writes; checked by mypy in its strict mode, and run."""

import sys
from pathlib import Path

import numpy as np
import trimesh

import rbfmuscle as rm

folder = Path(sys.argv[1])
scene: rm.Scene = rm.phantom_scene(end=4.0, step=2.0, spacing=6.0)
scene.muscles = [scene.muscle("abductor")]
changed = scene.with_options({"contact.substep_angle": 1.0}, model="pbd", frames="0:2")
run: rm.Run = rm.simulate(changed)
surface: trimesh.Trimesh = run["abductor"].surface(frame=-1)
error: float = float(np.abs(run.values("abductor", "volume_error")).max())
print(len(run), run.muscles, "abductor" in run, surface.volume, error, run.verdict)
for muscle in run:
    print(muscle.name, muscle.values("length"))
run.save(folder / "out", pictures=False)
again = rm.Run.load(folder / "out")
files: list[Path] = again.export(folder / "stl", "stl")
print(again.quantities, files[0].name)
built = rm.Scene("arm", units="mm").add_bone("upper", trimesh.creation.box((80, 20, 20)))
print([bone.name for bone in built.bones])
try:
    rm.simulate("nowhere.toml")
except rm.SceneError as problem:
    print(problem.exit_code, problem)
mesh = scene.muscle("abductor").mesh
field = rm.RBFField.fit_hermite(mesh.vertices[::20], mesh.vertex_normals[::20], kernel="cubic")
values = field(mesh.vertices)
print(values.shape, rm.BoneSDF.from_mesh(scene.bone("femur").mesh).distance(mesh.vertices).min())
