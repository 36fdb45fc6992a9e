"""A triangulation that goes with the material and is brought onto a level set: no grid, one topology.

Vertices go onto the zero set of max(f - s, -d) by Newton steps, the level s follows from the volume as for the marched
mesh, and what a fold of the field or the edge of a bone has turned inside out is smoothed.
"""

from dataclasses import dataclass

import numpy as np

from rbfmuscle.geometry.arrays import Floats
from rbfmuscle.geometry.fields import ClipDistance, Field
from rbfmuscle.geometry.surfaces import mesh_volume, vertex_normals
from rbfmuscle.implicit.extraction.carried_material import CarriedMaterial
from rbfmuscle.implicit.extraction.material_mesh import MaterialMesh
from rbfmuscle.implicit.extraction.obstacles import Obstacles
from rbfmuscle.implicit.extraction.surface import ExtractedSurface
from rbfmuscle.implicit.extraction.untangling import gather, untangle
from rbfmuscle.jit import compiled
from rbfmuscle.validation import check_finite

# No vertex goes farther than this from where the material carries it, in mean edges; and where the field's slope
# has sunk to these shares of its slope at rest, not at all, or as far as it likes within that.
FARTHEST = 1.0
UNSURE, SURE = 0.3, 0.7
# As the way back to the volume can make triangles cross others, all of it is done up to so many times; and rounds of
# smoothing after which bones are looked at again.
AGAIN, CLEAR = 8, 2
# A level that moves vertices by less than this share of a mean edge is met, as what is left is of second order.
SETTLED = 0.01
# Rounds in which the volume is met and what that drove into a bone is brought out.
MEET = 4


@dataclass(frozen=True)
class FittedMesh(ExtractedSurface):
    """A material mesh on a level set.

    Attributes
    ----------
    left : int
        Vertices that were kept from a level set far from where the material carries them.
    smoothed : int
        Vertices that were smoothed, as triangles around them crossed others.
    crossing : int
        Triangles that still cross others.
    """

    left: int = 0
    smoothed: int = 0
    crossing: int = 0


def project_to_level_set(
    mesh: MaterialMesh,
    vertices: Floats,
    field: Field,
    *,
    volume: float | None = None,
    level: float = 0.0,
    cut: ClipDistance | None = None,
    obstacles: Obstacles | None = None,
) -> FittedMesh:
    """Bring a triangulation onto the zero set of max(field - level, -cut).

    Parameters
    ----------
    mesh : MaterialMesh
    vertices : (n, 3) ndarray
        Where the material carries them [scene unit].
    field, cut, volume, level, obstacles
        As for `rbfmuscle.implicit.extraction.surface.extract_surface`.

    Returns
    -------
    FittedMesh

    Raises
    ------
    ValueError
        On NaN in field or cut, and where no level gives the volume.
    """
    fitting = _Fitting(mesh, vertices, field, cut, float(level))
    if volume is None:
        fitting.project()
    else:
        fitting.reach(volume)
    return fitting.finish(volume, obstacles)


def carry_material(
    mesh: MaterialMesh,
    vertices: Floats,
    *,
    volume: float | None = None,
    cut: ClipDistance | None = None,
    obstacles: Obstacles | None = None,
) -> FittedMesh:
    """A triangulation where the material is, out of the bones and blown up to a volume: for want of a level set.

    Parameters
    ----------
    mesh, vertices, volume, cut, obstacles
        As for `project_to_level_set`.

    Returns
    -------
    FittedMesh
        All of its vertices are ``left``.

    Raises
    ------
    ValueError
        Where so much of it is in the bones that nothing can be blown up to the volume.
    """
    fitting = _Fitting(mesh, vertices, None, cut, 0.0)
    fitting.inflate(volume)
    return fitting.finish(volume, obstacles)


