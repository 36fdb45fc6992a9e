"""Simple bones and a small elastic muscle for tests of contact: no real model."""

from functools import cache

import numpy as np
import trimesh

from pbd_baseline.settling import MeshSettling, MovingSurface
from rbfmuscle.bones.sdf import BoneSDF
from rbfmuscle.loops import loop
from rbfmuscle.scene.bone import Bone
from rbfmuscle.scene.joints import JointTable
from rbfmuscle.scene.objects import Attachment, Motion, Muscle
from rbfmuscle.scene.options import ContactOptions, DetectOptions, TunnellingOptions
from rbfmuscle.scene.scene import Scene
from rbfmuscle.simulation.frame import ModelSurface, MuscleModel
from rbfmuscle.simulation.touching import Body, settle


class Formula:
    """A field or a cut from a formula for its values; gradients are central differences."""

    def __init__(self, formula):
        self.formula = formula

    def __call__(self, points):
        return self.formula(points)

    def value_and_gradient(self, points):
        slopes = [
            (self.formula(points + e) - self.formula(points - e)) / 4e-4 for e in 2e-4 * np.eye(3)
        ]
        return self.formula(points), np.stack(slopes, axis=1)

    def value_and_gradient_below(self, points, limit):
        value, gradient = self.formula(points), np.zeros_like(points)
        rows = np.flatnonzero(value < limit)
        if len(rows):
            value[rows], gradient[rows] = self.value_and_gradient(points[rows])
        return value, gradient


@cache
def sphere(radius=1.0, centre=(0, 0, 0)):
    """Field of a ball of 5,120 triangles."""
    return _field(trimesh.creation.icosphere(4, radius), centre)


@cache
def box(half, centre=(0, 0, 0)):
    """Field of a box with half sizes ``half``: a thin plate where one is small."""
    return _field(trimesh.creation.box(2.0 * np.array(half, dtype=float)), centre)


def _field(mesh, centre):
    mesh.apply_translation(np.asarray(centre, dtype=float))
    return BoneSDF.from_mesh(mesh)


@loop
def press(target, now, inverse, index, gap, normal):
    """Least energy under half-spaces, by projected Gauss-Seidel on their pressures."""
    x, pressure = target.copy(), np.zeros(len(index))
    for _ in range(80):
        for c in range(len(index)):
            i = index[c]
            if inverse[i, i] == 0.0:
                continue
            violation = gap[c]
            for k in range(3):
                violation += normal[c, k] * (x[i, k] - now[i, k])
            step = max(-violation / inverse[i, i], -pressure[c])
            pressure[c] += step
            for j in range(len(x)):
                for k in range(3):
                    x[j, k] += inverse[j, i] * step * normal[c, k]
    return x


class ToyMuscle(MuscleModel):
    """Vertices on springs to t, where the bones' blended motion would take them; attached ones go
    with their bones.

    Energy (x - t)' K (x - t) / 2 with K a graph Laplacian plus a share of the identity.
    """

    def __init__(self, muscle, scene, *, sweeps=6, reach=None):
        self.name, self.muscle = muscle.name, muscle
        self.names = [bone.name for bone in scene.bones]
        self.rest = np.array(muscle.mesh.vertices, dtype=float)
        self.faces = np.array(muscle.mesh.faces)
        self.attached_bone = np.full(len(self.rest), -1)
        self._surface = None
        for attachment in muscle.attachments:
            self.attached_bone[attachment.vertices] = self.names.index(attachment.bone)
        self.sweeps = sweeps
        self.reach = reach or 0.1 * np.ptp(self.rest, axis=0).max()
        self.x, self.target = self.rest.copy(), self.rest.copy()
        self.solves = 0
        self._prepare()

    def _prepare(self):
        n = len(self.rest)
        laplacian = np.zeros((n, n))
        for a, b in np.vstack(
            [self.faces[:, [0, 1]], self.faces[:, [1, 2]], self.faces[:, [2, 0]]]
        ):
            laplacian[a, b] = laplacian[b, a] = -1
        laplacian -= np.diag(laplacian.sum(axis=1))
        free, held = np.flatnonzero(self.attached_bone < 0), np.flatnonzero(self.attached_bone >= 0)
        inner = laplacian[np.ix_(free, free)]
        self.weights = np.eye(len(self.names))[self.attached_bone]
        self.weights[free] = -np.linalg.solve(
            inner, laplacian[np.ix_(free, held)] @ self.weights[held]
        )
        self.inverse = np.zeros((n, n))
        self.inverse[np.ix_(free, free)] = np.linalg.inv(inner + 0.05 * np.eye(len(free)))

    def _blend(self, poses):
        moved = np.stack(
            [self.rest @ poses[n][:3, :3].T + poses[n][:3, 3] for n in self.names], axis=1
        )
        return np.einsum("nb,nbk->nk", self.weights, moved)

    def contact_points(self):
        return self.x

    def predict(self, before, after):
        target = self._blend(after)
        self.x = self.x + target - self._blend(before)
        self.target = target

    def begin(self, contacts):
        self.solves += 1
        if self._surface is not None:
            self._surface.move(self.x)

        def sweep(number):
            near = contacts.half_spaces(self.x, self.reach)
            self.x[:] = press(self.target, self.x, self.inverse, near.point, near.gap, near.normal)

        free = np.where(self.attached_bone < 0, 1.0, 0.0)
        return MeshSettling(self.x, free, 60.0, sweep, most=self.sweeps, surface=self._surface)

    def take(self, moving):
        pass

    def body(self):
        self._surface = MovingSurface(self.rest, self.faces, 6.0)
        free = np.flatnonzero(self.attached_bone < 0)
        return Body(free, free, np.ones(len(free)))

    def transform(self, motion):
        self.x, self.target = (
            points @ motion[:3, :3].T + motion[:3, 3] for points in (self.x, self.target)
        )

    def snapshot(self):
        return self.x.copy(), self.target.copy()

    def restore(self, state):
        self.x, self.target = state[0].copy(), state[1].copy()

    def material_mesh(self):
        return self.x.copy(), self.faces

    def surface(self, contacts):
        return ModelSurface(self.x.copy(), self.faces, {"solver_penetration_max": 0.0})


