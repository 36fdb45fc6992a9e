"""What a run of a scene would build and solve, without building it."""

import numpy as np

from rbfmuscle.scene.motion import completed, rest_coordinates
from rbfmuscle.scene.objects import Muscle
from rbfmuscle.scene.scene import Scene
from rbfmuscle.simulation.contact_pairs import find_contact_pairs
from rbfmuscle.simulation.neighbours import connected, find_links
from rbfmuscle.simulation.rigid_transport import RigidTransport
from rbfmuscle.simulation.substeps import PoseCache, SubSteps
from rbfmuscle.validation import SceneError


def plan_scene(scene: Scene) -> dict[str, object]:
    """Frames, sub-steps, muscles and fields of a run, by these names.

    Muscles have the ``bones`` within reach and the ``substeps`` in which they are solved, fields
    the triangles and the share of the bone's box. A listed bone need not be touched. A bone that
    comes near a muscle is not foreseen: the muscle may then be solved in more sub-steps.
    """
    regions, poses = find_contact_pairs(scene), PoseCache(scene)
    muscles: list[dict[str, object]] = []
    counts: list[int] = []
    fields = []
    met = {m.name: [bone for name, bone in regions if name == m.name] for m in scene.muscles}
    cuts = [SubSteps(scene, m, bones=met[m.name], poses=poses) for m in scene.muscles]
    names = [muscle.name for muscle in scene.muscles]
    groups = connected(len(names), find_links(scene, names))
    together = {m: [cuts[k] for k in group] for group in groups for m in group}
    for number, muscle in enumerate(scene.muscles):
        bones = met[muscle.name]
        counts.append(_count_substeps(muscle, scene, together[number], poses))
        muscles.append(
            {
                "name": muscle.name,
                "model": muscle.model,
                "vertices": len(muscle.mesh.vertices),
                "bones": bones,
                "substeps": counts[-1],
            }
        )
    for name in dict.fromkeys(bone for _, bone in regions):
        mesh = scene.bone(name).mesh
        boxes = np.array([found for (_, bone), found in regions.items() if bone == name])
        # The least that holds what all muscles can reach of it.
        box = np.array([boxes[:, 0].min(axis=0), boxes[:, 1].max(axis=0)])
        own = np.asarray(mesh.bounds, dtype=float)
        reached, extent = np.diff(np.clip(box, own[0], own[1]), axis=0)[0], own[1] - own[0]
        wide = extent > 0.0  # a bone may be flat
        share = float(np.prod(reached[wide] / extent[wide]))
        fields.append({"bone": name, "triangles": len(mesh.faces), "share": share})
    most = max(counts, default=0)
    return {"frames": len(scene.motion), "substeps": most, "muscles": muscles, "fields": fields}


def _count_substeps(
    muscle: Muscle, scene: Scene, together: list[SubSteps], poses: PoseCache
) -> int:
    """Sub-steps in which the motion requires a muscle to be solved, ``together`` with others those
    of the one that needs most.
    """
    always = muscle.contraction is not None or len(together) > 1
    rigid_transport = RigidTransport(muscle, scene)
    count = 0
    here = rest_coordinates(scene)
    rigid_transport.note_solved(poses(here))
    for index, frame in enumerate(scene.motion.frames):
        there = completed(scene, frame)
        try:
            stops = max((cut.split(here, there) for cut in together), key=len)
        except SceneError as error:
            raise SceneError(f"muscle {muscle.name!r}, frame {index}: {error}") from None
        for stop in stops:
            if always or not rigid_transport.keeps_shape(poses(stop)):
                count += 1
                rigid_transport.note_solved(poses(stop))
        here = there
    return count
