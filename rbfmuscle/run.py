"""Running a scene: in memory with `simulate`, or straight to a folder with `stream_run`."""

from __future__ import annotations

import atexit
import html
import shutil
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from rbfmuscle.folders import LIST, read_list
from rbfmuscle.geometry.fields import BoneField
from rbfmuscle.metrics.quantities import ALL, Row
from rbfmuscle.metrics.rows import moment_arms, reaches
from rbfmuscle.output.export import export_run
from rbfmuscle.output.saved import SavedRun, saved_frames
from rbfmuscle.output.writer import RunWriter, run_folder
from rbfmuscle.progress import Progress
from rbfmuscle.recording import MemorySink, Recording
from rbfmuscle.scene.joints.tables import full_name
from rbfmuscle.scene.phantom import open_scene
from rbfmuscle.scene.scene import Scene
from rbfmuscle.simulation.frame import Event, FibreLines, Frame
from rbfmuscle.validation import MissingPartError, SolveError, UsageError, did_you_mean

if TYPE_CHECKING:
    import pandas
    import trimesh
    from matplotlib.axes import Axes

    import rbfmuscle


def simulate(
    scene: Scene | str | Path,
    model: str | dict[str, Any] | None = None,
    *,
    settings: Mapping[str, Any] | None = None,
    frames: slice | str | None = None,
    progress: Callable[[int, int], None] | bool | None = None,
    fields: Mapping[str, BoneField] | None = None,
) -> Run:
    """Run a scene through its motion and keep every frame in memory.

    Parameters
    ----------
    scene : Scene, path or "phantom"
        A scene, its file, or the embedded hip.
    model : str or dict, optional
        For every muscle; the scene's own choice where not given.
    settings : mapping, optional
        Dotted keys with their values, as for `Scene.with_options`: ``{"model.centres": 200}``.
    frames : slice or str, optional
        Frames of the motion, a slice or "A:B:S".
    progress : callable or bool, optional
        Called as ``progress(done, total)`` after each frame; ``True`` shows on stderr what goes on,
        compiling and building included.
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
    scene = open_scene(scene)
    if progress is True:
        with Progress(scene.name) as shown:
            return simulate(
                scene, model, settings=settings, frames=frames, progress=shown, fields=fields
            )
    recording = Recording(scene, model=model, settings=settings, frames=frames, fields=fields)
    memory = MemorySink()
    run = Run(memory.frames, memory.rows, recording=recording)
    try:
        recording.feed(memory, progress=progress or None)
    except SolveError as error:
        error.run = run
        raise
    return run


def stream_run(
    scene: Scene,
    directory: str | Path,
    *,
    model: str | dict[str, Any] | None = None,
    settings: Mapping[str, Any] | None = None,
    frames: slice | str | None = None,
    fail_on: str | Sequence[str] | None = None,
    pictures: bool = True,
    progress: Callable[[int, int], None] | None = None,
) -> dict[str, Any]:
    """Run a scene and write it to a folder frame by frame, and return what ``run.json`` holds.

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
        If a limit of ``fail_on`` is exceeded, or was not measured; everything is written, and its
        ``info`` is what ``run.json`` holds.
    """
    run_folder(directory)
    recording = Recording(scene, model=model, settings=settings, frames=frames, fail_on=fail_on)
    writer = RunWriter(directory, recording.scene)
    recording.feed(writer, progress=progress)
    return recording.finish(writer, pictures=pictures)


class Run:
    """A run: in memory, or of a folder that holds one.

    ``len(run)`` is the number of its frames, ``run["extensor"]`` one muscle; iteration gives every
    muscle.

    Attributes
    ----------
    frames : list of Frame
        Those that were written, in their order.
    metrics : list of Row
        (frame, coordinate, angle [degree], muscle, quantity, value, unit), frame by frame.
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
        frames: list[Frame],
        metrics: list[Row],
        *,
        recording: Recording | None = None,
        saved: SavedRun | None = None,
    ) -> None:
        self.frames, self.metrics = frames, metrics
        self._recording = recording
        self.scene = None if recording is None else recording.scene
        if saved is not None:
            self.saved = saved

    @classmethod
    def load(cls, directory: str | Path) -> Run:
        """Return the run in a folder, or raise UsageError if it holds none."""
        saved = SavedRun(directory)
        return cls(saved_frames(saved), saved.metrics, saved=saved)

    @cached_property
    def saved(self) -> SavedRun:
        """The run in a folder; one in memory is written to a temporary folder."""
        folder = tempfile.mkdtemp(prefix="rbfmuscle")
        atexit.register(shutil.rmtree, folder, ignore_errors=True)
        self._write(folder)
        return SavedRun(folder)

    @cached_property
    def info(self) -> dict[str, Any]:
        """What ``run.json`` holds."""
        return self.saved.info if self._recording is None else self._recording.info()

    @property
    def events(self) -> list[Event]:
        """Events of all frames, in their order."""
        return [event for frame in self.frames for event in frame.events]

    @property
    def summary(self) -> dict[str, dict[str, Any]]:
        """Nested dict: muscle -> quantity -> min, max, mean, median, worst."""
        return self.info["muscles"]

    @property
    def verdict(self) -> str:
        """Which muscles are within all limits, which not, and the worst value."""
        return self.info["verdict"]

    @property
    def muscles(self) -> list[str]:
        """Names of the muscles."""
        return [muscle["name"] for muscle in self.info["scene"]["muscles"]]

    @property
    def quantities(self) -> list[str]:
        """Names of what was measured."""
        return list(dict.fromkeys(row.quantity for row in self.metrics))

    def __len__(self) -> int:
        return len(self.frames)

    def __contains__(self, muscle: object) -> bool:
        return muscle in self.muscles

    def __getitem__(self, muscle: str) -> MuscleRun:
        """The `MuscleRun` of a muscle."""
        if muscle not in self:
            raise UsageError(f"unknown muscle {muscle!r}, {did_you_mean(muscle, self.muscles)}")
        return MuscleRun(self, muscle)

    def __iter__(self) -> Iterator[MuscleRun]:
        """All muscles."""
        return (MuscleRun(self, muscle) for muscle in self.muscles)

    def values(
        self, muscle: str, quantity: str, *, coordinate: str | None = None
    ) -> NDArray[np.float64]:
        """Values of a quantity over the frames, (n,) ndarray; of moment arms those about a
        ``coordinate``, which must be named where the muscle has several.

        UsageError if the run has no such muscle, quantity or coordinate.
        """
        found: dict[str, list[Row]] = {}
        for row in self.metrics:
            if row.muscle == muscle:
                found.setdefault(row.quantity, []).append(row)
        if not found:
            raise UsageError(
                f"unknown muscle {muscle!r}, {did_you_mean(muscle, [*self.muscles, ALL])}"
            )
        if quantity not in found:
            raise UsageError(
                f"{quantity!r} was not measured of {muscle!r}, {did_you_mean(quantity, found)}"
            )
        rows = found[quantity]
        if "moment_arm" in quantity:
            rows = _about(rows, coordinate)
        elif coordinate is not None:
            raise UsageError(f"{quantity!r} has no coordinate; only moment arms have")
        return np.array([row.value for row in rows])

    def table(self) -> pandas.DataFrame:
        """Return the metrics as a pandas DataFrame, or raise MissingPartError if pandas is not
        installed.
        """
        try:
            import pandas
        except ImportError:
            raise MissingPartError("run.table() needs pandas: pip install pandas") from None
        return pandas.DataFrame(self.metrics, columns=list(Row._fields))

    def plot(self, quantity: str = "penetration_max") -> Axes:
        """Plot a quantity of every muscle over the motion, and return the matplotlib Axes."""
        if quantity not in self.quantities:
            raise UsageError(
                f"unknown quantity {quantity!r}, {did_you_mean(quantity, self.quantities)}"
            )
        from matplotlib import pyplot

        rows = [row for row in self.metrics if row.quantity == quantity]
        axes = pyplot.figure().add_subplot()
        for muscle, coordinate in dict.fromkeys((row.muscle, row.coordinate) for row in rows):
            track = [row for row in rows if (row.muscle, row.coordinate) == (muscle, coordinate)]
            axes.plot([row.frame for row in track], [row.value for row in track], label=muscle)
        axes.set(title=quantity, xlabel="frame", ylabel=rows[0].unit)
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
        elif Path(directory).resolve() != self.saved.directory.resolve():
            with folder.staged() as stage:
                _copy_run(self.saved.directory, stage)

    def export(
        self, directory: str | Path, formats: str | Sequence[str], *, units: str | None = None
    ) -> list[Path]:
        """Write the surfaces in other formats, into a folder for each, and return the files.

        Formats are ``pvd``, ``vtp``, ``ply``, ``stl``, ``obj``, ``glb``, ``usd`` and
        ``animated-glb``; ``units`` are ``"m"``, ``"cm"`` or ``"mm"``, the scene's where not given;
        glTF is in metres.
        """
        names = [formats] if isinstance(formats, str) else list(formats)
        return export_run(self.saved.directory, names, output=directory, units=units)

    def show(self) -> rbfmuscle.Page:
        """Show the frames in a browser or a notebook; see `rbfmuscle.show`."""
        import rbfmuscle

        return rbfmuscle.show(self.saved)

    def _write(self, directory):
        writer = RunWriter(directory, self.scene)
        for frame in self.frames:
            writer.write(frame)
        writer.close(self.metrics)
        writer.write_info(self._recording.info())
        return writer

    def __repr__(self) -> str:
        return (
            f"<Run of {self.info['scene']['name']!r}: {len(self)} frames, "
            f"{', '.join(self.muscles)}>"
        )

    def _repr_html_(self) -> str:
        from rbfmuscle.report.render import figure_html, render_run

        if not self.saved.has_surfaces():
            return html.escape(repr(self))
        return figure_html(
            lambda file: render_run(self.saved.directory, file), f"{self!r} {self.verdict}"
        )


