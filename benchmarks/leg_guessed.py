"""What `new` makes of a whole leg, against what is known of it: its bare meshes, and the same as labels.

    python benchmarks/leg_guessed.py meshes [--plain]
    python benchmarks/leg_guessed.py labels --voxel 1.0

`meshes`: right bones, hip, axes and middles of patches against ``data/leg/scene.json``; then the file goes through
`check` and `run --frames 0:5`. With ``--plain`` muscles are named Segment_1 and on. `labels`: the 47 meshes as one
volume of labels through `new`; each surface against its mesh, its volume against the label's, with time and memory.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import NamedTuple

import nibabel
import numpy as np
import trimesh
from guesses import run_commands
from label_arms import voxelise

from rbfmuscle.sim.guess.guess import SceneGuess, guess_scene
from rbfmuscle.study.measure.metrics import surface_distance


class Wanted(NamedTuple):
    """A row: what it is, what was found, what was wanted."""

    what: str
    found: str
    wanted: str


def copied(data: Path, facts: dict, folder: Path, *, plain: bool) -> dict[str, str]:
    """Meshes of all bones and muscles in a folder; the true name of each file."""
    names = {}
    for kind in ("bones", "muscles"):
        (folder / kind).mkdir()
        for number, name in enumerate(facts[kind], start=1):
            stem = f"Segment_{number}" if plain and kind == "muscles" else name
            (folder / kind / f"{stem}.ply").write_bytes((data / "leg" / kind / f"{name}.ply").read_bytes())
            names[stem] = name
    return names


def joint_rows(guess: SceneGuess, facts: dict, names: dict[str, str]) -> list[Wanted]:
    """The hip's centre, and the axes of knee and ankle."""
    joints, true = {names[joint.child.name]: joint for joint in guess.joints}, facts["joints"]
    off = np.linalg.norm(joints["femur"].centre - np.array(true["hip"]["centre_mm"]))
    rows = [Wanted("hip's centre", f"{off:.1f} mm", "2 mm")]
    for bone, name, limit in (("tibia", "knee", "6 degrees"), ("talus", "ankle", "10 degrees")):
        axis = joints[bone].axis if joints[bone].kind == "hinge" else None
        cosine = 0.0 if axis is None else min(abs(float(axis @ np.array(true[name]["axis"]))), 1.0)
        rows.append(Wanted(f"{name}'s axis", f"{np.degrees(np.arccos(cosine)):.1f} degrees", limit))
    return rows


def muscle_rows(guess: SceneGuess, facts: dict, names: dict[str, str]) -> list[Wanted]:
    """Muscles on the right bones, those that are not and are not said to be doubtful, and patches."""
    right, away, unsaid = 0, [], []
    for muscle in guess.muscles:
        name = names[muscle.muscle.name]
        true = {a["bone"]: a["centroid_mm"] for a in facts["muscles"][name]["attachments"]}
        points = muscle.muscle.points
        mine = {names[hold.bone.name]: points[hold.vertices].mean(axis=0) for hold in muscle.holds}
        right += set(mine) == set(true)
        if set(mine) != set(true) and not any(muscle.muscle.name in doubt for doubt in guess.doubts()):
            unsaid.append(name)
        away += [float(np.linalg.norm(mine[bone] - true[bone])) for bone in true if bone in mine]
    return [
        Wanted("muscles whose bones are all right", f"{right} of {len(guess.muscles)}", "34"),
        Wanted("others that are not marked as doubtful", ", ".join(unsaid) or "none", "none"),
        Wanted("middles of patches, median", f"{np.median(away):.1f} mm", "12 mm"),
        Wanted("the same, 90 % are nearer than", f"{np.percentile(away, 90):.1f} mm", ""),
    ]


def of_meshes(data: Path, *, plain: bool) -> list[Wanted]:
    """All rows of the bare meshes."""
    facts = json.loads((data / "leg" / "scene.json").read_text(encoding="utf-8"))
    with tempfile.TemporaryDirectory() as home:
        folder = Path(home)
        names = copied(data, facts, folder, plain=plain)
        guess = guess_scene(folder, "mm", folder)
        rows = joint_rows(guess, facts, names) + muscle_rows(guess, facts, names)
        wrong = run_commands(folder, "mm")
        rows.append(Wanted("new, check, run --frames 0:5", wrong or "end well", "end well"))
    return rows


