"""What a window shows of a scene or a saved run, and what its switches do; no graphics here."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial import cKDTree

from rbfmuscle.geometry.surfaces import edge_lengths, mesh_volume, unique_edges
from rbfmuscle.sim.scene.motion import inner_value, shown_value
from rbfmuscle.sim.scene.scene import MM_PER_UNIT
from rbfmuscle.study.files.meshfiles import write_mesh
from rbfmuscle.study.measure.mesh_distance import MeshDistance
from rbfmuscle.study.measure.penetration import BoneProbe, bone_coordinates, surface_depth
from rbfmuscle.study.show.render import coordinate_texts
from rbfmuscle.validation import SolveError, UsageError

if TYPE_CHECKING:
    from rbfmuscle.sim.loop.driving.live import LiveSession
    from rbfmuscle.study.files.saved import SavedRun


# Colouring: name, what the bar says, limits ("length" ones in mm), colour map.
COLOURINGS = {
    "nothing": ("", (0.0, 1.0), ""),
    "penetration": ("depth in a bone", (0.0, 2.0), "inferno"),
    "distance": ("distance to bone", (0.0, 20.0), "viridis"),
    "stretch": ("stretch of edges", (-0.5, 0.5), "coolwarm"),
    "volume": ("volume error", (-0.01, 0.01), "coolwarm"),
    "fibres": ("stretch of fibres", (0.5, 1.5), "coolwarm"),
    "activation": ("activation", (0.0, 1.0), "Reds"),
}
LENGTHS = ("penetration", "distance")
CONTRACTION = ("fibres", "activation")  # colourings of muscles that contract
NEAREST_FIBRES = 4  # segments that speak for one vertex
ACTIVATION = "activation "  # what the name of a muscle's slider begins with
# Coordinates advance by so many sub-steps a picture, so that a picture never waits for a long way.
SUBSTEPS_A_PICTURE = 1


@dataclass
class View:
    """One picture's content.

    Attributes
    ----------
    poses : dict of str to (4, 4) ndarray
    surfaces : dict of str to (vertices, faces)
    values : dict of str to (n,) ndarray
        One number a vertex where the colouring asks for it, else empty.
    lines : list of str
        Metrics of the moment.
    """

    poses: dict
    surfaces: dict
    values: dict = field(default_factory=dict)
    lines: list = field(default_factory=list)


class Viewer:
    """State shared by live scenes and saved runs: colouring, export, the names of things.

    Parameters
    ----------
    units : str
    length : float
        A millimetre in these units.
    bones : dict of str to (vertices, faces)
        At rest.
    muscles : list of str
    """

    live = False

    def __init__(self, units: str, length: float, bones: dict[str, Any], muscles: list[str]) -> None:
        self.units, self.length = units, length
        self.bones, self.muscles = bones, list(muscles)
        self.colouring = "nothing"
        self.message = ""
        self._shots = 0

    @cached_property
    def probes(self) -> list[BoneProbe]:
        """The bones, prepared for exact distances."""
        import trimesh

        return [BoneProbe(name, trimesh.Trimesh(*mesh, process=False)) for name, mesh in self.bones.items()]

    @cached_property
    def _trees(self):
        return {name: MeshDistance(*mesh) for name, mesh in self.bones.items()}

    def colour_by(self, name: str) -> None:
        """Choose a colouring.

        Raises
        ------
        UsageError
            If it is unknown.
        """
        if name not in COLOURINGS:
            raise UsageError(f"unknown colouring {name!r}; known: {', '.join(COLOURINGS)}")
        self.colouring = name

    def scale(self) -> tuple[str, tuple[float, ...], str] | None:
        """Title, limits and colour map of the present colouring, or None."""
        if self.colouring == "nothing":
            return None
        title, limits, colours = COLOURINGS[self.colouring]
        if self.colouring in LENGTHS:
            return f"{title} [{self.units}]", tuple(v * self.length for v in limits), colours
        return title, limits, colours

    def export(self, view: View, folder: Path, label: str) -> list[Path]:
        """Write every surface of a view as PLY; returns the paths."""
        folder = Path(folder)
        folder.mkdir(parents=True, exist_ok=True)
        paths = [folder / f"{name}_{label}.ply" for name in view.surfaces]
        for path, (vertices, faces) in zip(paths, view.surfaces.values()):
            write_mesh(path, vertices, faces)
        return paths

    def next_name(self, folder: Any, suffix: Any) -> Any:
        """A file name in the folder that is not taken."""
        folder = Path(folder)
        folder.mkdir(parents=True, exist_ok=True)
        while True:
            path = folder / f"view_{self._shots:04d}{suffix}"
            if not path.exists():
                return path
            self._shots += 1

    def _distances(self, vertices, poses):
        found = np.full(len(vertices), np.inf)
        for name, tree in self._trees.items():
            np.minimum(found, tree.unsigned(bone_coordinates(vertices, poses[name])), out=found)
        return found

    def _values(self, name, vertices, faces, poses, carried, volume_error):
        """One number a vertex for the present colouring, or None where it cannot be known."""
        if self.colouring == "penetration":
            return surface_depth(vertices, self.probes, poses)
        if self.colouring == "distance":
            return self._distances(vertices, poses)
        if self.colouring == "stretch" and carried is not None:
            return self._stretch(name, vertices, *carried)
        if self.colouring == "volume":
            return np.full(len(vertices), volume_error)
        return None

    def _stretch(self, name, vertices, carried, faces):
        edges, rest = self._rest_edges(name, carried, faces)
        change = edge_lengths(carried, edges) / rest - 1.0
        total, count = np.zeros(len(carried)), np.zeros(len(carried))
        for end in edges.T:
            np.add.at(total, end, change)
            np.add.at(count, end, 1.0)
        mean = total / np.maximum(count, 1.0)
        return mean[cKDTree(carried).query(vertices)[1]]

    def _rest_edges(self, name, carried, faces):
        raise NotImplementedError


class LiveViewer(Viewer):
    """A scene whose coordinates are set by hand.

    Parameters
    ----------
    session : rbfmuscle.sim.loop.driving.live.LiveSession
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
        self._studies, self._rests = {}, {}
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
                carried, faces = model.carried_mesh()
                edges = unique_edges(faces)
                self._edges[model.name] = edges, edge_lengths(carried, edges)
                self._rests[(*key, model.name)] = carried, faces
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
                if self.colouring in CONTRACTION and name in self.session.activation:
                    found = self._contraction(name, frame)
                view.values[name] = found
        if self.message:
            view.lines.append(self.message)
        return view

    def _contraction(self, name, frame):
        """Activation of a muscle, or the stretch of its nearest fibres, at each vertex of its surface."""
        vertices = frame.surfaces[name].vertices
        if self.colouring == "activation":
            return np.full(len(vertices), frame.activations[name])
        key = (self.model, self.quality, name)
        if key not in self._studies:
            from rbfmuscle.study.measure.contraction import ContractionStudy

            scene = self.session.scene
            self._studies[key] = ContractionStudy(scene.muscle(name), scene.joints, *self._rests[key])
        middles, stretch = self._studies[key].stretches(frame.carried[name][0])
        distance, index = cKDTree(middles).query(vertices, k=min(NEAREST_FIBRES, len(middles)))
        share = 1.0 / np.maximum(distance, 1e-9 * np.ptp(vertices)) ** 2
        return (share * stretch[index]).sum(axis=1) / share.sum(axis=1)

    def _rest_edges(self, name, carried, faces):
        return self._edges[name]

    def close(self) -> None:
        """End the session's threads."""
        self.session.close()


