"""Scenes whose answer is known: a bar pulled and bent, a strip wrapped around a cylinder and a
sphere.

All lengths are in millimetres; bars lie along x at rest. The closed forms stand with each scene.
"""

import math
from dataclasses import dataclass

import numpy as np

from rbfmuscle.scene.objects import Attachment
from rbfmuscle.scene.phantom import stitch
from rbfmuscle.scene.scene import Scene

# The centre of the joint that pulls lies this many bar lengths away: the path of the end is
# straight to half of its inverse (5e-5 of the pull) and turns by 1e-4 radian at most.
FAR = 1e4
STEPS_A_LENGTH = 50  # sub-steps in which an end is pulled by the bar's length
MUSCLE = "bar"
FIBRE_POINTS = 30


@dataclass(frozen=True)
class Bar:
    """A straight bar along x with a stadium for a section and rounded ends, of known volume.

    The section (two half circles joined by straight sides; a circle where width and thickness
    agree) is the same over ``length`` and shrinks beyond it as sqrt(1 - (d / dome)^2) with the
    distance d, so that

        V = A (length + 4/3 dome),    A = 4 (width - thickness) thickness + pi thickness^2.

    Parameters
    ----------
    length : float
        Of the part with constant section.
    width, thickness : float
        Half extents of the section along y and z.
    dome : float
        Length of each rounded end.
    """

    length: float
    width: float
    thickness: float
    dome: float

    @property
    def area(self):
        """Area of the section."""
        return 4 * (self.width - self.thickness) * self.thickness + np.pi * self.thickness**2

    @property
    def volume(self):
        """Volume in closed form."""
        return self.area * (self.length + 4 / 3 * self.dome)

    @property
    def girth(self):
        """Length of the section's outline."""
        return 4 * (self.width - self.thickness) + 2 * np.pi * self.thickness

    def ring(self, count, offset, scale=1.0):
        """Points (count, 2) of the outline at equal arcs, the first ``offset`` shares of an
        arc on."""
        side, half = 2 * (self.width - self.thickness), 0.5 * np.pi * self.thickness
        arc = ((np.arange(count) + offset) / count * self.girth) % self.girth
        # Quarter circle, upper side, half circle, lower side, quarter circle.
        ends = np.cumsum([half, side, 2 * half, side, half])
        places = [
            np.clip(arc - start, 0.0, end - start)
            for start, end in zip([0.0, *ends[:-1]], ends, strict=True)
        ]
        turned = (places[0] + places[2] + places[4]) / self.thickness
        along = 0.5 * side - places[1] + places[3]
        return scale * np.stack(
            [along + self.thickness * np.cos(turned), self.thickness * np.sin(turned)], 1
        )

    def mesh(self, spacing):
        """Closed outward triangles of about equal sides, vertices on the bar.

        Parameters
        ----------
        spacing : float
            Length of an edge.

        Returns
        -------
        vertices : (n, 3) ndarray
        faces : (m, 3) ndarray of int
        """
        count = 4 * max(2, round(self.girth / (4 * spacing)))
        rows = 2 * max(2, round(self.length / (np.sqrt(3) * spacing)))
        deep = max(3, round(0.5 * np.pi * max(self.dome, self.thickness) / spacing))
        turn = 0.5 * np.pi * np.arange(1, deep) / deep
        size, beyond = np.cos(turn), 0.5 * self.length + self.dome * np.sin(turn)
        middle = np.linspace(-0.5 * self.length, 0.5 * self.length, rows + 1)
        tip = 0.5 * self.length + self.dome
        x = np.concatenate([[-tip], -beyond[::-1], middle, beyond, [tip]])
        scale = np.concatenate([[0], size[::-1], np.ones(rows + 1), size, [0]])
        rings = []
        for k, (place, share) in enumerate(zip(x, scale)):
            number = 1 if share == 0 else 4 * max(1, round(share * count / 4))
            # Every other ring is turned by half an edge, for triangles without a handedness.
            section = self.ring(number, 0.5 * (k % 2), share)
            rings.append(np.column_stack([np.full(number, place), section]))
        starts = np.concatenate([[0], np.cumsum([len(ring) for ring in rings])])
        vertices = np.concatenate(rings)
        faces = [
            stitch(vertices, np.arange(a, b), np.arange(b, c))
            for a, b, c in zip(starts[:-2], starts[1:-1], starts[2:])
        ]
        return vertices, np.concatenate(faces)

    def fibres(self):
        """Straight fibres through the middle and halfway to the outline."""
        x = np.linspace(-0.5, 0.5, FIBRE_POINTS) * self.length
        places = [(0, 0), (0.5, 0), (-0.5, 0), (0, 0.5), (0, -0.5)]
        return [
            np.column_stack(
                [x, np.full(len(x), y * self.width), np.full(len(x), z * self.thickness)]
            )
            for y, z in places
        ]


