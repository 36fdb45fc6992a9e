"""Fields through many points: time, memory and error of the partition of unity, beside a dense fit and SciPy.

``python benchmarks/large_fields.py [--points 100000] [--resolution 256] [--dense 5000]``: points of a bumpy torus with
exact normals; prints processor seconds (wall beside), the greatest memory of the process, and the distance of unseen
points of the torus from the surface, |f| / |grad f|.
"""

import argparse
import resource
import time

import numpy as np
from scipy.interpolate import RBFInterpolator
from scipy.spatial import cKDTree

from rbfmuscle.implicit.field import RBFField
from rbfmuscle.implicit.partition import PartitionField
from rbfmuscle.implicit.placement.off_surface import off_surface_points
from rbfmuscle.study.measure.mesh_distance import MeshDistance

MAJOR, MINOR, BUMP, WAVES = 60.0, 20.0, 2.0, 9
# Of the spacing that as many points have on a torus.
CLOSEST = 0.55


def torus(count, seed):
    """Points and unit normals, nearly even by area."""
    rng = np.random.default_rng(seed)
    u, v = rng.uniform(0, 2 * np.pi, (2, 3 * count))
    keep = rng.uniform(0, MAJOR + MINOR + BUMP, 3 * count) < MAJOR + MINOR * np.cos(v)
    u, v = u[keep][:count], v[keep][:count]

    def place(u, v):
        r = MINOR + BUMP * np.sin(WAVES * u) * np.cos(4 * v)
        ring = MAJOR + r * np.cos(v)
        return np.stack([ring * np.cos(u), ring * np.sin(u), r * np.sin(v)], axis=1)

    step = 1e-5
    along = (place(u + step, v) - place(u - step, v)) / (2 * step)
    around = (place(u, v + step) - place(u, v - step)) / (2 * step)
    normal = np.cross(along, around)
    return place(u, v), normal / np.linalg.norm(normal, axis=1)[:, None]


def timed(work):
    """Result, processor and wall seconds."""
    start, wall = time.process_time(), time.perf_counter()
    result = work()
    return result, time.process_time() - start, time.perf_counter() - wall


def missed(field, points):
    """Root mean square and greatest distance to first order."""
    value, gradient = field.value_and_gradient(points)
    distance = np.abs(value) / np.linalg.norm(gradient, axis=1)
    return float(np.sqrt((distance**2).mean())), float(distance.max())


def memory():
    """Greatest resident memory of this process [GB]."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6


def main():
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--points", type=int, default=100_000)
    parser.add_argument("--resolution", type=int, default=256)
    parser.add_argument("--dense", type=int, default=0)
    parser.add_argument("--scipy", type=int, default=0)
    parser.add_argument("--poisson", action="store_true", help="needs pymeshlab")
    options = parser.parse_args()
    PartitionField.fit_hermite(*torus(200, 5)).surface(resolution=16)  # compiles
    unseen, _ = torus(20_000, 1)
    for count in (options.points // 10, options.points):
        points, normals = torus(count, 0)
        field, cpu, wall = timed(lambda p=points, n=normals: PartitionField.fit_hermite(p, n))
        print(f"{count} points: fit {cpu:.1f} s processor, {wall:.1f} s wall, {field.parts} parts, "
              f"condition {field.condition:.1e}, memory {memory():.2f} GB, error {missed(field, unseen)}",
              flush=True)  # fmt: skip
    mesh, cpu, wall = timed(lambda: field.surface(resolution=options.resolution))
    print(f"surface at {options.resolution} cells: {cpu:.1f} s processor, {wall:.1f} s wall, "
          f"{len(mesh.vertices)} vertices, Euler {mesh.euler_number}, closed {mesh.is_watertight}, "
          f"memory {memory():.2f} GB",
          flush=True)  # fmt: skip
    if options.poisson:
        apart = distance_of(mesh.vertices, mesh.faces, unseen)
        print(f"  unseen points from that surface, its chords included: {apart}", flush=True)
        compare_poisson(points, normals, unseen)
    if options.scipy:
        compare_scipy(points, normals, unseen[: options.scipy])
    if options.dense:
        compare_dense(options.dense, unseen)


def distance_of(vertices, faces, points):
    """Root mean square and greatest distance of points from a surface."""
    surface = np.ascontiguousarray(vertices, float), np.ascontiguousarray(faces, np.int64)
    distance = MeshDistance(*surface, closed=False).unsigned(points)
    return float(np.sqrt((distance**2).mean())), float(distance.max())


def compare_poisson(points, normals, unseen):
    """Screened Poisson surfaces (Kazhdan and Hoppe 2013) as MeshLab makes them, 2^8 and 2^9 cells."""
    import pymeshlab

    meshes = pymeshlab.MeshSet()
    meshes.add_mesh(pymeshlab.Mesh(vertex_matrix=points, v_normals_matrix=normals))
    for depth in (8, 9):
        meshes.set_current_mesh(0)
        _, cpu, _ = timed(
            lambda d=depth: meshes.generate_surface_reconstruction_screened_poisson(depth=d, threads=1)
        )
        made = meshes.current_mesh()
        apart = distance_of(made.vertex_matrix(), made.face_matrix(), unseen)
        print(
            f"screened Poisson, depth {depth}: {cpu:.1f} s, {made.vertex_number()} vertices, unseen points {apart}"
        )


def compare_scipy(points, normals, unseen):
    """SciPy's interpolator of 50 neighbours, values on and off the surface; its gradient by differences."""
    where, values = off_surface_points(points[::10], normals[::10])
    field, cpu, _ = timed(lambda: RBFInterpolator(where, values, neighbors=50, kernel="cubic", degree=1))
    value, spent, _ = timed(lambda: field(unseen))
    print(f"SciPy, 50 neighbours of {len(where)} values: {cpu:.1f} s, {1e6 * spent / len(unseen):.0f} us a value, "
          f"|f| RMS {np.sqrt((value**2).mean()):.4g}")  # fmt: skip
    own, spent, _ = timed(lambda: PartitionField.fit_hermite(points[::10], normals[::10]))
    value, spent, _ = timed(lambda: own(unseen))
    print(f"  partition of the same points: {1e6 * spent / len(unseen):.0f} us a value, "
          f"|f| RMS {np.sqrt((value**2).mean()):.4g}")  # fmt: skip


def spread(count):
    """So many points no two of which are close: of random ones that all but coincide no dense fit is sound."""
    points, normals = torus(4 * count, 0)
    tree, kept = cKDTree(points), np.ones(4 * count, bool)
    apart = CLOSEST * np.sqrt(4.0 * np.pi**2 * MAJOR * MINOR / count)
    for index in range(4 * count):
        if kept[index]:
            near = tree.query_ball_point(points[index], apart)
            kept[near] = False
            kept[index] = True
    which = np.flatnonzero(kept)[:count]
    return points[which], normals[which]


def compare_dense(count, unseen):
    """Dense fits to the normal derivatives and to all, whose matrix of (4 count)^2 numbers takes 3.2 GB for 5,000."""
    points, normals = spread(count)
    parts = missed(PartitionField.fit_hermite(points, normals), unseen)
    for derivatives in ("normal", "all"):
        dense, cpu, _ = timed(lambda d=derivatives: RBFField.fit_hermite(points, normals, derivatives=d))
        found = missed(dense, unseen)
        print(f"{len(points)} points, dense fit to {derivatives} derivatives: {cpu:.1f} s, error {found}; "
              f"partition {parts}, ratio {parts[0] / found[0]:.3f}, memory {memory():.2f} GB",
              flush=True)  # fmt: skip


if __name__ == "__main__":
    main()
