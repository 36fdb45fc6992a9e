"""A triangulation that goes with the material and is brought onto a level set: no grid, one
topology.

Vertices go onto the zero set of max(f - s, -d) by Newton steps, the level s follows from the volume
as for the marched mesh, and what a fold of the field or the edge of a bone has turned inside out is
smoothed.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from rbfmuscle.geometry.arrays import Booleans, Floats, Integers
from rbfmuscle.geometry.fields import ClipDistance, Field
from rbfmuscle.geometry.surfaces import mesh_volume, touching_faces, vertex_normals
from rbfmuscle.implicit.extraction.material_mesh import MaterialMesh
from rbfmuscle.implicit.extraction.obstacles import Obstacles
from rbfmuscle.implicit.extraction.projection import CutBounds, Projector
from rbfmuscle.implicit.extraction.surface import ExtractedSurface
from rbfmuscle.jit import compiled
from rbfmuscle.validation import check_finite

# What is within this many mean edges of the bones may come to lie on them.
NEAR_CUT = 1.5
# Greatest bound of the distance from them that is kept, in mean edges.
FAR = 100.0
# A triangle none of whose corners is so many spacings near a bone has no bone vertex behind it by a
# chord: no point of it is farther from a corner than its longest side over the root of three.
NEAR_BONE = 1.5
# What the material takes so many mean edges deep into a bone is sunk.
SUNK = 1.0
# Mean edges that a bone's vertex may lie within the surface.
PUSHED = 0.01
# Where both sides of a muscle sink into a bone, the far one stays above it by this share of a mean
# edge.
LAMELLA = 0.02
# Rounds of smoothing for triangles that cross others, and how the smoothed region grows with them.
UNTANGLE, GROWTH = 24, 4
# Rounds before them in which what crosses is taken back to where the material is, by this share of
# the way.
RETURN, BACK = 12, 0.15
# What is sunk in a bone, or what a bone sent so many mean edges away, is drawn as a skin over the
# place where it goes in: so many sweeps of smoothing first, and in each of some rounds after, each
# followed by the way out of the bone.
STRAYED = 1.5
FILL_SWEEPS = 150
GATHER = 4
GATHER_SWEEPS = 12
# No vertex goes farther than this from where the material carries it, in mean edges; and where the
# field's slope has sunk to these shares of its slope at rest, not at all, or as far as it likes
# within that.
FARTHEST = 1.0
UNSURE, SURE = 0.3, 0.7
# As the way back to the volume can make triangles cross others, all of it is done up to so many
# times; and rounds of smoothing after which bones are looked at again.
AGAIN, CLEAR = 8, 2
# A level that moves vertices by less than this share of a mean edge is met, as what is left is of
# second order.
SETTLED = 0.01
# Rounds in which the volume is met and what that drove into a bone is brought out.
MEET = 4


@dataclass(frozen=True)
class FittedMesh(ExtractedSurface):
    """A material mesh on a level set; ``left`` counts vertices kept from it, ``crossing`` faces
    that cross others.
    """

    left: int = 0
    crossing: int = 0


def project_to_level_set(
    mesh: MaterialMesh,
    vertices: Floats,
    field: Field | None,
    *,
    volume: float,
    level: float = 0.0,
    cut: ClipDistance | None = None,
    obstacles: Obstacles | None = None,
    excess: Callable[[Floats], Floats] | None = None,
) -> FittedMesh:
    """Bring a triangulation onto the zero set of max(field - level, -cut) that has a volume.

    ``vertices`` (n, 3) are where the material carries them [scene unit]; field, cut, volume, level
    and obstacles are those of `rbfmuscle.implicit.extraction.surface.extract_surface`. Without a
    field the triangulation stays where the material is, blown up to the volume out of the bones,
    and all vertices are ``left``. ``excess`` says how far (n,) vertices (n, 3) then move inwards.
    ValueError on NaN in field or cut, and where nothing has the volume.
    """
    fitting = CarriedMaterial(mesh, vertices, field, cut, float(level))
    if field is None:
        fitting.inflate(volume)
    else:
        fitting.reach(volume)
    if excess is not None:
        fitting.give_room(excess)
    return fitting.finish(volume, obstacles or [])


class CarriedMaterial:
    """A material mesh on its way from where the material takes it.

    Its vertices (n, 3) there [scene unit] are kept as ``carried``; ``projector`` holds the vertices
    where they are now, ``edge`` is the mean length of an edge [scene unit]. Masks (n,) say what the
    material takes deep into a bone (``sunk``), what it leaves outside all bones (``outside``), what
    a bone's vertex pushed off (``pushed``), what makes room for a neighbour (``moved``), and what
    was kept from a level set that is too far away (``left``).
    """

    def __init__(
        self,
        mesh: MaterialMesh,
        vertices: Floats,
        field: Field | None,
        cut: ClipDistance | None,
        level: float,
    ) -> None:
        self.mesh = mesh
        self.carried = np.ascontiguousarray(vertices, dtype=np.float64)
        self.level = level
        self.field, self.cut = field, cut
        self.edge = mesh.edge(self.carried)
        self.sunk, self.pushed, self.moved, self.left = np.zeros((4, len(vertices)), dtype=np.bool_)
        self.outside = np.ones(len(vertices), dtype=np.bool_)
        self.reach_of: Floats | None = None
        self._start(cut)
        if mesh.slope is not None and field is not None:
            self.projector.known = field.value_and_gradient(self.carried)
            self.projector.least = SURE * mesh.slope
            gradient = self.projector.known[1]
            share = np.sqrt(np.einsum("nd,nd->n", gradient, gradient)) / mesh.slope
            self.reach_of = (
                FARTHEST * self.edge * np.clip((share - UNSURE) / (SURE - UNSURE), 0.0, 1.0)
            )

    def _start(self, cut: ClipDistance | None) -> None:
        """A projector of the vertices where the material takes them, that knows how far the bones
        are there.
        """
        near, vertices = np.zeros(len(self.carried), dtype=np.bool_), self.carried.copy()
        if cut is None:
            self.projector = Projector(self.field, None, vertices, self.edge, near)
            return
        limit = np.full(len(vertices), NEAR_CUT * self.edge)
        distance, outward = cut.value_and_gradient_below(self.carried, limit)
        near, self.outside = distance < limit, distance >= 0.0
        self.projector = Projector(
            self.field, cut if near.any() else None, vertices, self.edge, near
        )
        self.projector.bounds = CutBounds(self.carried, np.minimum(distance, FAR * self.edge))
        if near.any():  # of what sinks into a bone, what looks away from it keeps off the rest
            normals = vertex_normals(self.carried, self.mesh.faces)
            away = near & (np.einsum("nd,nd->n", normals, outward) > 0.0)
            self.projector.clearance = np.where(away, LAMELLA * self.edge, 0.0)
            self.sunk = near & (distance < -SUNK * self.edge)

    def lift(self, rows: Integers) -> None:
        """Bring vertices out of the bones, where they stay."""
        self.projector.lift(rows)
        self.projector.hold(rows)

    def push_off(self, obstacles: Obstacles) -> None:
        """Move the corners of triangles that a bone's vertices came through."""
        if not obstacles:
            return
        vertices = self.projector.vertices
        faces = self.mesh.faces
        bounds = self.projector.bounds
        # So large that no corner is farther than 1.3 of it from its triangle's middle.
        spacing = max(self.edge, 0.52 * self.mesh.longest(vertices))
        if bounds is not None:
            near = bounds.below(vertices) < NEAR_BONE * spacing
            faces = faces[touching_faces(faces, near)]
        if len(faces):
            self.pushed |= self.projector.push_off(faces, obstacles, spacing, PUSHED * self.edge)

    def give_room(self, excess: Callable[[Floats], Floats]) -> None:
        """Move vertices inwards by their excess (n,), where they stay."""
        vertices, inwards = self.projector.vertices, excess(self.projector.vertices)
        rows = np.flatnonzero(inwards > 0.0)
        normals = vertex_normals(vertices, self.mesh.faces)[rows]
        size = np.maximum(np.linalg.norm(normals, axis=1), np.finfo(float).tiny)
        vertices[rows] -= (inwards[rows] / size)[:, None] * normals
        self.moved[rows] = True
        self.projector.hold(rows)
        self.projector.lift(rows)

    def gather(self) -> None:
        """Close the surface over what is deep in a bone: a sheet that is folded over it would cross
        itself.
        """
        lost = self.sunk | self._strayed(slice(None))
        if not lost.any():
            return
        rows = np.flatnonzero(self.mesh.around(lost, 1))
        for turn in range(GATHER):
            self.mesh.smooth(self.projector.vertices, rows, GATHER_SWEEPS if turn else FILL_SWEEPS)
            if self.field is None:
                self.lift(rows)
            else:
                self.projector.project(self.level, rows)

    def untangle(self) -> bool:
        """Smooth what crosses itself; return whether anything was moved for it."""
        faces, moved = self.mesh.faces, False
        among = self._suspicious()
        for turn in range(0 if self.field is None else -RETURN, UNTANGLE + 1):
            # What was not moved does not begin to cross.
            bad = self.mesh.tree.crossing(self.projector.vertices, among)
            if turn == UNTANGLE or not bad.any():
                break
            moved, marked = True, np.zeros(len(self.carried), dtype=np.bool_)
            marked[faces[bad].ravel()] = True
            region = self.mesh.around(marked, 1 + max(turn, 0) // GROWTH)
            among = touching_faces(faces, region)
            if turn < 0:
                self._return(np.flatnonzero(region))
            else:
                self._smooth(
                    np.flatnonzero(region), self.field is not None and turn < UNTANGLE // 2
                )
        return moved

    def _suspicious(self) -> Booleans | None:
        """Mask of the triangles that may cross others without a fold at a corner; None where it can
        be any.
        """
        if self.field is None or self.mesh.slope is None:
            return None
        faded = (
            SURE * self.projector.slope * self.mesh.slope >= 1.0 - 1e-9
        )  # the slope was cut to be 1
        odd = self.sunk | self.pushed | self.moved | self.left | faded
        return touching_faces(self.mesh.faces, odd)

    def _strayed(self, rows: Integers | slice) -> Booleans:
        """Mask of the vertices that are far from where the material takes them."""
        away = self.projector.vertices[rows] - self.carried[rows]
        return np.asarray(np.einsum("nd,nd->n", away, away) > (STRAYED * self.edge) ** 2)

    def _return(self, rows: Integers) -> None:
        """Take vertices back towards where the material is, which smoothing would shorten; not
        those on bones.
        """
        projector = self.projector
        rows = rows[projector.on_field[rows] & ~self._strayed(rows) & ~self.pushed[rows]]
        projector.vertices[rows] -= BACK * (projector.vertices[rows] - self.carried[rows])
        self.lift(rows)

    def _smooth(self, rows: Integers, onto_field: bool) -> None:
        """Move vertices towards their neighbours, then back onto the surface, or out of the bones
        at least.
        """
        projector = self.projector
        before = projector.vertices[rows]
        self.mesh.smooth(projector.vertices, rows, 3)
        if not onto_field:
            self.lift(rows)
            return
        smoothed = projector.vertices[rows]
        projector.project(self.level, rows)
        away = projector.vertices[rows] - before
        gone = np.einsum("nd,nd->n", away, away) > self.edge**2
        projector.vertices[rows[gone]] = smoothed[gone]

    def project(self) -> None:
        """Newton steps onto the level set, no farther from where the material is than the field is
        to be trusted.
        """
        projector = self.projector
        projector.project(self.level)
        if self.reach_of is None:
            return
        # A way to a bone from outside it, which the field asked for, is as long as the field is to
        # be trusted.
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
        raise ValueError(
            f"no level gives a volume of {volume:g}; is it the volume of the surface fitted?"
        )

    def inflate(self, volume: float) -> None:
        """Out of the bones, and along the normals to the volume; every vertex counts as left."""
        projector, faces = self.projector, self.mesh.faces
        self.left[:] = True
        projector.lift()
        for _ in range(20):
            projector.move_along(vertex_normals(projector.vertices, faces))
            step = float(
                np.clip(projector.volume_step(faces, volume), -0.5 * self.edge, 0.5 * self.edge)
            )
            projector.shift(step)
            projector.lift()
            if abs(step) < 1e-3 * self.edge:
                break

    def finish(self, volume: float, obstacles: Obstacles) -> FittedMesh:
        """Bone vertices pushed off, crossings smoothed, the volume met: the mesh."""
        self.gather()
        self.push_off(obstacles)
        crossing = self.settle(volume, obstacles)
        vertices, faces = self.projector.vertices, self.mesh.faces
        check_finite(vertices, name="fitted vertices")
        return FittedMesh(
            vertices,
            faces,
            self.level,
            mesh_volume(vertices, faces),
            1,
            self.edge,
            int(self.left.sum()),
            crossing,
        )

    def settle(self, volume: float, obstacles: Obstacles) -> int:
        """The volume met and nothing smoothed since; triangles that cross all the same."""
        for turn in range(AGAIN):
            self.fill(volume)
            if not self.untangle():
                return 0
            if turn < CLEAR:
                # What was smoothed may lie over a bone's vertex again.
                self.push_off(obstacles)
        self.fill(volume)
        return int(self.mesh.tree.crossing(self.projector.vertices).sum())

    def fill(self, volume: float) -> None:
        """The volume to the last digit; what its last step drove into a bone is brought out and
        stays there.
        """
        if self.field is None:
            # What was smoothed or filled stays put otherwise, and that may be all of it.
            self.projector.move_along(vertex_normals(self.projector.vertices, self.mesh.faces))
            self.projector.lift()
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