ROUND_BAR = Bar(length=200.0, width=10.0, thickness=10.0, dome=10.0)
BENT_BAR = Bar(length=100.0, width=8.0, thickness=8.0, dome=8.0)
# A strip as long as the cylinder's would slide off the sphere, see `wrapped_strip`.
STRIPS = {
    "cylinder": Bar(length=160.0, width=6.0, thickness=1.5, dome=3.0),
    "sphere": Bar(length=100.0, width=6.0, thickness=1.5, dome=3.0),
}
DRUM_RADIUS = 25.0


def stretched_bar(stretch, *, bar=ROUND_BAR, spacing=2.0, frames=1, model="rbf"):
    """A bar held at both ends, one of which is pulled along the axis.

    At constant volume and even stretch its radius is r / sqrt(stretch). The held ends keep theirs,
    which moves the middle of a bar of 20 radii by less than 1 % at a stretch of 1.3.

    Parameters
    ----------
    stretch : float
        Length over rest length in the last frame; below 1 compresses.
    bar : Bar
    spacing : float
        Edge length of the muscle's mesh [mm].
    frames : int
        Frames after the one at rest, at even steps.
    model : str or dict

    Returns
    -------
    Scene
    """
    scene = Scene("stretched_bar", units="mm")
    _add_blocks(scene, bar)
    far = FAR * bar.length
    scene.add_joint(
        "far", "origin", "insertion", (0.5 * bar.length, 0.0, far), {"pull": (0, -1, 0)}
    )
    _add_bar(scene, bar, spacing, model, ("origin", "insertion"))
    angle = math.degrees(math.asin((stretch - 1.0) * bar.length / far))
    scene.set_motion(ramp={"far.pull": {"to": angle, "step": abs(angle) / frames}})
    step = math.degrees(bar.length / STEPS_A_LENGTH / far)
    return scene.with_options({"contact.substep_angle": step})


def bent_bar(angle, *, bar=BENT_BAR, spacing=2.0, step=2.0, model="rbf"):
    """A bar whose end is turned and moved so that its axis becomes an arc of its own length.

    The insertion turns about y around the pole of the whole motion, so the ends fit an arc of
    radius length / angle in the last frame (and nearly so before it). A bar under end moments alone
    takes that shape; its axis keeps its length and, by Pappus, its volume: area of the section
    times length.

    Parameters
    ----------
    angle : float
        Between the ends in the last frame [degree].
    bar, spacing, model
        As for `stretched_bar`.
    step : float
        Between frames [degree].

    Returns
    -------
    Scene
    """
    turn = math.radians(angle)
    radius, start = bar.length / turn, -0.5 * bar.length
    rotation = np.array(
        [[math.cos(turn), math.sin(turn)], [-math.sin(turn), math.cos(turn)]]
    )  # of (x, z)
    end = np.array([start + radius * math.sin(turn), -radius * (1.0 - math.cos(turn))])
    pole = np.linalg.solve(np.eye(2) - rotation, end - rotation @ [-start, 0.0])
    scene = Scene("bent_bar", units="mm")
    _add_blocks(scene, bar)
    scene.add_joint("pole", "origin", "insertion", (pole[0], 0.0, pole[1]), {"bend": (0, 1, 0)})
    _add_bar(scene, bar, spacing, model, ("origin", "insertion"))
    return scene.set_motion(ramp={"pole.bend": {"to": float(angle), "step": float(step)}})


