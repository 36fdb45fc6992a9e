"""Running a scene: in memory with `simulate`, or straight to a folder with `stream_run`."""

import time
import warnings
from datetime import UTC, datetime

import numpy as np

from rbfmuscle.models import build_models
from rbfmuscle.sim.loop.frame import Event
from rbfmuscle.sim.loop.simulate import simulate_frames
from rbfmuscle.sim.scene.check import bone_collisions, bone_findings, check_initial
from rbfmuscle.study.files.runinfo import Stages, build_info
from rbfmuscle.study.files.writer import RunWriter
from rbfmuscle.study.measure.metrics import MetricsRecorder
from rbfmuscle.study.measure.summary import LIMITS, Summary, default_limit, parse_limits, require_limits
from rbfmuscle.validation import RBFMuscleError, SceneWarning, SolveError, UsageError


def simulate(scene, model=None, *, frames=None, progress=None, **settings):
    """Run a scene through its motion and keep every frame in memory.

    Parameters
    ----------
    scene : Scene
    model : str or dict, optional
        For every muscle; the scene's own choice where not given.
    frames : slice or str, optional
        Frames of the motion, a slice or "A:B:S".
    progress : callable, optional
        Called as ``progress(done, total)`` after each frame.
    **settings
        Dotted keys as for `Scene.with_options`: ``**{"model.centres": 200}``.

    Returns
    -------
    Run

    Raises
    ------
    SceneError, MeshError
        If the scene cannot be simulated.
    SolveError
        If a frame cannot be solved; its ``run`` attribute holds the frames so far.
    """
    course = _Course(scene.with_options(model=model, frames=frames, **settings), keep_rows=True)
    run = Run(course)
    try:
        for frame in course.frames():
            run.frames.append(frame)
            if progress is not None:
                progress(len(run.frames), len(course.scene.motion))
    except SolveError as error:
        error.run = run
        course.close("failed", str(error))
        raise
    course.close("complete")
    return run


def stream_run(
    scene,
    directory,
    *,
    model=None,
    frames=None,
    settings=None,
    fail_on=None,
    pictures=True,
    progress=None,
    watch=None,
):
    """Run a scene and write it to a folder frame by frame; memory does not grow with the frames.

    Parameters
    ----------
    scene : Scene
        Its ``output`` table says what is written.
    directory : path
    model, frames, progress
        As for `simulate`.
    settings : dict, optional
        Dotted keys with their values.
    fail_on : str, list of str or dict, optional
        Limits, see `rbfmuscle.study.measure.summary.parse_limits`.
    pictures : bool
        Draw pictures for the report and the preview.
    watch : callable, optional
        Called as ``watch(models, None)`` before the motion and ``watch(models, frame)`` with every frame.

    Returns
    -------
    dict
        What ``run.json`` holds.

    Raises
    ------
    SolveError
        If a frame cannot be solved or written; frames so far are kept.
    LimitExceededError
        If a limit of ``fail_on`` is exceeded; everything is written.
    MissingPartError
        If there are no graphics to draw with; everything else is written.
    """
    scene = scene.with_options(model=model, frames=frames, **(settings or {}))
    limits = parse_limits(fail_on, scene)
    course = _Course(scene, options={"model": model, "frames": str(frames or ""), "settings": settings or {}})
    writer = RunWriter(directory, scene)
    status, message = "interrupted", "interrupted"
    try:
        writer.write_info(course.info(writer.frames, "running"))
        driven = _bones_driven_together(course)
        if watch is not None:
            watch(course.models, None)
        for frame in course.frames():
            frame.events.extend(driven.get(frame.index, []))
            if watch is not None:
                watch(course.models, frame)
            with course.timed("write"):
                writer.write(frame, course.fresh)
            if progress is not None:
                progress(len(writer.frames), len(scene.motion))
        status, message = "complete", ""
    except RBFMuscleError as error:
        status, message = "failed", str(error)
        raise
    finally:
        course.close(status, message)
        writer.close(course.fresh)
        writer.write_info(course.info(writer.frames))
    return _finish(course, writer, limits, pictures)


def _bones_driven_together(course):
    """Events by frame, for some frames of the motion, and a warning for each pair of bones."""
    with course.timed("build"):
        collisions = bone_collisions(course.scene)
    for finding in bone_findings(collisions, course.scene.units):
        warnings.warn(f"{finding.place}: {finding.message}", SceneWarning, stacklevel=3)
    events = {}
    for frame, first, second, _ in collisions:
        events.setdefault(frame, []).append(Event(frame, "", f"{first} and {second}", 1, "bones_overlap"))
    return events


def _finish(course, writer, limits, pictures):
    """Report and pictures, then the limits: a missing part must not hide a broken limit."""
    output = course.scene.output
    missing = None
    with course.timed("report"):
        if output.report or output.preview:
            from rbfmuscle.study.show.report import write_report

            missing = write_report(
                writer.directory, report=output.report, preview=output.preview and pictures, pictures=pictures
            )
    info = course.info(writer.frames)
    writer.write_info(info)
    require_limits(course.summary.table(), limits)
    if missing is not None:
        raise missing
    return info


