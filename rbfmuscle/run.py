"""Running a scene: in memory with `simulate`, or straight to a folder with `stream_run`."""

from __future__ import annotations

import html
import shutil
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

from rbfmuscle.bones.sdf import BoneSDF
from rbfmuscle.folders import LIST, read_list
from rbfmuscle.metrics.quantities import Row
from rbfmuscle.output.export import export_run
from rbfmuscle.output.info import RunInfo
from rbfmuscle.output.run_data import RunData, SceneMeshes, named_coordinates
from rbfmuscle.output.run_folder import FolderMeshes
from rbfmuscle.output.writer import RunWriter, run_folder
from rbfmuscle.progress import Progress
from rbfmuscle.recording import MemorySink, Recording
from rbfmuscle.scene.frames import parse_slice
from rbfmuscle.scene.phantom import open_scene
from rbfmuscle.scene.scene import Scene
from rbfmuscle.simulation.frame import Frame
from rbfmuscle.validation import RBFMuscleError, SolveError, UsageError, did_you_mean

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

        from rbfmuscle.report.plots import motion_axis

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
            self._recording.finish(self._write(directory), pictures=pictures)
        elif self.directory and Path(directory).resolve() != self.directory.resolve():
            with folder.staged() as stage:
                _copy_run(self.directory, stage)

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
        from rbfmuscle.report.render import figure_html, render_run

        if not self.has_surfaces:
            return html.escape(repr(self))
        return figure_html(lambda file: render_run(self, file), f"{self!r} {self.verdict}")

    def _write(self, directory):
        writer = RunWriter(directory, self.scene)
        for frame in self.frames:
            writer.write(frame)
        writer.close(self.metrics)
        writer.write_info(self.info)
        return writer


def _copy_run(source: Path, target: Path) -> None:
    """Copy the files of a run, and nothing else that lies in its folder."""
    names = read_list(source, "run")
    if names is None:
        raise UsageError(f"{source} has no {LIST}, which names the files of a run; run it again")
    for name in names:
        if (source / name).is_file():
            (target / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(source / name, target / name)
