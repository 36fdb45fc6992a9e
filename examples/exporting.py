"""# Exporting

A saved run becomes meshes for other programs: a PVD time series for ParaView, PLY, STL or OBJ a
frame, one animated GLB; in metres where that is wanted.
"""

import numpy as np
from pictures import draw, folder

import rbfmuscle as rm

out = folder("exporting")
scene = rm.phantom_scene()
run = rm.simulate(scene, frames="0:31:10")
run.save(out / "run", pictures=False)
draw(out / "run", out / "exported.png")

for path in sorted((out / "run").iterdir()):
    print(path.name)

# The same from the command line: rbfmuscle export run --format stl,glb --units m
written = run.export(out / "meshes", ["stl", "glb"], units="m")
print(len(written), "files, for instance", ", ".join(sorted({path.suffix for path in written})))

# The check of this page: an STL read back has the muscle's volume, in cubic metres now.
import trimesh  # noqa: E402

file = next(path for path in written if path.suffix == ".stl" and path.name.startswith("extensor"))
mesh = trimesh.load(file)
expected = run["extensor"].surface(0).volume * 1e-9
print(f"{file.name}: {mesh.volume:.4e} m3, expected {expected:.4e}")
assert np.isclose(mesh.volume, expected, rtol=1e-3)
