"""Moment arms of fibres at the hip beside published ones: a finite-element model that was compared
with MRI (Blemker and Delp 2005).

    python benchmarks/hip_moment_arms.py [--data hip,leg] [--model rbf] [--set KEY=VALUE ...]

One coordinate moves at a time, the muscles in the scenes of the data folder. The published band
reaches, at each angle, from the least to the greatest moment arm over a muscle's fibres; ours is
the same of `FIBRES` fibres. Printed for each muscle and motion, over the angles that both have:

overlap   share of the published band's area that ours covers (a wide fan covers all)
inside    share of fibres x poses within the published band
union     area that both cover over the area that either covers
stretch   of fibres, 5th and 95th percentile over all poses; beside it that of the straight lines
          between their ends, the share of fibres x poses within 0.1 of it, that within 0.1 of it
          or of the shortest path over the bones, and the greatest difference from the straight line
"""

import argparse
import functools
import tempfile
from pathlib import Path

import numpy as np
from evidence import data_folder, write_evidence
from leg_tendons import convert

from rbfmuscle.geometry.lines import line_length
from rbfmuscle.metrics.centreline import NODES, shortest_path
from rbfmuscle.metrics.verdict import published_band
from rbfmuscle.recording import simulate
from rbfmuscle.scene.objects import Motion
from rbfmuscle.scene.scene import Scene
from rbfmuscle.scene.settings import parse_settings

FIBRES = 100
STEP = 5.0  # degrees
NEAR = 0.1  # of stretch
RANGES = {"flexion": (-10.0, 60.0), "adduction": (-40.0, 40.0), "rotation": (-30.0, 30.0)}
DATA = {
    "hip": (
        "flexion.toml",
        {"flexion": "flexion", "adduction": "adduction", "rotation": "internal_rotation"},
    ),
    "leg": (
        "leg.toml",
        {name: f"hip_{name}" for name in RANGES},
    ),
}
# Clinical angle = coordinate + this [degree], of the leg by its README; of the hip by the femur's
# mechanical axis and condyles (data/hip/scene.json), against the plane of anterior superior iliac
# spine and pubic tubercle, which leans 4.7 degrees forwards.
OFFSETS = {
    "hip": {"flexion": 4.7 - 6.7, "adduction": -2.9, "rotation": -0.2},
    "leg": {"flexion": -3.7, "adduction": 3.3, "rotation": -11.5},
}
PICTURED = "leg"  # the other data may not be
MUSCLES = ("psoas_major", "iliacus", "gluteus_maximus", "gluteus_medius")


def loaded(data):
    """The scene of a data folder, with tendons where it has bellies that end before their bones."""
    file = data_folder(data) / DATA[data][0]
    if data != "leg":
        return Scene.load(file)
    with tempfile.TemporaryDirectory() as folder:
        return Scene.load(convert(file, Path(folder)))


def moving(data, coordinate, ends):
    """A scene in which one coordinate moves, with the muscles of the table."""
    scene = loaded(data)
    angles = np.radians(np.arange(ends[0], ends[1] + 0.5 * STEP, STEP))
    scene.motion = Motion([{coordinate: float(angle)} for angle in angles])
    scene.muscles = [muscle for muscle in scene.muscles if muscle.name in MUSCLES]
    return scene


def off_shortest(run, muscle, bones, at_rest, far):
    """Stretch less that of the shortest path over the bones between the fibre's ends, of the
    frames and fibres ``far`` (n, 2).
    """

    @functools.cache
    def shortest(frame, fibre):
        line = run.frames[frame].fibres[muscle].points[fibre]
        poses = run.frames[frame].poses
        return line_length(shortest_path(line, bones, poses, np.zeros(NODES))[0])

    return np.array(
        [
            run.frames[k].fibres[muscle].stretch[i] - shortest(k, i) / shortest(at_rest, i)
            for k, i in far
        ]
    )


