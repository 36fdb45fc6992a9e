"""Frames per second of a scene, a surface in every frame.

    python benchmarks/frame_rate.py SCENE.toml [...] [--set KEY=VALUE ...] [--repeat N]

The median time from frame to frame without the first, which loads and compiles. Then the median of
each stage of each muscle [ms].
"""

import argparse
from pathlib import Path

import numpy as np

from rbfmuscle.models import build_models
from rbfmuscle.scene.scene import Scene
from rbfmuscle.scene.settings import parse_settings
from rbfmuscle.simulation.frame_loop import simulate_frames


def frames_of(scene):
    """Median time from frame to frame [ms], and the frames without surfaces."""
    frames = []
    for frame in simulate_frames(scene, build_models(scene)):
        frame.surfaces = {}
        frames.append(frame)
    return 1e3 * float(np.median([frame.wall for frame in frames[1:]])), frames[1:]


def measure(path, settings, repeat):
    scene = Scene.load(path).with_options(parse_settings(settings))
    walls = []
    for _ in range(repeat):
        wall, frames = frames_of(scene)
        walls.append(wall)
    low, middle, high = np.percentile(walls, [0, 50, 100])
    print(
        f"{path.stem}: {middle:.1f} ms ({low:.1f} to {high:.1f}), {1e3 / middle:.0f} frames "
        "per second"
    )
    for muscle in scene.muscles:
        times = [frame.times[muscle.name] for frame in frames]
        stages = {key: 1e3 * np.median([t.get(key, 0.0) for t in times]) for key in times[0]}
        print(
            f"  {muscle.name}: "
            + ", ".join(f"{k.removeprefix('time_')} {v:.1f}" for k, v in stages.items())
        )


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scenes", nargs="+", type=Path, metavar="SCENE.toml")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--repeat", type=int, default=3)
    given = parser.parse_args()
    for path in given.scenes:
        measure(path, given.set, given.repeat)


if __name__ == "__main__":
    main()
