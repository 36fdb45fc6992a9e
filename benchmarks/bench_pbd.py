"""Time of the mesh models on the hip, stage by stage, beside libigl's ARAP in the same run.

    NUMBA_NUM_THREADS=2 python benchmarks/bench_pbd.py [--data FOLDER]

FOLDER holds hip/. Figures are the least and the median over the frames of flexion by two degrees [ms].
"""

import argparse
import os
import time
from pathlib import Path

import numpy as np

from rbfmuscle.models import build_model
from rbfmuscle.sim.loop.simulate import simulate_frames
from rbfmuscle.sim.scene.scene import Scene

MODELS = ("pbd", "xpbd", "arap-pbd", "arap-volume", "arap-interleaved")


def timed(function, repeats=20):
    """Least time of a call [ms]; the first, which may compile, is not counted."""
    function()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        function()
        times.append(time.perf_counter() - start)
    return 1e3 * min(times)


def stages(model):
    """Single sweeps of a PBD model's parts."""
    shape, rest, points = model.shape, model.rest, model.points.copy()
    direction = rest.volume.gradient(points)
    return {
        "edges, a sweep": timed(lambda: shape.edges.project(points, rest.inverse_mass)),
        "bending, a sweep": timed(lambda: shape.bending.project(points, rest.inverse_mass)),
        "volume gradient": timed(lambda: rest.volume.gradient(points)),
        "volume step": timed(lambda: rest.volume.restore(points, direction)),
    }


def igl_iteration(model):
    """One ARAP iteration of libigl on the same mesh: half the difference of three and one."""
    import igl

    vertices, faces = model.rest.vertices, np.ascontiguousarray(model.rest.topology.faces)
    held = np.flatnonzero(model.rest.holder >= 0)

    def solve(count):
        data = igl.ARAPData()
        data.max_iter = count
        igl.arap_precomputation(vertices, faces, 3, held, data)
        return lambda: igl.arap_solve(vertices[held], data, vertices)

    return 0.5 * (timed(solve(3), 5) - timed(solve(1), 5))


def run(scene, name):
    """Least and median times of predict and solve for each muscle, and of the whole frame."""
    models = [build_model(muscle, scene, name) for muscle in scene.muscles]
    frames = list(simulate_frames(scene, models, surfaces=False))[1:]
    rows = {
        model.name: np.array(
            [f.times[model.name]["time_predict"] + f.times[model.name]["time_solve"] for f in frames]
        )
        for model in models
    }
    rows["wall"] = np.array([f.wall for f in frames])
    return {key: (1e3 * row.min(), 1e3 * np.median(row)) for key, row in rows.items()}


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    default = Path(__file__).resolve().parents[2] / "shared" / "data"
    parser.add_argument("--data", type=Path, default=Path(os.environ.get("RBFMUSCLE_DATA", default)))
    scene = Scene.load(parser.parse_args().data / "hip" / "flexion.toml")
    alone = scene.copy()
    alone.muscles = [scene.muscle("gluteus_maximus")]
    model = build_model(alone.muscles[0], alone, "pbd")
    for stage, figure in stages(model).items():
        print(f"{stage:36s} {figure:7.2f}")
    arap = build_model(alone.muscles[0], alone, "arap-volume")
    points = arap.points.copy()
    print(f"{'ARAP, an iteration':36s} {timed(lambda: arap.shape.sweep(points, 1.0)):7.2f}")
    print(f"{'ARAP of libigl, an iteration':36s} {igl_iteration(model):7.2f}")
    for name in MODELS:
        for what, chosen in (("alone", alone), ("all four", scene)):
            for key, (least, median) in run(chosen, name).items():
                print(f"{name + ', ' + what + ', ' + key:48s} {least:7.2f} {median:7.2f}", flush=True)


if __name__ == "__main__":
    main()
