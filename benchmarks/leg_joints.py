"""The leg on joints as they are: a knee that rolls and glides, a kneecap by its table, tendons that slide.

    python benchmarks/leg_joints.py knee --models rbf,pbd --output DIR
    python benchmarks/leg_joints.py squat --output DIR
    python benchmarks/leg_joints.py gait --output DIR

The scenes of ``data/leg`` turn the tibia and the kneecap about fixed hinges, and let tendons slide on joints 1 m away.
Here the tibia turns about the published axis and shifts by its published splines, the kneecap follows the knee by the
table in ``scene.json``, and tendon carriers are sliders that follow the joint that drives them. What is moved is hip,
knee and ankle alone.
"""

import argparse
import itertools
import json
import os
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from rbfmuscle.geometry.exact_distance import ExactDistance
from rbfmuscle.run import stream_run
from rbfmuscle.sim.scene.file import read_scene_file
from rbfmuscle.sim.scene.scene import Scene
from rbfmuscle.study.files.saved import SavedRun
from rbfmuscle.study.measure.mesh_distance import MeshDistance

HEADS = {
    "knee": [
        "rectus_femoris", "vastus_intermedius", "vastus_lateralis", "vastus_medialis", "semimembranosus",
        "semitendinosus", "biceps_femoris_long_head", "biceps_femoris_short_head", "gastrocnemius_medial",
        "gastrocnemius_lateral",
    ],
    "squat": None,
    "gait": None,
}  # fmt: skip
FILES = {"knee": "gait.toml", "squat": "squat.toml", "gait": "gait.toml"}
MOTIONS = {
    "knee": {"ramp": {"knee_angle": {"from": 0, "to": 110, "step": 2}}},
    "squat": {
        "ramp": {
            "hip_flexion": {"from": 0, "to": 60, "step": 2},
            "knee_angle": {"from": 0, "to": 70, "step": 2},
            "ankle_angle": {"from": 0, "to": 40, "step": 2},
        }
    },
    "gait": {"file": "gait.mot"},
}


def leg_folder() -> Path:
    """Where ``data/leg`` is."""
    for place in (os.environ.get("RBFMUSCLE_DATA"), Path(__file__).resolve().parents[2] / "shared" / "data"):
        if place and (Path(place) / "leg").is_dir():
            return Path(place) / "leg"
    raise SystemExit("data/leg is not here; set RBFMUSCLE_DATA to the folder that holds leg/")


def leg_scene(folder: Path, which: str, *, muscles: list[str] | None = None) -> Scene:
    """Return a scene of the leg on general joints.

    Parameters
    ----------
    folder : path
        ``data/leg``.
    which : {"knee", "squat", "gait"}
    muscles : list of str, optional
        Those of the scene where not given.
    """
    tables = read_scene_file(folder / FILES[which])
    facts = json.loads((folder / "scene.json").read_text())
    scene = Scene(which, units="mm")
    for bone in tables.bone:
        scene.add_bone(bone.name, folder / bone.mesh)
    add_joints(scene, tables.joint, facts)
    wanted = muscles or HEADS[which]
    for muscle in tables.muscle:
        if wanted is None or muscle.name in wanted:
            attach = [
                {"bone": entry.bone, "vertices": str(folder / entry.vertices)} for entry in muscle.attach
            ]
            model = muscle.model if "model" in muscle.model_fields_set else tables.defaults.model
            scene.add_muscle(muscle.name, folder / muscle.mesh, attach=attach, model=model)
    scene.contact, scene.detect = tables.contact, rm_detect()
    return scene.set_motion(folder=folder, **MOTIONS[which]).validate()


def rm_detect():
    """Tunnelling is looked for, and mended by halving the step."""
    from rbfmuscle.sim.scene.options import DetectOptions

    return DetectOptions(tunnelling={})


