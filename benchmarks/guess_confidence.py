"""What the confidence of guessed attachments is worth: leg and hip, changed, against their scenes.

    python benchmarks/guess_confidence.py [CASE ...] [-o FILE.json]

Without CASE the evidence of the pages is written (``docs/evidence``), else that of ``-o`` alone.

Each case writes the meshes of data/leg or data/hip changed (renamed, mirrored, turned, scaled, in
another unit, stretched, decimated, roughened, with muscles or bones missing), guesses a scene and
compares every attachment with that of the scene in the data. A guess is wrong where the scene does
not hold the muscle by that bone, or where half of the guessed vertices lie farther than 15 mm,
times the scale, from the vertices that the scene attaches. The sites of ``new`` were read off
these two skeletons, so this measures how the guess bears change, not how it does on others.
"""

import argparse
import json
import tempfile
import tomllib
from pathlib import Path
from typing import NamedTuple

import numpy as np
import trimesh
from evidence import ROOT, data_folder, write_evidence
from scipy.spatial import cKDTree

from rbfmuscle.geometry.surfaces import simplified
from rbfmuscle.importers.guess.guess import guess_scene

COLUMNS = ["confidence", "guesses", "wrong", "%"]
EVIDENCE = ROOT / "docs" / "evidence" / "guess_confidence.json"
FAR = 15.0  # [mm] at scale 1
PREFIXES = {
    "plain": "{}",
    "published": "VHF_Right_{}_smooth",
    "labels": "{}_right",
    "unknown": "",
}


class Case(NamedTuple):
    """How the meshes are changed: ``scale`` of lengths, ``units`` they are written in, ``linear``
    (3, 3), ``keep`` the share of the triangles, ``rough`` the standard deviation of vertices [mm].
    """

    name: str
    data: str = "leg"
    names: str = "plain"
    scale: float = 1.0
    units: str = "mm"
    linear: np.ndarray = np.eye(3)
    keep: float = 1.0
    rough: float = 0.0
    share: float = 1.0  # of the muscles that are there
    without: tuple[str, ...] = ()  # bones that are not there


TURN = trimesh.transformations.random_rotation_matrix(np.array([0.3, 0.6, 0.9]))[:3, :3]
MIRROR = np.diag([-1.0, 1.0, 1.0])
CASES = [
    Case("as they are"),
    Case("names as published", names="published"),
    Case("names of labels, in cm", names="labels", units="cm"),
    Case("names unknown", names="unknown"),
    Case("mirrored", linear=MIRROR),
    Case("mirrored and turned, in m", linear=TURN @ MIRROR, units="m"),
    Case("scale 0.5", scale=0.5),
    Case("scale 0.7, in m", scale=0.7, units="m"),
    Case("scale 1.4, in cm", scale=1.4, units="cm"),
    Case("scale 2", scale=2.0),
    Case("stretched across", linear=np.diag([1.12, 0.95, 1.0])),
    Case("stretched along", linear=np.diag([0.95, 1.0, 1.1])),
    Case("a third of the triangles", keep=0.33),
    Case("a tenth of the triangles", keep=0.1),
    Case("rough by 1 mm", rough=1.0),
    Case("half of the muscles", share=0.5),
    Case("a fifth of the muscles", share=0.2),
    Case("without patella and fibula", without=("patella", "fibula")),
    Case("without pelvis and sacrum", without=("pelvis", "sacrum")),
    Case("without foot, calcaneus, talus", without=("foot", "calcaneus", "talus")),
    Case("without tibia", without=("tibia",)),
    Case("without femur", without=("femur",)),
    Case("hip", data="hip"),
    Case("hip, mirrored, in m", data="hip", linear=MIRROR, units="m"),
    Case("hip, scale 0.8, turned", data="hip", scale=0.8, linear=TURN),
    Case("hip, a third of the triangles", data="hip", keep=0.33),
]


