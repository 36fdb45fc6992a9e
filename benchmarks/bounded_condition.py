"""What a bound of the condition costs: error and time of fits with a ridge and without, on greedy centres.

``python benchmarks/bounded_condition.py DATA [--surfaces a,b] [--centres 150,300] [--bounds 1e11,1e10]``: DATA holds
``hip`` and ``leg``. Prints for each kernel the error to first order at 2,000 other points [length], the estimate of
the condition and the processor time, without a bound first.
"""

import argparse
import time
import warnings
from pathlib import Path

import numpy as np
from kernel_table import surfaces

from rbfmuscle.implicit.field import RBFField
from rbfmuscle.implicit.placement.sampling import sample_surface
from rbfmuscle.implicit.selection import spacing, surface_miss
from rbfmuscle.study.experiment.kernel_judge import HELD_OUT
from rbfmuscle.study.experiment.workers import threads_limited

# Kernels and epsilon times the spacing; the last is flat.
KERNELS = (
    ("cubic", 1.0),
    ("skala_cervenka", 1.0),
    ("quintic", 1.0),
    ("septic", 1.0),
    ("inverse_multiquadric", 0.2),
)
REPEATS = 3


def measured(sample, held_out, kernel, epsilon, bound):
    """Error, condition and least processor seconds."""
    spent = []
    for _ in range(REPEATS):
        start = time.process_time()
        field = RBFField.fit_surface(
            sample.points, sample.normals, kernel=kernel, epsilon=epsilon, derivatives="all", condition=bound
        )
        spent.append(time.process_time() - start)
    return surface_miss(field, held_out, spacing(sample.points).mean()), field.condition, min(spent)


def main():
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("--surfaces", default="hip/iliacus,leg/sartorius,phantom")
    parser.add_argument("--centres", default="150,300")
    parser.add_argument("--bounds", default="1e11,1e10")
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    wanted = options.surfaces.split(",")
    for name, vertices, faces in surfaces(options.data):
        if name not in wanted:
            continue
        held_out = sample_surface(vertices, faces, HELD_OUT, placement="even").points
        for count in map(int, options.centres.split(",")):
            sample = sample_surface(vertices, faces, count, placement="greedy")
            for kernel, shape in KERNELS:
                epsilon = shape / spacing(sample.points).mean()
                found = [measured(sample, held_out, kernel, epsilon, bound)
                         for bound in (np.inf, *map(float, options.bounds.split(",")))]  # fmt: skip
                cells = "".join(f"{e:9.4f} {c:8.1e} {1e3 * s:5.0f} ms" for e, c, s in found)
                print(f"{name:16s} {count} {kernel:22s}{cells}", flush=True)


if __name__ == "__main__":
    with threads_limited(1):
        main()