def add_joints(scene: Scene, tables: list, facts: dict) -> None:
    """Add the joints of a scene file, with the knee, the kneecap and the tendons as `scene.json` has them."""
    carriers = facts["tendon_carriers"]
    for table in tables:
        if table.name == "knee":
            scene.add_joint("knee", "femur", "tibia", **knee_row(facts["joints"]["knee"]))
        elif table.name == "patella":
            scene.add_joint("patella", "femur", "patella", **patella_row(facts["joints"]["patella"]["table"]))
        elif table.name in carriers:
            scene.add_joint(table.name, table.parent, table.child, **carrier_row(table, carriers[table.name]))
        elif table.name in ("tibiofibular", "midfoot"):
            scene.add_joint(table.name, table.parent, table.child, type="fixed")
        else:
            scene.add_joint(table.name, table.parent, table.child, table.centre, table.axes)
    for joint in scene.joints:
        if joint.name == "patella":
            scene.add_coupling("patella.follow", ["knee.knee_angle"])
        if joint.name in carriers:
            carrier, name = carriers[joint.name], next(iter(joint.coordinates))
            points = np.array(carrier.get("excursion_mm") or carrier["angle_deg"])
            spline = {"x": points[:, 0].tolist(), "y": points[:, 1].tolist()}
            scene.add_coupling(f"{joint.name}.{name}", [carrier["driven_by"]], spline=spline)


# The published splines move the origin of the model's tibia, which lies 28.5 mm above the top of its own tibia mesh.
# ``origin_mm`` of the data lies at the plateau instead: turned about it, the tibia would be 45 mm too low at 90 degrees
# and the kneecap, whose table was made with the hinge, 16 mm inside it.
ABOVE_PLATEAU = 28.5


def knee_row(knee: dict) -> dict:
    """The published knee: a turn about the joint's axis through its origin, then a shift by splines of the angle."""
    shift = knee["published_translation"]
    rows = np.array(shift["table"])
    raised = np.array(shift["origin_mm"]) + ABOVE_PLATEAU * shift["length_ratio"] * np.array(
        shift["superior"]
    )
    return {
        "type": "custom",
        "centre": raised.tolist(),
        "rotations": [{"axis": knee["axis"], "coordinates": ["knee_angle"]}],
        "translations": splines(rows[:, 0], rows[:, 3:6], "knee_angle"),
        "coordinates": {"knee_angle": {"range": [-5.0, 120.0]}},
    }


def patella_row(table: dict) -> dict:
    """The kneecap's table: rotation vectors as turns about its own axes, and shifts, by splines of the knee's angle."""
    rows = np.array(table["rows"])
    turns = Rotation.from_rotvec(rows[:, 1:4], degrees=True).as_euler("XYZ", degrees=True)
    return {
        "type": "custom",
        "centre": table["point_mm"],
        "rotations": splines(rows[:, 0], turns, "follow"),
        "translations": splines(rows[:, 0], rows[:, 4:7], "follow"),
        "coordinates": {"follow": {"motion": "rotation"}},
    }


def carrier_row(table, carrier: dict) -> dict:
    """A tendon's stub: slides along its line, or turns about the tuberosity."""
    name = next(iter(table.axes))
    if "angle_deg" in carrier:
        return {"type": "hinge", "centre": carrier["joint_centre_mm"], "axes": {name: carrier["joint_axis"]}}
    return {"type": "slider", "centre": carrier["start_mm"], "axes": {name: carrier["direction"]}}


def splines(x: np.ndarray, columns: np.ndarray, coordinate: str) -> list[dict]:
    """Three axes that follow one coordinate by natural splines."""
    return [
        {
            "axis": np.eye(3)[k].tolist(),
            "coordinates": [coordinate],
            "natural_spline": {"x": x.tolist(), "y": columns[:, k].tolist()},
        }
        for k in range(3)
    ]


class Watch:
    """Keeps what the figures need: how far each muscle's surface moves from frame to frame."""

    def __init__(self):
        self.before, self.moves = {}, {}

    def __call__(self, models, frame):
        if frame is None:
            return
        for name, (vertices, _) in frame.carried.items():
            if name in self.before:
                way = np.linalg.norm(vertices - self.before[name], axis=1)
                self.moves.setdefault(name, []).append((float(np.sqrt(np.mean(way**2))), float(way.max())))
            self.before[name] = vertices.copy()


