"""The phantom hip: two bones and four muscles from formulas, no data files.

A right hip in millimetres with the joint's centre at the origin: +x medial, +y posterior, +z up.
"""

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rbfmuscle.geometry.arrays import Floats, Integers
from rbfmuscle.geometry.lines import distance_along
from rbfmuscle.scene.objects import Attachment
from rbfmuscle.scene.scene import Scene

LEAST_SLOPE = 1e-12  # of an ellipsoid's norm; only its centre has less


@dataclass(frozen=True)
class Tube:
    """A muscle as a generalised cylinder with closed-form volume.

    Its axis runs straight, along a circular arc, and straight again (a polyline of three points
    with a rounded corner). The section at the fraction u of the axis is an ellipse in the normal
    plane, centred on the axis, with half-axes ``width * w(u) * g(u)`` and ``thickness * w(u) /
    g(u)``, where w = sqrt(1 - |2u - 1|^fullness) rounds the ends and g runs from ``spread`` to 1 /
    spread (a fan). The section's centroid lies on the axis, so by Pappus the volume is the integral
    of the section's area,

        V = pi * width * thickness * length * fullness / (fullness + 1).
    """

    points: tuple  # start, corner and end of the axis (3, 3)
    radius: float  # of the rounded corner, at most what the shorter leg allows
    width: float  # half-axes of the largest section, for spread 1
    thickness: float
    fullness: float = 4.0  # 2 gives an ellipsoid's ends, more gives blunter ones
    spread: float = 1.0  # above 1 the start is wider and thinner than the end
    twist: tuple = (
        0.0,
        0.0,
    )  # of the wide half-axis from the bend's binormal at both ends [radian]

    def _bend(self):
        start, corner, end = np.asarray(self.points, dtype=float)
        first, last = corner - start, end - corner
        legs = np.array([np.linalg.norm(first), np.linalg.norm(last)])
        first, last = first / legs[0], last / legs[1]
        angle = np.arccos(np.clip(first @ last, -1, 1))
        cut = self.radius * np.tan(angle / 2)
        return start, first, last, legs, angle, cut

    @property
    def length(self) -> float:
        """Length of the axis."""
        _, _, _, legs, angle, cut = self._bend()
        return legs.sum() - 2 * cut + self.radius * angle

    @property
    def volume(self) -> float:
        """Volume in closed form."""
        return (
            np.pi * self.width * self.thickness * self.length * self.fullness / (self.fullness + 1)
        )

    def axis(self, u: Floats) -> tuple[Floats, Floats, Floats]:
        """Position, tangent and binormal (each (n, 3)) at fractions u of the length."""
        start, first, last, legs, angle, cut = self._bend()
        s = np.asarray(u, dtype=float) * self.length
        straight = legs[0] - cut
        turn = np.clip((s - straight) / self.radius, 0, angle)
        side = last - (first @ last) * first
        side /= np.linalg.norm(side)
        tangent = np.cos(turn)[:, None] * first + np.sin(turn)[:, None] * side
        before = np.minimum(s, straight)
        after = np.maximum(s - straight - self.radius * angle, 0)
        arc = self.radius * (np.sin(turn)[:, None] * first + (1 - np.cos(turn))[:, None] * side)
        position = start + before[:, None] * first + arc + after[:, None] * last
        return position, tangent, np.broadcast_to(np.cross(first, side), position.shape)

    def sections(self, u: Floats) -> tuple[Floats, Floats, Floats]:
        """Centre, wide half-axis and thin half-axis (each (n, 3)) of the ellipses at
        fractions u.
        """
        u = np.asarray(u, dtype=float)
        centre, tangent, binormal = self.axis(u)
        normal = np.cross(binormal, tangent)
        turn = (self.twist[0] + u * (self.twist[1] - self.twist[0]))[:, None]
        w = np.sqrt(np.clip(1 - np.abs(2 * u - 1) ** self.fullness, 0, None))
        g = self.spread ** (1 - 2 * u)
        wide = np.cos(turn) * binormal + np.sin(turn) * normal
        thin = np.cross(tangent, wide)
        return (
            centre,
            (self.width * w * g)[:, None] * wide,
            (self.thickness * w / g)[:, None] * thin,
        )

    def mesh(self, spacing: float) -> tuple[Floats, Integers, Floats]:
        """Closed outward triangles with edges of about ``spacing``, vertices on the tube.

        Vertices (n, 3), faces (m, 3), and the fraction of the axis (n,) of each vertex.
        """
        u = _stations(self, spacing)
        centre, wide, thin = self.sections(u)
        rings = [_ring(c, a, b, spacing) for c, a, b in zip(centre[1:-1], wide[1:-1], thin[1:-1])]
        rings = [centre[:1], *rings, centre[-1:]]
        starts = np.concatenate([[0], np.cumsum([len(ring) for ring in rings])])
        vertices = np.concatenate(rings)
        faces = [
            stitch(vertices, np.arange(a, b), np.arange(b, c))
            for a, b, c in zip(starts[:-2], starts[1:-1], starts[2:])
        ]
        return vertices, np.concatenate(faces), np.repeat(u, np.diff(starts))


