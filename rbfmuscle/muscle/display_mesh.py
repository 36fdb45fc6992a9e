"""The mesh of a muscle's material that shows it: where its vertices lie at rest."""

import numpy as np

from rbfmuscle.geometry.arrays import Floats
from rbfmuscle.geometry.rest_frame import RestFrame
from rbfmuscle.geometry.rotations import smooth_displacement
from rbfmuscle.implicit.extraction.material import project_to_level_set
from rbfmuscle.implicit.extraction.material_mesh import MaterialMesh, mend_slivers
from rbfmuscle.muscle.options import RBFOptions
from rbfmuscle.muscle.placement import cached_sample
from rbfmuscle.muscle.rest import RestState
from rbfmuscle.scene.objects import Muscle

# Edges of the shown mesh for each thickness of a muscle, and bounds on its vertices: by themselves,
# and asked for.
EDGES_THROUGH = 3.0
USUAL = (2500, 4000)
WANTED = (200, 12_000)
# Vertices of a triangulation on an area of one edge squared.
VERTICES_AN_EDGE = 1.15


def display_vertices(muscle: Muscle, resolution: int) -> int:
    """Vertices of the shown mesh of a muscle: three edges through its mean thickness.

    With a ``resolution`` above 0, so many edges along its longest side.
    """
    mesh, (low, high) = muscle.mesh, WANTED if resolution else USUAL
    edge = 2.0 * float(mesh.volume) / (float(mesh.area) * EDGES_THROUGH)
    if resolution:
        points = np.asarray(mesh.vertices, dtype=float)
        axes = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2]
        edge = float(np.ptp(points @ axes.T, axis=0).max()) / resolution
    return int(np.clip(VERTICES_AN_EDGE * float(mesh.area) / edge**2, low, high))


class DisplayMesh:
    """A triangulation of the rest surface that the solid carries along.

    Its vertices ``rest`` (n, 3) lie on the level set that has the mesh's volume.
    """

    def __init__(self, muscle: Muscle, rest: RestState, options: RBFOptions) -> None:
        frame = RestFrame(np.asarray(muscle.mesh.vertices, dtype=float))
        count = display_vertices(muscle, options.resolution)
        faces = np.asarray(muscle.mesh.faces)
        sample = cached_sample(frame.local, faces, count, "adaptive")
        points = frame.points(sample.points)
        self.mesh = MaterialMesh(points, sample.control_faces)
        self.rest = self._on_level(rest, points)
        self._sides = self._lengths(self.rest)

    def _on_level(self, rest: RestState, points: np.ndarray) -> np.ndarray:
        """The vertices on the level set at rest, where they stay as part of the material."""
        try:
            field = rest.field(rest.centres, rest.normals)

            def onto(mesh: MaterialMesh, vertices: Floats) -> Floats:
                return project_to_level_set(mesh, vertices, field, volume=rest.mesh_volume).vertices

            self.mesh, vertices = mend_slivers(self.mesh, onto(self.mesh, points), onto)
        except (ValueError, np.linalg.LinAlgError):
            # What the input mesh holds is a surface too; the frames say what is wrong with the
            # field.
            return points
        self.mesh.slope = np.linalg.norm(field.value_and_gradient(vertices)[1], axis=1)
        return vertices

    def smooth_displacement(self, vertices: np.ndarray, sweeps: int) -> np.ndarray:
        """The shape at rest, moved to vertices (n, 3) and deformed as these are where that is
        smooth.

        What the material does beside the rigid motion is smoothed in so many sweeps.
        """
        rows = np.arange(len(vertices))
        return smooth_displacement(
            self.rest, vertices, lambda beside: self.mesh.smooth(beside, rows, sweeps)
        )

    def stretch(self, vertices: np.ndarray) -> float:
        """Length of edges relative to rest that a tenth of them exceeds."""
        return float(np.percentile(self._lengths(vertices) / self._sides, 90.0))

    def _lengths(self, vertices: Floats) -> Floats:
        sides = vertices[self.mesh.faces] - vertices[np.roll(self.mesh.faces, 1, axis=1)]
        return np.maximum(np.linalg.norm(sides, axis=2), np.finfo(float).tiny)
