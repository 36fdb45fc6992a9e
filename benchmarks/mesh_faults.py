"""Where a muscle's surface is at fault: in bones by held or free vertices, bone vertices in it,
crossings of itself.

    NUMBA_NUM_THREADS=1 python benchmarks/mesh_faults.py SCENE [--model pbd] [--muscles A,B] [--set
    KEY=VALUE ...]
                                                         [--frames A:B:S]

Greatest depth over all frames, triangles that cross others (most in a frame, frames with any),
greatest volume error, distance from the input mesh in the first frame, frames in which the surface
is no sphere, and processor time of the frames without measures, files and pictures. A surface that
is not the muscle's own mesh has no held vertices; all its depth then stands under "free".
"""

import argparse
import time

import numpy as np

from rbfmuscle.geometry.mesh_distance import MeshDistance
from rbfmuscle.geometry.surfaces import mesh_volume
from rbfmuscle.metrics.metrics import SurfaceForm
from rbfmuscle.metrics.rows import bone_depth, surface_depth
from rbfmuscle.models import build_model, configure_scene
from rbfmuscle.scene.scene import Scene
from rbfmuscle.scene.settings import parse_settings
from rbfmuscle.simulation.frame_loop import simulate_frames

COLUMNS = (
    "held in bone",
    "free in bone",
    "bone in muscle",
    "crossing",
    "frames",
    "volume error",
    "rest error",
)


class Faults:
    """The faults of one muscle, frame by frame."""

    def __init__(self, muscle):
        self.muscle, self.form = muscle, SurfaceForm()
        self.held = np.zeros(len(muscle.mesh.vertices), dtype=bool)
        for attachment in muscle.attachments:
            self.held[attachment.vertices] = True
        self.rows = []

    def take(self, frame, probes):
        """Measure a frame."""
        surface = frame.surfaces[self.muscle.name]
        vertices, faces = surface.vertices, np.asarray(surface.faces)
        depth = surface_depth(vertices, probes, frame.poses)
        held = self.held if len(vertices) == len(self.held) else np.zeros(len(vertices), dtype=bool)
        form = self.form.measure(surface, same_faces=bool(self.rows))
        volume = mesh_volume(vertices, faces)
        away = 0.0
        if not self.rows:
            rest = MeshDistance(
                np.asarray(self.muscle.mesh.vertices), np.asarray(self.muscle.mesh.faces)
            )
            away = float(np.sqrt(np.mean(rest.unsigned(vertices) ** 2)))
        self.rows.append(
            (
                depth[held].max(initial=0.0),
                depth[~held].max(initial=0.0),
                bone_depth(MeshDistance(vertices, faces), probes, frame.poses),
                form["self_crossings"],
                form["self_crossings"] > 0,
                abs(volume / self.muscle.mesh.volume - 1.0),
                away,
                form["euler_characteristic"] != 2,
            )
        )

    def worst(self):
        """One row of `COLUMNS`, and the frames that are no sphere."""
        rows = np.array(self.rows, dtype=float)
        most = rows.max(axis=0)
        most[4] = rows[:, 4].sum()
        return most[:7], int(rows[:, 7].sum())


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scene")
    parser.add_argument("--model", default="pbd")
    parser.add_argument("--muscles", default="")
    parser.add_argument("--set", action="append", default=[])
    parser.add_argument("--frames")
    given = parser.parse_args()
    scene = Scene.load(given.scene)
    if given.muscles:
        scene.muscles[:] = [
            muscle for muscle in scene.muscles if muscle.name in given.muscles.split(",")
        ]
    scene = configure_scene(
        scene, parse_settings(given.set), model=given.model, frames=given.frames
    )
    faults = {muscle.name: Faults(muscle) for muscle in scene.muscles}
    probes = [bone.exact for bone in scene.bones]
    models = [build_model(muscle, scene, muscle.model) for muscle in scene.muscles]
    spent = 0.0
    start = time.process_time()
    events = {}
    for frame in simulate_frames(scene, models):
        spent += time.process_time() - start
        for found in faults.values():
            found.take(frame, probes)
        for event in frame.events:
            key = event.muscle, event.bone, event.action
            events[key] = max(events.get(key, 0), event.count)
        start = time.process_time()
    report(faults, spent)
    for key, count in events.items():
        if key[2] not in ("halved", "held_back"):
            print("event", *key, count)


def report(faults, spent):
    print(f"{'':28s}" + "".join(f"{name:>16s}" for name in COLUMNS))
    whole, spheres = [], 0
    for name, found in faults.items():
        most, odd = found.worst()
        spheres += odd
        whole.append(most)
        print(
            f"{name:28s}"
            + "".join(f"{value:16.3g}" for value in most)
            + (f"  no sphere in {odd}" if odd else "")
        )
    whole = np.array(whole)
    worst = [*whole[:, :4].max(axis=0), whole[:, 4].sum(), *whole[:, 5:].max(axis=0)]
    print(f"{'all':28s}" + "".join(f"{value:16.3g}" for value in worst))
    print(f"frames that are no sphere {spheres}; processor time of the frames {spent:.1f} s")


if __name__ == "__main__":
    main()