def _copy_run(source: Path, target: Path) -> None:
    """Copy the files of a run, and nothing else that lies in its folder."""
    names = read_list(source, "run")
    if names is None:
        raise UsageError(f"{source} has no {LIST}, which names the files of a run; run it again")
    for name in names:
        if (source / name).is_file():
            (target / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(source / name, target / name)


class MuscleRun:
    """One muscle of a run."""

    def __init__(self, run: Run, name: str) -> None:
        self.run, self.name = run, name

    def surface(self, frame: int = -1) -> trimesh.Trimesh:
        """Surface in a frame of the run: closed, faces outward, world coordinates [scene unit].

        ``frame`` is the place in the run's frames; negative counts from the end.
        """
        import trimesh

        count = len(self.run)
        if not -count <= frame < count:
            raise UsageError(f"frame {frame} is out of range, the run has {count} frames")
        surface = self.run.frames[frame].surfaces[self.name]
        return trimesh.Trimesh(surface.vertices, surface.faces, process=False)

    def values(self, quantity: str, *, coordinate: str | None = None) -> NDArray[np.float64]:
        """Values of a quantity over the frames, (n,) ndarray; see `Run.values`."""
        return self.run.values(self.name, quantity, coordinate=coordinate)

    def fibres(self, frame: int = -1) -> NDArray[np.float64]:
        """Points (N, k, 3) of the fibres in a frame of the run, each from origin to insertion with
        its tendons [scene unit]; of a run whose scene had ``output.fibres``.
        """
        return self._fibres(self.run.frames[frame]).points

    @property
    def fibre_lengths(self) -> NDArray[np.float64]:
        """Length (frames, N) of each fibre with its tendons [scene unit]."""
        return np.array([self._fibres(frame).lengths for frame in self.run.frames])

    def moment_arms(self, coordinate: str) -> NDArray[np.float64]:
        """Moment arm (frames, N) of each fibre about a coordinate, of its full or its short name.

        Minus the slope of the fibre's length [scene unit per radian, or 1 of a translation], see
        `rbfmuscle.metrics.rows.moment_arms`; NaN where the coordinate does not move alone.
        """
        path = [frame.coordinates for frame in self.run.frames]
        known = sorted({name for coordinates in path for name in coordinates})
        name = full_name(coordinate, known, place="moment_arms")
        scene = self.run.info["scene"]
        reach = reaches(known, scene.get("coordinate_units", {}), scene["units"])
        lengths = self.fibre_lengths
        out = np.full(lengths.shape, np.nan)
        for row, found in zip(out, moment_arms(path, lengths, reach)):
            row[:] = found.get(name, np.nan)
        return out

    def _fibres(self, frame: Frame) -> FibreLines:
        if self.name not in frame.fibres:
            raise UsageError(
                f"the run has no fibres of {self.name!r}; run it with output.fibres=32"
            )
        return frame.fibres[self.name]


def _about(rows: list[Row], coordinate: str | None) -> list[Row]:
    """The rows of moment arms about one coordinate."""
    names = list(dict.fromkeys(row.coordinate for row in rows))
    if coordinate is None:
        if len(names) > 1:
            raise UsageError(
                f"{rows[0].muscle!r} has moment arms about {', '.join(names)}; name one with "
                "coordinate="
            )
        return rows
    if coordinate not in names:
        raise UsageError(
            f"{rows[0].muscle!r} has no moment arm about {coordinate!r}, "
            f"{did_you_mean(coordinate, names)}"
        )
    return [row for row in rows if row.coordinate == coordinate]
