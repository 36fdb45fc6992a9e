"""Fitted paths of the embedded hip's four muscles over three coordinates: errors at poses held out.

    python benchmarks/fitted_paths.py --samples 125 --output DIR
    python benchmarks/fitted_paths.py --scene SCENE.toml --range flexion=0:50 --output DIR

Prints the errors; the folder holds what ``rbfmuscle paths`` leaves.
"""

import argparse
from pathlib import Path

from rbfmuscle.commands.opensim.sampling import Sampling, parse_ranges, report_fits
from rbfmuscle.sim.scene.phantom import phantom_scene
from rbfmuscle.sim.scene.scene import Scene

RANGES = ["flexion=0:60", "adduction=-10:10", "internal_rotation=-15:15"]


def main() -> None:
    """Sample, fit, print."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("--scene", type=Path)
    parser.add_argument("--range", action="append", dest="ranges")
    parser.add_argument("--samples", type=int, default=125)
    parser.add_argument("--order", type=int, default=7)
    parser.add_argument("--output", type=Path, required=True)
    arguments = parser.parse_args()
    scene = Scene.load(arguments.scene) if arguments.scene else phantom_scene()
    ranges = parse_ranges(scene, arguments.ranges or RANGES)
    sampling = Sampling(scene, arguments.output, ranges, samples=arguments.samples, kind="sobol")
    sampling.run(lambda done, total: print(f"{done} of {total}", flush=True) if done % 10 == 0 else None)
    print("\n".join(report_fits(sampling, arguments.order)))


if __name__ == "__main__":
    main()
