"""One pose reached over seven ways: how far muscles lie apart, which touch each other.

    python benchmarks/one_pose.py SCENE [--muscles A,B] [--pose hip.flexion=60 hip.adduction=-25]
                                  [--ways both "half a degree"] [--set model.nodes=300 ...]

The ways to a pose of two coordinates, by default in sub-steps of 2 degrees: both at once, either
one first, a detour through the third coordinate, a seeded random walk that ends there, both at once
in sub-steps of half a degree and of 10 degrees; and farther by half, and back. Distances are
between vertices of the surface as the solid carries it, and as it is shown, RMS and greatest over
all pairs of ways [mm]. Muscles touch as the scene has it: ``--set neighbours=false`` solves each
alone.
"""

import argparse
import itertools
import time
from pathlib import Path

import numpy as np
from evidence import write_evidence

from rbfmuscle.models import build_models
from rbfmuscle.scene.objects import Motion, from_mm
from rbfmuscle.scene.phantom import phantom_scene
from rbfmuscle.scene.scene import Scene
from rbfmuscle.scene.settings import parse_settings
from rbfmuscle.simulation.frame_loop import simulate_frames

STEP = 2.0  # degrees
WALK, SEED = 5, 0


def ways(pose, others, step=STEP):
    """Named lists of waypoints (dicts of degrees) from rest to a pose, and the sub-step of each
    [degree].
    """
    rest = dict.fromkeys([*pose, *others], 0.0)
    end = {**rest, **pose}
    first, second = list(pose)[:2]
    rng = np.random.default_rng(SEED)
    walk = [
        {**rest, **{key: value * rng.uniform(0.2, 1.0) for key, value in pose.items()}}
        for _ in range(WALK)
    ]
    found = {
        "both": ([rest, end], step),
        f"{first} first": ([rest, {**rest, first: pose[first]}, end], step),
        f"{second} first": ([rest, {**rest, second: pose[second]}, end], step),
        "random walk": ([rest, *walk, end], step),
        "half a degree": ([rest, end], 0.5),
        "10 degrees": ([rest, end], 10.0),
        "there and back": ([rest, {key: 1.5 * value for key, value in end.items()}, end], step),
    }
    if others:
        aside = {**rest, **{key: 0.5 * value for key, value in pose.items()}, others[0]: 25.0}
        found["detour"] = [rest, aside, end], step
    return found


def frames(waypoints, step):
    """Frames [radian] along waypoints, no coordinate by more than ``step`` degrees from one to the
    next.
    """
    out = [waypoints[0]]
    for here, there in itertools.pairwise(waypoints):
        count = max(1, int(np.ceil(max(abs(there[k] - here[k]) for k in there) / step - 1e-9)))
        out += [
            {k: here[k] + (there[k] - here[k]) * n / count for k in there}
            for n in range(1, count + 1)
        ]
    return [{k: float(np.radians(v)) for k, v in frame.items()} for frame in out]


def ends(scene, pose, others, wanted=(), step=STEP):
    """Vertices (n, 3) of carried and shown surfaces at the end of each of the wanted ways, by
    muscle and way, and the processor time of all [s].
    """
    found, start = {}, time.process_time()
    for name, (waypoints, angle) in ways(pose, others, step).items():
        if wanted and name not in wanted:
            continue
        part = scene.with_options({"contact.substep_angle": angle})
        part.motion = Motion(frames(waypoints, angle))
        last = len(part.motion.frames) - 1
        (frame,) = simulate_frames(part, build_models(part), written={last})
        for muscle, shown in frame.surfaces.items():
            found.setdefault(muscle, {})[name] = [
                points / from_mm(1.0, part.units)
                for points in (frame.material_meshes[muscle][0], shown.vertices)
            ]
    return found, time.process_time() - start


def spread(found):
    """Of surfaces by way (RMS, greatest) of the pair of ways farthest apart, and its names."""
    worst = (0.0, "")
    greatest = 0.0
    for a, b in itertools.combinations(found, 2):
        away = np.linalg.norm(found[a] - found[b], axis=1)
        greatest = max(greatest, float(away.max()))
        worst = max(worst, (float(np.sqrt((away**2).mean())), f"{a} / {b}"))
    return worst[0], greatest, worst[1]


COLUMNS = ["muscle", "RMS", "greatest", "paths", "shown: RMS", "greatest"]


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scene", help="a scene file, or 'phantom'")
    parser.add_argument("--muscles", help="separated by commas; all")
    parser.add_argument("--pose", nargs="+", default=["hip.flexion=60", "hip.adduction=-25"])
    parser.add_argument("--others", nargs="*", default=["hip.internal_rotation"])
    parser.add_argument("--ways", nargs="*", default=[], help="some of them")
    parser.add_argument("--set", nargs="*", default=[], dest="settings")
    parser.add_argument("-o", "--output", type=Path, help="file of evidence for the pages")
    given = parser.parse_args()
    scene = phantom_scene() if given.scene == "phantom" else Scene.load(given.scene)
    scene = scene.with_options(parse_settings(given.settings))
    if given.muscles:
        scene.muscles = [scene.muscle(name) for name in given.muscles.split(",")]
    found, seconds = ends(scene, parse_settings(given.pose), given.others, given.ways)
    rows = []
    for muscle, by_way in found.items():
        carried, shown = (spread({way: both[k] for way, both in by_way.items()}) for k in (0, 1))
        rows.append([muscle, *carried, *shown[:2]])
        print(*rows[-1], flush=True)
    print(f"{seconds:.1f} s")
    if given.output:
        command = ["benchmarks/one_pose.py", given.scene]
        command += ["--muscles", given.muscles] if given.muscles else []
        write_evidence(given.output, command, rows, COLUMNS)


if __name__ == "__main__":
    main()