def ellipsoid(half, centre=(0, 0, 0), *, subdivisions=2):
    mesh = trimesh.creation.icosphere(subdivisions=subdivisions)
    return trimesh.Trimesh(
        mesh.vertices * np.asarray(half) + np.asarray(centre), mesh.faces, process=False
    )


def attach(mesh, bone, where):
    return Attachment(bone, np.flatnonzero(where(mesh.vertices)))


def held(**bones):
    """Attachments as a scene takes them: a mask of a mesh's vertices for each bone."""
    return [
        {"bone": name, "vertices": np.flatnonzero(where).tolist()} for name, where in bones.items()
    ]


def bone(name, field):
    """A bone whose mesh is the box of its field (only its bounds and the name are used)."""
    low, high = field.bounds
    mesh = trimesh.creation.box(extents=high - low)
    mesh.apply_translation(0.5 * (low + high))
    return Bone(name, mesh)


def joint(name, parent, child, centre, **axes):
    axes = {key: list(map(float, axis)) for key, axis in axes.items()}
    row = {
        "name": name,
        "parent": parent,
        "child": child,
        "centre": list(map(float, centre)),
        "axes": axes,
    }
    return JointTable.build(row, context="toy ").joint()


def muscle(name, mesh, attachments, **options):
    return Muscle(name, mesh, options=options, attachments=attachments)


def scene(fields, joints, muscles, frames, *, initial="keep", neighbours=None, tunnelling=None):
    """A scene of these parts, its bones from their fields by name."""
    bones = [bone(name, field) for name, field in fields.items()]
    parts = {"bones": bones, "joints": joints, "muscles": muscles}
    detect = DetectOptions(tunnelling=tunnelling or TunnellingOptions(action="off"))
    contact = ContactOptions(initial=initial)
    return Scene(
        "toy", **parts, motion=Motion(frames), contact=contact, neighbours=neighbours, detect=detect
    )


def hinged_scene(angles, **options):
    """An arm that turns about z at the origin, with a long muscle over a round bone: (scene,
    fields).
    """
    fields = {"trunk": sphere(8.0, (0, 0, 0)), "arm": box((15, 2, 2), (30, 0, 0))}
    mesh = ellipsoid((32, 4, 4), (0, 14, 0))
    ends = [
        attach(mesh, "trunk", lambda v: v[:, 0] < -24),
        attach(mesh, "arm", lambda v: v[:, 0] > 24),
    ]
    frames = [{"hinge.bend": np.radians(a)} for a in angles]
    hinge = joint("hinge", "trunk", "arm", (0, 0, 0), bend=(0, 0, -1))
    return scene(fields, [hinge], [muscle("strap", mesh, ends)], frames, **options), fields


def box_mesh(low, high):
    """A box between two corners, its sides in 128 triangles each."""
    low, high = np.array(low, float), np.array(high, float)
    mesh = trimesh.creation.box(extents=high - low).subdivide().subdivide().subdivide()
    mesh.apply_translation(0.5 * (low + high))
    return mesh


def neighbour_scene(angles, gap=1.0, *, neighbours, order=(0, 1)):
    """Two long muscles side by side, "lower" and "upper", in a scene, and its fields.

    An arm presses an end of the upper, lifts it or rolls it, by a dict of angles in degrees for
    each frame.
    """
    fields = {"trunk": sphere(1.0, (0, 0, -60)), "arm": box((1, 1, 1), (60, 0, -40))}
    muscles = []
    for k, (name, far) in enumerate((("lower", "trunk"), ("upper", "arm"))):
        mesh = ellipsoid((30, 4, 4), (0, 0, (8 + gap) * k), subdivisions=3)
        ends = [
            attach(mesh, "trunk", lambda v: v[:, 0] < -25),
            attach(mesh, far, lambda v: v[:, 0] > 25),
        ]
        muscles.append(muscle(name, mesh, ends))
    hinge = joint(
        "hinge", "trunk", "arm", (-30, 0, 0), press=(0, 1, 0), lift=(0, -1, 0), roll=(1, 0, 0)
    )
    frames = [{f"hinge.{name}": np.radians(a) for name, a in angle.items()} for angle in angles]
    return scene(
        fields, [hinge], [muscles[k] for k in order], frames, neighbours=neighbours
    ), fields


def neighbour_parts(made):
    """Toy muscles of such a scene, by name."""
    return {one.name: ToyMuscle(one, made, sweeps=4, reach=2.0) for one in made.muscles}


def solve(model, contacts):
    """Bring a model to rest, as if it had no neighbours."""
    moving = model.begin(contacts)
    settle([moving])
    model.take(moving)
