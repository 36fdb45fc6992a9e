"""The fewest centres for a wanted error against an exhaustive search in steps of 4 %.

``python benchmarks/wanted_error.py MESH ... [--errors 0.5,0.2] [--kernels cubic,quintic] [--from 0.6]``: for each mesh
and error what `reach_error` takes, its error on unseen points, fits and processor seconds, and the fewest centres that
any of the kernels reaches it with when all numbers are tried from so many times those of the search on (the error falls
by the power 1.4 of the number: with 0.6 of it, it is twice the wanted one).
"""

import argparse
import time
import warnings
from pathlib import Path

from rbfmuscle.implicit.kernels.table import get_kernel
from rbfmuscle.sim.scene.meshes import read_mesh
from rbfmuscle.study.experiment.wanted_error import FEWEST, STEP, Search, reach_error


def exhaustive(mesh, error, kernels, least, most):
    """Fewest centres of all numbers from ``least`` to ``most``, in steps, with any kernel."""
    search = Search((mesh.vertices, mesh.faces), error, False, "fitted", most)
    count = max(least, FEWEST)
    while count <= most:
        for name in kernels:
            if search.measure(get_kernel(name), count) <= error:
                return count, name
        count = max(count + 1, round(count * (1.0 + STEP)))
    return None, ""


def main():
    """Run the cases and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("meshes", type=Path, nargs="+")
    parser.add_argument("--errors", default="0.5,0.2")
    parser.add_argument("--kernels", default="cubic,quintic")
    parser.add_argument("--from", type=float, default=0.6, dest="least")
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    kernels = options.kernels.split(",")
    for path in options.meshes:
        mesh = read_mesh(path).mesh
        for error in map(float, options.errors.split(",")):
            start = time.process_time()
            found = reach_error(mesh, error, kernels=kernels)
            seconds, count = time.process_time() - start, found.row["centres"]
            print(f"{path.stem} {error}: reached {found.reached}, {found.row['kernel']} with {count} centres, "
                  f"{found.error:.3f}, {len(found.tried)} fits, {seconds:.0f} s", flush=True)  # fmt: skip
            least, name = exhaustive(mesh, error, kernels, round(options.least * count), count)
            if found.reached and least:
                print(f"    exhaustive: {least} centres with {name}, ratio {count / least:.3f}", flush=True)


if __name__ == "__main__":
    main()
