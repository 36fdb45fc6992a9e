"""A scene driven by hand: the frame loop, asked for frames that are not known beforehand."""

import copy
import math

import numpy as np

from rbfmuscle.sim.loop.simulate import FrameLoop
from rbfmuscle.sim.plan.reach import build_fields, reached_bones
from rbfmuscle.sim.scene.motion import Motion, coordinate_names

# What a coordinate may be turned by where the scene's own motion does not go further [degree].
FREE_RANGE = 30.0


class LiveSession:
    """Models that follow coordinates set by hand, through the loop that a run goes through.

    Parameters
    ----------
    scene : Scene
    fields : dict of str to BoneSDF, optional
        Distance fields of the bones, as `live_fields` builds them.

    Attributes
    ----------
    limits : dict of str to (float, float)
        What each coordinate may be set to [radian].
    here : dict of str to float
        Where the bones are [radian].
    target : dict of str to float
        Where they shall be [radian].
    """

    def __init__(self, scene, *, fields=None):
        self.scene = scene
        self.limits = coordinate_limits(scene)
        self.fields = live_fields(scene) if fields is None else fields
        self.here = dict.fromkeys(self.limits, 0.0)
        self.target = dict(self.here)
        self.models, self._rest, self._loop = [], [], None

    def use(self, models, rest=None):
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

    def reset(self):
        """Put models and bones back to rest; the target stays."""
        self.close()
        for model, state in zip(self.models, self._rest):
            model.restore(state)
        self.here = dict.fromkeys(self.limits, 0.0)

    def set(self, name, angle):
        """Give a coordinate a new target [radian], kept within its limits."""
        low, high = self.limits[name]
        self.target[name] = min(max(float(angle), low), high)

    @property
    def arrived(self):
        """Whether the bones are where they shall be."""
        return all(abs(self.target[name] - self.here[name]) < 1e-9 for name in self.target)

    def advance(self, stride=math.inf):
        """Go towards the target and return the frame reached.

        Parameters
        ----------
        stride : float
            No coordinate changes by more [radian], so that the next picture does not wait for a long way.

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
        frame = self._loop.advance(dict(self.target) if share == 1.0 else step)
        self.here = dict(frame.coordinates)
        return frame

    def close(self):
        """End the loop and its threads."""
        if self._loop is not None:
            self._loop.close()
            self._loop = None


def coordinate_limits(scene):
    """What each coordinate may be set to by hand: the motion's own range and 30 degrees both ways.

    Parameters
    ----------
    scene : Scene

    Returns
    -------
    dict of str to (float, float)
        [radian]
    """
    free = math.radians(FREE_RANGE)
    limits = {}
    for name in coordinate_names(scene.joints):
        values = [frame.get(name, 0.0) for frame in scene.motion.frames]
        limits[name] = (min([-free, *values]), max([free, *values]))
    return limits


def live_fields(scene):
    """Distance fields of the bones that muscles reach anywhere within the coordinates' limits.

    Parameters
    ----------
    scene : Scene

    Returns
    -------
    dict of str to BoneSDF
    """
    return build_fields(scene, reached_bones(_wide_scene(scene)))


def _wide_scene(scene):
    """The scene with a motion that takes each coordinate to its limits: what muscles can meet by hand."""
    limits = coordinate_limits(scene)
    stops = [{}]
    for name, ends in limits.items():
        stops += [{name: angle} for low in ends for angle in np.linspace(0.0, low, 4)[1:]]
    wide = copy.copy(scene)
    wide.motion = Motion([dict.fromkeys(limits, 0.0) | stop for stop in stops])
    return wide
