"""Surfaces from points without normals beside those from the same points with their true normals.

``python benchmarks/unoriented.py DATA [--points 500] [--surfaces a,b] [--large 2000]``: for each surface the normals
that point the wrong way, the median angle to the true ones, the error of the reconstructed surface (RMS both ways) with
and without true normals, and processor seconds.
"""

import argparse
import time
from pathlib import Path

import numpy as np
import trimesh
from kernel_table import surfaces

from rbfmuscle.implicit.orientation import orient_points
from rbfmuscle.implicit.placement.sampling import sample_surface
from rbfmuscle.implicit.reconstruction import reconstruct_surface
from rbfmuscle.study.experiment.kernel_judge import SurfaceJudge

CHOSEN = (
    "hip/iliacus,hip/gluteus_maximus,hip/adductor_brevis,leg/sartorius,leg/popliteus,bumps,bent plate,torus"
)


def true_points(vertices, faces, count):
    """Points spread evenly over a surface and its normals there, smooth where the mesh is."""
    sample = sample_surface(vertices, faces, count, placement="even", seed=3)
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    near, _, face = trimesh.proximity.closest_point(mesh, sample.points)
    weights = trimesh.triangles.points_to_barycentric(mesh.triangles[face], near)
    normals = np.einsum("nk,nkj->nj", weights, mesh.vertex_normals[faces[face]])
    return sample.points, normals / np.linalg.norm(normals, axis=1)[:, None]


def main():
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("--points", type=int, default=500)
    parser.add_argument("--surfaces", default=CHOSEN)
    parser.add_argument(
        "--large", type=int, default=0, help="also time the first surface with so many points"
    )
    options = parser.parse_args()
    ratios, wanted = [], options.surfaces.split(",")
    shapes = {name: arrays for name, *arrays in surfaces(options.data) if name in wanted}
    for name in wanted:
        vertices, faces = shapes[name]
        judge = SurfaceJudge(vertices, faces, 96, 0)
        points, normals = true_points(vertices, faces, options.points)
        start = time.process_time()
        found = reconstruct_surface(points, resolution=96)
        seconds = time.process_time() - start
        known = reconstruct_surface(points, normals, resolution=96)
        cosine = np.einsum("ij,ij->i", found.normals, normals)
        angle = np.degrees(np.arccos(np.median(cosine)))
        errors = [judge.apart(one.vertices, one.faces)[0] for one in (found, known)]
        ratios.append(errors[0] / errors[1])
        print(f"{name:22s} {len(points)} points, {(cosine < 0).sum()} wrong, "
              f"{angle:.1f} degrees; error {errors[0]:.3g}, with true normals {errors[1]:.3g}, ratio {ratios[-1]:.2f}; "
              f"{seconds:.1f} s",
              flush=True)  # fmt: skip
    print(f"ratio: median {np.median(ratios):.2f}, greatest {max(ratios):.2f}")
    if options.large:
        points, normals = true_points(*shapes[wanted[0]], options.large)
        start = time.process_time()
        cosine = np.einsum("ij,ij->i", orient_points(points), normals)
        print(
            f"{wanted[0]}: {options.large} points, {(cosine < 0).sum()} wrong, {time.process_time() - start:.0f} s"
        )


if __name__ == "__main__":
    main()
