"""The page in the browser, its controls, and the thread that keeps its picture up to date."""

import contextlib
import html
import io
import math
import threading
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, TypeVar

import numpy as np
import trimesh

from rbfmuscle.run.appearance import UPRIGHT, VIEWS, view_axes
from rbfmuscle.run.data import RunData
from rbfmuscle.scene.bone import BoneDistance
from rbfmuscle.scene.scene import Scene
from rbfmuscle.validation import RBFMuscleError, SolveError
from rbfmuscle.viewer import open_server
from rbfmuscle.viewer.side import COLOURINGS, KINDS, ModelView, ViewSettings, legend
from rbfmuscle.viewer.sources import LiveSource, SavedSource

if TYPE_CHECKING:
    from viser import CameraHandle, GuiInputHandle, GuiUplotHandle, InitialCameraConfig, ViserServer


Element = TypeVar("Element", bound="GuiInputHandle")
WIDTH = 350  # [pixel]
HISTORY, LINES = 200, 8  # Pictures and lines in a plot.


class Panel:
    """Sliders by joint, play bar, choices, numbers and plot; ``touch`` is called whenever something
    was changed.
    """

    def __init__(
        self,
        server: "ViserServer",
        source: LiveSource | SavedSource,
        at: dict[str, float],
        colour: str,
        touch: Callable[[], None],
    ) -> None:
        self.gui = server.gui
        self.source = source
        self._touch = touch
        self._followed = 0  # frame of the motion
        # The coordinates that the motion moves, in each of its frames, and their ranges.
        moved = {name: source.controls[name] for frame in source.motion for name in frame}
        self._moved = list(moved)
        self._motion = np.array(
            [[frame.get(name, c.value) for name, c in moved.items()] for frame in source.motion]
        )
        self._span = np.array([max(c.high - c.low, 1e-9) for c in moved.values()])
        self.gui.configure_theme(show_logo=False, show_share_button=False)
        self.gui.main_panel.dock_right()
        self.gui.main_panel.set_width(WIDTH)
        self._numbers, tabs = self.gui.add_html(""), self.gui.add_tab_group()
        with tabs.add_tab("Move"):
            self._add_controls(at)
        with tabs.add_tab("Show"):
            self._add_choices(colour)
        with tabs.add_tab("Plot") as self._tab:
            quantities = (
                "none",
                "volume error [%]",
                f"depth in bones [{source.units}]",
                f"moment arm [{source.units}]",
                "mean of the colour",
            )
            self.quantity = self._watch(self.gui.add_dropdown("Quantity", quantities))
            self._plot: GuiUplotHandle | None = None
            self._lines, self._history = [], []

    def _watch(self, element: Element) -> Element:
        element.on_update(lambda _: self._touch())
        return element

    def _add_controls(self, at: dict[str, float]) -> None:
        last, folders = len(self.source.motion) - 1, {}
        self.frame = self._watch(
            self.gui.add_slider("Frame", 0, max(last, 1), 1, 0, visible=last > 0)
        )
        self.play = self._watch(self.gui.add_checkbox("Play", False))
        self.rest, self.controls = self.gui.add_button("Rest"), {}
        for name, (group, label, *limits, value) in self.source.controls.items():
            if group not in folders:
                folders[group] = self.gui.add_folder(group)
            with folders[group]:
                low, high = map(float, limits)
                step = 10.0 ** math.floor(math.log10(max(high - low, 1e-9) / 50.0))
                value = min(max(float(at.get(name, value)), low), high)
                marks = tuple((end, f"{end:.4g}") for end in (low, high))
                slider = self.gui.add_slider(label, low, high, step, value, marks=marks)
                self.controls[name] = self._watch(slider)

    def _add_choices(self, colour: str) -> None:
        gui, choices = self.gui, self.source.choices
        several = isinstance(self.source, SavedSource) and len(choices) > 1  # of a comparison
        model = gui.add_dropdown("Model", choices)
        beside = gui.add_dropdown(
            "Beside it", ("none", *choices), initial_value=choices[1] if several else "none"
        )
        self.models = [self._watch(model), self._watch(beside)]
        self.colour = self._watch(
            gui.add_dropdown("Colour", tuple(COLOURINGS), initial_value=colour)
        )
        self.view = gui.add_button_group("View", [view.capitalize() for view in VIEWS])
        self.cut = self._watch(gui.add_dropdown("Cut along", ("none", "x", "y", "z")))
        self.place = self._watch(gui.add_slider("Cut at", 0.0, 1.0, 0.01, 0.5))
        marks = self.source.marks
        kinds = KINDS if marks.held else KINDS[-1:]
        with gui.add_folder("Marks", expand_by_default=False):
            self.marks = {kind: self._watch(gui.add_checkbox(kind, False)) for kind in kinds}
        if marks.doubts:
            with gui.add_folder(f"Doubts ({len(marks.doubts)})", expand_by_default=False):
                lines = "".join(f"<li>{html.escape(doubt)}</li>" for doubt in marks.doubts)
                gui.add_html(f"<ul style='font-size:12px;padding:0 24px'>{lines}</ul>")
        self.eyes = {}
        for title, names in (("Muscles", self.source.muscles), ("Bones", self.source.bones)):
            with gui.add_folder(title, expand_by_default=False):
                self.eyes |= {name: self._watch(gui.add_checkbox(name, True)) for name in names}

    def look(self) -> ViewSettings:
        """All that decides how a picture is shown."""
        cut = None
        if self.cut.value != "none":
            axis = "xyz".index(self.cut.value)
            points = np.concatenate(
                [vertices[:, axis] for vertices, _ in self.source.muscles.values()]
            )
            cut = axis, float(points.min() + self.place.value * np.ptp(points))
        return ViewSettings(
            colour=self.colour.value,
            hidden=frozenset(name for name, eye in self.eyes.items() if not eye.value),
            cut=cut,
            others=(*(model.value for model in self.models), self.quantity.value),
            marks=frozenset(kind for kind, box in self.marks.items() if box.value),
        )

    def move_to(self, values: dict[str, float]) -> None:
        """Set controls."""
        for name, value in values.items():
            self.controls[name].value = value

    def follow_motion(self, arrived: bool) -> None:
        """Set the controls to the frame of the motion where the play bar is: the next one while it
        plays and pictures have ``arrived`` at the one before. Where the controls were moved
        instead, set the play bar to the frame nearest to them.
        """
        if self.play.value and arrived:
            self.frame.value = (self.frame.value + 1) % len(self.source.motion)
        if self.frame.value != self._followed:
            self._followed = self.frame.value
            self.move_to(self.source.motion[self.frame.value])
            return
        # The nearest in shares of the controls' ranges; the last one where others are as near.
        here = np.array([self.controls[name].value for name in self._moved])
        away = np.linalg.norm((self._motion - here) / self._span, axis=1)
        least = int(np.argmin(away))
        if away[least] < away[self._followed] - 1e-9:
            self._followed = least
        self.frame.value = self._followed

    def write(self, sides: list[ModelView], texts: list[str]) -> None:
        """Write the scale of the colours, the numbers of all muscles and texts."""
        colouring, units = COLOURINGS[self.colour.value], html.escape(self.source.units)
        bar = "" if colouring is None else legend(colouring, units, self.source.millimetre)
        head = (
            html.escape(" / ".join(side.choice for side in sides)),
            "volume [%]",
            f"in bones [{units}]",
            f"moment arm [{units}]",
        )
        more = round(-math.log10(self.source.millimetre))  # digits of a length
        rows = [f"<tr><th style='text-align:left'>{'</th><th>'.join(head)}</th></tr>"]
        for name, colour in self.source.colours.items() if sides else ():
            cells = [f"<span style='color:{colour}'>■</span> {html.escape(name.replace('_', ' '))}"]
            for key, digits in (("volume", 2), ("depth", 2 + more), ("moment", 1 + more)):
                # 0.0 is added so that no -0 is shown.
                known = (side.numbers.get(name, {}).get(key, math.nan) for side in sides)
                numbers = (f"{round(number, digits) + 0.0:.{digits}f}" for number in known)
                cells.append(" / ".join(numbers).replace("nan", "–"))
            rows.append(f"<tr><td style='text-align:left'>{'</td><td>'.join(cells)}</td></tr>")
        self._numbers.content = (
            f"<div style='padding:4px 12px;font-size:12px'>{bar}<div "
            "style='max-height:170px;overflow:auto'>"
            "<table style='width:100%;text-align:right;line-height:1.25'>"
            f"{''.join(rows)}</table></div>"
            f"{'<br>'.join(html.escape(text) for text in texts if text)}</div>"
        )

    def plot_on(self, sides: list[ModelView]) -> None:
        """Go on with the plot of the quantity; begin anew where other lines are asked for."""
        from viser import uplot

        key = self.quantity.value.partition(" ")[0]
        shown = [(s, name) for s in sides for name in self.source.colours if self.eyes[name].value][
            :LINES
        ]
        row = [side.numbers[name][key] for side, name in shown if key != "none"]
        if not row or not np.isfinite(row).all():
            return
        lines = [key, self.colour.value, *((side.choice, name) for side, name in shown)]
        if lines != self._lines:
            self._lines, self._history = lines, []
        self._history = [*self._history[1 - HISTORY :], row]
        data = (np.arange(float(len(self._history))), *np.array(self._history).T)
        if self._plot is not None:
            if len(self._history) > 1:
                self._plot.data = data
                return
            self._plot.remove()
        series = [uplot.Series(label="picture")]
        for side, name in shown:
            dash = [] if side is sides[0] else [6, 4]
            label = f"{name} {side.choice}" if len(sides) > 1 else name
            series.append(
                uplot.Series(label=label, stroke=self.source.colours[name], width=2, dash=dash)
            )
        with self._tab:
            self._plot = self.gui.add_uplot(
                data, tuple(series), height=260, scales={"x": {"time": False}}
            )


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
            more = False
            try:
                more = self._turn()
            except SolveError as error:
                self._rest(f"Back to rest: {error}")
            except RBFMuscleError as error:
                self._show_message(str(error))
            except Exception as error:  # noqa: BLE001 - whatever it is, the page goes on
                text = f"A bug: {type(error).__name__}: {error}; press Rest, and report it"
                self._show_message(text)
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

    def _rest(self, message: str) -> None:
        """Set controls and models to rest."""
        self._resting = False
        self._message = message
        self.panel.play.value = False
        self.panel.move_to({name: control.value for name, control in self.source.controls.items()})
        for side in self.sides:
            if side.figure is not None:
                side.figure.rest()

    def _draw(self, sides: list[ModelView], look: ViewSettings) -> None:
        with self.server.atomic():
            for side, other in zip(sides, sides[::-1] if len(sides) > 1 else [None]):
                side.draw(look, self._probes, None if other is None else other.picture)
            for side in self.sides:
                side.caption.visible = len(sides) > 1
            self._write()
            self.panel.plot_on(sides)

    def _show_message(self, text: str) -> None:
        """Show a text as one line, and stop the motion."""
        self._message = " ".join(text.split())[:LONGEST]
        self.panel.play.value = False
        self._write()

    def _write(self) -> None:
        sides = [side for side in self.sides if side.figure is not None]
        cost = f"{1e3 * self._cost:.0f} ms per picture"
        self.panel.write(sides, [self._message, *(side.picture.text for side in sides), cost])
