"""Bone distance fields beside libigl's and trimesh's exact distances and the baselines, in one run.

    NUMBA_NUM_THREADS=2 OMP_NUM_THREADS=2 python benchmarks/bench_sdf.py [--data FOLDER] [--bones
    femur pelvis]

FOLDER holds hip/. Builds use all threads numba is given, queries one. Times are the least of
several; errors are against libigl's pseudonormal distance at random points within 1 mm of the
surface, directions within 2 mm.
"""

import argparse
import os
import time
from pathlib import Path

import igl
import numpy as np
import trimesh
from evidence import write_evidence
from peers.detectors import TreeDetector, VoxelDetector
from peers.serendipity import SerendipityField
from peers.spline import SplineField

from rbfmuscle.bones.sdf import BoneSDF
from rbfmuscle.geometry.threads import thread_count, threads_limited

PSEUDONORMAL = igl.SIGNED_DISTANCE_TYPE_PSEUDONORMAL
# Points for accuracy, for speed, and for the slow exact tools.
ACCURACY = 200_000
SPEED = 1_000_000
SLOW = 2_000
# Bytes of a coefficient or node value of the dense fields.
FLOAT = 8


def least(function, repeats=3):
    """Least time of a call [s], and its result; the first call, which may compile, is not
    counted."""
    result = function()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        result = function()
        times.append(time.perf_counter() - start)
    return min(times), result


def on_one_thread(function, repeats=3):
    """Least time of a call [s] on one thread."""
    with threads_limited(1):
        return least(function, repeats)[0]


