"""A window's saved run, scrubbed by frame."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from rbfmuscle.geometry.surfaces import edge_lengths, unique_edges
from rbfmuscle.output.saved import coordinate_texts
from rbfmuscle.report.viewer.viewer import View, Viewer
from rbfmuscle.scene.objects import MM_PER_UNIT
from rbfmuscle.validation import UsageError

if TYPE_CHECKING:
    from rbfmuscle.output.saved import SavedRun


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
