"""What a scene says of its muscles and joints, shown in the browser: attachments, axes, names."""

from collections.abc import Collection, Mapping
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from rbfmuscle.geometry.arrays import Floats
from rbfmuscle.geometry.vectors import to_world, unit
from rbfmuscle.scene.check import stated_doubts
from rbfmuscle.scene.objects import from_mm
from rbfmuscle.scene.scene import Scene, doubtful
from rbfmuscle.simulation.frame import Mesh

if TYPE_CHECKING:
    from viser import LabelHandle, LineSegmentsHandle, PointCloudHandle, ViserServer

KINDS = ("Attachments", "Joint axes", "Names")
AXIS_COLOUR = (0.86, 0.20, 0.18)  # red, green, blue
HELD_COLOUR = (0.05, 0.35, 0.75)  # of vertices that bones hold
REACH = 25.0  # of a joint's axis to either side of its centre [mm]
POINT = 0.0012  # size of a vertex that a bone holds [m]


class Axes(NamedTuple):
    """Lines (k, 2, 3) along the axes of a joint at rest, which move with its parent."""

    parent: str
    lines: Floats


class Held(NamedTuple):
    """Vertices (n, 3) of a muscle at rest that move with a bone."""

    muscle: str
    bone: str
    points: Floats


class Marks(NamedTuple):
    """What can be marked: axes of joints by name, held vertices, and sentences on what is
    doubtful.
    """

    axes: dict[str, Axes]
    held: list[Held]
    doubts: list[str]


def scene_marks(scene: Scene) -> Marks:
    """The marks of a scene; attachments that tendons hold are left out."""
    axes, reach = {}, from_mm(REACH, scene.units)
    for joint in scene.joints:
        moving = [a for a in (*joint.rotations, *joint.translations) if a.coordinates]
        along = np.array([axis.direction for axis in moving]).reshape(-1, 3)
        along = reach * unit(along)
        if len(along):
            ends = np.stack([joint.centre - along, joint.centre + along], axis=1)
            axes[joint.name] = Axes(joint.parent, ends)
    held = [
        Held(muscle.name, end.bone, np.asarray(muscle.mesh.vertices)[end.vertices])
        for muscle in scene.muscles
        for end in muscle.attachments
        if end.tendon is None
    ]
    guesses = [
        f"{guess.table} {guess.name}: {guess.text}"
        for table in ("joint", "muscle")
        for guess in doubtful(scene.guesses, table)
    ]
    stated = [f"{name}: {text}" if name else text for name, text in stated_doubts(scene)]
    return Marks(axes, held, [*stated, *guesses])


class MarkView:
    """Marks under a node of a viser server, in metres; ``factor`` is from the scene's unit."""

    def __init__(self, server: "ViserServer", root: str, marks: Marks, factor: float) -> None:
        self._server = server
        self._root = root
        self._marks = marks
        self._factor = factor
        self._nodes: dict[str, LabelHandle | LineSegmentsHandle | PointCloudHandle] = {}

    def draw(
        self,
        shown: Collection[str],
        hidden: Collection[str],
        poses: Mapping[str, Floats],
        surfaces: Mapping[str, Mesh],
    ) -> None:
        """Show the marks of some `KINDS`, but for hidden muscles, with bones in these poses."""
        for node in self._nodes.values():
            node.visible = False
        if "Joint axes" in shown:
            for name, axes in self._marks.axes.items():
                if axes.parent in poses:
                    self._add_axes(name, to_world(axes.lines, poses[axes.parent]))
        if "Attachments" in shown:
            for number, held in enumerate(self._marks.held):
                if held.muscle not in hidden:
                    self._add_points(number, to_world(held.points, poses[held.bone]))
        if "Names" in shown:
            for name, (vertices, _) in surfaces.items():
                if name not in hidden:
                    self._add_name(name, vertices.mean(axis=0))

    def _add_axes(self, name: str, lines: Floats) -> None:
        place, points = f"{self._root}/axes/{name}", lines * self._factor
        if place not in self._nodes:
            colours = np.broadcast_to(np.array(AXIS_COLOUR), lines.shape)
            self._nodes[place] = self._server.scene.add_line_segments(
                place, points, colours, thickness=3.0, thickness_units="screen"
            )
        self._nodes[place].points = points
        self._nodes[place].visible = True
        self._add_name(name, lines[0].mean(axis=0))

    def _add_points(self, number: int, points: Floats) -> None:
        place, points = f"{self._root}/held/{number}", points * self._factor
        if place not in self._nodes:
            self._nodes[place] = self._server.scene.add_point_cloud(
                place, points, HELD_COLOUR, point_size=POINT
            )
        self._nodes[place].points = points
        self._nodes[place].visible = True

    def _add_name(self, name: str, middle: Floats) -> None:
        place = f"{self._root}/names/{name}"
        if place not in self._nodes:
            self._nodes[place] = self._server.scene.add_label(place, name)
        self._nodes[place].position = middle * self._factor
        self._nodes[place].visible = True
