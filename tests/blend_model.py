"""A muscle without mechanics, for tests of what lies around models: vertices blend their bones'
motion.
"""

from pathlib import Path

import numpy as np
import trimesh
from toy_scene import ToyMuscle, ellipsoid, held

from pbd_baseline.settling import MeshSettling
from rbfmuscle.geometry.harmonic import harmonic_weights
from rbfmuscle.scene.options import OutputOptions
from rbfmuscle.scene.scene import Scene
from rbfmuscle.simulation.frame import ModelSurface
from rbfmuscle.validation import SolveError


class BlendMuscle(ToyMuscle):
    """Shows its input mesh carried along; raises SolveError at the ``fail_at``-th solve."""

    fail_at = None

    def _prepare(self):
        held = [np.flatnonzero(self.attached_bone == k) for k in range(len(self.names))]
        bones = [k for k, vertices in enumerate(held) if len(vertices)]
        self.weights = np.zeros((len(self.rest), len(self.names)))
        self.weights[:, bones] = harmonic_weights(self.rest, self.faces, [held[k] for k in bones])

    def predict(self, before, after):
        self.x = self._blend(after)

    def begin(self, contacts):
        self.solves += 1
        if self.solves == self.fail_at:
            raise SolveError(f"muscle {self.name!r}: planted failure")
        free = np.where(self.attached_bone < 0, 1.0, 0.0)
        return MeshSettling(self.x, free, 60.0, lambda number: None, most=1)

    def surface(self, contacts):
        quantities = {
            "solver_penetration_max": 0.0,
            "solver_residual": 0.0,
            "time_extract": 0.001,
        }
        return ModelSurface(self.x.copy(), self.faces, quantities)


def arm_scene(*, end=20, step=10, units="mm"):
    """Two boxes with a hinge between them and an egg of a muscle above, from rest to ``end``
    degrees.
    """
    scene = Scene("arm", units=units)
    for name, place in (("upper", -22), ("fore", 22)):
        scene.add_bone(name, trimesh.creation.box((40, 6, 6)).apply_translation([place, 0, 0]))
    egg = ellipsoid([26, 5, 5], [0, 0, 9.5], subdivisions=3)
    x = egg.vertices[:, 0]
    scene.add_joint("elbow", "upper", "fore", (0, 0, 0), {"flexion": (0, -1, 0)})
    scene.add_muscle("biceps", egg, attach=held(upper=x < -19, fore=x > 19))
    scene.set_motion(ramp={"elbow.flexion": {"to": float(end), "step": float(step)}})
    scene.output = OutputOptions(report=False)
    return scene


# A scene file with places for end, step and defaults.
ARM_FILE = Path(__file__).parent / "data" / "arm.toml"


def arm_files(folder, name="arm.toml", *, end=10, step=5, muscles=(("biceps", 0.0),), defaults=""):
    """Write `arm_scene` as files, its muscle once for each name and shift sideways; return the
    scene file's path.
    """
    scene = arm_scene()
    for bone in scene.bones:
        bone.mesh.export(folder / f"{bone.name}.ply")
    text = ARM_FILE.read_text(encoding="utf-8").format(end=end, step=step, defaults=defaults)
    for muscle, shift in muscles:
        scene.muscles[0].mesh.copy().apply_translation([0, shift, 0]).export(
            folder / f"{muscle}.ply"
        )
        text += f'[[muscle]]\nname = "{muscle}"\nmesh = "{muscle}.ply"\n'
    for attachment in scene.muscles[0].attachments:
        np.savetxt(folder / f"{attachment.bone}.txt", attachment.vertices, fmt="%d")
    (folder / name).write_text(text)
    return folder / name


def use_blend_model(monkeypatch, fail_at=None):
    """Let `rbfmuscle.recording` build BlendMuscle for every muscle."""
    monkeypatch.setattr(BlendMuscle, "fail_at", fail_at)
    monkeypatch.setattr("rbfmuscle.models.build_model", BlendMuscle)


def files_in(folder):
    """Names of all files below a folder, relative to it."""
    return sorted(
        str(path.relative_to(folder)) for path in Path(folder).rglob("*") if path.is_file()
    )
