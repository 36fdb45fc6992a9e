"""What a version of the library makes of the hip's and the leg's motions, beside another version.

    PYTHONPATH=OTHER python benchmarks/before_after.py --record OTHER.pkl
    python benchmarks/before_after.py [--before OTHER.pkl] [--after THIS.pkl] [-o EVIDENCE]

Motions of the real hip and leg, each over a few frames. `--record` keeps surfaces, material and
poses of a version, from 1.0 on, in a file. Those of two versions are measured by the metrics of
this one, so that the same is measured of both, but for the error at rest: the greatest over frames
and muscles, and how many muscles flicker or bow beyond the limits. Without `--after` the motions
are run, without `--before` the rows of the other version are those in the file of evidence.
Penetration is that of the surface into bones, or of bones into the muscle, whichever is deeper.
Time is processor time per frame of all muscles, with measuring [ms]; none where loops were compiled
meanwhile. One pose is reached by three paths: the RMS distance of material points between the two
farthest apart. Lengths in mm.
"""

import argparse
import json
import pickle
import time
from pathlib import Path

import numpy as np
from evidence import ROOT, data_folder, write_evidence

import rbfmuscle as rm
from rbfmuscle.scene.objects import Motion

# Scene and frames of each motion: of the hip those from halfway on, of the leg fewer.
MOTIONS = {
    "hip, flexion": ("hip/flexion.toml", "22:46:1"),
    "hip, extension": ("hip/extension.toml", ""),
    "hip, adduction": ("hip/adduction.toml", ""),
    "hip, external rotation": ("hip/external_rotation.toml", ""),
    "hip, internal rotation": ("hip/internal_rotation.toml", ""),
    "leg, squat": ("leg/tendons/squat.toml", "24:36:1"),
    "leg, gait": ("leg/tendons/gait.toml", "0:51:3"),
}
FLEXION, ADDUCTION = {"hip.flexion": 60.0}, {"hip.adduction": -25.0}
END = {**FLEXION, **ADDUCTION}
PATHS = (([{}, FLEXION, END], 5.0), ([{}, ADDUCTION, END], 5.0), ([{}, END], 10.0))
PATHS_APART = "one pose by three paths"
COLUMNS = [
    "motion",
    "version",
    "rest error, RMS",
    "flicker",
    "muscles that flicker",
    "muscles that bow",
    "penetration",
    "crossing triangles",
    PATHS_APART,
    "time",
]
NOTE = "Before is commit 6dde41ae."
EVIDENCE = ROOT / "docs" / "evidence" / "before_after.json"


def recorded() -> dict[str, object]:
    """All motions with the library that is imported."""
    found: dict[str, object] = {}
    for title, (file, frames) in MOTIONS.items():
        folder, _, name = file.partition("/")
        scene = rm.Scene.load(data_folder(folder) / name)
        chosen = frames or f"{len(scene.motion) // 2}:{len(scene.motion)}:1"
        start = chosen.partition(":")[0]
        alone = f"{start}:{int(start) + 1}:1"
        rm.simulate(scene, frames=alone)
        first = spent(scene, alone)[0]
        seconds, run = spent(scene, chosen)
        found[title] = {
            "file": file,
            "time": 1000.0 * (seconds - first) / (len(run.frames) - 1),
            **at_rest(scene),
            "frames": [plain(frame) for frame in run.frames],
        }
        print(title, len(run.frames), "frames", flush=True)
    found["paths"] = paths()
    return found


def at_rest(scene):
    """The muscles at rest, and the version's own rest errors (RMS)."""
    still = scene.with_options()
    still.motion = Motion([{}])
    run = rm.simulate(still)
    errors = {
        muscle.name: float(run.values(muscle.name, "rest_error_rms")[0]) for muscle in scene.muscles
    }
    return {"rest": plain(run.frames[0]), "rest_errors": errors}


def spent(scene, frames):
    """Processor time of a run [s], and the run."""
    started = time.process_time()
    run = rm.simulate(scene, frames=frames)
    return time.process_time() - started, run


def plain(frame):
    """A frame as arrays: poses, and of each muscle surface and material."""
    material = frame.material_meshes if hasattr(frame, "material_meshes") else frame.carried
    shown = {
        name: (
            np.asarray(surface.vertices),
            np.asarray(surface.faces),
            float(surface.quantities.get("solver_penetration_max", 0.0)),
        )
        for name, surface in frame.surfaces.items()
    }
    meshes = {name: tuple(map(np.asarray, mesh)) for name, mesh in material.items()}
    return {"poses": dict(frame.poses), "surfaces": shown, "material": meshes}


