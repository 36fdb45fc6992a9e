"""The controls of the page, of viser's own elements; values are read from these when they are
needed.
"""

import html
import math
from collections.abc import Callable
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from rbfmuscle.output.appearance import VIEWS
from rbfmuscle.viewer.marks import KINDS
from rbfmuscle.viewer.side import COLOURINGS, ModelView, ViewSettings, legend
from rbfmuscle.viewer.sources import LiveSource, SavedSource

if TYPE_CHECKING:
    from viser import GuiInputHandle, GuiUplotHandle, ViserServer

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
        self.gui.configure_theme(show_logo=False, show_share_button=False)
        self.gui.main_panel.dock_right()
        self.gui.main_panel.set_width(WIDTH)
        self._numbers, tabs = self.gui.add_html(""), self.gui.add_tab_group()
        with tabs.add_tab("Move"):
            self._add_controls(at)
        with tabs.add_tab("Show"):
            self._add_choices(colour)
        with tabs.add_tab("Plot") as self._tab:
            depth = f"depth in bones [{source.units}]"
            arm = f"moment arm [{source.units}]"
            quantities = ("none", "volume error [%]", depth, arm, "mean of the colour")
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
        self._add_marks()
        self.eyes = {}
        for title, names in (("Muscles", self.source.muscles), ("Bones", self.source.bones)):
            with gui.add_folder(title, expand_by_default=False):
                self.eyes |= {name: self._watch(gui.add_checkbox(name, True)) for name in names}

    def _add_marks(self) -> None:
        marks = self.source.marks
        kinds = KINDS if marks.held else KINDS[-1:]
        with self.gui.add_folder("Marks", expand_by_default=False):
            self.marks = {kind: self._watch(self.gui.add_checkbox(kind, False)) for kind in kinds}
        if marks.doubts:
            with self.gui.add_folder(f"Doubts ({len(marks.doubts)})", expand_by_default=False):
                lines = "".join(f"<li>{html.escape(doubt)}</li>" for doubt in marks.doubts)
                self.gui.add_html(f"<ul style='font-size:12px;padding:0 24px'>{lines}</ul>")

    def look(self) -> ViewSettings:
        """All that decides how a picture is shown."""
        cut = None
        if self.cut.value != "none":
            axis = "xyz".index(self.cut.value)
            points = np.concatenate(
                [vertices[:, axis] for vertices, _ in self.source.muscles.values()]
            )
            cut = axis, float(points.min() + self.place.value * np.ptp(points))
        hidden = frozenset(name for name, eye in self.eyes.items() if not eye.value)
        others = *(model.value for model in self.models), self.quantity.value
        marks = frozenset(kind for kind, box in self.marks.items() if box.value)
        return ViewSettings(self.colour.value, hidden, cut, others, marks)

    def move_to(self, values: dict[str, float]) -> None:
        """Set controls."""
        for name, value in values.items():
            self.controls[name].value = value

    def follow_motion(self, arrived: bool) -> None:
        """Set the controls to the frame of the motion where the play bar is: the next one while it
        plays and pictures have ``arrived`` at the one before.
        """
        if self.play.value and arrived:
            self.frame.value = (self.frame.value + 1) % len(self.source.motion)
        if self.frame.value != self._followed:
            self._followed = self.frame.value
            self.move_to(self.source.motion[self.frame.value])

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
