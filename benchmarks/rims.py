"""Greatest distance and volume of the level zero with 300 fitted centres: cells of before and of now.

``python benchmarks/rims.py DATA [--muscles hip/iliacus,...] [--kernels cubic,quintic] [--centres 300]``: for each
muscle and kernel the root mean square and greatest distance both ways and the error of the volume, of the surface at
64 cells and at as many as `rbfmuscle kernels` takes, and the Euler characteristic (2 for a ball, less by 2 a handle).
"""

import argparse
from pathlib import Path

import numpy as np
import trimesh

from rbfmuscle.implicit.extraction.surface import extract_surface
from rbfmuscle.implicit.field import RBFField
from rbfmuscle.implicit.placement.refinement import fit_sample
from rbfmuscle.implicit.placement.sampling import sample_surface
from rbfmuscle.sim.scene.meshes import read_mesh
from rbfmuscle.study.experiment.kernel_judge import SurfaceJudge
from rbfmuscle.study.experiment.workers import threads_limited

LEG = "leg/muscles/semimembranosus,leg/muscles/tibialis_anterior,leg/muscles/sartorius"
CHOSEN = f"hip/iliacus,hip/gluteus_maximus,{LEG}"
BEFORE = 64


def main():
    """Print a line a muscle, kernel and number of cells."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("--muscles", default=CHOSEN)
    parser.add_argument("--kernels", default="cubic,quintic")
    parser.add_argument("--centres", type=int, default=300)
    options = parser.parse_args()
    for name in options.muscles.split(","):
        mesh = read_mesh(options.data / f"{name}.ply").mesh
        vertices, faces = np.asarray(mesh.vertices, float), np.asarray(mesh.faces)
        judge = SurfaceJudge(vertices, faces, 0, 0)
        placed = sample_surface(vertices, faces, options.centres, placement="greedy")
        for kernel in options.kernels.split(","):
            sample = fit_sample(placed, vertices, faces, kernel=kernel)
            field = RBFField.fit_hermite(sample.points, sample.normals, kernel=kernel)
            for cells in (BEFORE, judge.resolution):
                found = extract_surface(field, points=sample.points, resolution=cells)
                rms, greatest, *_ = judge.apart(found.vertices, found.faces)
                euler = trimesh.Trimesh(found.vertices, found.faces, process=False).euler_number
                print(f"{name:26s} {kernel:8s} {cells:4d} cells: RMS {rms:.3f}, greatest {greatest:.2f}, volume "
                      f"{100 * (found.volume / judge.volume - 1):+.2f} %, Euler {euler}, "
                      f"condition {field.condition:.1e}", flush=True)  # fmt: skip


if __name__ == "__main__":
    with threads_limited(1):
        main()
