"""A muscle without mechanics, for tests of what lies around models: vertices blend their bones' motion."""

from pathlib import Path

import numpy as np
import trimesh
from toy_scene import ToyMuscle

from rbfmuscle.geometry.harmonic import harmonic_weights
from rbfmuscle.scene.options import OutputOptions
from rbfmuscle.scene.scene import Scene
from rbfmuscle.simulation.frame import FinishedDrawing, ModelSurface
from rbfmuscle.validation import SolveError


class BlendMuscle(ToyMuscle):
    """Shows its input mesh carried along; raises SolveError at the ``fail_at``-th solve."""

    fail_at = None

    def _prepare(self):
        held = [np.flatnonzero(self.contact_bone == k) for k in range(len(self.names))]
        bones = [k for k, vertices in enumerate(held) if len(vertices)]
        self.weights = np.zeros((len(self.rest), len(self.names)))
        self.weights[:, bones] = harmonic_weights(self.rest, self.faces, [held[k] for k in bones])

    def predict(self, before, after):
        self.x = self._blend(after)

    def solve(self, contacts):
        self.solves += 1
        if self.solves == self.fail_at:
            raise SolveError(f"muscle {self.name!r}: planted failure")

    def drawing(self, contacts):
        quantities = {"solver_penetration_max": 0.0, "time_extract": 0.001}
        return FinishedDrawing(ModelSurface(self.x.copy(), self.faces, quantities))


def arm_scene(*, end=20, step=10, units="mm", **output):
    """Two boxes with a hinge between them and an egg of a muscle above, from rest to ``end`` degrees."""
    scene = Scene("arm", units=units)
    upper, fore = trimesh.creation.box((40, 6, 6)), trimesh.creation.box((40, 6, 6))
    upper.apply_translation([-22, 0, 0])
    fore.apply_translation([22, 0, 0])
    egg = trimesh.creation.icosphere(subdivisions=3)
    egg = trimesh.Trimesh(egg.vertices * [26, 5, 5] + [0, 0, 9.5], egg.faces, process=False)
    x = egg.vertices[:, 0]
    attach = [
        {"bone": "upper", "vertices": np.flatnonzero(x < -19).tolist()},
        {"bone": "fore", "vertices": np.flatnonzero(x > 19).tolist()},
    ]
    scene.add_bone("upper", upper).add_bone("fore", fore)
    scene.add_joint("elbow", "upper", "fore", (0, 0, 0), {"flexion": (0, -1, 0)})
    scene.add_muscle("biceps", egg, attach=attach)
    scene.set_motion(ramp={"elbow.flexion": {"to": float(end), "step": float(step)}})
    scene.output = OutputOptions(**{"report": False, **output})
    return scene


ARM_FILE = """[scene]
format = 1
name = "arm"
units = "{units}"
[[bone]]
name = "upper"
mesh = "upper.ply"
[[bone]]
name = "fore"
mesh = "fore.ply"
[[joint]]
name = "elbow"
parent = "upper"
child = "fore"
centre = [0, 0, 0]
axes = {{ flexion = [0, -1, 0] }}
[motion]
ramp = {{ "elbow.flexion" = {{ from = 0, to = {end}, step = {step} }} }}
[defaults]
{defaults}attach = [{{ bone = "upper", vertices = "upper.txt" }}, {{ bone = "fore", vertices = "fore.txt" }}]
[output]
report = false
"""


def arm_files(
    folder, name="arm.toml", *, end=10, step=5, muscles=(("biceps", 0.0),), defaults="", scale=1.0, units="mm"
):
    """Write `arm_scene` as files, its muscle once for each name and shift sideways; return the scene file's path."""
    scene = arm_scene()
    for bone in scene.bones:
        bone.mesh.copy().apply_scale(scale).export(folder / f"{bone.name}.ply")
    text = ARM_FILE.format(end=end, step=step, defaults=defaults, units=units)
    for muscle, shift in muscles:
        mesh = scene.muscles[0].mesh.copy()
        mesh.apply_translation([0, shift, 0])
        mesh.apply_scale(scale)
        mesh.export(folder / f"{muscle}.ply")
        text += f'[[muscle]]\nname = "{muscle}"\nmesh = "{muscle}.ply"\n'
    for attachment in scene.muscles[0].attachments:
        np.savetxt(folder / f"{attachment.bone}.txt", attachment.vertices, fmt="%d")
    (folder / name).write_text(text)
    return folder / name


def use_blend_model(monkeypatch, fail_at=None):
    """Let `rbfmuscle.run` build BlendMuscle for every muscle."""
    monkeypatch.setattr(BlendMuscle, "fail_at", fail_at)
    monkeypatch.setattr("rbfmuscle.models.build_model", BlendMuscle)


def files_in(folder):
    """Names of all files below a folder, relative to it."""
    return sorted(str(path.relative_to(folder)) for path in Path(folder).rglob("*") if path.is_file())
