"""How far a fitted surface is from the mesh at rest: derivatives in all directions, or along the normal alone.

    python benchmarks/rest_fits.py SCENE.toml [-o docs/evidence/rest_fits.json]

Cubic kernel, evenly sampled centres; distance |f|/|grad f| of the mesh's vertices from the surface, RMS, in the
scene's unit.
"""

import argparse
from pathlib import Path

import numpy as np
from evidence import write_evidence

import rbfmuscle as rm
from rbfmuscle.implicit.field import RBFField
from rbfmuscle.implicit.placement.sampling import sample_surface

CENTRES = (150, 300, 600)
DERIVATIVES = ("all", "normal")


def miss(mesh, count, derivatives):
    """RMS distance of a mesh's vertices from the surface through so many of its points."""
    sample = sample_surface(mesh.vertices, mesh.faces, count, placement="even")
    field = RBFField.fit_surface(sample.points, sample.normals, derivatives=derivatives)
    value, gradient = field.value_and_gradient(np.asarray(mesh.vertices))
    return float(np.sqrt(np.mean((value / np.linalg.norm(gradient, axis=1)) ** 2)))


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("scene", type=Path)
    parser.add_argument("-o", "--output", type=Path)
    given = parser.parse_args()
    rows = {
        muscle.name: {kind: [miss(muscle.mesh, count, kind) for count in CENTRES] for kind in DERIVATIVES}
        for muscle in rm.Scene.load(given.scene).muscles
    }
    for name, row in rows.items():
        print(name, *(" / ".join(f"{value:.2f}" for value in row[kind]) for kind in DERIVATIVES))
    if given.output:
        write_evidence(given.output, ["benchmarks/rest_fits.py", str(given.scene)], rows)


if __name__ == "__main__":
    main()
