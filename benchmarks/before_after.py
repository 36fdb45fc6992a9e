"""What a version of the library makes of the hip's and the leg's motions, beside another version.

    PYTHONPATH=OTHER python benchmarks/before_after.py record FILE   # in each version's own folder
    python benchmarks/before_after.py compare FILE FILE [-o EVIDENCE]

`record` runs motions of the real hip and leg, each over a few frames, and keeps surfaces, material
and poses in FILE. It takes versions from 1.0 on. `compare` measures the recordings of two versions
by the metrics of this one, so that the same is measured of both: the greatest over frames and
muscles, and how many muscles flicker or bow beyond the limits. Penetration is that of the surface
into bones, or of bones into the muscle, whichever is deeper. Time is processor time per frame of
all muscles, with measuring [ms]; none where loops were compiled meanwhile. One pose is reached by
three paths: the RMS distance of material points between the two farthest apart. Lengths in mm.
"""

import argparse
import pickle
import time
from pathlib import Path

import numpy as np
from evidence import data_folder, write_evidence

import rbfmuscle as rm

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
COLUMNS = [
    "motion",
    "version",
    "muscles",
    "rest error, RMS",
    "rest error, greatest",
    "flicker",
    "muscles beyond 0.5",
    "bowing beyond its limit, muscles",
    "bowing, median over rest",
    "penetration",
    "crossing triangles",
    "time",
]


def record(path: Path) -> None:
    """Run all motions with the library that is imported, and keep what they gave."""
    found = {}
    for title, (file, frames) in MOTIONS.items():
        folder, _, name = file.partition("/")
        scene = rm.Scene.load(data_folder(folder) / name)
        chosen = frames or f"{len(scene.motion) // 2}:{len(scene.motion)}:1"
        start = chosen.partition(":")[0]
        alone = f"{start}:{int(start) + 1}:1"
        rm.simulate(scene, frames=alone)
        first = spent(scene, alone)[0]
        seconds, run = spent(scene, chosen)
        rest = spent(scene, "0:1:1")[1].frames[0]
        found[title] = {
            "file": file,
            "time": 1000.0 * (seconds - first) / (len(run.frames) - 1),
            "rest": plain(rest),
            "frames": [plain(frame) for frame in run.frames],
        }
        print(title, len(run.frames), "frames", round(found[title]["time"]), "ms", flush=True)
    found["paths"] = paths()
    path.write_bytes(pickle.dumps(found))


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
        last = len(scene.motion.frames) - 1
        run = rm.simulate(scene, frames=f"{last}:{last + 1}:1")
        ends.append(plain(run.frames[-1])["material"])
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
    still = rest_poses(scene, kept)
    found = {}
    for muscle in scene.muscles:
        vertices, faces = kept["rest"]["material"][muscle.name]
        tracker = MuscleMeasurer(muscle, scene, vertices, faces)
        points, triangles, deepest = kept["rest"]["surfaces"][muscle.name]
        surface = ModelSurface(points, triangles, {"solver_penetration_max": deepest})
        tracker.measure_rest(surface, vertices, probes, still)
        rows = []
        for frame in kept["frames"]:
            points, triangles, _ = frame["surfaces"][muscle.name]
            carried = frame["material"][muscle.name][0]
            surface = ModelSurface(points, triangles)
            rows.append(tracker._of_surface(surface, carried, probes, frame["poses"]))
            rows[-1]["bowing"] = tracker.line.measure(carried, frame["poses"], probes)[1]
        found[muscle.name] = rows, tracker.at_rest
    return found


def rest_poses(scene, kept):
    """Poses of bones and of ends of tendons at rest."""
    names = kept["rest"]["poses"]
    return {name: np.eye(4) for name in names}


def row_of(title, version, kept):
    """A row of the table."""
    found = measured(kept)

    def worst(name):
        return max(max(row[name] for row in rows) for rows, _ in found.values())

    flicker = {
        name: max(row.get("flicker", 0.0) for row in rows[1:]) for name, (rows, _) in found.items()
    }
    bowing = {name: max(row["bowing"] for row in rows) for name, (rows, _) in found.items()}
    at_rest = {name: values["bowing_at_rest"] for name, (_, values) in found.items()}
    beyond = [name for name in bowing if bowing[name] > max(1.03, at_rest[name] + 0.03)]
    over = [bowing[name] - at_rest[name] for name in bowing]
    return [
        title,
        version,
        len(found),
        max(values["rest_error_rms"] for _, values in found.values()),
        max(values["rest_error_max"] for _, values in found.values()),
        max(flicker.values()),
        sum(value > 0.5 for value in flicker.values()),
        len(beyond),
        float(np.median(over)),
        max(worst("penetration_max"), worst("bone_penetration_max")),
        int(worst("self_crossings")),
        kept["time"] if kept["time"] > 0 else None,
    ]


def compare(paths_of, output):
    """Print, and write, the table of recordings, the earlier version's first."""
    recorded = [pickle.loads(path.read_bytes()) for path in paths_of]
    rows = []
    for title in MOTIONS:
        for version, found in zip(("before", "after"), recorded, strict=True):
            rows.append(row_of(title, version, found[title]))
            print(*rows[-1], flush=True)
    ways = [[name, *(found["paths"][name] for found in recorded)] for name in recorded[0]["paths"]]
    print(*ways, sep="\n")
    if output:
        command = ["benchmarks/before_after.py", "compare", *(path.name for path in paths_of)]
        write_evidence(output, command, rows, COLUMNS, one_pose=ways)


def main() -> None:
    """Record, or compare."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("what", choices=("record", "compare"))
    parser.add_argument("files", nargs="+", type=Path)
    parser.add_argument("-o", "--output", type=Path, help="file of evidence for the pages")
    given = parser.parse_args()
    if given.what == "record":
        record(given.files[0])
    else:
        compare(given.files, given.output)


if __name__ == "__main__":
    main()