def scene_of(name):
    """Meshes of bones and muscles by name, and attached points (n, 3) by muscle and bone [mm]."""
    folder = data_folder(name)
    file = {"leg": "leg.toml", "hip": "flexion.toml"}[name]
    table = tomllib.loads((folder / file).read_text(encoding="utf-8"))
    if name == "leg":
        facts = json.loads((folder / "scene.json").read_text(encoding="utf-8"))
        real = set(facts["bones"])
        rows = {
            muscle: {row["bone"]: row["vertices_file"] for row in found["attachments"]}
            for muscle, found in facts["muscles"].items()
        }
    else:
        real = {row["name"] for row in table["bone"]}
        rows = {
            row["name"]: {held["bone"]: held["vertices"] for held in row["attach"]}
            for row in table["muscle"]
        }
    bones = {
        row["name"]: trimesh.load(folder / row["mesh"], process=False)
        for row in table["bone"]
        if row["name"] in real
    }
    muscles, held = {}, {}
    for row in table["muscle"]:
        mesh = trimesh.load(folder / row["mesh"], process=False)
        muscles[row["name"]] = mesh
        held[row["name"]] = {
            bone: mesh.vertices[np.loadtxt(folder / file, dtype=int)]
            for bone, file in rows[row["name"]].items()
        }
    return bones, muscles, held


def changed(mesh, case, rng):
    """A mesh as a case has it."""
    vertices, faces = np.array(mesh.vertices), np.array(mesh.faces)
    if case.keep < 1.0:
        vertices, faces = simplified(vertices, faces, int(case.keep * len(faces)))
    vertices = vertices + case.rough * rng.normal(size=vertices.shape)
    found = trimesh.Trimesh(placed(vertices, case), faces, process=False)
    if np.linalg.det(case.linear) < 0.0:
        found.invert()
    return found


def placed(points, case):
    """Points (n, 3) of the data [mm] as a case has them."""
    unit = {"mm": 1.0, "cm": 0.1, "m": 0.001}[case.units]
    return points @ case.linear.T * (case.scale * unit)


def guessed(case):
    """(muscle, bone, confidence, wrong) of every attachment that is guessed."""
    rng = np.random.default_rng(0)
    bones, muscles, held = scene_of(case.data)
    names = sorted(muscles)
    chosen = rng.choice(names, max(1, round(case.share * len(names))), replace=False)
    true_name = {}
    with tempfile.TemporaryDirectory() as folder:
        for kind, meshes in (("bones", bones), ("muscles", muscles)):
            (Path(folder) / kind).mkdir()
            for name, mesh in meshes.items():
                if name in case.without or (kind == "muscles" and name not in chosen):
                    continue
                pattern = PREFIXES[case.names]
                # Of unknown names those of the bones are kept, which say what the muscles lack.
                shown = pattern.format(name) if pattern else f"part_{len(true_name)}"
                shown = name if kind == "bones" and not pattern else shown
                true_name[shown.lower()] = name
                changed(mesh, case, rng).export(Path(folder) / kind / f"{shown}.ply")
        found = guess_scene(Path(folder), case.units, Path(folder))
    rows = []
    for muscle in found.muscles:
        if muscle.wrong:
            continue
        name = true_name[muscle.muscle.name]
        for hold in muscle.holds:
            bone = true_name[hold.bone.name]
            sure = min(hold.confidence, muscle.confidence if muscle.doubted else 1.0)
            rows.append((name, bone, sure, is_wrong(muscle, hold, held[name].get(bone), case)))
    return rows


def is_wrong(muscle, hold, true, case):
    """Whether a guess is wrong, as above."""
    if true is None:
        return True
    points = muscle.muscle.points[hold.vertices]
    size = np.linalg.norm(placed(np.array([[1.0, 0.0, 0.0]]), case))
    return bool(np.median(cKDTree(placed(true, case)).query(points)[0]) > FAR * size)


def main():
    """Measure, print, and write the evidence."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("cases", nargs="*", help="names of cases, or parts of them")
    parser.add_argument("-o", "--output", type=Path)
    given = parser.parse_args()
    output = given.output or (None if given.cases else EVIDENCE)
    counts = {}
    for case in CASES:
        if given.cases and not any(word in case.name for word in given.cases):
            continue
        rows = guessed(case)
        for _, _, sure, wrong in rows:
            found = counts.setdefault(f"{sure:.1f}", [0, 0])
            found[0] += 1
            found[1] += wrong
        sure = [row for row in rows if row[2] >= 1.0]
        bad = [row[:2] for row in sure if row[3]]
        words = f"{len(rows)} guesses, {len(sure)} called 1.0, wrong of these {bad}"
        print(f"{case.name}: {words}", flush=True)
    table = [
        [sure, count, wrong, 100 * wrong / count]
        for sure, (count, wrong) in sorted(counts.items(), reverse=True)
    ]
    for row in table:
        print("confidence {}: {} guesses, {} wrong ({:.1f} %)".format(*row))
    if output:
        write_evidence(output, ["benchmarks/guess_confidence.py"], table, COLUMNS)


if __name__ == "__main__":
    main()
