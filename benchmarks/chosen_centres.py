"""How many centres the muscles of a scene have by their area and by the error at rest that is wanted.

    python benchmarks/chosen_centres.py SCENE.toml [-o docs/evidence/chosen_centres.json]

Numbers that the scene gives are left out of account. Errors are those of the vertices of the mesh from the field's
surface at rest, RMS, in the scene's unit.
"""

import argparse
from pathlib import Path

import numpy as np
from evidence import write_evidence

import rbfmuscle as rm
from rbfmuscle.model.options import RBFOptions
from rbfmuscle.model.placement import choose_centres, default_centres


def chosen(muscle, scene):
    """Centres and error by area alone, and as they are chosen."""
    given = {key: value for key, value in muscle.options.items() if key != "centres"}
    by_area = default_centres(muscle.mesh.area, scene)
    # With an error that any fit keeps, the area alone decides.
    plain = choose_centres(muscle, scene, RBFOptions(**{**given, "rest_error": 1e3}))
    found = choose_centres(muscle, scene, RBFOptions(**given))
    assert plain.centres == by_area
    return {"by_area": [by_area, plain.error], "chosen": [found.centres, found.error]}


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("scene", type=Path)
    parser.add_argument("-o", "--output", type=Path)
    given = parser.parse_args()
    scene = rm.Scene.load(given.scene)
    rows = {muscle.name: chosen(muscle, scene) for muscle in scene.muscles}
    for name, row in rows.items():
        (usual, before), (count, after) = row["by_area"], row["chosen"]
        print(f"{name}: {usual} by area, {before:.2f}; {count} chosen, {after:.2f}")
    print(f"mean {np.mean([row['chosen'][0] for row in rows.values()]):.0f}")
    if given.output:
        write_evidence(given.output, ["benchmarks/chosen_centres.py", str(given.scene)], rows)


if __name__ == "__main__":
    main()
