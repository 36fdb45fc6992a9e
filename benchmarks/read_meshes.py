"""Time and memory of reading VTK and VTP files, by our readers and by VTK's, in fresh processes taken in turn.

Processor time counts what is loaded too, as a user pays for it; memory is beyond that of Python with numpy.
"""

import argparse
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests"))

OURS = """
from rbfmuscle.sim.formats.polydata import read_polydata, triangles_of
data = read_polydata({path!r})
vertices, faces = data.points, triangles_of(data)
assert len(faces) == {count}
"""
VTK = """
from vtkmodules.util.numpy_support import vtk_to_numpy
from vtkmodules.vtkIOLegacy import vtkPolyDataReader
from vtkmodules.vtkIOXML import vtkXMLPolyDataReader
from vtkmodules.vtkFiltersCore import vtkTriangleFilter
reader = vtkXMLPolyDataReader() if {path!r}.endswith("vtp") else vtkPolyDataReader()
reader.SetFileName({path!r})
triangles = vtkTriangleFilter()
triangles.SetInputConnection(reader.GetOutputPort())
triangles.Update()
data = triangles.GetOutput()
vertices = vtk_to_numpy(data.GetPoints().GetData()).astype(float)
assert data.GetNumberOfPolys() == {count}
"""
MEASURE = """
import time
import numpy as np
def peak(name):
    rows = open("/proc/self/status").read().splitlines()
    return int(next(row.split()[1] for row in rows if row.startswith(name)))
open("/proc/self/clear_refs", "w").write("5")  # the peak so far may be that of the process that began this one
before, start = peak("VmRSS"), time.process_time()
{code}
spent = time.process_time() - start
print(spent, peak("VmHWM") - before)
"""


def measure(code: str) -> tuple[float, float]:
    """Processor time [s] and memory [bytes] of code in a fresh process."""
    done = subprocess.run(
        [sys.executable, "-c", MEASURE.format(code=code)],
        capture_output=True,
        text=True,
        check=True,
        cwd=ROOT,
    )
    spent, memory = map(float, done.stdout.split())
    return spent, memory * 1024


def main() -> None:
    """Print a table by form."""
    import trimesh
    from fuzz.base import FORMS, suffix_of, write_mesh

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--subdivisions", type=int, default=6, help="of a ball: 20 * 4^n triangles")
    parser.add_argument("--rounds", type=int, default=3)
    options = parser.parse_args()
    mesh = trimesh.creation.icosphere(subdivisions=options.subdivisions, radius=20.0)
    print(f"{len(mesh.faces)} triangles, least of {options.rounds} rounds")
    print(f"{'form':20}{'MB':>8}{'ours ms':>10}{'VTK ms':>10}{'memory/file':>13}{'VTK':>8}")
    with tempfile.TemporaryDirectory() as folder:
        for form in [form for form in FORMS if form.startswith("vt")]:
            path = write_mesh(Path(folder) / f"ball{suffix_of(form)}", mesh, form)
            codes = [text.format(path=str(path), count=len(mesh.faces)) for text in (OURS, VTK)]
            rounds = [[measure(code) for code in codes] for _ in range(options.rounds)]
            best = [[min(r[k][i] for r in rounds) for i in range(2)] for k in range(len(codes))]
            size = path.stat().st_size
            times = "".join(f"{1e3 * b[0]:10.0f}" for b in best)
            memory = f"{best[0][1] / size:13.1f}{best[1][1] / size:8.1f}"
            print(f"{form:20}{size / 1e6:8.2f}{times}{memory}")


if __name__ == "__main__":
    main()
