"""Contact on the real hip: tunnelling by step size, overlap at rest, sliding neighbours, and the cost.

    python benchmarks/contact_study.py DIR motions|apriori|sliding|cost [--models rbf,pbd] [--steps 2,10]

DIR is the folder with the scenes (flexion.toml, apriori.toml, ...). Prints one line a case; the distances of
`motions` are the exact ones of the metrics, not the solver's own fields.
"""

import argparse
import collections
import itertools
import time
from pathlib import Path

import numpy as np

import rbfmuscle as rm
from rbfmuscle.geometry.surfaces import mesh_volume
from rbfmuscle.models import build_model
from rbfmuscle.sim.loop.simulate import simulate_frames
from rbfmuscle.sim.scene.options import SlidingOptions

MOTIONS = ("flexion", "extension", "adduction", "internal_rotation", "external_rotation")
WHOLE = 1000.0


def worst(run, quantity):
    """Largest absolute value of a quantity over all muscles and frames."""
    values = [abs(row.value) for row in run.metrics if row.quantity == quantity]
    return max(values, default=float("nan"))


def count_actions(run):
    """Events by action: how many points."""
    counts = collections.Counter()
    for event in run.events:
        counts[event.action] += event.count
    return dict(counts)


def study_motions(folder, models, steps):
    """Every motion in every step: tunnelled points, penetration, volume."""
    for motion, model, step in itertools.product(MOTIONS, models, steps):
        scene = rm.Scene.load(folder / f"{motion}.toml")
        start = time.perf_counter()
        run = rm.simulate(scene, model=model, settings={"motion.step": step})
        print(
            f"{motion:18s} {model:12s} step {step:6g}  frames {len(run.frames):3d}"
            f"  tunnelled {worst(run, 'tunnelled'):3g}  surface in bone {worst(run, 'penetration_max'):5.2f}"
            f"  bone in muscle {worst(run, 'bone_penetration_max'):5.2f}"
            f"  solver {worst(run, 'solver_penetration_max'):5.2f}"
            f"  volume {100 * worst(run, 'volume_error'):6.3f} %"
            f"  {time.perf_counter() - start:5.1f} s  {count_actions(run)}",
            flush=True,
        )


def study_overlap(folder, models):
    """Bones and muscles that overlap at rest: what resolving changes."""
    for model in models:
        scene = rm.Scene.load(folder / "apriori.toml").with_options(frames=slice(0, 1))
        parts = [build_model(muscle, scene, model) for muscle in scene.muscles]
        rest = {part.name: part.contact_points().copy() for part in parts}
        fields = {bone.name: rm.BoneSDF.from_mesh(bone.mesh) for bone in scene.bones}
        (frame,) = simulate_frames(scene, parts, fields=fields)
        for part in parts:
            free = part.contact_bone < 0
            before, after = rest[part.name][free], part.contact_points()[free]
            first = np.min([field.distance(before) for field in fields.values()], axis=0)
            now = np.min([field.distance(after) for field in fields.values()], axis=0)
            moved = np.linalg.norm(after - before, axis=1)
            overlapped = before[first < 0.0]
            away = np.full(len(before), np.inf)
            if len(overlapped):
                away = np.min(np.linalg.norm(before[:, None] - overlapped[None], axis=2), axis=1)
            far = moved[away > scene.length(30.0)]
            volume = _volume(frame.surfaces[part.name])
            print(
                f"{model:12s} {part.name:16s} inside {100 * np.mean(first < 0):5.2f} % depth {-first.min():5.2f}"
                f" -> {max(0.0, -now.min()):5.3f}  moved {moved.max():5.2f}"
                f"  beyond 30 mm {np.sqrt(np.mean(far**2)) if len(far) else 0.0:5.3f} RMS"
                f"  volume {100 * (volume / scene.muscle(part.name).mesh.volume - 1):7.4f} %",
                flush=True,
            )


