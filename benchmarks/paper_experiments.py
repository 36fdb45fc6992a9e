"""The paper's experiments with the mesh models: where do first penetration and first tunnelling
come?

Cervenka, Havlicek, Kohout and Váša (GRAPP 2023) flex, turn and adduct the hip, and extend it by
steps of 2, 4, 5 and 10 degrees to 80. Here each model does so with and without sub-steps of 2
degrees; nothing is corrected afterwards, so that what the model itself can do shows. `pbd-paper` is
plain PBD as printed: vertices keep their velocity, all edges are alike, the response is to one
bone.

    python benchmarks/paper_experiments.py           two motions, two models (half a minute)
    python benchmarks/paper_experiments.py --all     every motion, every model (ten minutes)

With ``-o FILE.md`` the table is written to a file too.

It needs the hip (RBFMUSCLE_DATA, the folder that holds hip/); without it the embedded phantom is
taken.
"""

import argparse
import os
import time
from pathlib import Path

import numpy as np
from peers import paper_models

from rbfmuscle.geometry.mesh_distance import MeshDistance
from rbfmuscle.metrics.rows import bone_depth, surface_depth
from rbfmuscle.models import build_model
from rbfmuscle.scene.motion import bone_poses
from rbfmuscle.scene.objects import from_mm
from rbfmuscle.scene.options import TunnellingOptions
from rbfmuscle.scene.phantom import phantom_scene
from rbfmuscle.scene.scene import Scene
from rbfmuscle.simulation.contact import BoneContacts, BonesInReach
from rbfmuscle.simulation.contact_pairs import build_fields, find_contact_pairs
from rbfmuscle.simulation.substeps import SubSteps
from rbfmuscle.simulation.touching import settle
from rbfmuscle.simulation.tunnelling import find_crossings

paper_models.register()
MODELS = ("pbd-paper", "pbd", "xpbd", "arap-pbd", "arap-volume", "arap-interleaved")
# Coordinate, end and step [degree].
MOTIONS = {
    "flexion by 2": ("hip.flexion", 90, 2),
    "internal rotation by 1": ("hip.internal_rotation", 45, 1),
    "external rotation by 1": ("hip.internal_rotation", -45, 1),
    "adduction by 2": ("hip.adduction", 60, 2),
    "extension by 2": ("hip.flexion", -80, 2),
    "extension by 4": ("hip.flexion", -80, 4),
    "extension by 5": ("hip.flexion", -80, 5),
    "extension by 10": ("hip.flexion", -80, 10),
}
QUICK_MOTIONS, QUICK_MODELS = ("flexion by 2", "extension by 4"), ("pbd-paper", "pbd")
# Depth [mm] from which a vertex counts as inside; the fields of the hip are good to a hundredth of
# this.
INSIDE = 0.5
HEADINGS = (
    "motion",
    "model",
    "sub-steps",
    "penetration from",
    "deepest vertex, mm",
    "deepest bone vertex, mm",
    "tunnelling from",
    "volume error",
    "edge ratio 1 % to 99 %",
    "ms a frame",
)


def hip_scene(muscle):
    """The hip with one muscle, or the phantom with its first where the data are absent."""
    root = Path(__file__).resolve().parent.parent
    for place in (os.environ.get("RBFMUSCLE_DATA"), root.parent / "shared" / "data"):
        if place and (Path(place) / "hip" / "flexion.toml").is_file():
            scene = Scene.load(Path(place) / "hip" / "flexion.toml")
            scene.muscles = [scene.muscle(muscle)]
            return scene
    scene = phantom_scene(model="pbd")
    scene.muscles = scene.muscles[:1]
    return scene


class Experiment:
    """One muscle through one motion; its bones' fields are built once for all models."""

    def __init__(self, scene, coordinate, end, step):
        self.scene = scene.with_options()
        known = {f"{joint.name}.{axis}" for joint in scene.joints for axis in joint.coordinates}
        self.possible = coordinate in known
        if not self.possible:
            return
        self.coordinate = coordinate
        self.scene.set_motion(ramp={coordinate: {"from": 0, "to": end, "step": step}})
        regions = find_contact_pairs(self.scene)
        fields = build_fields(self.scene, regions)
        self.names = [bone.name for bone in scene.bones]
        self.sub_steps = SubSteps(self.scene)
        self.fields = [fields.get(name) for name in self.names]
        self.probes = [bone.exact for bone in scene.bones]

    def run(self, method, substeps):
        """Angles of the first penetration and tunnelling, and the worst of everything else."""
        model = build_model(self.scene.muscles[0], self.scene, method)
        contacts = BoneContacts(BonesInReach(self.names, self.fields), model.attached_bone)
        record = Record(model, self.probes)
        here = {self.coordinate: 0.0}
        for coordinates in self.scene.motion.frames:
            stops = self.sub_steps.split(here, coordinates) if substeps else [coordinates]
            for after in stops:
                self.step(model, contacts, here, after, record)
                here = after
            record.measure(coordinates[self.coordinate], bone_poses(self.scene, coordinates))
        return record

    def step(self, model, contacts, before, after, record):
        """One step, timed, and its swept test."""
        poses = bone_poses(self.scene, before), bone_poses(self.scene, after)
        start = model.contact_points().copy()
        clock = time.perf_counter()
        contacts.move(poses[1])
        model.predict(*poses)
        moving = model.begin(contacts)
        settle([moving])
        model.take(moving)
        record.seconds += time.perf_counter() - clock
        crossings = find_crossings(
            contacts,
            start,
            model.contact_points(),
            *poses,
            TunnellingOptions(),
            tolerance=from_mm(0.1, self.scene.units),
        )
        if record.tunnelling is None and any(len(crossing.index) for crossing in crossings):
            record.tunnelling = after[self.coordinate]


