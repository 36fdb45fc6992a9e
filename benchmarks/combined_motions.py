"""Shapes in motions of several coordinates together: handles, flicker, crossings, points that stay beyond bones.

python benchmarks/combined_motions.py phantom            # the embedded hip
python benchmarks/combined_motions.py path/to/flexion.toml --muscles gluteus_maximus --set model.surface=marching
python benchmarks/combined_motions.py path/to/flexion.toml --seeds 7 8 9 10 11 --model pbd
python benchmarks/combined_motions.py phantom --write FOLDER     # the motions as scene files, nothing run
"""

import argparse
import re
import time
from pathlib import Path

import numpy as np

import rbfmuscle as rm
from rbfmuscle.metrics.mesh_distance import MeshDistance
from rbfmuscle.scene.phantom import AXES, phantom_scene
from rbfmuscle.scene.settings import parse_settings

# Degrees from rest to the end of each coordinate, all together, or angles of stops on a way.
RAMPS = {
    "flexion, abduction, internal rotation": {"flexion": 90, "adduction": -25, "internal_rotation": 20},
    "flexion, adduction, external rotation": {"flexion": 60, "adduction": 12, "internal_rotation": -25},
}
STEP = 1.5
# A walk of stops up to so many degrees apart, within these bounds.
WALK, FARTHEST, SEED = 40, 20.0, 7
# What is shown of each muscle, its greatest over the frames, and the flicker that is wanted [mm].
WORST = (
    "self_crossings", "flicker", "unfitted_fraction", "penetration_max", "bone_penetration_max",
    "volume_error",
)  # fmt: skip
FLICKER = 0.5
# Material whose step changed by less than this since the frame before goes on as it went [mm]; the rest leaps.
STEADY = 0.5
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


def motion_text(motion: dict) -> str:
    """The table of a motion as a scene file says it."""

    def table(pairs: dict) -> str:
        return (
            "{ "
            + ", ".join(f'"{k}" = {v if not isinstance(v, dict) else table(v)}' for k, v in pairs.items())
            + " }"
        )

    if "ramp" in motion:
        return f"[motion]\nramp = {table(motion['ramp'])}\n"
    stops = ",\n  ".join(table(stop) for stop in motion["waypoints"])
    return f"[motion]\nwaypoints = [\n  {stops},\n]\nstep = {motion['step']}\n"


def phantom_files(folder: Path) -> Path:
    """The embedded hip as a scene file with meshes and attachments beside it."""
    scene = phantom_scene()
    (joint,) = scene.joints
    lines = [f'[scene]\nformat = 1\nname = "{scene.name}"\nunits = "{scene.units}"\n']
    for bone in scene.bones:
        bone.mesh.export(folder / f"{bone.name}.ply")
        lines.append(f'[[bone]]\nname = "{bone.name}"\nmesh = "{bone.name}.ply"\n')
    axes = ", ".join(f"{name} = {list(map(float, axis))}" for name, axis in AXES.items())
    lines.append(
        f'[[joint]]\nname = "hip"\nparent = "{joint.parent}"\nchild = "{joint.child}"\ncentre = [0, 0, 0]\n'
        f"axes = {{ {axes} }}\n"
    )
    lines.append('[motion]\nramp = { "hip.flexion" = { from = 0, to = 90, step = 2 } }\n')
    for muscle in scene.muscles:
        muscle.mesh.export(folder / f"{muscle.name}.ply")
        ends = []
        for number, end in enumerate(muscle.attachments):
            held = f"{muscle.name}_{number}.txt"
            (folder / held).write_text("\n".join(str(v) for v in end.vertices) + "\n")
            ends.append(f'{{ bone = "{end.bone}", vertices = "{held}" }}')
        lines.append(
            f'[[muscle]]\nname = "{muscle.name}"\nmesh = "{muscle.name}.ply"\nattach = [{", ".join(ends)}]\n'
        )
    lines.append("[detect]\ntunnelling = {}\n")
    path = folder / "phantom.toml"
    path.write_text("\n".join(lines))
    return path


def write_scenes(source: Path, motions: dict, folder: Path) -> list[Path]:
    """Scene files of a scene with other motions; its meshes stay where they are and are named by their whole path."""
    text = re.sub(
        r'((?:mesh|vertices|fibres) = ")([^"]+)"',
        lambda found: f'{found[1]}{(source.parent / found[2]).resolve()}"',
        source.read_text(),
    )
    written = []
    for title, motion in motions.items():
        path = folder / (re.sub(r"[^a-z0-9]+", "_", title.lower()) + ".toml")
        path.write_text(
            re.sub(r"\[motion\]\n.*?(?=\n\[)", lambda _, m=motion: motion_text(m), text, flags=re.S)
        )
        written.append(path)
    return written


