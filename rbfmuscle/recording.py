"""Running a scene: in memory with `simulate`, or straight to a folder with `stream_run`; measured
and clocked frame by frame.
"""

from __future__ import annotations

import html
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING

from rbfmuscle.anatomy.bones import orient_scene
from rbfmuscle.bones.sdf import BoneSDF
from rbfmuscle.display.export import export_run
from rbfmuscle.fibres import build_bundles
from rbfmuscle.folders import copy_listed
from rbfmuscle.geometry.arrays import Floats
from rbfmuscle.metrics.metrics import MuscleMeasures, Values
from rbfmuscle.metrics.quantities import ALL, Row
from rbfmuscle.metrics.rows import frame_rows, joint_gaps, moment_arm_rows
from rbfmuscle.metrics.summary import (
    LIMITS,
    Doubt,
    Limits,
    Summary,
    parse_limits,
)
from rbfmuscle.metrics.verdict import (
    measured_doubts,
    require_limits,
    verdict_facts,
)
from rbfmuscle.models import build_models, configure_scene, kernel_names
from rbfmuscle.progress import Progress, stage
from rbfmuscle.run.data import FolderMeshes, RunData, SceneMeshes, named_coordinates
from rbfmuscle.run.info import RunInfo
from rbfmuscle.run.writer import RunWriter, build_info, frame_facts, run_folder
from rbfmuscle.scene.check import (
    bone_collisions,
    bone_findings,
    check_initial,
    sampled_frames,
    stated_doubts,
)
from rbfmuscle.scene.frames import parse_slice
from rbfmuscle.scene.objects import from_mm
from rbfmuscle.scene.phantom import open_scene
from rbfmuscle.scene.scene import Scene, doubtful, require_complete
from rbfmuscle.simulation.frame import Event, Frame
from rbfmuscle.simulation.frame_loop import FrameLoop
from rbfmuscle.simulation.substeps import check_substeps
from rbfmuscle.validation import (
    RBFMuscleError,
    SceneWarning,
    SolveError,
    UsageError,
    did_you_mean,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def simulate(
    scene: Scene | str | Path,
    model: str | dict[str, object] | None = None,
    *,
    settings: Mapping[str, object] | None = None,
    frames: slice | str | None = None,
    progress: Callable[[int, int], None] | bool | None = None,
    bone_sdfs: Mapping[str, BoneSDF] | None = None,
) -> Run:
    """Run a scene through its motion and keep every frame in memory.

    Parameters
    ----------
    scene : Scene, path or "phantom"
        A scene, its file, or the phantom hip.
    model : str or dict, optional
        For every muscle; the scene's own choice where not given.
    settings : mapping, optional
        Dotted keys with their values, as for `Scene.with_options`: ``{"model.centres": 200}``.
    frames : slice or str, optional
        Frames of the motion, a slice or "A:B:S".
    progress : callable or bool, optional
        Called as ``progress(done, total)`` after each frame; ``True`` shows on stderr what goes on,
        compiling and building included.
    bone_sdfs : mapping of str to BoneSDF, optional
        Distance fields of the bones, by the bone's name; `BoneSDF` where not given.

    Returns
    -------
    Run

    Raises
    ------
    SceneError, MeshError
        If the scene cannot be simulated.
    UsageError
        If a setting is unknown or impossible.
    SolveError
        If a frame cannot be solved; its ``run`` attribute holds the frames so far.

    Examples
    --------
    >>> from rbfmuscle import phantom_scene
    >>> run = simulate(phantom_scene(end=4.0), model="pbd")
    >>> len(run.frames)
    3
    """
    scene = open_scene(scene)
    if progress is True:
        with Progress(scene.name) as shown:
            return simulate(
                scene, model, settings=settings, frames=frames, progress=shown, bone_sdfs=bone_sdfs
            )
    recording = Recording(scene, model=model, settings=settings, frames=frames, bone_sdfs=bone_sdfs)
    memory = MemorySink()
    try:
        recording.feed(memory, progress=progress or None)
    except SolveError as error:
        error.run = _kept_run(recording, memory)
        raise
    return _kept_run(recording, memory)


def _kept_run(recording: Recording, memory: MemorySink) -> Run:
    """The run of which a sink holds the frames."""
    meshes = SceneMeshes(recording.scene)
    assert memory.info is not None
    return Run(memory.info, memory.frames, memory.rows, meshes, recording=recording)


def stream_run(
    scene: Scene,
    directory: str | Path,
    *,
    model: str | dict[str, object] | None = None,
    settings: Mapping[str, object] | None = None,
    frames: slice | str | None = None,
    fail_on: str | Sequence[str] | None = None,
    pictures: bool = True,
    progress: Callable[[int, int], None] | None = None,
) -> RunInfo:
    """Run a scene and write it to a folder frame by frame, and return its facts.

    Memory does not grow with the frames. The scene's ``output`` table says what is written;
    ``model``, ``settings``, ``frames`` and ``progress`` are as for `simulate`; ``fail_on`` are
    limits, see `rbfmuscle.metrics.summary.parse_limits`; ``pictures`` are those of the report and
    the preview.

    Raises
    ------
    UsageError
        If a setting is unknown or impossible, or the folder cannot be written to, or holds
        anything but an earlier run.
    SolveError
        If a frame cannot be solved or written; frames so far are kept.
    LimitExceededError
        If a limit of ``fail_on`` is exceeded, or was not measured; everything is written.
    """
    run_folder(directory)
    recording = Recording(scene, model=model, settings=settings, frames=frames, fail_on=fail_on)
    writer = RunWriter(directory, recording.scene)
    try:
        recording.feed(writer, progress=progress)
    except SolveError:
        if recording.written:  # what is kept is shown as far as that works
            with suppress(RBFMuscleError):
                recording.finish(writer, pictures=pictures)
        raise
    return recording.finish(writer, pictures=pictures)


class Run(RunData):
    """A run: what `simulate` returns, and what `Run.load` reads from a folder.

    Attributes are those of `RunData`, and:

    Attributes
    ----------
    scene : Scene or None
        As it was run; None of a run that was loaded.

    Examples
    --------
    >>> from rbfmuscle import phantom_scene
    >>> run = simulate(phantom_scene(end=0.0), model="pbd")
    >>> len(run), "extensor" in run, run.muscles[0]
    (1, True, 'extensor')
    >>> bool(abs(run["extensor"].surface(frame=0).volume) > 0.0)
    True
    """

    def __init__(
        self,
        info: RunInfo,
        frames: list[Frame],
        metrics: list[Row],
        meshes: SceneMeshes | FolderMeshes,
        *,
        recording: Recording | None = None,
    ) -> None:
        super().__init__(info, frames, metrics, meshes)
        self._recording = recording
        self.scene = None if recording is None else recording.scene

    def plot(self, quantity: str = "penetration_max", *, coordinate: str | None = None) -> Axes:
        """Plot a quantity of every muscle over the motion, and return the matplotlib Axes.

        The axis is the only coordinate that moves [degree, or scene unit], if it moves one way,
        else the number of the frame. Moment arms are those about ``coordinate``, or all.
        """
        if quantity not in self.quantities:
            raise UsageError(
                f"unknown quantity {quantity!r}, {did_you_mean(quantity, self.quantities)}"
            )
        from matplotlib import pyplot

        from rbfmuscle.display.plots import motion_axis

        place, label = motion_axis(self)
        rows = [row for row in self.metrics if row.quantity == quantity]
        about = named_coordinates(quantity, rows, coordinate)
        axes = pyplot.figure().add_subplot()
        for muscle in dict.fromkeys(row.muscle for row in rows):
            for name in about or [""]:
                frames, values = self.series(muscle, quantity, name or None)
                if len(frames):
                    line = f"{muscle}, {name}" if len(about) > 1 else muscle
                    axes.plot([place[frame] for frame in frames.tolist()], values, label=line)
        axes.set(title=quantity, xlabel=label, ylabel=rows[0].unit)
        axes.legend()
        return axes

    def save(self, directory: str | Path, *, pictures: bool = True) -> None:
        """Write what `stream_run` would have written; a run that was loaded is copied.

        ``pictures`` are those of the report and the preview. UsageError if the folder cannot be
        written to, or holds anything but an earlier run.
        """
        folder = run_folder(directory)
        if self._recording is not None:
            writer = RunWriter(directory, self._recording.scene)
            for frame in self.frames:
                writer.write(frame)
            writer.close(self.metrics)
            writer.write_info(self.info)
            self._recording.finish(writer, pictures=pictures)
        elif self.directory and Path(directory).resolve() != self.directory.resolve():
            with folder.staged() as stage:
                copy_listed(self.directory, stage, "run")

    def export(
        self,
        directory: str | Path,
        formats: str | Sequence[str],
        *,
        units: str | None = None,
        muscles: Sequence[str] | None = None,
        frames: slice | str | None = None,
        fps: float | None = None,
    ) -> list[Path]:
        """Write the surfaces in other formats, into a folder for each, and return the files.

        Formats are ``pvd``, ``vtp``, ``ply``, ``stl``, ``obj``, ``glb``, ``usd`` and
        ``animated-glb``; ``units`` are ``"m"``, ``"cm"`` or ``"mm"``, the scene's where not given;
        glTF is in metres. ``muscles`` are names, all where not given. ``frames`` are those to take
        of the written ones, a slice or "A:B:S". ``fps`` are frames of the motion per second in
        ``usd`` and ``animated-glb``; the times of the motion's file, or 24, where not given.
        """
        names = [formats] if isinstance(formats, str) else list(formats)
        chosen = parse_slice(frames) if isinstance(frames, str) else frames
        return export_run(
            self,
            names,
            output=directory,
            units=units,
            muscles=muscles,
            frames=chosen,
            fps=fps,
        )

    def _repr_html_(self) -> str:
        """A picture for a notebook, or text where there is nothing to draw."""
        from rbfmuscle.display.pictures import figure_html, render_run

        if not self.has_surfaces:
            return html.escape(repr(self))
        return figure_html(lambda file: render_run(self, file), f"{self!r} {self.verdict}")


class MemorySink:
    """Keeps the frames, metrics and facts of a run, which `RunWriter` writes."""

    def __init__(self) -> None:
        self.frames: list[Frame] = []
        self.rows: list[Row] = []
        self.info: RunInfo | None = None

    def write(self, frame: Frame, rows: Sequence[Row] = ()) -> None:
        """Keep a frame, and the rows of metrics that are complete by now."""
        self.frames.append(frame)
        self.rows.extend(rows)

    def close(self, rows: Sequence[Row] = ()) -> None:
        """Keep the last rows."""
        self.rows.extend(rows)

    def write_info(self, info: RunInfo) -> None:
        """Keep the facts, in place of those before."""
        self.info = info


class Recording:
    """One run of a scene: its models through the frame loop, measured and clocked, into a sink.

    ``model``, ``settings`` and ``frames`` are those of `configure_scene`; ``bone_sdfs``, by
    bone, stand in place of `BoneSDF`; ``fail_on`` are the limits of `parse_limits`.
    """

    def __init__(
        self,
        scene: Scene,
        *,
        model: str | dict[str, object] | None = None,
        settings: Mapping[str, object] | None = None,
        frames: slice | str | None = None,
        bone_sdfs: Mapping[str, BoneSDF] | None = None,
        fail_on: str | Sequence[str] | None = None,
    ) -> None:
        self.started = datetime.now(UTC)
        self._start = time.perf_counter()
        self._end = 0.0
        scene = configure_scene(scene, settings, model=model, frames=frames)
        self.scene = orient_scene(require_complete(scene))
        self.limits: Limits = parse_limits(fail_on, self.scene)
        if bone_sdfs is not None and set(bone_sdfs) != {bone.name for bone in scene.bones}:
            bones = ", ".join(bone.name for bone in scene.bones)
            raise UsageError(
                f"bone_sdfs must name each bone ({bones}), got {', '.join(bone_sdfs) or 'none'}"
            )
        self.options = {
            "model": model,
            "frames": str(frames or ""),
            "settings": dict(settings or {}),
        }
        self.times: dict[str, float] = {}
        self.status, self.message = "running", ""
        self.summary = Summary()
        self.written: list[dict] = []
        self._path: dict[int, dict[str, float]] = {}
        self._fibres: dict[str, dict[int, Floats]] = {}  # lengths (N,) by muscle and frame
        self._place = {muscle.name: k for k, muscle in enumerate(scene.muscles)}
        with timed(self.times, "build"), stage("building"):
            check_substeps(self.scene)
            check_initial(self.scene)
            self._doubts = [Doubt(name or ALL, text) for name, text in stated_doubts(self.scene)]
            self._skeleton = _check_skeleton(self.scene)
            self._models = build_models(self.scene)
            material = {model.name: model.material_mesh() for model in self._models}
            self._measures = MuscleMeasures(self.scene, material)
            self._bundles = build_bundles(self.scene, self._models)
        self._fields = bone_sdfs

    def feed(
        self, sink: RunWriter | MemorySink, *, progress: Callable[[int, int], None] | None = None
    ) -> None:
        """Run the whole motion into a sink, which is closed whatever ends it."""
        self.status, self.message = "failed", "a bug"
        try:
            sink.write_info(self.info("running"))
            for frame, measured in self._frames():
                # By muscle, whichever thread was first.
                frame.events.sort(key=lambda event: self._place[event.muscle])
                events, together = self._skeleton.get(frame.index, ([], {}))
                frame.events.extend(events)
                before = next(reversed(self._path.values()), None)
                rows = frame_rows(self.scene, frame, before, {**measured, ALL: together})
                self.summary.add(rows)
                with timed(self.times, "write"):
                    sink.write(frame, rows)
                self._path[frame.index] = dict(frame.coordinates)
                for name, fibres in frame.fibres.items():
                    self._fibres.setdefault(name, {})[frame.index] = fibres.lengths
                self.written.append(frame_facts(self.scene, frame))
                if progress is not None:
                    progress(len(self.written), len(self.scene.motion))
            self.status, self.message = "complete", ""
        except KeyboardInterrupt:
            self.status, self.message = "interrupted", "interrupted"
            raise
        except (RBFMuscleError, MemoryError, OSError) as error:
            self.message = str(error) or type(error).__name__
            raise
        except BaseException as error:
            self.message = f"a bug: {type(error).__name__}: {error}"
            raise
        finally:
            series = self.summary.series
            rows = moment_arm_rows(
                self.scene,
                self._path,
                lengths=series("length"),
                shortest=series("path_length"),
                fibres=self._fibres,
                activations=series("activation"),
            )
            self.summary.add(rows)
            self._doubts += measured_doubts(self.scene, self.summary.table(), rows, self._path)
            # What ended the run says more than a disk that then refuses the rest.
            with suppress(*((SolveError,) if self.status == "failed" else ())):
                sink.close(rows)
                self._end = time.perf_counter()
                sink.write_info(self.info())

    def finish(self, writer: RunWriter, *, pictures: bool = True) -> RunInfo:
        """Write report and pictures of a run that is in a folder, then hold it to the limits that
        it may fail on; its facts.
        """
        start = time.perf_counter()
        if self.scene.output.report:
            from rbfmuscle.display.report import write_report

            said = "drawing pictures" if pictures else "writing the report"
            with timed(self.times, "report"), stage(said):
                write_report(writer.directory, pictures=pictures)
        self._end += time.perf_counter() - start
        info = self.info()
        writer.write_info(info)
        require_limits(self.summary.table(), self.limits)
        return info

    def _frames(self) -> Iterator[tuple[Frame, dict[str, Values]]]:
        """The frames as they are solved, with their values by muscle and quantity; SolveError names
        muscle, frame and coordinates.
        """
        with stage("solving the first frame"):
            with timed(self.times, "simulate"):
                loop = FrameLoop(self.scene, self._models, bone_sdfs=self._fields)
                surfaces, poses = loop.at_rest()
            with timed(self.times, "metrics"):
                material = {m.name: m.material_mesh()[0] for m in self._models}
                self._measures.measure_rest(surfaces, material, poses)
        for coordinates in self.scene.motion.frames:
            with timed(self.times, "simulate"):
                frame = loop.advance(coordinates)
                poses, tendons = frame.poses, frame.tendons
                frame.fibres = {n: lines.at(poses, tendons) for n, lines in self._bundles.items()}
            with timed(self.times, "metrics"):
                measured = self._measures.measure(frame)
            yield frame, measured

    def info(self, status: str | None = None) -> RunInfo:
        """The facts by now."""
        self.times["wall"] = (self._end or time.perf_counter()) - self._start
        table = self.summary.table()
        stopped = ""
        if self.status == "failed" and self.written:
            stopped = f"{len(self.written)} of {len(self.scene.motion)}"
        return build_info(
            self.scene,
            self.started,
            table,
            status=status or self.status,
            message=self.message,
            options=self.options,
            kernels=kernel_names(self.scene),
            epsilons={
                model.name: epsilon
                for model in self._models
                if (epsilon := getattr(model, "epsilon", None)) is not None
            },
            times=self.times,
            **verdict_facts(
                table, self.limits, self._doubts, self.scene.missing_bones, stopped=stopped
            ),
            neighbours=self._measures.neighbours.table(),
            frames=self.written,
        )


@contextmanager
def timed(times: dict[str, float], part: str) -> Iterator[None]:
    """Add the time spent inside to one entry of ``times`` [s]."""
    start = time.perf_counter()
    try:
        yield
    finally:
        times[part] = times.get(part, 0.0) + time.perf_counter() - start


Found = tuple[list[Event], dict[str, float]]


def _check_skeleton(scene: Scene) -> dict[int, Found]:
    """Events and values of the bones for some frames of the motion, and a warning for each pair
    that meets.
    """
    numbers, sampled = scene.motion.numbers.tolist(), sampled_frames(scene)
    collisions = [(numbers[place], *rest) for place, *rest in bone_collisions(scene, sampled)]
    for finding in bone_findings(collisions, scene.units):
        warnings.warn(f"{finding.place}: {finding.message}", SceneWarning, stacklevel=5)
    for note in scene.motion.notes:
        warnings.warn(f"motion: {note}", SceneWarning, stacklevel=5)
    found: dict[int, Found] = {
        numbers[place]: ([], {"bone_overlap": 0.0, "joint_gap": 0.0}) for place in sampled
    }
    for frame, first, second, depth in collisions:
        events, values = found.setdefault(frame, ([], {}))
        events.append(Event(frame, "", f"{first} and {second}", 1, "bones_overlap"))
        values["bone_overlap"] = max(values.get("bone_overlap", 0.0), depth)
    events, values = found.setdefault(numbers[0], ([], {}))
    events.extend(Event(numbers[0], "", name, 1, "missing_bone") for name in scene.missing_bones)
    values["missing_bones"] = float(len(scene.missing_bones))
    if doubts := doubtful(scene.guesses, "joint"):
        values["doubtful_guesses"] = float(len(doubts))
    opened = from_mm(LIMITS["joint_gap"].value, scene.units)
    for place, parent, child, opening in joint_gaps(scene, sampled):
        frame = numbers[place]
        events, values = found.setdefault(frame, ([], {}))
        values["joint_gap"] = max(values.get("joint_gap", 0.0), opening)
        if opening > opened:
            events.append(Event(frame, "", f"{parent} and {child}", 1, "joint_opens"))
    return found