def wrapped_strip(
    angle, *, over="cylinder", bar=None, radius=DRUM_RADIUS, spacing=2.0, step=2.0, model="rbf"
):
    """A strip over a cylinder or a sphere whose insertion turns about the middle of that bone.

    At rest the strip touches the bone at its top. After a turn by q it consists of two straight
    parts, each as long as before, and an arc over the angle q between them, so its path is longer
    by (radius + h) q, with h the distance of its centreline from the bone: half of its thickness,
    which shrinks with the stretch t as 1 / sqrt(t) (`wrapped_path`). This is the answer for a
    string; a strip that resists bending touches less.

    On a sphere the middle plane is the shortest way only where the straight line between the ends
    passes the sphere's centre on the strip's side, tan(q / 2) < (radius + thickness) / (length /
    2); beyond that the strip slides off sideways.

    Parameters
    ----------
    angle : float
        In the last frame [degree].
    over : {"cylinder", "sphere"}
    bar : Bar, optional
        ``width`` along the cylinder's axis; one of ``STRIPS`` where not given.
    radius : float
        Of the bone.
    spacing, step, model
        As for `bent_bar`.

    Returns
    -------
    Scene
    """
    import trimesh

    bar = bar or STRIPS[over]
    lift = radius + bar.thickness
    scene = Scene(f"strip_over_{over}", units="mm")
    # Vertices on the surface, sides of about 1 degree: the bone is nowhere more than 0.01 % too
    # thin.
    if over == "sphere":
        bone = trimesh.creation.icosphere(subdivisions=5, radius=radius)
    else:
        bone = trimesh.creation.cylinder(radius=radius, height=6 * bar.width, sections=360)
        bone.apply_transform(trimesh.transformations.rotation_matrix(0.5 * math.pi, (1, 0, 0)))
    scene.add_bone("drum", bone)
    scene.add_bone("lever", _block(bar, 1.0, lift))
    scene.add_joint("hinge", "drum", "lever", (0, 0, 0), {"turn": (0, 1, 0)})
    _add_bar(scene, bar, spacing, model, ("drum", "lever"), lift=lift)
    return scene.set_motion(ramp={"hinge.turn": {"to": float(angle), "step": float(step)}})


def wrapped_path(angle, *, bar, radius=DRUM_RADIUS):
    """Length added to the path by a turn by ``angle`` [radian], and the centreline's radius on the
    bone [mm].
    """
    stretch = 1.0
    for _ in range(
        20
    ):  # thickness follows stretch, stretch follows the path: contracts by 1e-2 a round
        lifted = radius + bar.thickness / math.sqrt(stretch)
        stretch = 1.0 + lifted * angle / bar.length
    return lifted * angle, lifted


def _block(bar, side, lift=0.0):
    """A small box beyond an end of the bar: a bone that holds it and touches nothing."""
    import trimesh

    size = bar.thickness
    box = trimesh.creation.box(extents=(size, size, size))
    box.apply_translation((side * (0.5 * bar.length + bar.dome + 1.5 * size), 0.0, lift))
    return box


def _add_blocks(scene, bar):
    scene.add_bone("origin", _block(bar, -1.0)).add_bone("insertion", _block(bar, 1.0))


def _add_bar(scene, bar, spacing, model, bones, *, lift=0.0):
    """The muscle: its rounded ends, with the first ring of the straight part, are held."""
    vertices, faces = bar.mesh(spacing)
    edge = 0.5 * bar.length - 1e-6
    attach = [
        Attachment(bones[0], np.flatnonzero(vertices[:, 0] <= -edge)),
        Attachment(bones[1], np.flatnonzero(vertices[:, 0] >= edge)),
    ]
    up = np.array([0.0, 0.0, lift])
    fibres = [line + up for line in bar.fibres()]
    scene.add_muscle(MUSCLE, (vertices + up, faces), attach=attach, model=model, fibres=fibres)
