"""A window's scene whose coordinates are set by hand."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from rbfmuscle.geometry.surfaces import edge_lengths, mesh_volume, unique_edges
from rbfmuscle.report.viewer.viewer import View, Viewer
from rbfmuscle.scene.motion import inner_value, shown_value
from rbfmuscle.validation import SolveError

if TYPE_CHECKING:
    from rbfmuscle.simulation.live import LiveSession


ACTIVATION = "activation "  # what the name of a muscle's slider begins with
# Coordinates advance by so many sub-steps a picture, so that a picture never waits for a long way.
SUBSTEPS_A_PICTURE = 1


class LiveViewer(Viewer):
    """A scene whose coordinates are set by hand.

    Parameters
    ----------
    session : rbfmuscle.simulation.live.LiveSession
    build : callable
        ``build(model, quality)`` returns new models, one a muscle.
    models, qualities : list of str
        What may be switched to; the first is used.
    """

    live = True

    def __init__(
        self, session: LiveSession, build: Callable[..., Any], models: list[str], qualities: list[str]
    ) -> None:
        scene = session.scene
        bones = {
            bone.name: (np.asarray(bone.mesh.vertices), np.asarray(bone.mesh.faces)) for bone in scene.bones
        }
        super().__init__(scene.units, scene.length(1.0), bones, [m.name for m in scene.muscles])
        self.session, self.build = session, build
        self.models, self.qualities = list(models), list(qualities)
        self.model, self.quality = self.models[0], self.qualities[0]
        self.rest_volume = {m.name: float(m.mesh.volume) for m in scene.muscles}
        self.stride = SUBSTEPS_A_PICTURE * math.radians(scene.contact.substep_angle)
        self._built, self._edges, self._rate = {}, {}, 0.0
        self._frame: Any = None
        self._stale = True
        self._switch()

    def switch(self, *, model: str | None = None, quality: Any = None) -> None:
        """Use another model or quality; it starts at rest and goes to where the sliders are."""
        self.model, self.quality = model or self.model, quality or self.quality
        self._switch()

    def _switch(self):
        key = (self.model, self.quality)
        if key not in self._built:
            self._built[key] = [self.build(*key), None, {}]
        entry = self._built[key]
        entry[1] = self.session.use(entry[0], entry[1])
        self._edges = entry[2]
        for model in entry[0]:
            if model.name not in self._edges:
                carried, faces = model.material_mesh()
                edges = unique_edges(faces)
                self._edges[model.name] = edges, edge_lengths(carried, edges)
        self._stale, self.message = True, ""

    @property
    def coordinates(self) -> dict[str, Any]:
        """Name, limits and target of each coordinate [degree or scene unit], and of each activation (0 to 1)."""
        target, scene = self.session.target, self.session.scene
        return {
            name: tuple(shown_value(scene, name, value) for value in (low, high, target[name]))
            for name, (low, high) in self.session.limits.items()
        } | {ACTIVATION + name: (0.0, 1.0, value) for name, value in self.session.activation.items()}

    def set(self, name: str, degrees: float) -> None:
        """Move a slider."""
        if name.startswith(ACTIVATION):
            self.session.activate(name.removeprefix(ACTIVATION), degrees)
        else:
            self.session.set(name, inner_value(self.session.scene, name, degrees))

    def rest(self) -> None:
        """All sliders to where the meshes are."""
        for name, value in self.session.rest.items():
            self.session.set(name, value)
        for name in self.session.activation:
            self.session.activate(name, 0.0)

    def colour_by(self, name: str) -> None:
        """Show another quantity in colours."""
        super().colour_by(name)
        self._stale = True

    @property
    def pending(self) -> bool:
        """Whether there is something new to show."""
        return self._stale or not self.session.arrived

    def advance(self) -> View:
        """Go one picture further and return it; a muscle that cannot be solved sends all back to rest."""
        start = time.perf_counter()
        if self._frame is None or self._stale or not self.session.arrived:
            try:
                self._frame = self.session.advance(self.stride)
            except SolveError as error:
                self.rest()
                self.session.reset()
                self._frame = self.session.advance(self.stride)
                self.message = f"back to rest: {error}"
        self._stale = False
        self._rate = time.perf_counter() - start
        return self._view(self._frame)

    @property
    def frame(self) -> Any:
        """The frame shown last."""
        return self._frame

    def label(self) -> str:
        """Where the bones are, for file names."""
        return "_".join(
            f"{k.split('.')[-1]}{shown_value(self.session.scene, k, v):+.0f}"
            for k, v in self.session.here.items()
        )

    def _view(self, frame):
        view = View(frame.poses, {n: (s.vertices, s.faces) for n, s in frame.surfaces.items()})
        view.lines.append(f"{self.model}, {self.quality}: computed in {1e3 * self._rate:.0f} ms")
        for name, surface in frame.surfaces.items():
            error = mesh_volume(surface.vertices, surface.faces) / self.rest_volume[name] - 1.0
            depth = surface.quantities.get("solver_penetration_max", math.nan)
            view.lines.append(f"{name}: volume {100 * error:+.3f} %, in bone {depth:.2f} {self.units}")
            if self.colouring != "nothing":
                found = self._values(
                    name, surface.vertices, surface.faces, frame.poses, frame.carried[name], error
                )
                if self.colouring == "activation" and name in self.session.activation:
                    found = np.full(len(surface.vertices), frame.activations[name])
                view.values[name] = found
        if self.message:
            view.lines.append(self.message)
        return view

    def _rest_edges(self, name, carried, faces):
        return self._edges[name]

    def close(self) -> None:
        """End the session's threads."""
        self.session.close()