def compared(run, muscle, coordinate, offset, bones):
    """Measures of one muscle's fibres about one coordinate, beside ``bones``; ``offset`` is as in
    `OFFSETS`.
    """
    band = published_band(muscle, coordinate)
    turned = np.degrees([frame.coordinates[coordinate] for frame in run.frames])
    angles = turned + offset
    every = run[muscle].moment_arms(coordinate)
    shared = (angles >= band.angle[0] - 1e-6) & (angles <= band.angle[-1] + 1e-6)
    arms = every[shared]
    least = np.interp(angles[shared], band.angle, band.least)
    greatest = np.interp(angles[shared], band.angle, band.greatest)
    ours = arms.min(axis=1), arms.max(axis=1)
    both = np.maximum(np.minimum(greatest, ours[1]) - np.maximum(least, ours[0]), 0.0).sum()
    areas = (greatest - least).sum(), (ours[1] - ours[0]).sum()
    middle = np.median(arms, axis=1)
    fibres = [frame.fibres[muscle] for frame in run.frames]
    straight = np.array([np.linalg.norm(f.points[:, 0] - f.points[:, -1], axis=1) for f in fibres])
    at_rest = np.argmin(np.abs(turned))
    stretch = np.array([f.stretch for f in fibres])
    apart = stretch - straight / straight[at_rest]
    far = np.argwhere(np.abs(apart) > NEAR)
    still_far = np.abs(off_shortest(run, muscle, bones, at_rest, far)) > NEAR
    return {
        "overlap": both / areas[0],
        "inside": ((arms >= least[:, None]) & (arms <= greatest[:, None])).mean(),
        "union": both / (areas[0] + areas[1] - both),
        "median inside": ((middle >= least) & (middle <= greatest)).mean(),
        "arms": [float(arms.min()), float(arms.max())],
        "stretch": np.percentile(stretch, [5, 95]).tolist(),
        "straight": np.percentile(straight / straight[at_rest], [5, 95]).tolist(),
        "stretch within 0.1": 1.0 - len(far) / apart.size,
        "or of the shortest path": 1.0 - still_far.sum() / apart.size,
        "stretch, worst": np.abs(apart).max(),
        "plot": {
            "angle": angles,
            "least": every.min(axis=1),
            "median": np.median(every, axis=1),
            "greatest": every.max(axis=1),
        },
    }


def table(data, model, settings):
    """Measures by muscle and motion."""
    found = {}
    for motion, name in DATA[data][1].items():
        coordinate = f"hip.{name}"
        scene = moving(data, coordinate, RANGES[motion])
        asked = {"output.fibres": FIBRES, **settings}
        run = simulate(scene, model=model, settings=asked)
        bones = [bone.exact for bone in scene.bones]
        for muscle in run.muscles:
            offset = OFFSETS[data][motion]
            found[muscle, motion] = compared(run, muscle, coordinate, offset, bones)
    return found


SHARES = (
    "overlap",
    "inside",
    "union",
    "median inside",
    "stretch within 0.1",
    "or of the shortest path",
)
WORST = "stretch, worst"


def means(found):
    """Means of `SHARES` over some rows, and the greatest of `WORST`."""
    rows = list(found)
    return [float(np.mean([row[name] for row in rows])) for name in SHARES] + [
        float(max(row[WORST] for row in rows))
    ]


def show(title, found):
    """Print a table, and its means."""
    print(f"\n{title}\n")
    print(f"| muscle | motion | {' | '.join(SHARES)} | {WORST} | arms [mm] | stretch |")
    print("|---" * (len(SHARES) + 5) + "|")
    for (muscle, motion), row in found.items():
        numbers = " | ".join(f"{number:.2f}" for number in means([row]))
        arms = " to ".join(f"{x:.0f}" for x in row["arms"])
        stretch = " to ".join(f"{x:.2f}" for x in row["stretch"])
        straight = " to ".join(f"{x:.2f}" for x in row["straight"])
        print(f"| {muscle} | {motion} | {numbers} | {arms} | {stretch} ({straight}) |")
    print(f"| mean | | {' | '.join(f'{x:.2f}' for x in means(found.values()))} | | |", flush=True)


def evidence_rows(data, found):
    """Rows of the pages' table: each muscle over its motions, then all."""
    rows = []
    for muscle in dict.fromkeys(muscle for muscle, _ in found):
        own = [row for (name, _), row in found.items() if name == muscle]
        rows.append([data, muscle.replace("_", " "), len(own), *means(own)])
    rows.append([data, "all", len(found), *means(found.values())])
    return rows


def plots(found):
    """What the pages' plots show of each muscle and motion [degree, mm]."""
    return [
        {"muscle": muscle, "motion": motion}
        | {name: np.round(values, 2).tolist() for name, values in row["plot"].items()}
        for (muscle, motion), row in found.items()
    ]


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", default="hip,leg")
    parser.add_argument("--model", default="rbf")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("-o", "--output", help="file of evidence for the pages: means")
    given = parser.parse_args()
    rows, drawn = [], []
    for data in given.data.split(","):
        found = table(data, given.model, parse_settings(given.set))
        show(f"data/{data}, {given.model} {' '.join(given.set)}", found)
        rows += evidence_rows(data, found)
        drawn += plots(found) if data == PICTURED else []
    if given.output:
        heads = ["data", "muscle", "motions", *SHARES, WORST]
        command = ["benchmarks/hip_moment_arms.py", *given.set]
        write_evidence(given.output, command, rows, heads, plots=drawn)


if __name__ == "__main__":
    main()
