"""The off-screen window that pictures of runs are drawn in."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

from rbfmuscle.geometry.arrays import Floats
from rbfmuscle.geometry.surfaces import vertex_normals
from rbfmuscle.output.saved import SavedRun
from rbfmuscle.report.appearance import BACKGROUND, BONE_COLOUR, VIEWS, aim_camera, neighbour_colours
from rbfmuscle.report.paint import PAINT_COLOURS

_PAINT = "paint"
_BONE_TRIANGLES = 12_000


class Stage:
    """An off-screen window with several panels, each aimed at the muscles' whole path.

    Parameters
    ----------
    rows : list of list of (SavedRun, str)
        What each panel shows: a run, and the view of it. Runs of several panels are of one scene.
    size : (width, height)
        Of a panel [pixel].
    paint : callable, optional
        ``paint(saved, muscle, frame, vertices)`` gives values (n,) from 0 to 1 to colour a muscle by; plain
        colours where not given.
    """

    def __init__(self, rows: list[Any], size: Any, paint: Callable[..., Any] | None = None) -> None:
        import pyvista

        self.paint = paint
        self.panels = [
            (i, j, saved, view) for i, row in enumerate(rows) for j, (saved, view) in enumerate(row)
        ]
        shape = (len(rows), len(rows[0]))
        window = (size[0] * shape[1], size[1] * shape[0])
        self.plotter = pyvista.Plotter(off_screen=True, shape=shape, border=False, window_size=window)
        self.plotter.set_background(BACKGROUND)
        # Edges are smoothed in the finished picture. Set past pyvista, which would draw it many times as large where
        # there is no graphics card, at twice the time; several samples a pixel cost more still.
        self.plotter.render_window.SetMultiSamples(0)
        first = rows[0][0][0]
        self.first, self.colours = first, neighbour_colours(first)
        self.bones = [(name, self._add_bone(first.bone(name))) for name in first.bones]
        # Of each run's muscle: its mesh, and its actor in all panels.
        self.skins: dict[Any, tuple[Any, Any]] = {}
        bounds = path_bounds({id(saved): saved for row in rows for saved, _ in row}.values())
        for i, j, _, view in self.panels:
            self.plotter.subplot(i, j)
            aim_camera(self.plotter.camera, VIEWS[view][0], bounds, size)
            self.plotter.renderer.SetUseFXAA(True)

    def show(self, frame: int) -> Any:
        """Put bones and muscles where they are in a frame, and return the picture (h, w, 3) uint8."""
        for name, actor in self.bones:
            actor.user_matrix = self.first.poses[frame][name]
        for saved in {id(saved): saved for _, _, saved, _ in self.panels}.values():
            for muscle in saved.muscles:
                self._show_skin(saved, muscle, frame)
        for renderer in self.plotter.renderers:
            renderer.ResetCameraClippingRange()
        self.plotter.render()  # a screenshot alone shows what was drawn last
        return self.plotter.screenshot(return_img=True)

    def close(self) -> None:
        """Let the plotter go."""
        self.plotter.close()

    def _add_bone(self, mesh):
        import pyvista

        mesh = pyvista.make_tri_mesh(*mesh)
        if mesh.n_cells > _BONE_TRIANGLES:  # software drawing pays for each of them in every frame
            mesh = mesh.decimate(1.0 - _BONE_TRIANGLES / mesh.n_cells)
        mesh = mesh.compute_normals(split_vertices=False, auto_orient_normals=False)
        return self._add(self.panels, mesh, BONE_COLOUR)

    def _show_skin(self, saved, muscle, frame):
        """A muscle in all panels of its run: moved where its faces are those of the frame before, else made anew."""
        import pyvista

        vertices, faces = saved.surface(muscle, frame)
        mesh, actor = self.skins.get((id(saved), muscle), (None, None))
        known = mesh is not None and np.array_equal(mesh.regular_faces, faces)
        if known:
            mesh.points = vertices
        else:
            mesh = pyvista.make_tri_mesh(vertices, faces)
        # Set and not computed by the plotter, which would do it again for every panel.
        mesh.point_data.active_normals = vertex_normals(vertices, np.asarray(faces)).astype(np.float32)
        if self.paint is not None:
            mesh.point_data[_PAINT] = self.paint(saved, muscle, frame, np.asarray(mesh.points))
        if known:
            return
        panels = [panel for panel in self.panels if panel[2] is saved]
        if actor is not None:
            self.plotter.remove_actor(actor, render=False)
        self.skins[id(saved), muscle] = mesh, self._add(panels, mesh, self.colours[muscle])

    def _add(self, panels, mesh, colour):
        """One actor in all of some panels, so that the mesh goes to the graphics once."""
        self.plotter.subplot(*panels[0][:2])
        painted = _PAINT in mesh.point_data
        actor = self.plotter.add_mesh(
            mesh,
            color=None if painted else colour,
            scalars=_PAINT if painted else None,
            cmap=PAINT_COLOURS,
            clim=(0.0, 1.0),
            show_scalar_bar=False,
            smooth_shading=True,
            specular=0.25,
            specular_power=18,
            ambient=0.12,
            render=False,
            reset_camera=False,
        )
        for i, j, _, _ in panels[1:]:
            self.plotter.subplot(i, j)
            self.plotter.renderer.AddActor(actor)
        return actor


def path_bounds(runs: Iterable[SavedRun]) -> Floats:
    """Box around the muscles of all runs in the first, middle and last frame."""
    boxes = np.array([saved.path_bounds for saved in runs])
    return np.array([boxes[:, 0].min(axis=0), boxes[:, 1].max(axis=0)])
