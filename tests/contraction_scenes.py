"""Scenes of muscles along x that contract, whose answers are known, by closed forms or finite
elements [mm].
"""

import itertools
import math
from dataclasses import dataclass

import numpy as np
import trimesh
from peers.known_scenes import FAR, Bar, _block
from toy_scene import held

from rbfmuscle.geometry.mesh_distance import MeshDistance
from rbfmuscle.metrics.centreline import belly_measures
from rbfmuscle.scene.objects import Motion
from rbfmuscle.scene.phantom import stitch
from rbfmuscle.scene.scene import Scene

MUSCLE = "muscle"
# A flat pennate muscle between two plates: their length and width, the fibres' length and their
# angle [degree] at rest.
PLATES = (120.0, 40.0)
FIBRE = 60.0
PENNATION = 25.0
# How far the plates are apart, which does not change, nor does the volume, and how far fibres lean.
HEIGHT, LEAN = FIBRE * math.sin(math.radians(PENNATION)), FIBRE * math.cos(math.radians(PENNATION))


@dataclass(frozen=True)
class Spindle:
    """A belly between two tendons, round, with flat ends and a dome of the tendon's radius beyond
    each, of radius

    r(x) = tendon + (belly - tendon) cos²(π x / belly_length)    for |x| < belly_length / 2, else
    tendon.
    """

    length: float = 320.0
    belly_length: float = 120.0
    belly: float = 15.0
    tendon: float = 9.0

    def radius(self, x):
        turn = np.pi * np.clip(x / self.belly_length, -0.5, 0.5)
        return self.tendon + (self.belly - self.tendon) * np.cos(turn) ** 2

    def mesh(self, spacing):
        """Closed outward triangles of about equal sides: vertices (n, 3) and faces (m, 3)."""
        half, tip = 0.5 * self.length, self.tendon
        rows = 2 * round(self.length / (np.sqrt(3) * spacing))
        middle = np.linspace(-half, half, rows + 1)
        deep = max(4, round(0.5 * np.pi * tip / spacing))
        turn = 0.5 * np.pi * np.arange(1, deep) / deep
        beyond, size = half + tip * np.sin(turn), tip * np.cos(turn)
        x = np.concatenate([[-half - tip], -beyond[::-1], middle, beyond, [half + tip]])
        radius = np.concatenate([[0.0], size[::-1], self.radius(middle), size, [0.0]])
        rings = []
        for k, (place, r) in enumerate(zip(x, radius)):
            count = 1 if r == 0.0 else max(6, round(2 * np.pi * r / spacing))
            angle = 2 * np.pi * (np.arange(count) + 0.5 * (k % 2)) / count
            rings.append(
                np.column_stack([np.full(count, place), r * np.cos(angle), r * np.sin(angle)])
            )
        vertices = np.concatenate(rings)
        numbers = np.split(np.arange(len(vertices)), np.cumsum([len(ring) for ring in rings])[:-1])
        return vertices, np.concatenate(
            [stitch(vertices, *pair) for pair in itertools.pairwise(numbers)]
        )

    def fibres(self):
        """Lines at constant shares of the radius, in the middle, at a half and at nine tenths of
        it.
        """
        x = np.linspace(-0.5, 0.5, 60) * self.length
        radius = self.radius(x)
        lines = [np.column_stack([x, 0 * x, 0 * x])]
        for share, number in ((0.5, 6), (0.9, 12)):
            for angle in 2 * np.pi * np.arange(number) / number:
                side = share * radius[:, None] * [math.cos(angle), math.sin(angle)]
                lines.append(np.column_stack([x, side]))
        return lines


SPINDLE = Spindle()


def spindle_scene(*, spacing=3.0, frames=10, model="rbf", **contraction):
    """The spindle between two bones that stand still, and keys of its contraction; activation rises
    from 0 to 1.
    """
    scene = Scene("spindle", units="mm")
    ends = Bar(
        length=SPINDLE.length, width=SPINDLE.tendon, thickness=SPINDLE.tendon, dome=SPINDLE.tendon
    )
    _add_slider(scene, ends)
    vertices, faces = SPINDLE.mesh(spacing)
    contraction.setdefault("activation", [0.0, 1.0])
    _add(scene, vertices, faces, 0.5 * SPINDLE.length - 1e-6, SPINDLE.fibres(), model, contraction)
    scene.set_motion(waypoints=[{"slider.pull": 0.0}, {"slider.pull": 0.0}], step=1.0)
    return with_frames(scene, [0.0] * (frames + 1), SPINDLE.length)


def bar_scene(*, bar, spacing, model, **contraction):
    """A bar on a slider: `with_frames` moves it."""
    scene = Scene("free_bar", units="mm")
    _add_slider(scene, bar)
    vertices, faces = bar.mesh(spacing)
    # Only the domes are held, so that little of the bar keeps its girth.
    _add(
        scene, vertices, faces, 0.5 * bar.length + 0.5 * bar.dome, bar.fibres(), model, contraction
    )
    return scene


