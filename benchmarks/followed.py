"""The surface that keeps its vertices beside marching cubes: time, distance, triangles, and how steadily vertices go.

python benchmarks/followed.py .../hip/flexion.toml .../hip/extension.toml [...] [--every 5] [--cells 128]

For each motion and muscle, the same fields for both surfaces: time of the fit and of either surface (medians over the
frames, in turns on one thread); distance of the vertices from the surface extracted with so many cells where no bone
is near, and back, and from the surface extracted at the same level (what is left of it where both have one level, so no
longer one volume); error of the volume; triangles that look inwards, and smallest angles; greatest way of a vertex
from frame to frame beside the bone that it follows best, as the worst frame's over the median frame's.
"""

import argparse
import time
from itertools import pairwise
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

from rbfmuscle.geometry.exact_distance import ExactDistance
from rbfmuscle.geometry.surfaces import face_normals, mesh_volume, vertex_normals
from rbfmuscle.implicit.extraction.surface import extract_surface
from rbfmuscle.model import drawing
from rbfmuscle.models import build_models
from rbfmuscle.sim.loop.simulate import simulate_frames
from rbfmuscle.sim.scene.scene import Scene

# What is nearer to a bone than so many mean edges may lie on a cut.
CUT = 1.0
HEAD = (
    "motion", "muscle", "fit ms", "kept surface ms", "48 cells ms", "with fit, kept : 48 cells",
    "to the fine surface, RMS / max mm", "back", "to the fine surface of its own level", "volume", "inverted",
    "angle, 1st percentile, worst frame", "greatest way, worst / median frame mm",
)  # fmt: skip


def record(scene: Scene) -> tuple[list, dict]:
    """All drawings of a motion as (drawer, moment, contacts), and the scene's frames by muscle."""
    made, start = [], drawing.RBFDrawing.__init__

    def keep(self, drawer, now, contacts):
        start(self, drawer, now, contacts)
        moment = drawing.Moment(*(None if part is None else np.array(part) for part in now))
        made.append((drawer, moment, self._contacts))

    drawing.RBFDrawing.__init__ = keep
    try:
        frames = list(simulate_frames(scene, build_models(scene), ahead=False))
    finally:
        drawing.RBFDrawing.__init__ = start
    return made, frames


def timed(act) -> tuple:
    """What a call returns, and its processor time [ms]."""
    started = time.process_time()
    found = act()
    return found, 1e3 * (time.process_time() - started)


def times_of(kept: list) -> np.ndarray:
    """Median milliseconds of the fit, the kept surface and marching cubes at 48 cells."""
    rows = []
    for drawer, now, contacts in kept:
        field, fit = timed(lambda d=drawer, n=now: d.rest.fit.fit(n.centres, n.normals))
        _, kept_time = timed(
            lambda d=drawer, n=now, c=contacts, f=field: d._of_material(lambda: f, n.carried, c)
        )
        _, marched = timed(lambda d=drawer, n=now, c=contacts, f=field: d._march(lambda: f, n, c))
        rows.append((fit, kept_time, marched))
    return np.median(rows, axis=0)


def away_from(kept: tuple, surface: object, level: float, cells: int) -> tuple:
    """Distances [mm] where no bone is near: to so many cells, back, and to the same of the surface's own level."""
    drawer, now, contacts = kept
    field = drawer.rest.fit.fit(now.centres, now.normals)
    edge = drawer.shown.mesh.edge(surface.vertices)
    where = {"axes": drawer._axes(contacts), "obstacles": drawer._obstacles(contacts)}
    cut = drawing._BoneCut(contacts, 2.0 * edge)
    marched = [
        extract_surface(
            field, points=now.points, resolution=cells, cut=cut, volume=volume, level=level, **where
        )
        for volume in (drawer.rest.mesh_volume, None)
    ]
    found = []
    for one, other in ((surface, marched[0]), (marched[0], surface), (surface, marched[1])):
        free = contacts.nearest(one.vertices, 2 * edge) > CUT * edge
        found.append(np.abs(ExactDistance(other.vertices, other.faces).signed_distance(one.vertices[free])))
    return tuple(found)


