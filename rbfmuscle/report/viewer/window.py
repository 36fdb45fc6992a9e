"""The window of ``rbfmuscle view``: pyvista's part, fed by a `Viewer`."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

from rbfmuscle.geometry.surfaces import vertex_normals
from rbfmuscle.output.colours import BONE_COLOUR, muscle_colours
from rbfmuscle.report.appearance import BACKGROUND
from rbfmuscle.report.viewer.viewer import COLOURINGS
from rbfmuscle.validation import MissingPartError

KEYS = "m model   k quality   c colour   space motion   h rest   i screenshot   x export   q close"
# A picture every so many milliseconds at most, while anything moves.
_TICK = 10
_BONE_TRIANGLES = 6_000
_SIZE = (1120, 780)
_SMALL = 9
_SAMPLES = 8  # a pixel, in pictures that are kept
# From one slider to the next, as a share of the window's height.
_ROW = 0.095
_LOOK = {"style": "modern", "color": "#444444"}
_REMEDY = (
    "log in on a desktop, use ssh -X, or start it with xvfb-run; "
    "without any, 'rbfmuscle run' and 'rbfmuscle render' draw to files"
)
_PROBE = (
    "import vtk; w = vtk.vtkRenderWindow(); w.SetSize(16, 16); w.AddRenderer(vtk.vtkRenderer()); w.Render(); "
    "w.Finalize()"
)


def require_display() -> None:
    """Raise MissingPartError where no window can be opened; VTK itself would end the process.

    The test opens a small window in a child process.
    """
    if sys.platform.startswith("linux") and not os.environ.get("DISPLAY"):
        raise MissingPartError(f"no display to open a window on (DISPLAY is not set): {_REMEDY}")
    try:
        done = subprocess.run(
            [sys.executable, "-c", _PROBE], capture_output=True, text=True, timeout=60, check=False
        )
    except subprocess.TimeoutExpired:
        raise MissingPartError(f"opening a window took longer than 60 s: {_REMEDY}") from None
    if done.returncode != 0 or "bad X server" in done.stderr:
        where = os.environ.get("DISPLAY", "")
        raise MissingPartError(f"no window can be opened on display {where!r}: {_REMEDY}")


class Window:
    """Bones, muscles, sliders and switches.

    Parameters
    ----------
    viewer : LiveViewer or SavedViewer
    folder : path
        Where screenshots and exported surfaces go.
    motion : list of dict, optional
        Coordinates [degree] that the space bar plays, for a live scene.

    Attributes
    ----------
    latencies : list of float
        From the moment a slider was moved to the picture that shows it [s].
    """

    def __init__(
        self, viewer: Any, folder: str | Path, *, motion: list[Any] | None = None, title: str = "rbfmuscle"
    ) -> None:
        import pyvista

        self.viewer, self.folder, self.motion = viewer, folder, motion or []
        self.latencies, self._touched, self._paces = [], None, []
        self._played: int | None = None
        self.plotter = pyvista.Plotter(window_size=_SIZE, title=title)
        self.plotter.set_background(BACKGROUND)
        # Software drawing takes three to four times as long with several samples a pixel.
        self.plotter.render_window.SetMultiSamples(0)
        self.colours = muscle_colours(viewer.muscles)
        self.bones = {name: self._add_bone(mesh) for name, mesh in viewer.bones.items()}
        self.skins, self.sliders, self.switches, self._bar = {}, {}, {}, None
        self.text = self.plotter.add_text("", position="upper_left", font_size=_SMALL, color="#333333")
        self.plotter.add_text(KEYS, position="lower_left", font_size=7, color="#777777")
        self._add_sliders()
        self._add_keys()
        self.view: Any = None
        self.refresh(render=False)
        self._aim()

    # --- drawing ------------------------------------------------------------------------------------------

    def refresh(self, *, render: bool = True) -> None:
        """Compute the next picture and draw it."""
        start = time.perf_counter()
        self.view = self.viewer.advance()
        for name, actor in self.bones.items():
            actor.user_matrix = self.view.poses[name]
        for name, (vertices, faces) in self.view.surfaces.items():
            self._draw_muscle(name, vertices, faces)
        self._draw_bar()
        self._write()
        if render:
            self.plotter.render()
            if self._touched is not None:
                self.latencies.append(time.perf_counter() - self._touched)
                self._touched = None
        self._paces = [*self._paces[-9:], time.perf_counter() - start]

    def _draw_muscle(self, name, vertices, faces):
        import pyvista

        mesh = pyvista.make_tri_mesh(vertices, faces)
        mesh.point_data.active_normals = vertex_normals(vertices, faces)
        values = self.view.values.get(name)
        scale = self.viewer.scale()
        if name not in self.skins:
            self.skins[name] = self.plotter.add_mesh(
                mesh, color=self.colours[name], smooth_shading=True, specular=0.25, specular_power=18,
                ambient=0.12, render=False, reset_camera=False,
            )  # fmt: skip
        mapper = self.skins[name].mapper
        if values is None or scale is None:
            mapper.scalar_visibility = False
        else:
            mesh.point_data["value"] = values
            mesh.set_active_scalars("value")
            mapper.scalar_visibility = True
            mapper.lookup_table = self._table(scale)
            mapper.scalar_range = scale[1]
        mapper.dataset = mesh

    def _table(self, scale):
        import pyvista

        return pyvista.LookupTable(cmap=scale[2], scalar_range=scale[1])

    def _draw_bar(self):
        scale = self.viewer.scale()
        if scale == self._bar:
            return
        if self._bar is not None:
            self.plotter.remove_scalar_bar(self._bar[0], render=False)
        self._bar = scale
        if scale is not None:
            mapper = next(iter(self.skins.values())).mapper
            mapper.lookup_table = self._table(scale)
            mapper.scalar_range = scale[1]
            self.plotter.add_scalar_bar(
                scale[0], mapper=mapper, vertical=True, position_x=0.86, position_y=0.55, height=0.35,
                width=0.05, color="#333333", title_font_size=13, label_font_size=12, render=False,
            )  # fmt: skip

    def _write(self):
        pace = np.mean(self._paces) if self._paces else 0.0
        rate = f"{1.0 / pace:.0f} pictures a second" if pace > 0 else ""
        self.text.set_text("upper_left", "\n".join([rate, *self.view.lines]))

    def _add_bone(self, mesh):
        import pyvista

        mesh = pyvista.make_tri_mesh(*mesh)
        if mesh.n_cells > _BONE_TRIANGLES:  # software drawing pays for each of them in every frame
            mesh = mesh.decimate(1.0 - _BONE_TRIANGLES / mesh.n_cells)
        mesh = mesh.compute_normals(split_vertices=False, auto_orient_normals=False)
        return self.plotter.add_mesh(
            mesh, color=BONE_COLOUR, smooth_shading=True, specular=0.2, ambient=0.12, render=False,
            reset_camera=False,
        )  # fmt: skip

    def _aim(self):
        """From behind and the side, the muscles in the middle; z is up."""
        points = np.concatenate([vertices for vertices, _ in self.view.surfaces.values()])
        low, high = points.min(axis=0), points.max(axis=0)
        size = float(np.linalg.norm(high - low))
        camera = self.plotter.camera
        camera.focal_point = (low + high) / 2
        camera.position = (low + high) / 2 + size * np.array([-1.4, 1.6, 0.5])
        camera.up = (0.0, 0.0, 1.0)
        self.plotter.reset_camera_clipping_range()

    # --- controls -----------------------------------------------------------------------------------------

    def _add_sliders(self):
        if self.viewer.live:
            for k, (name, (low, high, value)) in enumerate(self.viewer.coordinates.items()):
                self._slider(name, (low, high), value, k, lambda v, name=name: self._set(name, v))
            self._switch("model", self.viewer.models, lambda v: self._change(model=v), 0)
            self._switch("quality", self.viewer.qualities, lambda v: self._change(quality=v), 1)
        else:
            self._slider("frame", (0, self.viewer.count - 1), 0, 0, self._scrub)
        self._switch("colour", list(COLOURINGS), self._colour, 2)

    def _slider(self, title, limits, value, row, act):
        y = 0.09 + _ROW * row
        self.sliders[title] = self.plotter.add_slider_widget(
            act, limits, value=value, title=title, pointa=(0.66, y), pointb=(0.97, y),
            interaction_event="always", fmt="%.0f", **_LOOK,
        )  # fmt: skip
        self._trim(self.sliders[title])

    def _switch(self, title, choices, act, row):
        """A slider with names for its places."""
        if len(choices) < 2:
            return
        y = 0.09 + _ROW * row
        now = getattr(self.viewer, {"colour": "colouring"}.get(title, title))
        shown = {f"{title}: {choice}": choice for choice in choices}
        widget = self.plotter.add_text_slider_widget(
            lambda text: act(shown[text]), list(shown), value=choices.index(now), pointa=(0.03, y),
            pointb=(0.26, y), interaction_event="end", **_LOOK,
        )  # fmt: skip
        self._trim(widget)
        self.switches[title] = (widget, choices, act)

    @staticmethod
    def _trim(widget):
        bar = widget.GetRepresentation()
        bar.SetTitleHeight(0.016)
        bar.SetLabelHeight(0.016)
        bar.SetSliderLength(0.018)
        bar.SetSliderWidth(0.014)
        bar.SetTubeWidth(0.003)

    def _add_keys(self):
        keys = {"m": "model", "k": "quality", "c": "colour"}
        for key, title in keys.items():
            self.plotter.add_key_event(key, lambda title=title: self.next_choice(title))
        self.plotter.add_key_event("space", self.play)
        self.plotter.add_key_event("h", self.rest)
        self.plotter.add_key_event("i", self.screenshot)
        self.plotter.add_key_event("x", self.export)

    def _set(self, name, degrees):
        self._touch()
        self.viewer.set(name, degrees)

    def _scrub(self, place):
        self._touch()
        self.viewer.scrub(place)

    def _touch(self):
        if self._touched is None:
            self._touched = time.perf_counter()

    def _change(self, **what):
        if all(getattr(self.viewer, key) == value for key, value in what.items()):
            return
        self.text.set_text("upper_left", "building muscles ...")
        self.plotter.render()
        self.viewer.switch(**what)

    def _colour(self, name):
        self.viewer.colour_by(name)

    def next_choice(self, title: Any) -> None:
        """Go on to the next model, quality or colouring."""
        if title not in self.switches:
            return
        widget, choices, act = self.switches[title]
        bar = widget.GetRepresentation()
        place = (round(bar.GetValue()) + 1) % len(choices)
        bar.SetValue(place)
        bar.SetTitleText(f"{title}: {choices[place]}")
        act(choices[place])

    def play(self) -> None:
        """Play the scene's motion, or stop it."""
        self._played = 0 if self._played is None else None

    def rest(self) -> None:
        """All sliders to zero."""
        self._played = None
        for name, widget in self.sliders.items():
            widget.GetRepresentation().SetValue(0.0)
            if self.viewer.live:
                self.viewer.set(name, 0.0)
            else:
                self.viewer.scrub(0)

    def screenshot(self) -> Any:
        """Write the window as PNG to the folder; returns the path."""
        path = self.viewer.next_name(self.folder, ".png")
        self.write_picture(path)
        print(path, file=sys.stderr)
        return path

    def write_picture(self, path: Path) -> None:
        """Write the window as PNG, with smooth edges."""
        self.plotter.render_window.SetMultiSamples(_SAMPLES)
        self.plotter.render()
        self.plotter.screenshot(path)
        self.plotter.render_window.SetMultiSamples(0)

    def export(self) -> Any:
        """Write the surfaces shown as PLY to the folder; returns the paths."""
        paths = self.viewer.export(self.view, self.folder, self.viewer.label())
        for path in paths:
            print(path, file=sys.stderr)
        return paths

    # --- the loop -----------------------------------------------------------------------------------------

    def tick(self) -> Any:
        """One turn of the loop: play on, then draw if there is anything new; returns whether there was."""
        if self._played is not None:
            self._play_on()
        if not self.viewer.pending:
            return False
        self.refresh()
        return True

    def _play_on(self):
        if not self.viewer.live:
            self._show_frame((self.viewer.place + 1) % self.viewer.count)
        elif self.motion and self.viewer.session.arrived:
            for name, degrees in self.motion[self._played % len(self.motion)].items():
                self.viewer.set(name, degrees)
                self.sliders[name].GetRepresentation().SetValue(degrees)
            self._played += 1

    def _show_frame(self, place):
        self.viewer.scrub(place)
        self.sliders["frame"].GetRepresentation().SetValue(place)

    def open(self, *, until_closed: bool = True) -> None:
        """Show the window; returns when it is closed, or at once."""
        self.plotter.show(interactive=False, auto_close=False, interactive_update=True)
        if not until_closed:
            return
        interactor = self.plotter.iren.interactor
        interactor.AddObserver("TimerEvent", lambda *_: self.tick())
        interactor.CreateRepeatingTimer(_TICK)
        interactor.Start()
        self.close()

    def close(self) -> None:
        """Take the window away."""
        self.plotter.close()
        self.viewer.close()
