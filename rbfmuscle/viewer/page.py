"""The page in the browser, and the thread that keeps its picture up to date."""

import contextlib
import io
import math
import threading
import time
from typing import TYPE_CHECKING

import numpy as np

from rbfmuscle.output.appearance import UPRIGHT, VIEWS, view_axes
from rbfmuscle.output.run_data import RunData
from rbfmuscle.scene.bone import BoneDistance
from rbfmuscle.scene.scene import Scene
from rbfmuscle.validation import RBFMuscleError, SolveError
from rbfmuscle.viewer.panel import Panel
from rbfmuscle.viewer.server import open_server
from rbfmuscle.viewer.side import ModelView, ViewSettings
from rbfmuscle.viewer.sources import LiveSource, SavedSource

if TYPE_CHECKING:
    from viser import CameraHandle, InitialCameraConfig, ViserServer

# Where a picture takes longer [s], those on the way to the controls' places are drawn coarse.
COSTLY = 0.1
# Time in which a browser has read a coloured mesh [s]; the one before it is removed then.
READ = 1.0
LONGEST = 300  # characters of a message
PACE = 0.04  # Least time of a picture while a motion is played [s].
FIELD_OF_VIEW = 0.5  # [radian], upright
FIRST = (-1.4, 1.6, 0.5)  # Where the camera stands at first, along the body's axes.


def show(shown: Scene | RunData, *, model: str | None = None) -> "ViewerPage":
    """Show a scene or a run in a browser or a notebook.

    Parameters
    ----------
    shown : Scene or Run
    model : str, optional
        To begin with, in place of the scene's own.

    Returns
    -------
    ViewerPage
        Shown by a notebook as the last value of a cell; elsewhere open its ``address``. ``close()``
        ends it.

    Examples
    --------
    >>> from rbfmuscle import phantom_scene, show
    >>> page = show(phantom_scene(end=0.0), model="pbd")
    >>> page.address.startswith("http://127.0.0.1:")
    True
    >>> page.close()
    """
    return ViewerPage(
        SavedSource({"run": shown}) if isinstance(shown, RunData) else LiveSource(shown, model)
    )


