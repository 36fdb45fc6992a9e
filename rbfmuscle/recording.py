"""One run of a scene: its models through the frame loop, measured and clocked, a generator of frames for a sink."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext, suppress
from datetime import UTC, datetime

from rbfmuscle.compiled.warm import compile_ahead
from rbfmuscle.compiled.watch import compiled_so_far, tell_stage
from rbfmuscle.models import build_models
from rbfmuscle.sim.loop.frame import Event, Frame
from rbfmuscle.sim.loop.simulate import simulate_frames
from rbfmuscle.sim.scene.check import bone_collisions, bone_findings, check_initial
from rbfmuscle.sim.scene.scene import Scene
from rbfmuscle.study.files.runinfo import Clock, Stages, build_info, frame_facts
from rbfmuscle.study.files.sinks import Sink
from rbfmuscle.study.measure.metrics import MetricsRecorder
from rbfmuscle.study.measure.quantities import Row
from rbfmuscle.study.measure.summary import LIMITS, Summary, default_limit
from rbfmuscle.validation import RBFMuscleError, SceneWarning, SolveError


class Recording:
    """One run of a scene: its models through the frame loop, measured and clocked, into a sink.

    Parameters
    ----------
    scene : Scene
        As it shall be run.
    options : dict, optional
        What the caller asked for, for ``run.json``.
    resumable : bool
        Give the sink what `go_on` needs, frame by frame.
    """

    def __init__(self, scene: Scene, *, options: dict | None = None, resumable: bool = False) -> None:
        self.started, self._start = datetime.now(UTC), time.perf_counter()
        self.scene = scene.validate()
        self.options = options or {}
        self._compiled = compiled_so_far()
        self.times: dict[str, float] = {}
        self.status, self.message = "running", ""
        self.summary, self.stages = Summary(), Stages()
        self.written: list[dict] = []
        self.resumable, self._behind = resumable, None
        with self.timed("compile"):
            compile_ahead({muscle.model for muscle in scene.muscles})
        with self.timed("build"), tell_stage("building"):
            check_initial(self.scene)
            self.models = build_models(scene)
            carried = {m.name: m.carried_mesh() for m in self.models}
            self.recorder = MetricsRecorder(scene, carried) if scene.output.metrics else None
            self.fibres = _fibre_study(scene, carried) if scene.output.fibres else None
            self._driven = _bones_driven_together(scene)

    @contextmanager
    def timed(self, part: str) -> Iterator[None]:
        """Add the time spent inside to one entry of ``times`` [s]."""
        start = time.perf_counter()
        try:
            yield
        finally:
            self.times[part] = self.times.get(part, 0.0) + time.perf_counter() - start

    def go_on(self, state: dict, rows: list[Row]) -> None:
        """Go on behind a frame: what a sink was given to keep with it, and the rows that were complete by then."""
        self._behind, self.written = state["loop"], list(state["written"])
        self._start -= state["times"].pop("wall", 0.0)
        for part, seconds in state["times"].items():
            self.times[part] = self.times.get(part, 0.0) + seconds
        self.stages.go_on(state["stages"])
        self.summary.add(rows)
        if self.recorder is not None:
            self.recorder.go_on(state["recorder"])

    def _state(self, frame):
        """What `go_on` needs behind a frame."""
        return {
            "loop": frame.state,
            "written": self.written,
            "times": {**self.times, "wall": time.perf_counter() - self._start},
            "stages": self.stages.state(),
            "recorder": None if self.recorder is None else self.recorder.state(),
        }

    def feed(
        self,
        sink: Sink,
        *,
        progress: Callable[[int, int], None] | None = None,
        watch: Callable[[list, Frame | None], None] | None = None,
    ) -> None:
        """Run the whole motion into a sink, which is closed whatever ends it."""
        self.status, self.message = "interrupted", "interrupted"
        try:
            sink.write_info(self.info("running"))
            if watch is not None:
                watch(self.models, None)
            for frame, rows in self.frames():
                if watch is not None:
                    watch(self.models, frame)
                with self.timed("write"):
                    sink.write(frame, rows)
                    self.written.append(frame_facts(self.scene, frame))
                    if self.resumable:
                        sink.keep(self._state(frame))
                if progress is not None:
                    progress(len(self.written), len(self.scene.motion))
            self.status, self.message = "complete", ""
        except RBFMuscleError as error:
            self.status, self.message = "failed", str(error)
            raise
        finally:
            rows = self.recorder.finish() if self.recorder is not None else []
            self.summary.add(rows)
            # What ended the run says more than a disk that then refuses the rest.
            with suppress(*((SolveError,) if self.status == "failed" else ())):
                sink.close(rows)
                sink.write_info(self.info())

    def frames(self) -> Iterator[tuple[Frame, list[Row]]]:
        """The frames as they are solved, each with the rows of metrics that became complete with it."""
        wanted = bool(self.scene.output.surfaces) or self.recorder is not None
        frames = simulate_frames(
            self.scene, self.models, surfaces=wanted, resumable=self.resumable, start=self._behind
        )
        while True:
            with (
                self.timed("simulate"),
                nullcontext() if self.written else tell_stage("solving the first frame"),
            ):
                frame = next(frames, None)
            if frame is None:
                return
            frame.events.extend(self._driven.get(frame.index, []))
            self.stages.add(frame)
            if self.fibres is not None:
                with self.timed("fibres"):
                    frame.fibres = self.fibres.at(frame)
            rows = []
            if self.recorder is not None:
                with self.timed("metrics"):
                    rows = self.recorder.add(frame)
                    self.summary.add(rows)
            yield frame, rows

    def info(self, status: str | None = None) -> dict:
        """What ``run.json`` holds by now."""
        self.times["wall"] = time.perf_counter() - self._start
        found = compiled_so_far()
        compiled = {name: found[name] - self._compiled[name] for name in found}
        return build_info(
            self.scene,
            ending=(status or self.status, self.message),
            clock=Clock(self.started, dict(self.times), self.stages, compiled),
            frames=self.written,
            summary=self.summary.table(),
            limits={name: default_limit(name, self.scene) for name in LIMITS},
            options=self.options,
        )


def _bones_driven_together(scene):
    """Events by frame, for some frames of the motion, and a warning for each pair of bones."""
    collisions = bone_collisions(scene)
    for finding in bone_findings(collisions, scene.units):
        warnings.warn(f"{finding.place}: {finding.message}", SceneWarning, stacklevel=4)
    for note in scene.motion.notes:
        warnings.warn(f"motion: {note}", SceneWarning, stacklevel=4)
    events = {}
    for frame, first, second, _ in collisions:
        events.setdefault(frame, []).append(Event(frame, "", f"{first} and {second}", 1, "bones_overlap"))
    return events


def _fibre_study(scene, carried):
    from rbfmuscle.study.measure.fibre_study import FibreStudy

    return FibreStudy(scene, carried)