class Record:
    """What happened in one run."""

    def __init__(self, model, probes):
        self.model, self.probes = model, probes
        self.penetration = self.tunnelling = None
        self.depth = self.bone_depth = self.volume = self.seconds = 0.0
        self.ratio, self.frames = [np.inf, 0.0], 0
        rest, self.edges = model.rest, model.rest.topology.edges
        self.free = model.attached_bone < 0
        self.lengths = self.edge_lengths(rest.vertices)

    def edge_lengths(self, points):
        return np.linalg.norm(points[self.edges[:, 0]] - points[self.edges[:, 1]], axis=1)

    def measure(self, angle, poses):
        """Take in one frame."""
        self.frames += 1
        points = self.model.contact_points()
        depth = float(surface_depth(points[self.free], self.probes, poses).max())
        if self.penetration is None and self.frames > 1 and depth > INSIDE:
            self.penetration = angle
        # the muscle starts with an overlap; the first frame resolves it
        if self.frames > 1:
            self.depth = max(self.depth, depth)
        self.bone_depth = max(
            self.bone_depth,
            bone_depth(MeshDistance(*self.model.material_mesh()), self.probes, poses),
        )
        self.volume = max(
            self.volume,
            abs(
                self.model.rest.volume.volume(self.model.points) / self.model.rest.volume.rest - 1.0
            ),
        )
        low, high = np.quantile(self.edge_lengths(points) / self.lengths, [0.01, 0.99])
        self.ratio = [min(self.ratio[0], low), max(self.ratio[1], high)]

    def cells(self):
        """The figures as text."""
        first = [
            "never" if a is None else f"{np.degrees(a):.0f}°"
            for a in (self.penetration, self.tunnelling)
        ]
        return (
            first[0],
            f"{self.depth:.2f}",
            f"{self.bone_depth:.2f}",
            first[1],
            f"{self.volume:.0e}",
            f"{self.ratio[0]:.2f} to {self.ratio[1]:.2f}",
            f"{1e3 * self.seconds / self.frames:.0f}",
        )


def run_all(scene, motions, models):
    """Yield (motion, model, sub-steps, Record) for every combination that the scene allows."""
    for motion in motions:
        experiment = Experiment(scene, *MOTIONS[motion])
        if not experiment.possible:
            continue
        for model in models:
            for substeps in (True, False):
                yield motion, model, substeps, experiment.run(model, substeps)


def main(arguments=None):
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--all", action="store_true", help="every motion and model")
    parser.add_argument("--muscle", default="gluteus_maximus")
    parser.add_argument("-o", "--output", type=Path, help="Markdown file for the table")
    given = parser.parse_args(arguments)
    motions, models = (MOTIONS, MODELS) if given.all else (QUICK_MOTIONS, QUICK_MODELS)
    lines = ["| " + " | ".join(HEADINGS) + " |", "|---" * len(HEADINGS) + "|"]
    print("\n".join(lines))
    records = {}
    for motion, model, substeps, record in run_all(hip_scene(given.muscle), motions, models):
        records[motion, model, substeps] = record
        cells = (motion, model, "yes" if substeps else "no", *record.cells())
        lines.append("| " + " | ".join(cells) + " |")
        print(lines[-1], flush=True)
    if given.output:
        given.output.write_text("\n".join(lines) + "\n", encoding="utf-8")
    for (motion, model, substeps), record in records.items():
        assert np.isfinite(record.model.contact_points()).all(), (motion, model, substeps)
        if model == "pbd" and substeps:
            assert record.volume < 1e-3, (motion, record.volume)
            assert record.depth <= 0.5 or motion == "adduction by 2", (motion, record.depth)


if __name__ == "__main__":
    main()