def _stations(tube, spacing):
    """Fractions of the axis, so spaced that neighbouring rings are about ``spacing`` apart on the
    surface.
    """
    fine = (1 - np.cos(np.linspace(0, np.pi, 2001))) / 2
    centre, wide, thin = tube.sections(fine)
    path = np.zeros(len(fine))
    for line in (centre + wide, centre + thin, centre - wide, centre - thin):
        path = np.maximum(path, distance_along(line))
    count = max(8, round(path[-1] / spacing))
    return np.interp(np.linspace(0, path[-1], count + 1), path, fine)


def _ring(centre, wide, thin, spacing):
    """Points at equal arcs of an ellipse."""
    angle = np.linspace(0, 2 * np.pi, 361)
    points = centre + np.cos(angle)[:, None] * wide + np.sin(angle)[:, None] * thin
    arc = distance_along(points)
    count = max(6, round(arc[-1] / spacing))
    angle = np.interp(np.arange(count) * arc[-1] / count, arc, angle)
    return centre + np.cos(angle)[:, None] * wide + np.sin(angle)[:, None] * thin


def stitch(vertices: Floats, lower: Integers, upper: Integers) -> Integers:
    """Triangles between two rings with different numbers of points, always along the shorter
    diagonal.
    """
    faces = []
    i = j = 0
    n, m = len(lower), len(upper)
    while i < n or j < m:
        a, b = lower[i % n], upper[j % m]
        next_a, next_b = lower[(i + 1) % n], upper[(j + 1) % m]
        along_lower = j >= m or (
            i < n
            and np.sum((vertices[next_a] - vertices[b]) ** 2)
            <= np.sum((vertices[next_b] - vertices[a]) ** 2)
        )
        if along_lower:
            if n > 1:
                faces.append((a, next_a, b))
            i += 1
        else:
            if m > 1:
                faces.append((a, next_b, b))
            j += 1
    return np.array(faces, dtype=np.int64)


def ball(points: Floats, centre: Sequence[float], radius: float) -> Floats:
    """Signed distance to a ball."""
    return np.linalg.norm(points - np.asarray(centre), axis=-1) - radius


def ellipsoid(points: Floats, centre: Sequence[float], radii: Sequence[float]) -> Floats:
    """Nearly the signed distance to an ellipsoid along the axes."""
    local, radii = points - np.asarray(centre), np.asarray(radii, dtype=float)
    value = np.linalg.norm(local / radii, axis=-1)
    slope = np.linalg.norm(local / radii**2, axis=-1)
    return np.where(
        slope > LEAST_SLOPE, value * (value - 1) / np.maximum(slope, LEAST_SLOPE), -radii.min()
    )


def plate(
    points: Floats,
    centre: Sequence[float],
    radii: Sequence[float],
    half_thickness: float,
    turn: Floats,
) -> Floats:
    """Nearly the signed distance to an elliptic plate with a round rim, its first axis across the
    plate.
    """
    local = (points - np.asarray(centre)) @ np.asarray(turn).T
    flat = np.stack([local[..., 1], local[..., 2]], axis=-1)
    outside = np.maximum(ellipsoid(flat, (0, 0), radii), 0)
    return np.hypot(local[..., 0], outside) - half_thickness