def study_sliding(folder, models):
    """Four muscles with and without sliding: overlap, gaps, share of the time."""
    for motion, model, slide in itertools.product(("flexion", "adduction"), models, (False, True)):
        scene = rm.Scene.load(folder / f"{motion}.toml").with_options(frames=slice(None, None, 5))
        scene.sliding = SlidingOptions() if slide else None
        parts = [build_model(muscle, scene, model) for muscle in scene.muscles]
        depth, share, gap, slip = 0.0, 0.0, 0.0, 0.0
        spent = collections.Counter()
        for frame in simulate_frames(scene, parts):
            found = overlaps(frame.surfaces)
            depth, share = max(depth, found[0]), max(share, found[1])
            for surface in frame.surfaces.values():
                gap = max(gap, surface.quantities.get("sliding_gap_max", 0.0))
                slip = max(slip, surface.quantities.get("sliding_speed", 0.0))
            for times in frame.times.values():
                spent.update(times)
        print(
            f"{motion:10s} {model:12s} sliding {slide!s:5s}  overlap {depth:5.2f} mm, {100 * share:6.3f} % of volume"
            f"  linked gap {gap:4.2f}  slip {slip:4.2f} a frame"
            f"  time {100 * spent['time_sliding'] / spent['time_frame']:4.1f} %",
            flush=True,
        )


def study_cost(folder, models):
    """Share of the tunnelling test, and what running muscles side by side gains."""
    import numba

    for model, threads in itertools.product(models, (1, 2)):
        numba.set_num_threads(threads)
        scene = rm.Scene.load(folder / "flexion.toml").with_options(frames=slice(0, 16))
        parts = [build_model(muscle, scene, model) for muscle in scene.muscles]
        spent, wall = collections.Counter(), []
        for frame in simulate_frames(scene, parts):
            wall.append(frame.wall)
            for times in frame.times.values():
                spent.update(times)
        print(
            f"{model:12s} threads {threads}  all four {1e3 * np.median(wall[3:]):6.1f} ms a frame"
            f"  tunnelling test {100 * spent['time_tunnelling'] / spent['time_frame']:4.1f} %",
            flush=True,
        )


def _volume(surface):
    return mesh_volume(surface.vertices, np.asarray(surface.faces))


def overlaps(surfaces):
    """Deepest vertex of one surface in another, and the overlap's share of the smaller volume (by a grid)."""
    import igl

    depth, share = 0.0, 0.0
    for one, two in itertools.combinations(surfaces.values(), 2):
        low = np.maximum(one.vertices.min(axis=0), two.vertices.min(axis=0))
        high = np.minimum(one.vertices.max(axis=0), two.vertices.max(axis=0))
        if np.any(low >= high):
            continue
        for a, b in ((one, two), (two, one)):
            near = a.vertices[np.all((a.vertices > low) & (a.vertices < high), axis=1)]
            if len(near):
                depth = max(depth, -float(signed(igl, near, b).min(initial=0.0)))
        spacing = 1.5
        axes = [np.arange(low[k], high[k], spacing) for k in range(3)]
        grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
        grid = grid[winding(igl, grid, one) > 0.5]
        both = int((winding(igl, grid, two) > 0.5).sum()) if len(grid) else 0
        share = max(share, both * spacing**3 / min(_volume(one), _volume(two)))
    return depth, share


def signed(igl, points, surface):
    """Signed distance with the sign of the winding number, which no sliver triangle can turn."""
    kind = igl.SIGNED_DISTANCE_TYPE_FAST_WINDING_NUMBER
    return igl.signed_distance(points, surface.vertices, np.asarray(surface.faces), kind)[0]


def winding(igl, points, surface):
    """Winding number of a closed surface at each point."""
    return igl.fast_winding_number(surface.vertices, np.asarray(surface.faces), points)


def main():
    """Read the command line and run one study."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("study", choices=("motions", "apriori", "sliding", "cost"))
    parser.add_argument("--models", default="rbf,pbd")
    parser.add_argument("--steps", default=f"2,10,30,{WHOLE:g}")
    options = parser.parse_args()
    models = options.models.split(",")
    if options.study == "motions":
        study_motions(options.folder, models, [float(step) for step in options.steps.split(",")])
    else:
        {"apriori": study_overlap, "sliding": study_sliding, "cost": study_cost}[options.study](
            options.folder, models
        )


if __name__ == "__main__":
    main()