class ViewerPage:
    """A scene or saved runs in a browser; a notebook shows it where it is the value of a cell.

    ``at`` are controls that begin elsewhere than at rest, ``colour`` is of `COLOURINGS`, ``served``
    is what `open_server` returned, called where not given. A browser opens the ``address``.
    """

    def __init__(
        self,
        source: LiveSource | SavedSource,
        *,
        at: dict[str, float] | None = None,
        colour: str = "group",
        served: "tuple[ViserServer, str] | None" = None,
    ) -> None:
        import trimesh

        self.source, (self.server, self.address) = source, served or open_server()
        self._probes = [
            BoneDistance(n, trimesh.Trimesh(*m, process=False)) for n, m in source.bones.items()
        ]
        self._wake = threading.Event()
        self._closed = False
        self._resting = False
        self._cost = 0.0
        self._message = "Building the models …"
        self._shown: ViewSettings | None = None
        self.sides = [ModelView(self.server, f"/{name}", source) for name in ("first", "second")]
        self.panel = Panel(self.server, source, at or {}, colour, self._touch)
        self.panel.rest.on_click(lambda _: self._touch(rest=True))
        self.panel.view.on_click(
            lambda e: self._aim(VIEWS[e.target.value.lower()], e.client.camera)
        )
        self.server.scene.set_up_direction(source.body[2])
        self._aim(FIRST, self.server.initial_camera)
        self._draw(self.sides[:1], self.panel.look())
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()
        self._touch()
        # Browsers that came before the scene was read look elsewhere.
        self.server.on_client_connect(lambda client: self._aim(FIRST, client.camera))

    def close(self) -> None:
        """Stop the server."""
        self._closed = True
        self._wake.set()
        self._thread.join()
        with contextlib.redirect_stdout(io.StringIO()):
            self.server.stop()

    def __repr__(self) -> str:
        return f"<ViewerPage of {self.source.title!r} at {self.address}>"

    def _repr_html_(self) -> str:
        return f'<iframe src="{self.address}" width="100%" height="640" style="border:0"></iframe>'

    def _touch(self, *, rest: bool = False) -> None:
        self._resting |= rest
        self._wake.set()

    def _aim(
        self, direction: tuple[float, ...], camera: "CameraHandle | InitialCameraConfig"
    ) -> None:
        """Let a camera look at everything; models then stand side by side across its direction."""
        points = (0.001 / self.source.millimetre) * np.concatenate(self.sides[0].points())
        middle, size = (points.min(axis=0) + points.max(axis=0)) / 2, np.ptp(points, axis=0)
        right, up, ahead = view_axes(direction, self.source.body)
        wide, tall, deep = (float(np.abs(axis) @ size) for axis in (right, up, ahead))
        both = self.panel.models[1].value != "none"
        apart = 1.1 * max(wide, 0.7 * tall) * right
        self.sides[1].frame.position = apart
        middle = middle + both * apart / 2
        away = (
            0.55 * max(tall, wide + both * np.linalg.norm(apart)) / math.tan(FIELD_OF_VIEW / 2)
            + deep / 2
        )
        pole = self.source.body[2] if abs(ahead @ self.source.body[2]) < UPRIGHT else up
        with self.server.atomic():
            setattr(camera, "up_direction" if hasattr(camera, "up_direction") else "up", pole)
            camera.fov, camera.position = FIELD_OF_VIEW, middle + away * ahead
            camera.look_at = middle  # a camera that is moved takes along what it looks at

    def _run(self) -> None:
        while True:
            if not self._wake.wait(READ):
                for side in self.sides:
                    side.forget()
                self._wake.wait()
            self._wake.clear()
            if self._closed:
                return
            start = time.perf_counter()
            try:
                more = self._turn()
            except SolveError as error:
                more = self._rest(f"Back to rest: {error}")
            except RBFMuscleError as error:
                more = self._show_message(str(error))
            except Exception as error:  # noqa: BLE001 - whatever it is, the page goes on
                text = f"A bug: {type(error).__name__}: {error}; press Rest, and report it"
                more = self._show_message(text)
            self.server.flush()
            if more:
                time.sleep(
                    max(0.0, PACE - (time.perf_counter() - start)) if self.panel.play.value else 0.0
                )
                self._wake.set()

    def _turn(self) -> bool:
        """Show the next picture if there is a new one; returns whether more follow."""
        panel = self.panel
        changed = [side.choose(model.value) for side, model in zip(self.sides, panel.models)]
        if any(changed):
            self._message = ""
        if changed[1]:
            for client in self.server.get_clients().values():
                self._aim(FIRST, client.camera)
        figures = {side: side.figure for side in self.sides if side.figure is not None}
        if self._resting:
            self._rest("")
        panel.follow_motion(not any(figure.pending for figure in figures.values()))
        for figure in figures.values():
            for name, control in panel.controls.items():
                figure.set(name, control.value)
        start = time.perf_counter()
        coarse = self._cost > COSTLY and not all(figure.near for figure in figures.values())
        waiting = {side: figure for side, figure in figures.items() if figure.pending}
        for side, figure in waiting.items():
            side.picture = figure.advance(coarse=coarse)
        if waiting and not coarse:
            self._cost = time.perf_counter() - start
        look = panel.look()
        if waiting or look != self._shown:
            self._shown = look
            self._draw(list(figures), look)
        return panel.play.value or any(figure.pending for figure in figures.values())

    def _rest(self, message: str) -> bool:
        """Set controls and models to rest; returns that no picture has to follow by itself."""
        self._resting = False
        self._message = message
        self.panel.play.value = False
        self.panel.move_to({name: control.value for name, control in self.source.controls.items()})
        for side in self.sides:
            if side.figure is not None:
                side.figure.rest()
        return False

    def _draw(self, sides: list[ModelView], look: ViewSettings) -> None:
        with self.server.atomic():
            for side, other in zip(sides, sides[::-1] if len(sides) > 1 else [None]):
                side.draw(look, self._probes, None if other is None else other.picture)
            self._write()
            self.panel.plot_on(sides)

    def _show_message(self, text: str) -> bool:
        """Show a text as one line; returns that no picture has to follow by itself."""
        self._message = " ".join(text.split())[:LONGEST]
        self.panel.play.value = False
        self._write()
        return False

    def _write(self) -> None:
        sides = [side for side in self.sides if side.figure is not None]
        cost = f"{1e3 * self._cost:.0f} ms per picture"
        self.panel.write(sides, [self._message, *(side.picture.text for side in sides), cost])
