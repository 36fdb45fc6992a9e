"""The phantom hip: two bones and four muscles from formulas, no data files.

A right hip in millimetres with the joint's centre at the origin: +x medial, +y posterior, +z up.
"""

import functools
from pathlib import Path

import numpy as np

from rbfmuscle.geometry.arrays import Floats
from rbfmuscle.scene.objects import Attachment
from rbfmuscle.scene.phantom_shapes import (
    Tube,
    ball,
    blend,
    carve,
    ellipsoid,
    plate,
    rod,
    solid_mesh,
)
from rbfmuscle.scene.scene import Scene

PHANTOM = "phantom"
HEAD_RADIUS = 23.0  # of the femur [mm]
SOCKET_RADIUS = 26.5  # [mm]
AXES = {"flexion": (-1, 0, 0), "adduction": (0, -1, 0), "internal_rotation": (0, 0, 1)}


def femur_distance(points: Floats) -> Floats:
    """Nearly the signed distance to the femur: head, neck, trochanters, bowed shaft, condyles."""
    shaft_stops = [(-42, 5, -45), (-42, -3, -120), (-35, -8, -210), (-22, -4, -310), (-10, 2, -375)]
    shaft = rod(points, shaft_stops, [17, 15, 13.5, 15, 24])
    upper = blend(shaft, rod(points, [(0, 0, 0), (-42, 4, -38)], [14, 17]), 14)
    upper = blend(upper, ellipsoid(points, (-52, 8, -22), (15, 19, 24)), 12)
    upper = blend(upper, ellipsoid(points, (-28, 20, -68), (10, 10, 13)), 10)
    medial = ellipsoid(points, (16, 8, -400), (17, 29, 21))
    lateral = ellipsoid(points, (-29, 8, -400), (17, 30, 21))
    knee = blend(blend(shaft, medial, 22), lateral, 22)
    return blend(blend(upper, knee, 0.5), ball(points, (0, 0, 0), HEAD_RADIUS), 8)


def pelvis_distance(points: Floats) -> Floats:
    """Nearly the signed distance to the hip bone: ilium, socket, ischium, pubis and the ring
    between them.
    """
    tilt = np.radians(14.0)
    turn = np.array(
        [[np.cos(tilt), 0.0, np.sin(tilt)], [0, 1, 0], [-np.sin(tilt), 0.0, np.cos(tilt)]]
    )
    ilium = plate(points, (10, 16, 94), (70, 50), 5.5, turn)
    ilium = blend(ilium, rod(points, [(10, 10, 20), (12, 14, 70)], [27, 10]), 30)
    ischium = rod(points, [(16, 18, -12), (26, 36, -52), (30, 32, -84)], [20, 15, 17])
    pubis = rod(points, [(22, -14, 0), (55, -38, -22), (84, -42, -44)], [15, 9, 12])
    ramus = rod(points, [(32, 28, -88), (56, 0, -82), (84, -40, -52)], [13, 8, 10])
    ring = blend(blend(pubis, ramus, 8), ischium, 12)
    opening = np.array([-0.72, -0.22, -0.66])
    cup = carve(ball(points, (4, 1, 3), 37), 6 - points @ (opening / np.linalg.norm(opening)), 10)
    solid = blend(blend(ilium, cup, 12), ring, 12)
    return carve(solid, ball(points, (0, 0, 0), SOCKET_RADIUS), 5)


@functools.cache
def bone_meshes(spacing: float = 3.5) -> dict[str, object]:
    """Vertices and faces of both bones, by name."""
    return {
        "pelvis": solid_mesh(pelvis_distance, (-45, -75, -120), (115, 110, 165), spacing),
        "femur": solid_mesh(femur_distance, (-85, -50, -435), (50, 55, 40), spacing),
    }