class _Fitting(CarriedMaterial):
    """A material mesh on its way to a level set."""

    def __init__(
        self,
        mesh: MaterialMesh,
        vertices: Floats,
        field: Field | None,
        cut: ClipDistance | None,
        level: float,
    ) -> None:
        super().__init__(mesh, vertices, field, cut, level)
        self.reach_of = None
        if mesh.slope is not None and field is not None:
            self.projector.known = field.value_and_gradient(self.carried)
            self.projector.least = SURE * mesh.slope
            gradient = self.projector.known[1]
            share = np.sqrt(np.einsum("nd,nd->n", gradient, gradient)) / mesh.slope
            self.reach_of = FARTHEST * self.edge * np.clip((share - UNSURE) / (SURE - UNSURE), 0.0, 1.0)

    def project(self) -> None:
        """Newton steps onto the level set, no farther from where the material is than the field is to be trusted."""
        projector = self.projector
        projector.project(self.level)
        if self.reach_of is None:
            return
        # A way to a bone from outside it, which the field asked for, is as long as the field is to be trusted.
        bounded = projector.on_field | (self.outside & (self.reach_of < FARTHEST * self.edge))
        _bound_loop(projector.vertices, self.carried, self.reach_of, bounded, self.left)
        rows = np.flatnonzero(self.left)
        if len(rows):
            self.lift(rows)

    def reach(self, volume: float) -> None:
        """Move the level until the mesh has the volume."""
        for _ in range(20):
            self.project()
            step = self.projector.volume_step(self.mesh.faces, volume)
            largest = np.abs(self.projector.slope).max()
            step = float(np.clip(step, -self.edge / largest, self.edge / largest))
            self.level += step
            self.projector.shift(step)
            if abs(step) * largest < SETTLED * self.edge:
                return
        raise ValueError(f"no level gives a volume of {volume:g}; is it the volume of the surface fitted?")

    def inflate(self, volume: float | None) -> None:
        """Out of the bones, and along the normals to the volume; every vertex counts as left."""
        projector, faces = self.projector, self.mesh.faces
        self.left[:] = True
        projector.lift()
        if volume is None:
            return
        for _ in range(20):
            projector.move_along(vertex_normals(projector.vertices, faces))
            step = float(np.clip(projector.volume_step(faces, volume), -0.5 * self.edge, 0.5 * self.edge))
            projector.shift(step)
            projector.lift()
            if abs(step) < 1e-3 * self.edge:
                break

    def finish(
        self,
        volume: float | None,
        obstacles: Obstacles | None,
    ) -> FittedMesh:
        """Bone vertices pushed off, crossings smoothed, the volume met: the mesh."""
        gather(self)
        self.push_off(obstacles)
        smoothed, crossing = self.settle(volume, obstacles)
        vertices, faces = self.projector.vertices, self.mesh.faces
        check_finite(vertices, name="fitted vertices")
        return FittedMesh(
            vertices, faces, self.level, mesh_volume(vertices, faces), 1, self.edge, int(self.left.sum()), smoothed,
            crossing,
        )  # fmt: skip

    def settle(
        self,
        volume: float | None,
        obstacles: Obstacles | None,
    ) -> tuple[int, int]:
        """The volume met and nothing smoothed since; vertices that were, and triangles that cross all the same."""
        smoothed = 0
        for turn in range(AGAIN):
            self.fill(volume)
            touched = untangle(self)
            if touched == 0:
                return smoothed, 0
            smoothed = max(smoothed, touched)
            if turn < CLEAR:
                # What was smoothed may lie over a bone's vertex again.
                self.push_off(obstacles)
        self.fill(volume)
        return smoothed, int(self.mesh.tree.crossing(self.projector.vertices).sum())

    def fill(self, volume: float | None) -> None:
        """The volume, where one is to be met."""
        if volume is None:
            return
        if self.field is None:
            # What was smoothed or filled stays put otherwise, and that may be all of it.
            self.projector.move_along(vertex_normals(self.projector.vertices, self.mesh.faces))
            self.projector.lift()
        self.meet(volume)

    def meet(self, volume: float) -> None:
        """The volume to the last digit; what its last step drove into a bone is brought out and stays there."""
        for turn in range(MEET + 1):
            step = self.projector.volume_step(self.mesh.faces, volume, steps=4)
            self.level += step
            self.projector.shift(step)
            if turn == MEET or not self.projector.lift():
                break


@compiled(error_model="numpy")
def _bound_loop(vertices, carried, reach, bounded, left):
    """Bring back bounded vertices that went beyond their reach, and mark them."""
    for v in range(len(vertices)):
        square = 0.0
        for a in range(3):
            square += (vertices[v, a] - carried[v, a]) ** 2
        # NaN counts as beyond.
        left[v] = bounded[v] and not square <= reach[v] ** 2
        if left[v]:
            share = reach[v] / np.sqrt(square) if square < np.inf else 0.0
            for a in range(3):
                way = share * (vertices[v, a] - carried[v, a]) if share > 0.0 else 0.0
                vertices[v, a] = carried[v, a] + way