def paths():
    """Greatest RMS distance between paths to one pose, by muscle of the hip [mm]."""
    ends = []
    for waypoints, step in PATHS:
        scene = rm.Scene.load(data_folder("hip") / "flexion.toml")
        scene.muscles = [scene.muscle(name) for name in ("gluteus_maximus", "iliacus")]
        scene.set_motion(waypoints=waypoints, step=step)
        # All frames: alone, the last one would be reached straight from rest.
        ends.append(plain(rm.simulate(scene).frames[-1])["material"])
    return {
        name: max(
            float(np.sqrt(((a[name][0] - b[name][0]) ** 2).sum(axis=1).mean()))
            for a in ends
            for b in ends
        )
        for name in ends[0]
    }


def measured(kept):
    """Values by muscle and quantity of a motion that was recorded, by this version's metrics."""
    from rbfmuscle.metrics.metrics import MuscleMeasurer
    from rbfmuscle.simulation.frame import ModelSurface

    folder, _, name = kept["file"].partition("/")
    scene = rm.Scene.load(data_folder(folder) / name)
    probes = [bone.exact for bone in scene.bones]
    found = {}
    for muscle in scene.muscles:
        vertices, faces = kept["rest"]["material"][muscle.name]
        tracker = MuscleMeasurer(muscle, scene, vertices, faces)
        rows = []
        for frame in kept["frames"]:
            points, triangles, _ = frame["surfaces"][muscle.name]
            carried = frame["material"][muscle.name][0]
            surface = ModelSurface(points, triangles)
            rows.append(tracker._of_surface(surface, carried, probes, frame["poses"]))
            rows[-1]["bowing"] = tracker.line.measure(carried, frame["poses"], probes)[1]
        still = tracker.line.measure(vertices, kept["rest"]["poses"], probes)[1]
        found[muscle.name] = rows, still
    return found


def row_of(title, version, kept):
    """A row of the table."""
    found = measured(kept)

    def worst(name):
        return max(max(row[name] for row in rows) for rows, _ in found.values())

    flicker = {
        name: max(row.get("flicker", 0.0) for row in rows[1:]) for name, (rows, _) in found.items()
    }
    bowing = {name: max(row["bowing"] for row in rows) for name, (rows, _) in found.items()}
    still = {name: value for name, (_, value) in found.items()}
    beyond = [name for name in bowing if bowing[name] > max(1.03, still[name] + 0.03)]
    return [
        title,
        version,
        max(kept["rest_errors"].values()),
        max(flicker.values()),
        int(sum(value > 0.5 for value in flicker.values())),
        len(beyond),
        max(worst("penetration_max"), worst("bone_penetration_max")),
        int(worst("self_crossings")),
        None,
        kept["time"] if kept["time"] > 0 else None,
    ]


def table(version: str, found: dict) -> list[list]:
    """Rows of one version, printed."""
    rows = [row_of(title, version, found[title]) for title in MOTIONS]
    rows[0][COLUMNS.index(PATHS_APART)] = max(found["paths"].values())
    for row in rows:
        print(*row, flush=True)
    return rows


def main() -> None:
    """Record, or compare."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--record", type=Path, help="file for what this version gives")
    parser.add_argument("--before", type=Path, help="recording of the other version")
    parser.add_argument("--after", type=Path, help="recording of this version")
    parser.add_argument("-o", "--output", type=Path, help="file of evidence for the pages")
    given = parser.parse_args()
    if given.record:
        given.record.write_bytes(pickle.dumps(recorded()))
        return
    if given.before:
        other = table("before", pickle.loads(given.before.read_bytes()))
    else:
        kept = json.loads(EVIDENCE.read_text(encoding="utf-8"))
        other = [row for row in kept["rows"] if row[1] == "before"]
    this = table("after", pickle.loads(given.after.read_bytes()) if given.after else recorded())
    rows = [row for pair in zip(other, this, strict=True) for row in pair]
    if given.output:
        write_evidence(given.output, ["benchmarks/before_after.py"], rows, COLUMNS, note=NOTE)


if __name__ == "__main__":
    main()
