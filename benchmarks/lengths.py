"""How smooth fibre lengths are over the angle of a joint, and how far they differ there and back.

    python benchmarks/lengths.py [--data hip,leg] [--neighbours on,off] [-o FILE]

Muscles that cross the hip, one coordinate at a time from its least angle to its greatest and back
in steps of 2 degrees, 50 fibres a muscle. Printed for each muscle, as quadratic means over its
motions [mm]: the second differences of lengths on the way there, and the differences of lengths
between there and back.
"""

import argparse
from dataclasses import replace

import numpy as np
from evidence import write_evidence
from hip_moment_arms import DATA, RANGES, loaded

from rbfmuscle.recording import simulate
from rbfmuscle.scene.objects import Motion

STEP = 2.0  # degrees
FIBRES = 50
TRUNK = {"pelvis", "sacrum"}


def measured(scene, coordinate, ends):
    """Second differences, and differences there and back, by muscle: root mean squares."""
    angles = np.radians(np.arange(ends[0], ends[1] + 0.5 * STEP, STEP))
    there_and_back = np.concatenate([angles, angles[-2::-1]])
    moved = replace(scene, motion=Motion([{coordinate: float(a)} for a in there_and_back]))
    run = simulate(moved, model="rbf", settings={"output.fibres": FIBRES})
    found = {}
    for muscle in run.muscles:
        lengths = np.array([frame.fibres[muscle].lengths for frame in run.frames])
        there, back = lengths[: len(angles)], lengths[: len(angles) - 2 : -1]
        rough = np.diff(there, 2, axis=0)
        found[muscle] = [float(np.sqrt((x**2).mean())) for x in (rough, there - back)]
    return found


def table(data, neighbours):
    """Quadratic means over the motions, by muscle."""
    scene = loaded(data)
    if not neighbours:
        scene = replace(scene, neighbours=None)
    scene.muscles = [m for m in scene.muscles if {a.bone for a in m.attachments} & TRUNK]
    found = {m.name: [] for m in scene.muscles}
    for motion, name in DATA[data][1].items():
        for muscle, values in measured(scene, f"hip.{name}", RANGES[motion]).items():
            found[muscle].append(values)
    return {m: np.sqrt((np.array(v) ** 2).mean(axis=0)) for m, v in found.items()}


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", default="hip,leg")
    parser.add_argument("--neighbours", default="off,on")
    parser.add_argument("-o", "--output", help="file of evidence for the pages")
    given = parser.parse_args()
    rows = []
    for data in given.data.split(","):
        for word in given.neighbours.split(","):
            found = table(data, word == "on")
            found["all"] = np.sqrt((np.array(list(found.values())) ** 2).mean(axis=0))
            for muscle, (rough, apart) in found.items():
                rows.append([data, word, muscle.replace("_", " "), float(rough), float(apart)])
                print(f"{data:4} {word:3} {muscle:26} {rough:.3f} {apart:.4f}", flush=True)
    if given.output:
        heads = ["data", "neighbours", "muscle", "second difference [mm]", "there and back [mm]"]
        write_evidence(given.output, ["benchmarks/lengths.py"], rows, heads)


if __name__ == "__main__":
    main()
