"""Muscles of ``data/leg`` that contract: the calf at a fixed pose, and hip muscles that come to lie short.

    python benchmarks/contraction_leg.py calf [--model rbf]
    python benchmarks/contraction_leg.py hip [--model rbf] [--output DIR]

``calf``: gastrocnemii and soleus from rest to full activation at the scan's pose, once with fibres along the harmonic
field (what a muscle without fibres has), once with pennate fibres of a published angle between their two faces. Prints
fibre length, pennation and thickness at rest and at full activation.

``hip``: the gluteus maximus in 30 degrees of extension and the iliacus in 90 of flexion, without any key of contraction
and with the optimal fibre lengths of gait2392 (Delp et al. 1990). Prints the greatest mean curvature over balls of 8 mm
against that at rest; with ``--output`` the runs are kept, to be drawn.
"""

import argparse
import os
from pathlib import Path

import numpy as np
from leg_joints import leg_folder, leg_scene

from rbfmuscle.geometry.exact_distance import ExactDistance
from rbfmuscle.run import simulate
from rbfmuscle.sim.scene.motion import Motion
from rbfmuscle.study.measure.centreline import split_ends
from rbfmuscle.study.measure.fibre_lines import grow_fibres, resampled

# Pennation of gait2392 (Delp et al. 1990) [degree]; the share at each end that is tendon where fibres run lengthwise.
CALF = {"gastrocnemius_medial": 17.0, "gastrocnemius_lateral": 8.0, "soleus": 25.0}
TENDON = 0.25
# Optimal fibre lengths [mm] of gait2392 (mean of three compartments of the gluteus maximus), and the motions.
HIP = {
    "gluteus_maximus": (144.3, {"hip_flexion": -30.0}),
    "iliacus": (100.0, {"hip_flexion": 90.0}),
}
RADIUS = 8.0
STEP = 2.0


def scene_of(name, which="gait", **keys):
    """A scene of one muscle of the leg, with keys of contraction."""
    scene = leg_scene(leg_folder(), which, muscles=[name])
    scene = scene.copy()
    muscle = scene.muscles.pop()
    attach = list(muscle.attachments)
    scene.add_muscle(name, (muscle.mesh.vertices, muscle.mesh.faces), attach=attach, model="rbf", **keys)
    return scene


def harmonic_fibres(scene, name, count=60):
    """Streamlines from end to end."""
    muscle = scene.muscle(name)
    groups = split_ends(muscle, scene.joints)
    ends = [np.concatenate([np.asarray(a.vertices) for a in group]) for group in groups]
    return grow_fibres(np.asarray(muscle.mesh.vertices), np.asarray(muscle.mesh.faces), ends, count=count)


def pennate_fibres(scene, name, angle, count=60, seed=0):
    """Straight lines through the belly at an angle [degree] to its line of action, from face to face.

    They lean in the plane of the line of action and of the direction across in which the belly is thinnest.
    """
    muscle = scene.muscle(name)
    vertices, faces = np.asarray(muscle.mesh.vertices, float), np.asarray(muscle.mesh.faces)
    groups = split_ends(muscle, scene.joints)
    ends = [np.concatenate([np.asarray(a.vertices) for a in group]) for group in groups]
    first, last = (vertices[end].mean(axis=0) for end in ends)
    axis = (last - first) / np.linalg.norm(last - first)
    tree = ExactDistance(vertices, faces)
    height = (vertices - first) @ axis
    middle = vertices[np.abs(height - np.median(height)) < 15.0]
    across = middle - middle.mean(axis=0)
    across -= np.outer(across @ axis, axis)
    thin = np.linalg.eigh(across.T @ across)[1][:, 1]  # 0 is the axis itself, 2 the belly's width
    way = np.cos(np.radians(angle)) * axis + np.sin(np.radians(angle)) * thin
    rng, lines = np.random.default_rng(seed), []
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    while len(lines) < count:
        seeds = rng.uniform(low, high, (400, 3))
        for point in seeds[tree.signed_distance(seeds) < -3.0]:
            steps = point + np.arange(-150.0, 150.5, 1.0)[:, None] * way
            inside = tree.signed_distance(steps) < -1.0
            start = end = 150
            while start > 0 and inside[start - 1]:
                start -= 1
            while end < len(steps) - 1 and inside[end + 1]:
                end += 1
            if end - start > 15:
                lines.append(resampled(steps[start : end + 1], 12))
    return lines[:count]