# The first is long and wraps the back of the hip; the second is a fan; the last two lie 1.2 mm
# apart.
ADDUCTOR = functools.partial(Tube, radius=220, width=14, thickness=9, twist=(0.29, 0.045))
MUSCLES = {
    "extensor": Tube(
        ((8.2, 45.5, 76.1), (-46, 52.5, -36), (-43, 18, -137)),
        radius=90,
        width=27,
        thickness=11,
        fullness=5,
        spread=1.3,
        twist=(0.7, -0.62),
    ),
    "abductor": Tube(
        ((-9.5, -19, 130), (-28, -6, 50), (-60.3, 8, 1.8)),
        radius=200,
        width=23,
        thickness=7,
        fullness=5,
        spread=1.6,
        twist=(0.04, -0.6),
    ),
    "adductor_anterior": ADDUCTOR(((66.4, -42, -44), (23.2, -14, -125.1), (-20.3, -13.5, -211.9))),
    "adductor_posterior": ADDUCTOR(
        ((49.7, -14.8, -66.6), (6.5, 13.2, -147.7), (-38.7, 14.2, -234.6))
    ),
}
# Muscle vertices within the first and last parts of the axis, and this near to the bone [mm], are
# attached.
ATTACHED_ENDS = {"extensor": (0.17, 0.83), "abductor": (0.3, 0.87)}
USUAL_ENDS, ATTACHED_WITHIN = (0.12, 0.88), 6.0
FIBRE_PLACES = ((0, 0), (0.55, 0), (-0.55, 0), (0, 0.5), (0, -0.5))
FIBRE_POINTS = 15


@functools.cache
def _parts(spacing):
    """Meshes, attachments and fibres, computed once; nobody may change them in place."""
    scene = Scene("phantom_hip", units="mm")
    for name, mesh in bone_meshes().items():
        scene.add_bone(name, mesh)
    muscles = {}
    for name, tube in MUSCLES.items():
        vertices, faces, u = tube.mesh(spacing)
        first, last = ATTACHED_ENDS.get(name, USUAL_ENDS)
        near = {bone.name: bone.distances(vertices) <= ATTACHED_WITHIN for bone in scene.bones}
        attach = [
            Attachment("pelvis", np.flatnonzero((u <= first) & near["pelvis"])),
            Attachment("femur", np.flatnonzero((u >= last) & near["femur"])),
        ]
        along = np.linspace(0.02, 0.98, FIBRE_POINTS)
        fibres = [tube.points_inside(along, across, thick) for across, thick in FIBRE_PLACES]
        muscles[name] = ((vertices, faces), attach, fibres)
    return bone_meshes(), muscles


def phantom_scene(
    *, model: str = "rbf", end: float = 90.0, step: float = 2.0, spacing: float = 3.0
) -> Scene:
    """Return the phantom hip as a scene: flexion from 0 to ``end`` by ``step`` [degree].

    The muscles' volumes are known in closed form (``MUSCLES[name].volume``); a mesh of triangles
    with edges of 3 mm, its vertices on the surface, holds up to 1.5 % less.

    Parameters
    ----------
    model : str or dict
        For every muscle.
    end, step : float
        [degree].
    spacing : float
        Edge length of the muscles' meshes [mm].

    Returns
    -------
    Scene
        In millimetres.

    Examples
    --------
    >>> scene = phantom_scene(end=10.0, step=5.0)
    >>> len(scene.motion), scene.units
    (3, 'mm')
    """
    bones, muscles = _parts(float(spacing))
    scene = Scene("phantom_hip", units="mm")
    for name, mesh in bones.items():
        scene.add_bone(name, mesh)
    scene.add_joint("hip", "pelvis", "femur", (0, 0, 0), AXES)
    for name, (mesh, attach, fibres) in muscles.items():
        scene.add_muscle(name, mesh, attach=attach, model=model, fibres=fibres)
    scene.set_motion(ramp={"hip.flexion": {"from": 0.0, "to": float(end), "step": float(step)}})
    return scene


def open_scene(scene: Scene | str | Path, *, skeleton: bool = False) -> Scene:
    """Return the scene of a file; the phantom hip for "phantom" where there is no file of that
    name.

    A Scene is returned as it is; ``skeleton`` is that of `Scene.load`.
    """
    if isinstance(scene, Scene):
        return scene
    if str(scene) == PHANTOM and not Path(scene).is_file():
        return phantom_scene()
    return Scene.load(scene, skeleton=skeleton)