def spent_by(words: list[str]) -> tuple[float, float]:
    """Processor time [s] and greatest memory [GB] of a command."""
    process = subprocess.Popen([sys.executable, "-m", "rbfmuscle", *words], stdout=subprocess.DEVNULL)
    _, status, used = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise SystemExit(f"rbfmuscle {words[0]} ended with {process.returncode}")
    return used.ru_utime + used.ru_stime, used.ru_maxrss / 1e6


def of_labels(data: Path, voxel: float) -> list[Wanted]:
    """All rows of the leg as labels."""
    facts = json.loads((data / "leg" / "scene.json").read_text(encoding="utf-8"))
    # Where two overlap at rest the voxel is the first one's: what bones cut from muscles would be no smoothing's fault.
    paths = [data / "leg" / "muscles" / f"{name}.ply" for name in facts["muscles"]]
    paths += [data / "leg" / "bones" / f"{name}.ply" for name in facts["bones"]]
    meshes = {path.stem: trimesh.load_mesh(path) for path in paths}
    labels, affine = voxelise(meshes, voxel)
    sizes = np.bincount(labels.ravel())[1:] * voxel**3
    with tempfile.TemporaryDirectory() as home:
        folder = Path(home)
        image = nibabel.Nifti1Image(labels, affine)
        image.header.set_xyzt_units("mm")
        nibabel.save(image, folder / "leg.nii.gz")
        names = {str(number): name for number, name in enumerate(meshes, start=1)}
        (folder / "names.json").write_text(json.dumps(names), encoding="utf-8")
        spent, memory = spent_by(
            [
                "new",
                str(folder / "leg.nii.gz"),
                "--labels",
                str(folder / "names.json"),
                "-o",
                str(folder / "s.toml"),
            ]
        )
        found = {path.stem: trimesh.load_mesh(path) for path in (folder / "meshes").glob("*.ply")}
    muscles, bones = list(facts["muscles"]), list(facts["bones"])
    apart = {
        name: surface_distance(found[name].vertices, found[name].faces, mesh.vertices, mesh.faces)
        for name, mesh in meshes.items()
        if name in found
    }
    worst = max(muscles, key=lambda name: apart[name][0])
    volumes = [abs(found[name].volume / size - 1.0) for name, size in zip(meshes, sizes) if name in muscles]
    spheres = sum(found[name].euler_number == 2 and found[name].body_count == 1 for name in muscles)
    return [
        Wanted("surfaces of labels", f"{len(found)} of {len(meshes)}", "all"),
        Wanted(
            "muscles from their meshes, RMS of the worst", f"{apart[worst][0]:.2f} mm ({worst})", "0.25 mm"
        ),
        Wanted(
            "bones", ", ".join(f"{name} {apart[name][0]:.2f}" for name in bones if name in apart), "0.25 mm"
        ),
        Wanted("volumes of muscles from their labels', worst", f"{100 * max(volumes):.4f} %", "0.5 %"),
        Wanted("muscles that are spheres", f"{spheres} of {len(muscles)}", "all"),
        Wanted("processor time of `new`", f"{spent:.0f} s", "180 s on two cores"),
        Wanted("its greatest memory", f"{memory:.2f} GB", "2 GB"),
    ]


def main() -> None:
    """Print the rows."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("what", choices=("meshes", "labels"))
    parser.add_argument("--plain", action="store_true", help="muscles named Segment_1 and on")
    parser.add_argument("--voxel", type=float, default=1.0)
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    asked = parser.parse_args()
    rows = (
        of_meshes(asked.data, plain=asked.plain)
        if asked.what == "meshes"
        else of_labels(asked.data, asked.voxel)
    )
    print("| what | found | wanted |\n|---|---|---|")
    for row in rows:
        print(f"| {row.what} | {row.found} | {row.wanted} |")


if __name__ == "__main__":
    main()
