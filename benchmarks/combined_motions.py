"""Shapes in motions of several coordinates together: handles, flicker, crossings, points that stay beyond bones.

python benchmarks/combined_motions.py phantom            # the embedded hip
python benchmarks/combined_motions.py path/to/flexion.toml --muscles gluteus_maximus --set model.surface=marching
"""

import argparse
import time
from pathlib import Path

import numpy as np

import rbfmuscle as rm
from rbfmuscle.sim.scene.phantom import phantom_scene

# Degrees from rest to the end of each coordinate, all together, or angles of stops on a way.
RAMPS = {
    "flexion, abduction, internal rotation": {"flexion": 90, "adduction": -25, "internal_rotation": 20},
    "flexion, adduction, external rotation": {"flexion": 60, "adduction": 12, "internal_rotation": -25},
}
STEP = 1.5
# A walk of stops up to so many degrees apart, within these bounds.
WALK, FARTHEST, SEED = 40, 20.0, 7
BOUNDS = {"flexion": (-15, 80), "adduction": (-30, 12), "internal_rotation": (-25, 25)}


def ramp(ends: dict) -> dict:
    """A motion option in which all coordinates go together."""
    return {f"hip.{name}": {"from": 0, "to": end, "step": STEP} for name, end in ends.items()}


def walk(stops: int, seed: int = SEED) -> list[dict]:
    """Stops of a random walk, each up to `FARTHEST` degrees from the one before in each coordinate."""
    rng, here, path = np.random.default_rng(seed), dict.fromkeys(BOUNDS, 0.0), [{}]
    for _ in range(stops):
        for name, (low, high) in BOUNDS.items():
            here[name] = float(np.clip(here[name] + rng.uniform(-FARTHEST, FARTHEST), low, high))
        path.append({f"hip.{name}": angle for name, angle in here.items()})
    return path


def measure(scene: rm.Scene) -> list[tuple]:
    """Run a scene; for each muscle its worst figures over the frames."""
    started = time.process_time()
    run = rm.simulate(scene)
    spent = (time.process_time() - started) / len(run.frames)
    rows = []
    for name, found in run.summary.items():
        if name == "all":
            continue
        stayed = sum(e.count for e in run.events if e.muscle == name and e.action == "unresolved")
        euler = run.values(name, "euler")
        worst = [
            found[q]["worst"] for q in ("self_crossing", "flicker_max", "flicker_rms", "unfitted_fraction")
        ]
        rows.append((name, int((euler != 2).sum()), len(euler), *worst, stayed, spent))
    return rows


def main() -> None:
    """Print a table for each motion."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scene", help="phantom, or a scene whose joint is called hip")
    parser.add_argument("--muscles", nargs="*")
    parser.add_argument("--set", nargs="*", default=[], metavar="KEY=VALUE")
    parser.add_argument("--seeds", nargs="*", type=int, help="random walks of these seeds, and nothing else")
    arguments = parser.parse_args()
    scene = phantom_scene() if arguments.scene == "phantom" else rm.Scene.load(Path(arguments.scene))
    settings = dict(text.split("=", 1) for text in arguments.set)
    scene = scene.with_options(settings)
    if arguments.muscles:
        scene.muscles = [scene.muscle(name) for name in arguments.muscles]
    motions = {name: {"ramp": ramp(ends)} for name, ends in RAMPS.items()}
    motions[f"random walk of {WALK} stops"] = {"waypoints": walk(WALK), "step": FARTHEST}
    if arguments.seeds:
        motions = {
            f"random walk of {WALK} stops, seed {seed}": {"waypoints": walk(WALK, seed), "step": FARTHEST}
            for seed in arguments.seeds
        }
    for title, motion in motions.items():
        moved = scene.copy()
        moved.set_motion(**motion)
        print(f"\n{title}: {len(moved.motion)} frames")
        print("| muscle | frames with handles | crossing | flicker max | rms | unfitted | unresolved |")
        print("|---|---|---|---|---|---|---|")
        rows = measure(moved)
        for name, handles, frames, crossing, greatest, rms, unfitted, stayed, _ in rows:
            print(
                f"| {name} | {handles} of {frames} | {crossing:.0f} | {greatest:.2f} | {rms:.3f} "
                f"| {unfitted:.3f} | {stayed} |"
            )
        print(f"{rows[0][-1]:.2f} s of processor time a frame, measures included")


if __name__ == "__main__":
    main()
