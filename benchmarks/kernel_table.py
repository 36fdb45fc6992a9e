"""Choices of `rbfmuscle kernels` against a brute force of 40 shape parameters, on surfaces of all kinds.

``python benchmarks/kernel_table.py DATA [--surfaces a,b] [--kernels a,b] [--centres 150] [--placements fitted]``:
DATA holds ``hip`` and ``leg``. Prints for each case the error of the choice over the best of the scan (both ways, by
the same judge, unfit ones left out), the condition, fits and processor seconds of the row; then the share within 5 %.
"""

import argparse
import time
import warnings
from pathlib import Path

import numpy as np
import trimesh

from rbfmuscle.implicit.field import RBFField
from rbfmuscle.implicit.kernels.table import KERNELS
from rbfmuscle.implicit.placement.refinement import FITTED, fit_sample
from rbfmuscle.implicit.placement.sampling import sample_surface
from rbfmuscle.implicit.selection import SPAN, spacing, surface_miss
from rbfmuscle.study.experiment import kernel_study
from rbfmuscle.study.experiment.kernel_choice import mark_unfit

SCANNED, LIMIT = 40, 1.05
HIP = ("gluteus_maximus", "gluteus_medius", "iliacus", "adductor_brevis")
LEG = ("sartorius", "semimembranosus", "tibialis_anterior", "popliteus")


def surfaces(data):
    """Name -> (vertices, faces): hip, leg, and shapes that a script makes."""
    from rbfmuscle.sim.scene.meshes import read_mesh

    made = {f"hip/{name}": data / "hip" / f"{name}.ply" for name in HIP}
    made |= {f"leg/{name}": data / "leg" / "muscles" / f"{name}.ply" for name in LEG}
    for name, path in made.items():
        if path.exists():
            mesh = read_mesh(path).mesh
            yield name, (np.asarray(mesh.vertices, float), np.asarray(mesh.faces))
    ball = trimesh.creation.icosphere(subdivisions=4)
    bumps = np.array(ball.vertices)
    bumps *= (1.0 + 0.15 * np.sin(5 * bumps[:, 0]) * np.sin(5 * bumps[:, 1]) * np.sin(5 * bumps[:, 2]))[
        :, None
    ]
    plate = np.array(ball.vertices) * [30.0, 18.0, 3.0]
    plate[:, 2] += (plate[:, 0] / 12.0) ** 2
    torus = trimesh.creation.torus(30.0, 10.0, major_sections=96, minor_sections=48)
    rod = trimesh.creation.capsule(120.0, 6.0, count=[40, 40])
    for name, mesh in (("bumps", (30 * bumps, ball.faces)), ("bent plate", (plate, ball.faces)),
                       ("torus", (torus.vertices, torus.faces)), ("rod", (rod.vertices, rod.faces))):  # fmt: skip
        yield name, (np.asarray(mesh[0], float), np.asarray(mesh[1]))


def brute_force(judge, sample, kernel, derivatives):
    """Least error both ways of the scan's fits that are fit."""
    h, scan = spacing(sample.points).mean(), []
    for epsilon in np.geomspace(*SPAN, SCANNED) / h:
        try:
            fitted = RBFField.fit_surface(
                sample.points, sample.normals, kernel=kernel, epsilon=epsilon, derivatives=derivatives
            )
            scan.append((surface_miss(fitted, judge.held_out, h), epsilon))
        except np.linalg.LinAlgError:
            continue
    best = (np.inf, np.nan)
    for missed, epsilon in sorted(scan):
        if missed > 2.0 * best[0]:
            break
        row = blank_row(kernel, sample, epsilon)
        try:
            kernel_study.fill_row(row, judge, sample, kernel, derivatives)
        except (ValueError, np.linalg.LinAlgError):
            continue
        mark_unfit([row], sheets=judge.sheets)
        if not row["unfit"]:
            best = min(best, (row["rms"], epsilon * h))
    return best


def blank_row(kernel, sample, epsilon):
    """A row before it is measured."""
    return {"kernel": kernel.name, "centres": len(sample.points), "epsilon": epsilon, "note": "", "rms": None}


def case(judge, sample, kernel, placement):
    """One case: the choice, and the best of the scan with the same centres."""
    ask = kernel_study.Request("all", "held_out", placement, np.inf)
    start = time.process_time()
    row, _ = kernel_study.measure_row(judge, sample, kernel, ask, [])
    seconds = time.process_time() - start
    mark_unfit([row], sheets=judge.sheets)
    if placement == FITTED and kernel.hermite:
        # the centres that the choice was made for
        sample = fit_sample(sample, judge.vertices, judge.faces, kernel=kernel, epsilon=row["placed"] or 1.0)
    best = brute_force(judge, sample, kernel, "all") if kernel.has_epsilon else (row["rms"] or np.inf, np.nan)
    return row, best, seconds


def main():
    """Run the cases and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("--surfaces", default="")
    parser.add_argument("--kernels", default=",".join(KERNELS))
    parser.add_argument("--centres", default="150,300,600")
    parser.add_argument("--placements", default="greedy,fitted")
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    wanted, good, unfit, beyond = options.surfaces.split(",") if options.surfaces else None, 0, 0, []
    for name, (vertices, faces) in surfaces(options.data):
        if wanted and name not in wanted:
            continue
        judge = kernel_study.SurfaceJudge(vertices, faces, 64, 0)
        for count in map(int, options.centres.split(",")):
            sample = sample_surface(vertices, faces, count, placement="greedy")
            for placement in options.placements.split(","):
                for kernel in map(KERNELS.get, options.kernels.split(",")):
                    row, best, seconds = case(judge, sample, kernel, placement)
                    ratio = np.nan if row["unfit"] else row["rms"] / best[0]
                    unfit, good = unfit + bool(row["unfit"]), good + bool(ratio <= LIMIT)
                    if not row["unfit"] and not ratio <= LIMIT:
                        beyond.append((name, kernel.name, count, placement, round(ratio, 3)))
                    print(f"{name:22s} {count} {placement:7s} {kernel.name:26s} ratio {ratio:.3f} "
                          f"condition {row['condition'] or np.nan:.1e} fits {row['fits']} {seconds:.1f} s "
                          f"{row['unfit'] and 'unfit: ' + row['unfit'][:60]}"
                          f"{f' (scan: {best[0]:.3g})' if row['unfit'] and np.isfinite(best[0]) else ''}",
                          flush=True)  # fmt: skip
    print(f"{good} within 5 %, {unfit} named unfit, {len(beyond)} beyond: {beyond}")


if __name__ == "__main__":
    main()