class SavedViewer(Viewer):
    """A saved run, scrubbed by frame.

    Parameters
    ----------
    saved : SavedRun

    Raises
    ------
    UsageError
        If it holds no surfaces.
    """

    def __init__(self, saved: SavedRun) -> None:
        if not saved.has_surfaces():
            raise UsageError(f"{saved.directory} has no surfaces to show; run it with output.surfaces")
        bones = {name: saved.bone(name) for name in saved.bones}
        super().__init__(saved.units, 1.0 / MM_PER_UNIT[saved.units], bones, saved.muscles)
        self.saved, self.place = saved, 0
        self._kept, self._stale = {}, True
        self._metrics = {(r.frame, r.muscle, r.quantity): r.value for r in saved.metrics}

    @property
    def count(self) -> int:
        """Number of frames."""
        return len(self.saved.frames)

    def scrub(self, place: float) -> None:
        """Go to the frame at this place of those written."""
        place = min(max(round(place), 0), self.count - 1)
        self._stale = self._stale or place != self.place
        self.place = place

    def place_of(self, frame: int) -> int:
        """Place of a frame among those written.

        Raises
        ------
        UsageError
            If it was not written.
        """
        if frame not in self.saved.frames:
            first, last = self.saved.frames[0], self.saved.frames[-1]
            raise UsageError(f"frame {frame:g} was not written; the run has {first} to {last}")
        return self.saved.frames.index(frame)

    def colour_by(self, name: str) -> None:
        """Show another quantity in colours."""
        super().colour_by(name)
        self._stale = True

    @property
    def pending(self) -> bool:
        """Whether there is something new to show."""
        return self._stale

    def advance(self) -> View:
        """The present frame's picture."""
        self._stale = False
        frame = self.saved.frames[self.place]
        view = View(self.saved.poses[frame], {n: self._surface(n, frame) for n in self.muscles})
        entry = next(entry for entry in self.saved.info["frames"] if entry["frame"] == frame)
        angles = ", ".join(coordinate_texts(self.saved.info, entry))
        view.lines.append(f"frame {frame}: {angles}")
        for name, (vertices, faces) in view.surfaces.items():
            error = self._metrics.get((frame, name, "volume_error"), math.nan)
            depth = self._metrics.get((frame, name, "penetration_max"), math.nan)
            view.lines.append(f"{name}: volume {100 * error:+.3f} %, in bone {depth:.2f} {self.units}")
            first = self._surface(name, self.saved.frames[0])
            same = np.array_equal(first[1], faces)
            view.values[name] = self._values(
                name, vertices, faces, view.poses, (vertices, faces) if same else None, error
            )
        if self.colouring == "stretch" and any(v is None for v in view.values.values()):
            view.lines.append(
                "stretch: only for surfaces of constant topology in a saved run; use a live scene"
            )
        return view

    def label(self) -> Any:
        """The frame, for file names."""
        return f"{self.saved.frames[self.place]:04d}"

    def _surface(self, name, frame):
        if (name, frame) not in self._kept:
            first = self.saved.frames[0]
            self._kept = {key: mesh for key, mesh in self._kept.items() if key[1] in (first, frame)}
            self._kept[name, frame] = self.saved.surface(name, frame)
        return self._kept[name, frame]

    def _rest_edges(self, name, carried, faces):
        first = self._surface(name, self.saved.frames[0])
        edges = unique_edges(first[1])
        return edges, edge_lengths(first[0], edges)

    def close(self) -> None:
        """Nothing is held open."""