def calf(model):
    """A line for each muscle and kind of fibres, at rest and at full activation."""
    for name, angle in CALF.items():
        plain = scene_of(name)
        for kind in ("harmonic", "pennate"):
            keys = (
                {"tendon": TENDON} if kind == "harmonic" else {"fibres": pennate_fibres(plain, name, angle)}
            )
            scene = scene_of(name, activation=[0, 1], **keys)
            scene.motion = Motion([{} for _ in range(9)])
            run = simulate(scene, model)
            row = {q: run.values(name, q)[[0, -1]] for q in ("fibre_length", "pennation", "belly_thickness")}
            worst = np.abs(run.values(name, "volume_error")).max()
            texts = [f"{q} {a:.1f} to {b:.1f} ({100 * (b / a - 1):+.0f} %)" for q, (a, b) in row.items()]
            print(f"{name:22} {kind:9} {'; '.join(texts)}; volume {worst:.0e}", flush=True)


def greatest_curvature(mesh):
    """Greatest and least mean curvature [1/mm] of a surface over balls of `RADIUS` about its vertices.

    The measure of Cohen-Steiner and Morvan (mean over edges within the ball), over the surface's area in the ball.
    """
    from scipy.spatial import cKDTree
    from trimesh.curvature import discrete_mean_curvature_measure

    points = np.asarray(mesh.vertices)[:: max(1, len(mesh.vertices) // 3000)]
    total = discrete_mean_curvature_measure(mesh, points, RADIUS)
    middles = cKDTree(mesh.triangles_center)
    areas = np.array([mesh.area_faces[near].sum() for near in middles.query_ball_point(points, RADIUS)])
    mean = total / np.maximum(areas, 0.25 * np.pi * RADIUS**2)
    return float(mean.max()), float(mean.min())


def hip(model, output):
    """A line for each muscle: curvature at rest and at the end, without and with published fibre lengths."""
    for name, (optimal, pose) in HIP.items():
        plain = scene_of(name, "squat")
        fibres = list(harmonic_fibres(plain, name))
        length = np.mean([np.linalg.norm(np.diff(line, axis=0), axis=1).sum() for line in fibres])
        cases = {"without": {}}
        for activation in (0.0, 0.3):
            cases[f"activation {activation:g}"] = {
                "fibres": fibres, "optimal_fibre_length": optimal, "activation": activation
            }  # fmt: skip
        print(f"{name}: fibres of {length:.0f} mm in the scan, optimal {optimal:g}", flush=True)
        for case, keys in cases.items():
            scene = scene_of(name, "squat", **keys)
            ((coordinate, end),) = pose.items()
            scene.set_motion(ramp={coordinate: {"from": 0.0, "to": end, "step": STEP}})
            run = simulate(scene, model)
            if output:
                run.save(output / f"{name}_{case.replace(' ', '_')}", pictures=False)
            (top, low), (top_end, low_end) = (
                greatest_curvature(run[name].surface(frame=frame.index))
                for frame in (run.frames[0], run.frames[-1])
            )
            crossing = run.values(name, "self_crossing").max()
            print(
                f"  {case:15} ridge {top:.3f} to {top_end:.3f} 1/mm ({top_end / top:.2f}), furrow {low:.3f} to "
                f"{low_end:.3f} ({low_end / low:.2f}); crossing triangles {crossing:g}, "
                f"volume {np.abs(run.values(name, 'volume_error')).max():.0e}",
                flush=True,
            )


def main():
    """Run what the command line asks for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("action", choices=("calf", "hip"))
    parser.add_argument("--model", default="rbf")
    parser.add_argument("--output", type=Path)
    given = parser.parse_args()
    os.environ.setdefault("NUMBA_NUM_THREADS", "1")
    if given.action == "calf":
        calf(given.model)
    else:
        hip(given.model, given.output)


if __name__ == "__main__":
    main()
