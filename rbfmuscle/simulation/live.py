"""A scene whose coordinates are set interactively."""

from __future__ import annotations

import copy
import math
from typing import TYPE_CHECKING, Any

import numpy as np

from rbfmuscle.geometry.arrays import Floats
from rbfmuscle.scene.activation.curve import STEP
from rbfmuscle.scene.joints.skeleton import all_coordinates
from rbfmuscle.scene.objects import Motion
from rbfmuscle.simulation.frame_loop import FrameLoop
from rbfmuscle.simulation.plan.contact_pairs import build_fields, find_contact_pairs
from rbfmuscle.validation import UsageError

if TYPE_CHECKING:
    from rbfmuscle.scene.scene import Scene
    from rbfmuscle.simulation.frame import Frame


# Range of a coordinate around rest where the scene's motion does not exceed it [degree, mm].
FREE_RANGE = 30.0


class LiveSession:
    """Models that follow coordinates set interactively.

    Parameters
    ----------
    scene : Scene
    fields : dict of str to BoneSDF, optional
        Distance fields of the bones, as `live_fields` builds them.

    Attributes
    ----------
    limits : dict of str to (float, float)
        Range of each coordinate [radian].
    here : dict of str to float
        Present coordinates [radian].
    target : dict of str to float
        Target coordinates [radian].
    activation : dict of str to float
        Target activation of the muscles that contract, 0 to 1.
    """

    def __init__(self, scene: Scene, *, fields: dict[str, Any] | None = None) -> None:
        self.scene = scene
        self.limits = coordinate_limits(scene)
        self.fields = live_fields(scene) if fields is None else fields
        self.rest = _rest(scene, self.limits)
        self.here, self.target = dict(self.rest), dict(self.rest)
        self.activation = {m.name: 0.0 for m in scene.muscles if m.contraction is not None}
        self.models, self._rest = [], []
        self._loop: Any = None

    def use(
        self, models: list[Any], rest: list[tuple[Floats, Floats]] | None = None
    ) -> list[tuple[Floats, Floats]]:
        """Start these models from the rest pose; the target stays.

        Parameters
        ----------
        models : list of MuscleModel
        rest : list, optional
            Their snapshots at rest; taken now where not given, so the models must be new.

        Returns
        -------
        list
            Snapshots at rest.
        """
        self.models = list(models)
        self._rest = [model.snapshot() for model in self.models] if rest is None else list(rest)
        self.reset()
        return self._rest

    def reset(self) -> None:
        """Return models and bones to rest; the target stays."""
        self.close()
        for model, state in zip(self.models, self._rest):
            model.restore(state)
            if model.name in self.activation:
                model.activate(0.0)
        self.here = dict(self.rest)

    def set(self, name: str, angle: float) -> None:
        """Give a coordinate a new target [radian], kept within its limits."""
        low, high = self.limits[name]
        self.target[name] = min(max(float(angle), low), high)

    def activate(self, muscle: Any, activation: Any) -> None:
        """Give a muscle that contracts a new activation, kept from 0 to 1."""
        if muscle not in self.activation:
            raise UsageError(f"muscle {muscle!r} does not contract: give it activation = 0 in the scene")
        self.activation[muscle] = min(max(float(activation), 0.0), 1.0)

    @property
    def arrived(self) -> bool:
        """Whether coordinates and activations have reached their targets."""
        active = self._loop.activations.here if self._loop else dict.fromkeys(self.activation, 0.0)
        return all(abs(self.target[name] - self.here[name]) < 1e-9 for name in self.target) and all(
            abs(value - active[name]) < 1e-9 for name, value in self.activation.items()
        )

    def advance(self, stride: float = math.inf, *, surfaces: bool = True) -> Frame:
        """Move towards the target and return the frame reached.

        Parameters
        ----------
        stride : float
            Greatest change of a coordinate [radian]. If finite, no activation changes by more than one sub-step's.
        surfaces : bool
            Whether the frame has surfaces in addition to the material.

        Returns
        -------
        Frame

        Raises
        ------
        SolveError
            If a muscle cannot be solved; `reset` goes back to rest.
        """
        farthest = max((abs(self.target[k] - self.here[k]) for k in self.target), default=0.0)
        share = 1.0 if farthest <= stride else stride / farthest
        step = {k: self.here[k] + share * (self.target[k] - self.here[k]) for k in self.target}
        if self._loop is None:
            self._loop = FrameLoop(_wide_scene(self.scene), self.models, fields=self.fields)
        self._loop.surfaces = surfaces
        active = self._loop.activations
        reach = 1.0 if stride == math.inf else STEP
        for name, wanted in self.activation.items():
            now = active.here[name]
            active.target[name] = now + min(max(wanted - now, -reach), reach)
        frame = self._loop.advance(dict(self.target) if share == 1.0 else step)
        self.here = dict(frame.coordinates)
        return frame

    def close(self) -> None:
        """End the loop and its threads."""
        if self._loop is not None:
            self._loop.close()
            self._loop = None


def coordinate_limits(scene: Scene) -> dict[str, tuple[float, float]]:
    """Range of each free coordinate: its own, or the motion's and 30 degrees (30 mm) both ways.

    Coordinates that are coupled or locked are left out.

    Parameters
    ----------
    scene : Scene

    Returns
    -------
    dict of str to (float, float)
        [radian]
    """
    followers = {coupling.coordinate for coupling in scene.couplings}
    limits = {}
    for name, facts in all_coordinates(scene.joints).items():
        if name in followers or facts.locked:
            continue
        free = scene.length(FREE_RANGE) if facts.motion == "translation" else math.radians(FREE_RANGE)
        values = [frame.get(name, facts.rest) for frame in scene.motion.frames]
        low, high = min([facts.rest - free, *values]), max([facts.rest + free, *values])
        if facts.range is not None and facts.range[0] < facts.range[1]:
            least, most = (min(facts.range[0], facts.rest), max(facts.range[1], facts.rest))
            low, high = max(low, least), min(high, most)
        limits[name] = (low, high)
    return limits


def _rest(scene, names):
    facts = all_coordinates(scene.joints)
    return {name: facts[name].rest for name in names}


def live_fields(scene: Scene) -> Any:
    """Distance fields of the bones in reach of a muscle within the coordinates' ranges.

    Parameters
    ----------
    scene : Scene

    Returns
    -------
    dict of str to BoneSDF
    """
    return build_fields(scene, find_contact_pairs(_wide_scene(scene)))


def _wide_scene(scene):
    """The scene with a motion that takes each coordinate to its limits."""
    limits = coordinate_limits(scene)
    rest, stops = _rest(scene, limits), [{}]
    for name, ends in limits.items():
        stops += [{name: value} for end in ends for value in np.linspace(rest[name], end, 4)[1:]]
    wide = copy.copy(scene)
    wide.motion = Motion([rest | stop for stop in stops])
    return wide
