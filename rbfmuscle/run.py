"""Running a scene: in memory with `simulate`, or straight to a folder with `stream_run`.

Both are one run, a generator of frames, and differ in the sink that takes them.
"""

import atexit
import shutil
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing
from typing import Any

import numpy as np

from rbfmuscle.geometry.fields import BoneField
from rbfmuscle.metrics.quantities import Row
from rbfmuscle.metrics.summary import parse_limits, require_limits
from rbfmuscle.models import configure_scene
from rbfmuscle.output.saved import SavedRun
from rbfmuscle.output.sinks import MemorySink
from rbfmuscle.output.writer import RunWriter, check_writable
from rbfmuscle.progress import Progress, stage
from rbfmuscle.recording import Recording
from rbfmuscle.scene.scene import Scene
from rbfmuscle.simulation.frame import Event, Frame
from rbfmuscle.validation import SolveError, UsageError


def simulate(
    scene: Scene,
    model: str | dict | None = None,
    *,
    settings: Mapping[str, Any] | None = None,
    frames: slice | str | None = None,
    progress: Callable[[int, int], None] | bool | None = None,
    fields: Mapping[str, BoneField] | None = None,
) -> "Run":
    """Run a scene through its motion and keep every frame in memory.

    Parameters
    ----------
    scene : Scene
    model : str or dict, optional
        For every muscle; the scene's own choice where not given.
    settings : mapping, optional
        Dotted keys with their values, as for `Scene.with_options`: ``{"model.centres": 200}``.
    frames : slice or str, optional
        Frames of the motion, a slice or "A:B:S".
    progress : callable or bool, optional
        Called as ``progress(done, total)`` after each frame; ``True`` shows on stderr what goes on, compiling and
        building included.
    fields : mapping of str to BoneField, optional
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
    if progress is True:
        with Progress(scene.name) as shown:
            return simulate(scene, model, settings=settings, frames=frames, progress=shown, fields=fields)
    scene = configure_scene(scene, settings, model=model, frames=frames)
    if fields is not None and set(fields) != {bone.name for bone in scene.bones}:
        bones = ", ".join(bone.name for bone in scene.bones)
        raise UsageError(f"fields must name each bone ({bones}), got {', '.join(fields) or 'none'}")
    options = _options(model, settings, frames)
    recording, memory = Recording(scene, options=options, models_here=False, fields=fields), MemorySink()
    run = Run(recording, memory)
    try:
        recording.feed(memory, progress=progress or None)
    except SolveError as error:
        error.run = run
        raise
    return run


def stream_run(
    scene: Scene,
    directory: Any,
    *,
    model: str | dict | None = None,
    settings: Mapping[str, Any] | None = None,
    frames: slice | str | None = None,
    fail_on: str | Sequence[str] | dict | None = None,
    pictures: bool = True,
    progress: Callable[[int, int], None] | None = None,
    watch: Callable[[list, Frame | None], None] | None = None,
) -> dict:
    """Run a scene and write it to a folder frame by frame; memory does not grow with the frames.

    Parameters
    ----------
    scene : Scene
        Its ``output`` table says what is written.
    directory : path
    model, settings, frames, progress
        As for `simulate`.
    fail_on : str, list of str or dict, optional
        Limits, see `rbfmuscle.metrics.summary.parse_limits`.
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
    UsageError
        If a setting is unknown or impossible, or the folder cannot be written to.
    SolveError
        If a frame cannot be solved or written; frames so far are kept.
    LimitExceededError
        If a limit of ``fail_on`` is exceeded; everything is written.
    """
    scene = configure_scene(scene, settings, model=model, frames=frames)
    limits = parse_limits(fail_on, scene)
    check_writable(directory)
    recording = Recording(scene, options=_options(model, settings, frames), models_here=watch is not None)
    with closing(recording):
        writer = RunWriter(directory, scene)
        recording.feed(writer, progress=progress, watch=watch)
    return _finish(recording, writer, limits, pictures)


def _options(model, settings, frames):
    """The caller's options, for ``run.json``."""
    return {"model": model, "frames": str(frames or ""), "settings": dict(settings or {})}


