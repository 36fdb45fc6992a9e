"""One pose reached over six ways: how far the muscle's material lies apart.

    python benchmarks/one_pose.py SCENE --muscles A,B [--pose hip.flexion=60 hip.adduction=-25]
                                  [--set nodes=300 ...]

The ways to a pose of two coordinates, by default in sub-steps of 2 degrees: both at once, either
one first, a detour through the third coordinate, a seeded random walk that ends there, both at once
in sub-steps of half a degree and of 10 degrees. Distances are between material points of the
carried surface, RMS and greatest over all pairs [mm].
"""

import argparse
import itertools
import time
from pathlib import Path

import numpy as np
from evidence import write_evidence

from rbfmuscle.muscle.muscle import RBFMuscle
from rbfmuscle.muscle.options import RBFOptions
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


def ends(scene, pose, others, settings):
    """Carried vertices (n, 3) at the end of each way, by name, and the processor time of all
    [s]."""
    found, start = {}, time.process_time()
    for name, (waypoints, step) in ways(pose, others).items():
        part = scene.with_options({"contact.substep_angle": step})
        part.motion = Motion(frames(waypoints, step))
        muscle = part.muscles[0]
        model = RBFMuscle(muscle, part, RBFOptions(**{**muscle.options, **settings}))
        last = len(part.motion.frames) - 1
        (frame,) = simulate_frames(part, [model], surfaces=False, written={last})
        found[name] = frame.material_meshes[muscle.name][0] / from_mm(1.0, part.units)
    return found, time.process_time() - start


def spread(found):
    """(rms, greatest) of the pair of ways farthest apart, and its names."""
    worst = (0.0, 0.0, "")
    greatest = 0.0
    for a, b in itertools.combinations(found, 2):
        away = np.linalg.norm(found[a] - found[b], axis=1)
        rms = float(np.sqrt((away**2).mean()))
        greatest = max(greatest, float(away.max()))
        if rms > worst[0]:
            worst = (rms, greatest, f"{a} / {b}")
    return worst[0], greatest, worst[2]


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scene", help="a scene file, or 'phantom'")
    parser.add_argument("--muscles", required=True, help="separated by commas")
    parser.add_argument("--pose", nargs="+", default=["hip.flexion=60", "hip.adduction=-25"])
    parser.add_argument("--others", nargs="*", default=["hip.internal_rotation"])
    parser.add_argument("--set", nargs="*", default=[], dest="settings")
    parser.add_argument("-o", "--output", type=Path, help="file of evidence for the pages")
    given = parser.parse_args()
    rows = [row_of(name, given) for name in given.muscles.split(",")]
    if given.output:
        command = ["benchmarks/one_pose.py", given.scene, "--muscles", given.muscles]
        write_evidence(given.output, command, rows, ["muscle", "RMS", "greatest", "paths"])


def row_of(muscle, given):
    """Spread of the paths of one muscle [mm], which is printed with all distances."""
    scene = phantom_scene() if given.scene == "phantom" else Scene.load(given.scene)
    scene.muscles = [scene.muscle(muscle)]
    settings = parse_settings(given.settings)
    found, seconds = ends(scene, parse_settings(given.pose), given.others, settings)
    rms, greatest, pair = spread(found)
    print(
        f"{muscle} {settings}: {rms:.3f} mm RMS ({pair}), {greatest:.2f} greatest, {seconds:.1f} s"
    )
    names = list(found)
    for a in names:
        row = [float(np.sqrt(((found[a] - found[b]) ** 2).sum(axis=1).mean())) for b in names]
        print(f"  {a:22}" + " ".join(f"{value:6.3f}" for value in row), flush=True)
    return [muscle, rms, greatest, pair]


if __name__ == "__main__":
    main()
