"""The mesh models beside the RBF muscle on the phantom: sweeps, time, distance, and what is left
after the way back.

    python benchmarks/mesh_models.py [--models rbf,pbd,pbd-converged] [-o FILE.json]

Flexion to 90 degrees and back. The time is the median processor time per frame of one thread over
that of ``pbd``; the distance is RMS between the model's surface and that of the RBF muscle at 90
degrees, the return RMS between the first and the last frame, the greater of both muscles [mm].
"""

import argparse
import time
from pathlib import Path

import numpy as np
from evidence import write_evidence

from rbfmuscle.geometry.threads import threads_limited
from rbfmuscle.metrics.metrics import surface_distance
from rbfmuscle.models import build_models
from rbfmuscle.scene.phantom import phantom_scene
from rbfmuscle.simulation.frame_loop import simulate_frames

MODELS = ("rbf", "pbd", "pbd-converged", "xpbd", "arap-pbd", "arap-volume")
MUSCLES = ("extensor", "adductor_anterior")
COLUMNS = ["model", "sweeps", "time / pbd", "distance from RBF", "return"]


def play(model, step):
    """First, middle and last surfaces by muscle, the mean sweeps, and the processor time [s]."""
    scene = phantom_scene(model=model)
    scene.muscles = [scene.muscle(name) for name in MUSCLES]
    stops = [{"hip.flexion": angle} for angle in (0.0, 90.0, 0.0)]
    scene.set_motion(waypoints=stops, step=step)
    kept = []
    sweeps = []
    last = len(scene.motion) - 1
    stamps = []
    for k, frame in enumerate(simulate_frames(scene, build_models(scene))):
        stamps.append(time.process_time())
        known = [surface.quantities for surface in frame.surfaces.values()] if k else []
        sweeps += [q["solver_sweeps"] for q in known if "solver_sweeps" in q]
        if k in (0, last // 2, last):
            kept.append({name: frame.surfaces[name] for name in MUSCLES})
    spent = float(np.median(np.diff(stamps)))  # the first frames may compile
    return kept, float(np.mean(sweeps)) if sweeps else None, spent


def away(one, other):
    """Greater RMS distance of two muscles' surfaces [mm]."""
    pairs = ((one[name], other[name]) for name in MUSCLES)
    return max(
        float(surface_distance(a.vertices, a.faces, b.vertices, b.faces)[0]) for a, b in pairs
    )


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--models", default=",".join(MODELS))
    parser.add_argument("--step", type=float, default=2.0, help="degrees from frame to frame")
    parser.add_argument("-o", "--output", type=Path)
    given = parser.parse_args()
    found = {}
    for model in dict.fromkeys(["rbf", "pbd", *given.models.split(",")]):
        found[model] = play(model, given.step)
        print(model, f"{found[model][2]:.3f} s a frame, sweeps {found[model][1]}", flush=True)
    rows = []
    for model, (kept, sweeps, spent) in found.items():
        apart = away(kept[1], found["rbf"][0][1]) if model != "rbf" else None
        rows.append([model, sweeps, spent / found["pbd"][2], apart, away(kept[0], kept[2])])
        print(*rows[-1], flush=True)
    if given.output:
        write_evidence(given.output, ["benchmarks/mesh_models.py"], rows, COLUMNS)


if __name__ == "__main__":
    with threads_limited(1):
        main()