def steady_flicker(run: rm.Run, name: str) -> tuple[float, float]:
    """Flicker, greatest [mm], of material that goes on as it went, and how far the rest leaps at most.

    Each vertex of the carried mesh is asked for the change of its step; where a sheet slips from one place of rest to
    another, surface and material part for another reason than a grid or a fold.
    """
    places = np.array([frame.carried[name][0] for frame in run.frames])
    surfaces = [frame.surfaces[name] for frame in run.frames]
    offsets = np.array([MeshDistance(s.vertices, s.faces).signed(p) for s, p in zip(surfaces, places)])
    leap = np.linalg.norm(np.diff(places, 2, axis=0), axis=2)
    change = np.abs(np.diff(offsets, axis=0))[1:]
    return float(change[leap < STEADY].max(initial=0.0)), float(leap.max(initial=0.0))


def measure(scene: rm.Scene, model: str | None) -> tuple[list[tuple], float]:
    """Run a scene; for each muscle its worst figures over the frames, and the processor time of a frame [s]."""
    started = time.process_time()
    run = rm.simulate(scene, model=model)
    spent = (time.process_time() - started) / len(run.frames)
    rows = []
    for name in (muscle.name for muscle in scene.muscles):
        count = {
            action: sum(e.count for e in run.events if e.muscle == name and e.action == action)
            for action in ("unresolved", "grazed", "held_back")
        }
        euler = run.values(name, "euler")
        worst = {q: abs(run.values(name, q)).max(initial=0.0) for q in WORST if q in run.summary[name]}
        flicker = run.values(name, "flicker")
        worst["steady"], worst["leap"] = steady_flicker(run, name)
        rows.append((name, int((euler != 2).sum()), len(euler), int((flicker > FLICKER).sum()), worst, count))
    return rows, spent


def show(title: str, frames: int, rows: list[tuple], spent: float) -> None:
    """Print the table of a motion."""
    print(f"\n{title}: {frames} frames, {spent:.2f} s of processor time each, measures included")
    print(
        "| muscle | frames with handles | crossing | flicker max (frames over 0.5) | of steady material "
        "| leap | unfitted | surface in bones "
        "| bones in muscle | volume | unresolved | grazed | held back |"
    )
    print("|---" * 13 + "|")
    for name, handles, count, over, worst, events in rows:
        print(
            f"| {name} | {handles} of {count} | {worst['self_crossings']:.0f} "
            f"| {worst.get('flicker', 0.0):.2f} ({over}) | {worst['steady']:.2f} | {worst['leap']:.1f} "
            f"| {worst.get('unfitted_fraction', 0.0):.3f} "
            f"| {worst['penetration_max']:.3f} | {worst['bone_penetration_max']:.3f} "
            f"| {worst['volume_error']:.0e} | {events['unresolved']} | {events['grazed']} | {events['held_back']} |",
            flush=True,
        )


def main() -> None:
    """Print a table for each motion."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scene", help="phantom, or a scene whose joint is called hip")
    parser.add_argument("--muscles", nargs="*")
    parser.add_argument("--model")
    parser.add_argument("--set", nargs="*", default=[], metavar="KEY=VALUE")
    parser.add_argument("--first", action="store_true", help="the first motion alone")
    parser.add_argument("--own", action="store_true", help="the scene's own motion, whatever its joints")
    parser.add_argument("--seeds", nargs="*", type=int, help="random walks of these seeds, and nothing else")
    parser.add_argument(
        "--write", type=Path, metavar="FOLDER", help="write the motions as scene files, and run none"
    )
    arguments = parser.parse_args()
    scene = phantom_scene() if arguments.scene == "phantom" else rm.Scene.load(Path(arguments.scene))
    settings = parse_settings(arguments.set)
    scene = scene.with_options(settings)
    if arguments.muscles:
        scene.muscles = [scene.muscle(name) for name in arguments.muscles]
    motions = {name: {"ramp": ramp(ends)} for name, ends in RAMPS.items()}
    motions[f"random walk of {WALK} stops"] = {"waypoints": walk(WALK), "step": FARTHEST}
    if arguments.own:
        motions = {"its own motion": None}
    elif arguments.seeds:
        motions = {
            f"random walk of {WALK} stops, seed {seed}": {"waypoints": walk(WALK, seed), "step": FARTHEST}
            for seed in arguments.seeds
        }
    if arguments.first:
        motions = dict(list(motions.items())[:1])
    if arguments.write:
        arguments.write.mkdir(parents=True, exist_ok=True)
        source = phantom_files(arguments.write) if arguments.scene == "phantom" else Path(arguments.scene)
        print(*write_scenes(source, motions, arguments.write), sep="\n")
        return
    for title, motion in motions.items():
        moved = scene.copy()
        if motion:
            moved.set_motion(**motion)
        rows, spent = measure(moved, arguments.model)
        show(title, len(moved.motion), rows, spent)


if __name__ == "__main__":
    main()