class Run:
    """A finished run in memory.

    Attributes
    ----------
    scene : Scene
        As it was run.
    frames : list of Frame
    metrics : list of Row
        frame, coordinate, angle [degree], muscle, quantity, value, unit.
    events : list of Event
    """

    def __init__(self, course):
        self._course = course
        self.scene = course.scene
        self.frames = []

    @property
    def metrics(self):
        return self._course.rows

    @property
    def events(self):
        return [event for frame in self.frames for event in frame.events]

    @property
    def summary(self):
        """Nested dict: muscle -> quantity -> min, max, mean, median, worst."""
        return self._course.summary.table()

    def __getitem__(self, muscle):
        """The `MuscleRun` of a muscle."""
        return MuscleRun(self, self.scene.muscle(muscle).name)

    def __iter__(self):
        """All muscles."""
        return (MuscleRun(self, muscle.name) for muscle in self.scene.muscles)

    def values(self, muscle, quantity):
        """Values of a quantity over the frames, (n,) ndarray."""
        found = [r.value for r in self.metrics if r.muscle == muscle and r.quantity == quantity]
        return np.array(found)

    def save(self, directory, *, pictures=True):
        """Write what `stream_run` would have written.

        Parameters
        ----------
        directory : path
        pictures : bool
            Draw pictures for the report and the preview.

        Raises
        ------
        UsageError
            If the folder cannot be written to.
        MissingPartError
            If there are no graphics to draw with; everything else is written.
        """
        writer = RunWriter(directory, self.scene)
        for frame in self.frames:
            writer.write(frame)
        writer.close(self.metrics)
        writer.write_info(self._course.info(writer.frames))
        _finish(self._course, writer, {}, pictures)

    def __repr__(self):
        return f"<Run of {self.scene.name!r}: {len(self.frames)} frames>"


class MuscleRun:
    """One muscle of a run."""

    def __init__(self, run, name):
        self.run = run
        self.name = name

    def surface(self, frame=-1):
        """Surface in a frame of the run.

        Parameters
        ----------
        frame : int
            Place in the run's frames; negative counts from the end.

        Returns
        -------
        trimesh.Trimesh
            Closed, faces outward, world coordinates [scene unit].
        """
        import trimesh

        surface = self._frame(frame).surfaces[self.name]
        return trimesh.Trimesh(surface.vertices, surface.faces, process=False)

    def fibres(self, frame=-1):
        """Fibres in a frame of the run, `FibreLines`: points, lengths and lengths at rest.

        Raises
        ------
        UsageError
            If the frame is out of range, or the scene did not ask for fibres.
        """
        found = self._frame(frame).fibres
        if self.name not in found:
            raise UsageError("the run has no fibres: set output.fibres = true in the scene")
        return found[self.name]

    def values(self, quantity):
        """Values of a quantity over the frames, (n,) ndarray."""
        return self.run.values(self.name, quantity)

    def _frame(self, frame):
        count = len(self.run.frames)
        if not -count <= frame < count:
            raise UsageError(f"frame {frame} is out of range, the run has {count} frames")
        return self.run.frames[frame]

    def __repr__(self):
        return f"<{self.name!r} in {self.run!r}>"


class _Course:
    """A scene on its way through its motion: models, measurements, clocks."""

    def __init__(self, scene, *, options=None, keep_rows=False):
        self.started, self._start = datetime.now(UTC), time.perf_counter()
        self.scene = scene.validate()
        self.options = options or {}
        self.times = {}
        self.status, self.message = "running", ""
        self.summary, self.stages = Summary(), Stages()
        self.keep_rows, self.rows, self.fresh = keep_rows, [], []
        with self.timed("build"):
            check_initial(self.scene)
            self.models = build_models(scene)
            carried = {m.name: m.carried_mesh() for m in self.models}
            self.recorder = MetricsRecorder(scene, carried) if scene.output.metrics else None
            self.fibres = _fibre_study(scene, carried) if scene.output.fibres else None

    def timed(self, part):
        return _Clock(self.times, part)

    def frames(self):
        """Yield the frames; `fresh` then holds the rows of metrics that became complete."""
        wanted = bool(self.scene.output.surfaces) or self.recorder is not None
        course = iter(simulate_frames(self.scene, self.models, surfaces=wanted))
        while True:
            with self.timed("simulate"):
                frame = next(course, None)
            if frame is None:
                return
            self.stages.add(frame)
            if self.fibres is not None:
                with self.timed("fibres"):
                    frame.fibres = self.fibres.at(frame)
            if self.recorder is not None:
                with self.timed("metrics"):
                    self._take(self.recorder.add(frame))
            yield frame

    def close(self, status, message=""):
        self.status, self.message = status, message
        self._take(self.recorder.finish() if self.recorder is not None else [])

    def _take(self, rows):
        self.fresh = rows
        if self.keep_rows:
            self.rows += rows
        self.summary.add(rows)

    def info(self, frames, status=None):
        self.times["wall"] = time.perf_counter() - self._start
        return build_info(
            self.scene,
            started=self.started,
            status=status or self.status,
            message=self.message,
            times=dict(self.times),
            stages=self.stages,
            frames=frames,
            summary=self.summary.table(),
            limits={name: default_limit(name, self.scene) for name in LIMITS},
            options=self.options,
        )


def _fibre_study(scene, carried):
    from rbfmuscle.study.measure.fibre_study import FibreStudy

    return FibreStudy(scene, carried)


class _Clock:
    """Adds the time spent inside to one entry of a table [s]."""

    def __init__(self, times, part):
        self.times, self.part = times, part

    def __enter__(self):
        self.start = time.perf_counter()

    def __exit__(self, *error):
        spent = time.perf_counter() - self.start
        self.times[self.part] = self.times.get(self.part, 0.0) + spent
