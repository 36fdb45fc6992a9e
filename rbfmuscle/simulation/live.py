"""A scene whose coordinates are set interactively."""

import copy
import math
from collections.abc import Mapping

import numpy as np

from rbfmuscle.bones.sdf import BoneSDF
from rbfmuscle.scene.activation import STEP
from rbfmuscle.scene.joints import all_coordinates
from rbfmuscle.scene.motion import SHIFT_LEVER
from rbfmuscle.scene.objects import Motion, from_mm
from rbfmuscle.scene.scene import Scene
from rbfmuscle.simulation.contact_pairs import build_fields, find_contact_pairs
from rbfmuscle.simulation.frame import Frame, MuscleModel
from rbfmuscle.simulation.frame_loop import FrameLoop, LoopState
from rbfmuscle.validation import UsageError

# Range of a coordinate around rest where the scene's motion does not exceed it [degree, mm].
FREE_RANGE = 30.0


class LiveSession:
    """Models that follow coordinates set interactively.

    Coordinates at ``rest``, ``here`` and at their ``target`` are in radian, as are the ``limits``
    of each; ``activation`` holds the target, 0 to 1, of the muscles that contract. ``fields`` are
    as `live_fields` builds them.
    """

    def __init__(self, scene: Scene, *, bone_sdfs: Mapping[str, BoneSDF] | None = None) -> None:
        self.scene, self.limits = scene, coordinate_limits(scene)
        self.bone_sdfs = live_fields(scene) if bone_sdfs is None else bone_sdfs
        known = all_coordinates(scene.joints)
        self.rest = {name: known[name].rest for name in self.limits}
        self.here, self.target = dict(self.rest), dict(self.rest)
        self.activation = {m.name: 0.0 for m in scene.muscles if m.contraction is not None}
        #: A shift counts as the turn that moves a place at this lever as far.
        self._lever = {
            n: from_mm(SHIFT_LEVER, scene.units) if known[n].motion == "translation" else 1.0
            for n in self.rest
        }
        self._loop: FrameLoop
        self._start: LoopState

    def use(self, models: list[MuscleModel]) -> None:
        """Start these models, in their rest state, from the rest pose; the target stays.

        Raises as `FrameLoop` does.
        """
        self.models = models
        self._loop = FrameLoop(_wide_scene(self.scene), models, bone_sdfs=self.bone_sdfs)
        self._start = self._loop.snapshot()
        self.here = dict(self.rest)

    def reset(self) -> None:
        """Return models and bones to rest; the target stays."""
        self._loop.restore(self._start)
        self.here = dict(self.rest)

    def set(self, name: str, angle: float) -> None:
        """Give a coordinate a new target [radian], kept within its limits."""
        low, high = self.limits[name]
        self.target[name] = min(max(float(angle), low), high)

    def activate(self, muscle: str, activation: float) -> None:
        """Give a muscle that contracts a new activation, kept from 0 to 1."""
        if muscle not in self.activation:
            raise UsageError(
                f"muscle {muscle!r} does not contract: give it activation = 0 in the scene"
            )
        self.activation[muscle] = min(max(float(activation), 0.0), 1.0)

    @property
    def arrived(self) -> bool:
        """Whether coordinates and activations have reached their targets."""
        return self.within(1e-9, 1e-9)

    def within(self, stride: float, step: float) -> bool:
        """Whether no coordinate is farther than ``stride`` [radian] from its target, no activation
        than ``step``.
        """
        active = self._loop.activations.here
        near = self._farthest() <= stride
        return near and all(
            abs(value - active[name]) <= step for name, value in self.activation.items()
        )

    def advance(self, stride: float = math.inf, *, surfaces: bool = True) -> Frame:
        """Move towards the target and return the frame reached.

        No coordinate changes by more than ``stride`` [radian], and, if that is finite, no
        activation by more than a sub-step's. Raises SolveError if a muscle cannot be solved;
        `reset` goes back to rest.
        """
        self._loop.surfaces = surfaces
        active = self._loop.activations
        reach = 1.0 if stride == math.inf else STEP
        for name, wanted in self.activation.items():
            now = active.here[name]
            active.target[name] = now + min(max(wanted - now, -reach), reach)
        farthest = self._farthest()
        share = stride / farthest if farthest > stride else 1.0
        step = {k: self.here[k] + share * (self.target[k] - self.here[k]) for k in self.target}
        frame = self._loop.advance(dict(self.target) if share == 1.0 else step)
        self.here = dict(frame.coordinates)
        return frame

    def _farthest(self) -> float:
        """How far coordinates are from their targets, at most [radian]."""
        return max(
            (abs(self.target[k] - self.here[k]) / self._lever[k] for k in self.target), default=0.0
        )


def coordinate_limits(scene: Scene) -> dict[str, tuple[float, float]]:
    """Range [radian] of each free coordinate: its own with the rest value, or where it has none the
    motion's and 30 degrees (30 mm) both ways.

    Coordinates that are coupled or locked are left out.
    """
    followers = {coupling.coordinate for coupling in scene.couplings}
    limits = {}
    for name, coordinate in all_coordinates(scene.joints).items():
        if name in followers or coordinate.locked:
            continue
        free = (
            from_mm(FREE_RANGE, scene.units)
            if coordinate.motion == "translation"
            else math.radians(FREE_RANGE)
        )
        values = [frame.get(name, coordinate.rest) for frame in scene.motion.frames]
        low, high = min([coordinate.rest - free, *values]), max([coordinate.rest + free, *values])
        if coordinate.range is not None and coordinate.range[0] < coordinate.range[1]:
            low = min(coordinate.range[0], coordinate.rest)
            high = max(coordinate.range[1], coordinate.rest)
        limits[name] = (low, high)
    return limits


def live_fields(scene: Scene) -> Mapping[str, BoneSDF]:
    """Distance fields of the bones in reach of a muscle within the coordinates' ranges."""
    return build_fields(scene, find_contact_pairs(_wide_scene(scene)))


def _wide_scene(scene: Scene) -> Scene:
    """The scene with a motion that takes each coordinate to its limits."""
    known, limits = all_coordinates(scene.joints), coordinate_limits(scene)
    rest, stops = {name: known[name].rest for name in limits}, [{}]
    for name, ends in limits.items():
        stops += [{name: value} for end in ends for value in np.linspace(rest[name], end, 4)[1:]]
    wide = copy.copy(scene)
    wide.motion = Motion([rest | stop for stop in stops])
    return wide