def angles_of(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Smallest angle of each triangle [degree]."""
    sides = [vertices[faces[:, (k + 1) % 3]] - vertices[faces[:, k]] for k in range(3)]
    smallest = np.full(len(faces), 180.0)
    for k in range(3):
        one, other = sides[k], -sides[k - 1]
        cosine = (
            np.einsum("nd,nd->n", one, other) / np.linalg.norm(one, axis=1) / np.linalg.norm(other, axis=1)
        )
        smallest = np.minimum(smallest, np.degrees(np.arccos(np.clip(cosine, -1, 1))))
    return smallest


def inverted(vertices: np.ndarray, faces: np.ndarray) -> int:
    """Triangles that look away from all three of their corners' normals."""
    corners, normals = vertex_normals(vertices, faces), face_normals(vertices, faces)
    return int((np.einsum("mkd,md->mk", corners[faces], normals) < 0.0).all(axis=1).sum())


def greatest_ways(frames: list, name: str) -> np.ndarray:
    """Greatest way of a vertex between frames beside the bone that it follows best, for each pair of frames."""
    found = []
    for before, after in pairwise(frames):
        one, other = before.surfaces[name].vertices, after.surfaces[name].vertices
        least = np.full(len(one), np.inf)
        for bone, pose in after.poses.items():
            step = pose @ np.linalg.inv(before.poses[bone])
            least = np.minimum(least, np.linalg.norm(other - one @ step[:3, :3].T - step[:3, 3], axis=1))
        found.append(least.max())
    return np.array(found)


def measure(path: Path, every: int, cells: int) -> None:
    """Print the rows of one motion."""
    scene = Scene.load(path)
    made, frames = record(scene)
    for muscle in scene.muscles:
        kept = [row for row in made if row[0].name == muscle.name][-len(frames) :]
        fit, surface_time, marched = times_of(kept)
        surfaces = [frame.surfaces[muscle.name] for frame in frames]
        levels = [surface.quantities["level"] for surface in surfaces]
        apart = [away_from(kept[k], surfaces[k], levels[k], cells) for k in range(0, len(frames), every)]
        there, back, alike = (np.concatenate([row[side] for row in apart]) for side in range(3))
        rest = kept[0][0].rest.mesh_volume
        volume = max(abs(mesh_volume(s.vertices, s.faces) / rest - 1.0) for s in surfaces)
        angles = [angles_of(s.vertices, s.faces) for s in surfaces]
        ways = greatest_ways(frames, muscle.name)
        percentiles = [np.percentile(a, 1) for a in angles]
        cells_of_row = (
            path.stem, muscle.name, f"{fit:.1f}", f"{surface_time:.1f}", f"{marched:.1f}",
            f"{(fit + surface_time) / (fit + marched):.2f}", f"{np.sqrt((there**2).mean()):.3f} / {there.max():.2f}",
            f"{np.sqrt((back**2).mean()):.3f} / {back.max():.2f}",
            f"{np.sqrt((alike**2).mean()):.3f} / {alike.max():.2f}", f"{volume:.0e}",
            f"{sum(inverted(s.vertices, s.faces) for s in surfaces)}", f"{min(percentiles):.1f}",
            f"{ways.max():.2f} / {np.median(ways):.2f} = {ways.max() / np.median(ways):.1f}",
        )  # fmt: skip
        print(f"| {' | '.join(cells_of_row)} |", flush=True)


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scenes", nargs="+", type=Path, metavar="SCENE.toml")
    parser.add_argument("--every", type=int, default=5)
    parser.add_argument("--cells", type=int, default=128)
    given = parser.parse_args()
    print(f"| {' | '.join(HEAD)} |")
    print("|" + "---|" * len(HEAD))
    with threadpool_limits(1):
        for path in given.scenes:
            measure(path, given.every, given.cells)


if __name__ == "__main__":
    main()
