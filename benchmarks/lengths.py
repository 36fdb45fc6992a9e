"""Lengths and moment arms of a scene's muscles over a ramp of one coordinate, and whether arms integrate to lengths.

    python benchmarks/lengths.py SCENE.toml [-o docs/evidence/lengths.json]

RBF model, the scene's own frames. Lengths in the scene's unit, moment arms in that unit a radian; the sum rule is the
greatest deviation of the integral of the arms from the change of length, relative to the greatest change.
"""

import argparse
from pathlib import Path

import numpy as np
from evidence import write_evidence

import rbfmuscle as rm

SHOWN = 4  # frames, evenly from the first to the last


def rows_of(scene):
    """Of each muscle lengths and arms in the frames shown, and how well they sum up."""
    run = rm.simulate(scene, model="rbf")
    (coordinate,) = scene.motion.coordinates
    angles = np.array([frame.coordinates[coordinate] for frame in run.frames])
    shown = np.linspace(0, len(angles) - 1, SHOWN).round().astype(int)
    rows = {}
    for muscle in run:
        length, arm = muscle.values("length"), muscle.values("moment_arm")
        steps = 0.5 * (arm[1:] + arm[:-1]) * np.diff(angles)
        change = length - length[0]
        apart = np.abs(change + np.concatenate([[0.0], np.cumsum(steps)])).max() / np.abs(change).max()
        rows[muscle.name] = {
            "lengths": length[shown].tolist(),
            "arms": arm[shown].tolist(),
            "sum_rule": float(apart),
        }
    return rows, np.degrees(angles[shown]).round(6).tolist()


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("scene", type=Path)
    parser.add_argument("-o", "--output", type=Path)
    given = parser.parse_args()
    rows, angles = rows_of(rm.Scene.load(given.scene))
    for name, row in rows.items():
        print(name, np.round(row["lengths"], 1), np.round(row["arms"], 1), f"{100 * row['sum_rule']:.2f} %")
    if given.output:
        write_evidence(given.output, ["benchmarks/lengths.py", str(given.scene)], rows, angles=angles)


if __name__ == "__main__":
    main()
