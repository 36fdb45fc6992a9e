"""Thickness of the gluteus maximus beneath the ischial tuberosity as the hip flexes, beside MRI
(Makhsous et al. 2011, doi 10.1002/ca.21119).

    python benchmarks/ischial_cover.py [--models rbf,pbd] [--set KEY=VALUE ...] [-o FILE.json]

The muscle of the real leg alone, flexion from the scan's pose to 90 degrees. The tip of the
tuberosity is the point of the ischium that lies farthest down and back. Thickness is the length of
a ray inside the muscle, mean of rays from the pelvis' surface within a radius of the tip, where it
faces down and back. As in MRI the rays are perpendicular to the thigh: backwards in the scan's
pose, downwards at 90 degrees. In the last row of a model they keep their first direction.
"""

import argparse

import numpy as np
from evidence import data_folder, write_evidence

from rbfmuscle.geometry.mesh_distance import MeshDistance
from rbfmuscle.recording import simulate
from rbfmuscle.scene.motion import bone_poses
from rbfmuscle.scene.objects import Motion
from rbfmuscle.scene.scene import Scene
from rbfmuscle.scene.settings import parse_settings

MUSCLE = "gluteus_maximus"
COORDINATE = "hip.hip_flexion"
STEP = 5.0  # degrees
SHOWN = (0, 45, 75, 90)  # degrees
BACK = np.array([0.0, 1.0, 0.0])  # of the data: +y posterior, +z superior
BEHIND_BELOW = np.array([0.0, 1.0, -1.0]) / np.sqrt(2.0)
ISCHIUM = 40.0  # the ischium's lower part: so far below the centre of the hip at least [mm]
RADII = (0.0, 10.0, 20.0)  # [mm]
FACING = 60.0  # greatest angle of the surface's normal to down and back [degree]
REACH, SAMPLE = 150.0, 0.25  # length of a ray, and distance of its points [mm]


def flexion_scene():
    """The gluteus maximus alone, flexing from rest to 90 degrees."""
    scene = Scene.load(data_folder("leg") / "tendons" / "leg.toml")
    angles = np.radians(np.arange(0.0, SHOWN[-1] + 0.5 * STEP, STEP))
    scene.motion = Motion([{COORDINATE: float(angle)} for angle in angles])
    scene.muscles = [scene.muscle(MUSCLE)]
    return scene


def tuberosity(pelvis, hip):
    """Tip of the tuberosity (3,), and for each of `RADII` the points (n, 3) that rays leave."""
    vertices = np.asarray(pelvis.vertices)
    low = vertices[:, 2] < hip[2] - ISCHIUM
    tip = vertices[low][np.argmax(vertices[low] @ BEHIND_BELOW)]
    facing = np.asarray(pelvis.vertex_normals) @ BEHIND_BELOW > np.cos(np.radians(FACING))
    distance = np.where(low & facing, np.linalg.norm(vertices - tip, axis=1), np.inf)
    return tip, [vertices[distance <= radius] if radius else tip[None] for radius in RADII]


def thickness(surface, starts, direction):
    """Mean length of rays inside a surface."""
    along = np.arange(0.5 * SAMPLE, REACH, SAMPLE)
    points = starts[:, None] + along[:, None] * direction
    inside = MeshDistance(surface.vertices, surface.faces).inside(points.reshape(-1, 3))
    return SAMPLE * inside.sum() / len(starts)


def perpendicular_to_thigh(scene, frame):
    """Direction (3,) backwards from the thigh, which runs from the hip's to the knee's centre."""
    centres = {joint.name: np.asarray(joint.centre) for joint in scene.joints}
    thigh = centres["knee"] - centres["hip"]
    thigh /= np.linalg.norm(thigh)
    back = BACK - (BACK @ thigh) * thigh
    return bone_poses(scene, frame.coordinates)["femur"][:3, :3] @ back / np.linalg.norm(back)


def table(model, settings):
    """Rows of a model: its name, what rays, thickness at `SHOWN`, and how much less at the last, in
    per cent.
    """
    scene = flexion_scene()
    hip = next(np.asarray(joint.centre) for joint in scene.joints if joint.name == "hip")
    pelvis = next(bone.mesh for bone in scene.bones if bone.name == "pelvis")
    tip, patches = tuberosity(pelvis, hip)
    print(f"{model}; tip {np.round(tip, 1)}; rays: {[len(patch) for patch in patches]}")
    run = simulate(scene, model=model, settings=settings)
    frames = [run.frames[round(angle / STEP)] for angle in SHOWN]
    turning = [perpendicular_to_thigh(scene, frame) for frame in frames]
    names = ["at the tip", *(f"within {radius:g} mm of the tip" for radius in RADII[1:])]
    cases = [(name, starts, turning) for name, starts in zip(names, patches)]
    cases.append((f"{names[-1]}, direction fixed", patches[-1], turning[:1] * len(frames)))
    rows = []
    for name, starts, ways in cases:
        found = [thickness(f.surfaces[MUSCLE], starts, way) for f, way in zip(frames, ways)]
        rows.append([model, name, *found, 100.0 * (1.0 - found[-1] / found[0])])
    return rows


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--models", default="rbf,pbd")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("-o", "--output", help="file of evidence for the pages")
    given = parser.parse_args()
    rows = []
    for model in given.models.split(","):
        rows += table(model, parse_settings(given.set))
    heads = ["model", "rays", *(f"{angle}° [mm]" for angle in SHOWN), f"less at {SHOWN[-1]}° [%]"]
    print(f"| {' | '.join(heads)} |\n{'|---' * len(heads)}|")
    for model, name, *values in rows:
        print(f"| {model} | {name} | {' | '.join(f'{value:.1f}' for value in values)} |")
    if given.output:
        write_evidence(given.output, ["benchmarks/ischial_cover.py", *given.set], rows, heads)


if __name__ == "__main__":
    main()