def free_depth(scene: Scene, saved: SavedRun, muscle: str, trees: dict[str, ExactDistance]) -> float:
    """Depth [mm] in any bone of the vertices that no bone holds, over the frames whose surface is in a bone.

    A held end is carried rigidly by its bone, up to 35 mm away from it where the data lack the tendon; what drives it
    into another bone is the motion, not the model.
    """
    own = scene.muscle(muscle)
    rest = np.asarray(own.mesh.vertices)
    held = np.zeros(len(rest), dtype=bool)
    for attachment in own.attachments:
        held[np.asarray(attachment.vertices)] = True
    near = MeshDistance(rest, np.asarray(own.mesh.faces)[held[np.asarray(own.mesh.faces)].any(axis=1)])
    start = saved.surface(muscle, saved.frames[0])[0]
    free = near.unsigned(start) > 1.0
    frames, depths = saved.series(muscle, "penetration_max")
    worst = 0.0
    for frame in frames[depths > 0.01]:
        points = saved.surface(muscle, int(frame))[0][free]
        for bone, tree in trees.items():
            pose = saved.poses[int(frame)][bone]
            inside = -tree.signed_distance((points - pose[:3, 3]) @ pose[:3, :3])
            worst = max(worst, float(inside.max()))
    return worst


def figures(directory: Path, watch: Watch, scene: Scene) -> list[dict]:
    """The wanted figures of each muscle of a finished run; jumps of the knee to 90 degrees apart, where tables end."""
    info = json.loads((directory / "run.json").read_text())
    saved = SavedRun(directory)
    angles = [frame["coordinates"].get("knee.knee_angle", 0.0) for frame in info["frames"]]
    within = np.array(angles[1:]) <= 90.0
    trees = {
        b.name: ExactDistance(np.asarray(b.mesh.vertices), np.asarray(b.mesh.faces)) for b in scene.bones
    }
    rows = []
    for name, facts in info["muscles"].items():
        moves = np.array(watch.moves[name])
        rows.append(
            {
                "muscle": name,
                "tunnelled": facts["tunnelled"]["worst"],
                "volume_error": facts["volume_error"]["worst"],
                "penetration_max": facts["penetration_max"]["worst"],
                "penetration_free": free_depth(scene, saved, name, trees),
                "jump_rms": float(moves[:, 0].max() / np.median(moves[:, 0])),
                "jump_max": float(moves[:, 1].max() / np.median(moves[:, 1])),
                "jump_max_90": float(moves[within, 1].max() / np.median(moves[within, 1])),
                "jump_rms_90": float(moves[within, 0].max() / np.median(moves[within, 0])),
                "jump_frame": int(moves[:, 1].argmax() + 1),
            }
        )
    return rows


def main() -> None:
    """Run, and print the figures of each model."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("which", choices=sorted(FILES))
    parser.add_argument("--models", default="rbf")
    parser.add_argument("--muscles", help="only these, by commas")
    parser.add_argument("--frames")
    parser.add_argument("--output", type=Path, required=True)
    parser.add_argument("--no-pictures", action="store_true")
    arguments = parser.parse_args()
    muscles = arguments.muscles.split(",") if arguments.muscles else None
    scene = leg_scene(leg_folder(), arguments.which, muscles=muscles)
    for model in arguments.models.split(","):
        directory, watch = arguments.output / model, Watch()
        other = None if model == "rbf" else model
        stream_run(
            scene, directory, model=other, frames=arguments.frames, watch=watch, pictures=not arguments.no_pictures
        )  # fmt: skip
        rows = figures(directory, watch, scene)
        (directory / "figures.json").write_text(json.dumps(rows, indent=1) + "\n")
        for key, row in itertools.product(("worst",), rows):
            print(
                model,
                key,
                " ".join(f"{k}={v:.3g}" if isinstance(v, float) else f"{k}={v}" for k, v in row.items()),
            )


if __name__ == "__main__":
    main()
