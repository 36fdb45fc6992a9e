"""Shapes in motions of several coordinates together: handles, flicker, crossings, points that stay
beyond bones.

python benchmarks/combined_motions.py phantom            # the embedded hip python
benchmarks/combined_motions.py path/to/flexion.toml --muscles gluteus_maximus --set
model.surface=marching python benchmarks/combined_motions.py path/to/flexion.toml --seeds 7 8 9 10
11 --model pbd
"""

import argparse
import time
from pathlib import Path

import numpy as np
from evidence import write_evidence

import rbfmuscle as rm
from rbfmuscle.scene.phantom import phantom_scene
from rbfmuscle.scene.settings import parse_settings

# Degrees from rest to the end of each coordinate, all together, or angles of stops on a way.
RAMPS = {
    "flexion, abduction, internal rotation": {
        "flexion": 90,
        "adduction": -25,
        "internal_rotation": 20,
    },
    "flexion, adduction, external rotation": {
        "flexion": 60,
        "adduction": 12,
        "internal_rotation": -25,
    },
}
STEP = 1.5
# A walk of stops up to so many degrees apart, within these bounds.
WALK = 40
FARTHEST = 20.0
SEED = 7
# What is shown of each muscle, its greatest over the frames, and the flicker that is wanted [mm].
WORST = (
    "self_crossings",
    "flicker",
    "unfitted_fraction",
    "penetration_max",
    "bone_penetration_max",
    "volume_error",
)
FLICKER = 0.5
BOUNDS = {"flexion": (-15, 80), "adduction": (-30, 12), "internal_rotation": (-25, 25)}


def ramp(ends: dict) -> dict:
    """A motion option in which all coordinates go together."""
    return {f"hip.{name}": {"from": 0, "to": end, "step": STEP} for name, end in ends.items()}


def walk(stops: int, seed: int = SEED) -> list[dict]:
    """Stops of a random walk, each up to `FARTHEST` degrees from the one before in each
    coordinate."""
    rng = np.random.default_rng(seed)
    here = dict.fromkeys(BOUNDS, 0.0)
    path = [{}]
    for _ in range(stops):
        for name, (low, high) in BOUNDS.items():
            here[name] = float(np.clip(here[name] + rng.uniform(-FARTHEST, FARTHEST), low, high))
        path.append({f"hip.{name}": angle for name, angle in here.items()})
    return path


# Column of the table: quantity.
QUANTITY_OF = {
    "surface in bones": "penetration_max",
    "bones in the muscle": "bone_penetration_max",
    "flicker": "flicker",
    "crossing triangles": "self_crossings",
    "without a fit": "unfitted_fraction",
}
COLUMNS = ["muscle", *QUANTITY_OF, "points beyond a bone"]


def measure(scene: rm.Scene, model: str | None) -> tuple[list[tuple], float]:
    """Run a scene; for each muscle its worst figures over the frames, and the processor time of a
    frame [s].
    """
    started = time.process_time()
    run = rm.simulate(scene, model=model)
    spent = (time.process_time() - started) / len(run.frames)
    rows = []
    for name in (muscle.name for muscle in scene.muscles):
        count = {
            action: sum(e.count for e in run.events if e.muscle == name and e.action == action)
            for action in ("unresolved", "held_back")
        }
        euler = run.values(name, "euler_characteristic")
        worst = {
            q: abs(run.values(name, q)).max(initial=0.0) for q in WORST if q in run.summary[name]
        }
        measured = "flicker" in run.summary[name]
        flicker = run.values(name, "flicker") if measured else np.zeros(1)
        rows.append(
            (
                name,
                int((euler != 2).sum()),
                len(euler),
                int((flicker > FLICKER).sum()),
                worst,
                count,
            )
        )
    return rows, spent


def show(title: str, frames: int, rows: list[tuple], spent: float) -> None:
    """Print the table of a motion."""
    print(f"\n{title}: {frames} frames, {spent:.2f} s of processor time each, measures included")
    print(
        "| muscle | frames with handles | crossing | flicker max (frames over 0.5) | unfitted | "
        "surface in bones "
        "| bones in muscle | volume | unresolved | held back |"
    )
    print("|---" * 10 + "|")
    for name, handles, count, over, worst, events in rows:
        print(
            f"| {name} | {handles} of {count} | {worst['self_crossings']:.0f} "
            f"| {worst.get('flicker', 0.0):.2f} ({over}) "
            f"| {worst.get('unfitted_fraction', 0.0):.3f} "
            f"| {worst['penetration_max']:.3f} | {worst['bone_penetration_max']:.3f} "
            f"| {worst['volume_error']:.0e} | {events['unresolved']} | "
            f"{events['held_back']} |",
            flush=True,
        )


def main() -> None:
    """Print a table for each motion."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scene", help="phantom, or a scene whose joint is called hip")
    parser.add_argument("--muscles", nargs="*")
    parser.add_argument("--model")
    parser.add_argument("--set", nargs="*", default=[], metavar="KEY=VALUE")
    parser.add_argument(
        "--seeds", nargs="*", type=int, help="random walks of these seeds, and nothing else"
    )
    parser.add_argument("-o", "--output", type=Path, help="file of evidence for the pages")
    arguments = parser.parse_args()
    scene = (
        phantom_scene() if arguments.scene == "phantom" else rm.Scene.load(Path(arguments.scene))
    )
    scene = scene.with_options(parse_settings(arguments.set))
    if arguments.muscles:
        scene.muscles = [scene.muscle(name) for name in arguments.muscles]
    motions = {name: {"ramp": ramp(ends)} for name, ends in RAMPS.items()}
    motions[f"random walk of {WALK} stops"] = {"waypoints": walk(WALK), "step": FARTHEST}
    if arguments.seeds:
        motions = {
            f"random walk of {WALK} stops, seed {seed}": {
                "waypoints": walk(WALK, seed),
                "step": FARTHEST,
            }
            for seed in arguments.seeds
        }
    found = []
    for title, motion in motions.items():
        moved = scene.with_options()
        moved.set_motion(**motion)
        rows, spent = measure(moved, arguments.model)
        show(title, len(moved.motion), rows, spent)
        found += rows
    if arguments.output:
        command = ["benchmarks/combined_motions.py", arguments.scene, "--seeds"]
        command += map(str, arguments.seeds or [])
        write_evidence(arguments.output, command, worst_by_muscle(found), COLUMNS)


def worst_by_muscle(rows: list[tuple]) -> list[list]:
    """Worst figures of each muscle over all motions, in the order of `COLUMNS`."""
    out = []
    for muscle in dict.fromkeys(row[0] for row in rows):
        own = [row for row in rows if row[0] == muscle]
        worst = [max(float(row[4].get(name, 0.0)) for row in own) for name in QUANTITY_OF.values()]
        out.append([muscle, *worst, sum(row[5]["unresolved"] for row in own)])
    return out


if __name__ == "__main__":
    main()