def _finish(recording, writer, limits, pictures):
    """Report and pictures, then the limits."""
    output = recording.scene.output
    with recording.timed("report"), stage("drawing pictures"):
        if output.report or output.preview:
            from rbfmuscle.report.report import write_report

            write_report(
                writer.directory, report=output.report, preview=output.preview and pictures, pictures=pictures
            )
    info = recording.info()
    writer.write_info(info)
    require_limits(recording.summary.table(), limits)
    return info


class Run:
    """A finished run in memory.

    Attributes
    ----------
    scene : Scene
        As it was run.

    Examples
    --------
    >>> from rbfmuscle import phantom_scene
    >>> run = simulate(phantom_scene(end=0.0), model="pbd")
    >>> [muscle.name for muscle in run][:1]
    ['extensor']
    >>> bool(abs(run["extensor"].surface(frame=0).volume) > 0.0)
    True
    """

    def __init__(self, recording: Recording, memory: MemorySink) -> None:
        self._recording, self._memory = recording, memory
        self.scene = recording.scene

    @property
    def frames(self) -> list[Frame]:
        """Frames that were written, in their order."""
        return self._memory.frames

    @property
    def metrics(self) -> list[Row]:
        """Rows (frame, coordinate, angle [degree], muscle, quantity, value, unit), frame by frame."""
        return self._memory.rows

    @property
    def events(self) -> list[Event]:
        """Events of all frames, in their order."""
        return [event for frame in self.frames for event in frame.events]

    @property
    def summary(self) -> dict:
        """Nested dict: muscle -> quantity -> min, max, mean, median, worst."""
        return self._recording.summary.table()

    def __getitem__(self, muscle: str) -> "MuscleRun":
        """The `MuscleRun` of a muscle."""
        return MuscleRun(self, self.scene.muscle(muscle).name)

    def __iter__(self) -> Iterator["MuscleRun"]:
        """All muscles."""
        return (MuscleRun(self, muscle.name) for muscle in self.scene.muscles)

    def values(self, muscle: str, quantity: str) -> np.ndarray:
        """Values of a quantity over the frames, (n,) ndarray."""
        found = [r.value for r in self.metrics if r.muscle == muscle and r.quantity == quantity]
        return np.array(found)

    def save(self, directory: Any, *, pictures: bool = True) -> None:
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
        """
        _finish(self._recording, self._write(directory), {}, pictures)

    def show(self) -> Any:
        """Show the frames in a browser or a notebook; see `rbfmuscle.show`."""
        import rbfmuscle

        folder = tempfile.mkdtemp(prefix="rbfmuscle")
        atexit.register(shutil.rmtree, folder, ignore_errors=True)
        self._write(folder)
        return rbfmuscle.show(SavedRun(folder))

    def _write(self, directory: Any) -> RunWriter:
        writer = RunWriter(directory, self.scene)
        self._memory.replay(writer)
        writer.write_info(self._recording.info())
        return writer

    def __repr__(self) -> str:
        return f"<Run of {self.scene.name!r}: {len(self.frames)} frames>"


class MuscleRun:
    """One muscle of a run."""

    def __init__(self, run: Run, name: str) -> None:
        self.run = run
        self.name = name

    def surface(self, frame: int = -1) -> Any:
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

    def values(self, quantity: str) -> np.ndarray:
        """Values of a quantity over the frames, (n,) ndarray."""
        return self.run.values(self.name, quantity)

    def _frame(self, frame):
        count = len(self.run.frames)
        if not -count <= frame < count:
            raise UsageError(f"frame {frame} is out of range, the run has {count} frames")
        return self.run.frames[frame]

    def __repr__(self) -> str:
        return f"<{self.name!r} in {self.run!r}>"
