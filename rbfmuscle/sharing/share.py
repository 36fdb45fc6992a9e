"""Muscles of a scene that one process builds, solves and measures."""

import time
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from typing import NamedTuple

from rbfmuscle.geometry.fields import BoneField
from rbfmuscle.metrics.metrics import MuscleMeasures, Values
from rbfmuscle.models import build_models
from rbfmuscle.progress import stage
from rbfmuscle.scene.scene import Scene
from rbfmuscle.simulation.frame import Frame
from rbfmuscle.simulation.frame_loop import FrameLoop


class Solved(NamedTuple):
    """A frame of some muscles, or of all, and its values by muscle and quantity, none where metrics
    are off.
    """

    frame: Frame
    measured: dict[str, Values]


class MuscleGroup:
    """The models of some muscles of a scene, by ``names``, or of all; SceneError or MeshError if
    one cannot be built.

    The scene is whole: what does not belong to a muscle is the same in every share. ``fields`` of
    the bones by name replace `BoneSDF`; ``times`` are wall times spent so far [s], by ``simulate``
    and ``metrics``.
    """

    def __init__(
        self,
        scene: Scene,
        names: Collection[str] | None = None,
        *,
        fields: Mapping[str, BoneField] | None = None,
    ) -> None:
        self.scene, self._fields = scene, fields
        self.times: dict[str, float] = {}
        self.models = build_models(scene, names)
        carried = {model.name: model.material_mesh() for model in self.models}
        self._measures = MuscleMeasures(scene, carried)

    def frames(self) -> Iterator[Solved]:
        """The frames as they are solved and measured; SolveError names muscle, frame and
        coordinates.
        """
        with stage("solving the first frame"):
            with timed(self.times, "simulate"):
                loop = FrameLoop(self.scene, self.models, fields=self._fields)
                surfaces, poses = loop.at_rest()
            with timed(self.times, "metrics"):
                self._measures.measure_rest(surfaces, poses)
        for coordinates in self.scene.motion.frames:
            with timed(self.times, "simulate"):
                frame = loop.advance(coordinates)
            with timed(self.times, "metrics"):
                measured = self._measures.measure(frame)
            yield Solved(frame, measured)

    def close(self) -> None:
        """Nothing is held."""


@contextmanager
def timed(times: dict[str, float], part: str) -> Iterator[None]:
    """Add the time spent inside to one entry of ``times`` [s]."""
    start = time.perf_counter()
    try:
        yield
    finally:
        times[part] = times.get(part, 0.0) + time.perf_counter() - start