def rod(points: Floats, stops: Sequence[Sequence[float]], radii: Sequence[float]) -> Floats:
    """Nearly the signed distance to a rod along a polyline whose radius is linear between its
    points.
    """
    stops = np.asarray(stops, dtype=float)
    nearest = np.full(points.shape[:-1], np.inf)
    for a, b, ra, rb in zip(stops[:-1], stops[1:], radii[:-1], radii[1:]):
        along = np.clip((points - a) @ (b - a) / ((b - a) @ (b - a)), 0, 1)
        away = np.linalg.norm(points - a - along[..., None] * (b - a), axis=-1)
        nearest = np.minimum(nearest, away - (ra + along * (rb - ra)))
    return nearest


def blend(first: Floats, second: Floats, width: float) -> Floats:
    """Smooth union of two distance fields: a fillet where they are within ``width`` of each
    other.
    """
    overlap = np.clip(width - np.abs(first - second), 0, None) / width
    return np.minimum(first, second) - overlap**3 * width / 6


def carve(solid: Floats, hole: Floats, width: int) -> Floats:
    """Smooth difference: the solid without the hole, its rim rounded over ``width``."""
    return -blend(-solid, hole, width)


def solid_mesh(
    distance: Callable[[Floats], Floats],
    low: Sequence[float],
    high: Sequence[float],
    spacing: float,
) -> tuple[Floats, Integers]:
    """Closed outward triangles of the zero set of ``distance`` within a box, vertices projected
    onto it.
    """
    from skimage.measure import marching_cubes

    low = np.asarray(low, dtype=float)
    shape = np.ceil((np.asarray(high) - low) / spacing).astype(int) + 1
    grid = low + spacing * np.moveaxis(np.indices(shape), 0, -1)
    vertices, faces, _, _ = marching_cubes(distance(grid), 0.0, spacing=(spacing,) * 3)
    vertices = vertices.astype(float) + low
    h = 1e-4 * spacing
    for _ in range(2):  # Newton's method from within a cell, a choice: the shapes are defined so
        value = distance(vertices)
        slope = np.stack(
            [
                (distance(vertices + h * e) - distance(vertices - h * e)) / (2 * h)
                for e in np.eye(3)
            ],
            axis=1,
        )
        step = (value / np.maximum(np.einsum("ij,ij->i", slope, slope), 0.1))[:, None] * slope
        vertices -= np.clip(step, -spacing / 2, spacing / 2)
    return vertices, faces.astype(np.int64)


PHANTOM = "phantom"
HEAD_RADIUS = 23.0  # of the femur [mm]
SOCKET_RADIUS = 26.5  # [mm]
BONE_EDGE = 3.5  # of the cells from which bones are drawn [mm]
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
def bone_meshes() -> dict[str, object]:
    """Vertices and faces of both bones, by name."""
    return {
        "pelvis": solid_mesh(pelvis_distance, (-45, -75, -120), (115, 110, 165), BONE_EDGE),
        "femur": solid_mesh(femur_distance, (-85, -50, -435), (50, 55, 40), BONE_EDGE),
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
# attached. Fibres lie at fixed fractions, within the unit disc, of the half-axes.
ATTACHED_ENDS = {"extensor": (0.17, 0.83), "abductor": (0.3, 0.87)}
USUAL_ENDS, ATTACHED_WITHIN = (0.12, 0.88), 6.0
FIBRE_PLACES = ((0, 0), (0.55, 0), (-0.55, 0), (0, 0.5), (0, -0.5))
FIBRE_POINTS = 15


@functools.cache
def _muscles(spacing):
    """Mesh, attachments and fibres of each muscle, computed once; nobody may change them in
    place.
    """
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
        centre, wide, thin = tube.sections(along)
        fibres = [centre + across * wide + thick * thin for across, thick in FIBRE_PLACES]
        muscles[name] = ((vertices, faces), attach, fibres)
    return muscles


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
    scene = Scene("phantom_hip", units="mm")
    for name, mesh in bone_meshes().items():
        scene.add_bone(name, mesh)
    scene.add_joint("hip", "pelvis", "femur", (0, 0, 0), AXES)
    for name, (mesh, attach, fibres) in _muscles(float(spacing)).items():
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