def points_near(vertices, faces, count, width, *, seed=0):
    """Random points (count, 3) up to ``width`` from the surface, along the faces' normals."""
    rng = np.random.default_rng(seed)
    corners = vertices[faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(normal, axis=1)
    face = rng.choice(len(area), count, p=area / area.sum())
    points = np.einsum("nk,nkj->nj", rng.dirichlet(np.ones(3), count), corners[face])
    return points + rng.uniform(-width, width, (count, 1)) * (normal[face] / area[face, None])


def judge(points, vertices, faces):
    """libigl's signed distances and directions."""
    distance, _, closest, _ = igl.signed_distance(points, vertices, faces, PSEUDONORMAL)[:4]
    return distance, (points - closest) / np.where(distance == 0.0, 1.0, distance)[:, None]


def accuracy(field, vertices, faces):
    """RMS and greatest error [mm], wrong signs [%], median and 99 % of the direction [degree]."""
    near = points_near(vertices, faces, ACCURACY, 1.0)
    exact, _ = judge(near, vertices, faces)
    found = field.distance(near)
    error, wrong = found - exact, np.mean(found * exact < 0.0)
    band = points_near(vertices, faces, ACCURACY // 4, 2.0, seed=1)
    exact, direction = judge(band, vertices, faces)
    away = np.abs(exact) > 1e-2
    gradient = field.gradient(band)[away]
    cosine = np.einsum("ni,ni->n", gradient, direction[away]) / np.maximum(
        np.linalg.norm(gradient, axis=1), 1e-300
    )
    angle = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
    size = np.abs(error)
    found = np.sqrt(np.mean(size**2)), size.max(), 100 * wrong, *np.percentile(angle, [50, 99])
    return [float(x) for x in found]


def memory(field):
    """Bytes that questions read."""
    return field.memory if hasattr(field, "memory") else sum(a.nbytes for a in field.arrays)


COLUMNS = [
    "field",
    "build [s]",
    "memory [MB]",
    "value [ns]",
    "with gradient [ns]",
    "RMS [mm]",
    "worst [mm]",
    "wrong sign [%]",
    "direction, median [°]",
    "99 % [°]",
]


def row(name, field, build, vertices, faces, count=SPEED):
    """One field's line of the table, printed, and in the order of `COLUMNS`."""
    points = points_near(vertices, faces, count, 1.0, seed=2)
    ordered = points[np.lexsort(np.floor(points / 4.0).T)]
    value = on_one_thread(lambda: field.distance(points)) / count
    both = on_one_thread(lambda: field.distance_and_gradient(points)) / count
    coherent = on_one_thread(lambda: field.distance_and_gradient(ordered)) / count
    rms, worst, wrong, middle, wide = accuracy(field, vertices, faces)
    print(
        f"{name:22s} {build:7.3f} {memory(field) / 1e6:7.1f} {1e9 * value:7.0f} {1e9 * both:7.0f} "
        f"{1e9 * coherent:7.0f} {rms:9.5f} {worst:8.3f} {wrong:9.4f} {middle:8.3f} {wide:7.2f}",
        flush=True,
    )
    times = [build, memory(field) / 1e6, 1e9 * value, 1e9 * both]
    return [name, *times, rms, worst, wrong, middle, wide]


def bone_table(name, mesh):
    """All fields and detectors on one bone."""
    vertices, faces = np.asarray(mesh.vertices, dtype=float), np.asarray(mesh.faces, dtype=np.int64)
    print(
        f"\n{name}: {len(vertices)} vertices, {len(faces)} faces, {thread_count()} threads to build"
    )
    print(
        f"{'':22s} {'build':>7s} {'memory':>7s} {'value':>7s} {'+grad':>7s} {'sorted':>7s} "
        f"{'RMS':>9s} {'worst':>8s} {'sign':>9s} {'angle':>8s} {'99 %':>7s}"
    )
    print(
        f"{'':22s} {'s':>7s} {'MB':>7s} {'ns':>7s} {'ns':>7s} {'ns':>7s} {'mm':>9s} {'mm':>8s} "
        f"{'% wrong':>9s}"
    )
    surface = vertices, faces
    build, field = least(lambda: BoneSDF.from_mesh(surface))
    rows = [row("BoneSDF", field, build, *surface)]
    cells = int((memory(field) / FLOAT / 7.0) ** (1 / 3))
    build, dense = least(lambda: SerendipityField.from_mesh(mesh, cells=cells), 1)
    rows.append(row(f"serendipity {cells}³", dense, build, *surface))
    build, dense = least(lambda: SplineField.from_mesh(mesh, nodes=memory(field) // FLOAT), 1)
    rows.append(row("tricubic B-spline", dense, build, *surface))
    build, voxels = least(lambda: VoxelDetector.from_mesh(mesh), 1)
    rows.append(row("voxels 64³", voxels, build, *surface, SPEED // 10))
    build, tree = least(lambda: TreeDetector.from_mesh(surface))
    rows.append(row("exact tree", tree, build, *surface, SPEED // 10))
    exact_tools(mesh, vertices, faces)
    return rows


def exact_tools(mesh, vertices, faces):
    """Time of the exact distances of libigl and trimesh, which asks for rtree."""
    points = points_near(vertices, faces, 20 * SLOW, 1.0, seed=2)
    spent, _ = least(lambda: igl.signed_distance(points, vertices, faces, PSEUDONORMAL), 2)
    threads = os.environ.get("OMP_NUM_THREADS", "all")
    print(
        f"libigl pseudonormals, tree included, {threads} threads: {1e9 * spent / len(points):.0f} "
        "ns a value"
    )
    spent, _ = least(lambda: trimesh.proximity.signed_distance(mesh, points[:SLOW]), 1)
    print(f"trimesh: {1e9 * spent / SLOW:.0f} ns a value")


def build_stages(mesh):
    """An open bone."""
    vertices, faces = np.asarray(mesh.vertices, dtype=float), np.asarray(mesh.faces, dtype=np.int64)
    centres = vertices[faces].mean(axis=1)
    place = centres[len(faces) // 3]
    hole = np.argsort(np.linalg.norm(centres - place, axis=1))[: len(faces) // 100]
    radius = np.linalg.norm(centres[hole] - place, axis=1).max()
    spent, field = least(lambda: BoneSDF.from_mesh((vertices, np.delete(faces, hole, axis=0))), 1)
    points = points_near(vertices, faces, ACCURACY, 3.0, seed=3)
    points = points[np.linalg.norm(points - place, axis=1) > 2.0 * radius]
    right = np.mean(field.distance(points) * judge(points, vertices, faces)[0] >= 0.0)
    print(
        f"1 % of the faces removed: built in {spent:.3f} s, sign right for {100 * right:.4f} % "
        "away from the hole"
    )


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--data", default=os.environ.get("RBFMUSCLE_DATA", "../shared/data"))
    parser.add_argument("--bones", nargs="*", default=["femur", "pelvis"])
    parser.add_argument("-o", "--output", help="file of evidence for the pages, of the first bone")
    arguments = parser.parse_args()
    folder = Path(arguments.data) / "hip"
    shapes = {
        "box 20 x 30 x 40": trimesh.creation.box((20.0, 30.0, 40.0)),
        "torus 20, 5": trimesh.creation.torus(20.0, 5.0),
        "thin plate 0.5": trimesh.creation.box((40.0, 30.0, 0.5)),
    }
    if folder.is_dir():
        for name in arguments.bones:
            mesh = trimesh.load(folder / f"{name}.ply", process=False)
            rows = bone_table(name, mesh)
            if arguments.output:
                command = ["benchmarks/bench_sdf.py", "--bones", name]
                write_evidence(arguments.output, command, rows, COLUMNS)
                return
            build_stages(mesh)
    for name, mesh in shapes.items():
        bone_table(name, mesh)


if __name__ == "__main__":
    main()