def with_frames(scene, pulls, length):
    """The scene with one frame for each pull of the slider [mm, positive shortens]."""
    far = FAR * length
    moved = scene.with_options()
    moved.motion = Motion([{"slider.pull": math.asin(pull / far)} for pull in pulls])
    return moved.with_options({"contact.substep_angle": math.degrees(length / 50 / far)})


def _add_slider(scene, bar):
    """Two bones; the insertion turns about a far joint, so that it moves along x."""
    scene.add_bone("origin", _block(bar, -1.0)).add_bone("insertion", _block(bar, 1.0))
    far = FAR * bar.length
    scene.add_joint(
        "slider", "origin", "insertion", (0.5 * bar.length, 0.0, far), {"pull": (0, 1, 0)}
    )


def _add(scene, vertices, faces, edge, fibres, model, contraction):
    x = vertices[:, 0]
    attach = held(origin=x <= -edge, insertion=x >= edge)
    scene.add_muscle(
        MUSCLE, (vertices, faces), attach=attach, model=model, fibres=fibres, **contraction
    )


def panel_pennation(stretch):
    """Pennation [degree] at a stretch of the fibres: height / (fibre stretch) is its sine (constant
    thickness).
    """
    return math.degrees(math.asin(HEIGHT / (FIBRE * stretch)))


def panel_scene(stretch, *, frames=5, model="rbf"):
    """The panel with its upper plate slid so far that straight fibres have the stretch, fully
    active at the end.
    """
    length, width = PLATES
    box = trimesh.creation.box((length, width, HEIGHT))
    for _ in range(4):
        box = box.subdivide()
    vertices, faces = box.vertices + [0.0, 0.0, 0.5 * HEIGHT], box.faces
    vertices[:, 0] += LEAN * (vertices[:, 2] / HEIGHT)
    scene = Scene("panel", units="mm")
    for name, low in (("lower", -6.0), ("upper", HEIGHT + 2.0)):
        plate = trimesh.creation.box(extents=(0.5 * length, width, 4.0))
        plate.apply_translation((0.0 if low < 0 else LEAN, 0.0, low + 2.0))
        scene.add_bone(name, plate)
    scene.add_joint(
        "slider", "lower", "upper", (LEAN, 0.0, HEIGHT + FAR * length), {"pull": (0, 1, 0)}
    )
    attach = held(lower=vertices[:, 2] <= 1e-9, upper=vertices[:, 2] >= HEIGHT - 1e-9)
    share = np.linspace(0.02, 0.98, 12)[:, None]
    places = itertools.product((-0.3, 0.0, 0.3), (-0.25, 0.25))
    fibres = [
        np.array([x * length, y * width, 0.0]) + share * [LEAN, 0.0, HEIGHT] for x, y in places
    ]
    scene.add_muscle(
        MUSCLE, (vertices, faces), attach=attach, model=model, fibres=fibres, activation=[0, 1]
    )
    shortened = math.sqrt((FIBRE * stretch) ** 2 - HEIGHT**2)
    return with_frames(scene, np.linspace(0.0, LEAN - shortened, frames + 1), length)


# Ends of the spindle's line of action.
ENDS = np.array([[-0.5, 0.0, 0.0], [0.5, 0.0, 0.0]]) * SPINDLE.length


def settings(model):
    """Slender muscles want finer cells and more centres than the defaults of the RBF model."""
    return {"name": "rbf", "centres": 400, "resolution": 140} if model == "rbf" else model


def compare_spindle(vertices, faces, activation, kept):
    """Errors of a spindle's surface against finite elements: RMS [mm], greatest section (relative),
    and its place.
    """
    row = int(np.argmin(np.abs(kept["activations"] - activation)))
    wanted = kept["vertices"][row].astype(float)
    between = np.abs(wanted[:, 0]) < 0.5 * SPINDLE.length - 5.0
    away = MeshDistance(vertices, faces).unsigned(wanted[between])
    mine = belly_measures(vertices, np.asarray(faces), *ENDS)
    theirs = belly_measures(wanted, kept["faces"], *ENDS)
    return {
        "rms": float(np.sqrt(np.mean(away**2))),
        "csa": mine["csa_max"] / theirs["csa_max"] - 1.0,
        "place": mine["csa_place"] - theirs["csa_place"],
    }


def belly_length(rest, now):
    """Length between the sections that lay at the ends of the belly at rest, of points that move
    with the muscle.
    """
    half = 0.5 * SPINDLE.belly_length
    moved = now[:, 0] - rest[:, 0]
    ends = []
    for side in (-half, half):
        near = np.abs(rest[:, 0] - side) < 6.0
        # A line through the points about the section, as they do not lie evenly on both sides of
        # it.
        ends.append(side + np.polyval(np.polyfit(rest[near, 0] - side, moved[near], 1), 0.0))
    return ends[1] - ends[0]
