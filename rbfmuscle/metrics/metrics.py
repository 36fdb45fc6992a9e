"""What is measured of every muscle in a written frame."""

import math
from collections.abc import Mapping

import numpy as np
from scipy.spatial import cKDTree

from rbfmuscle.geometry.arrays import Floats, Integers, to_world
from rbfmuscle.geometry.crossing import FaceTree
from rbfmuscle.geometry.mesh_distance import MeshDistance
from rbfmuscle.geometry.surfaces import EdgeLengths, label_sheets, mesh_volume, unique_edges
from rbfmuscle.geometry.threads import each
from rbfmuscle.metrics.centreline import Centreline, moving_joints
from rbfmuscle.metrics.neighbours import InputNeighbours, NeighbourMeasures, Shown
from rbfmuscle.metrics.quantities import QUANTITIES, percentiles
from rbfmuscle.metrics.rows import bone_depth, bones_about, surface_depth
from rbfmuscle.scene.bone import BoneDistance
from rbfmuscle.scene.check import articular_share, end_gap, scene_surfaces
from rbfmuscle.scene.objects import Muscle, from_mm
from rbfmuscle.scene.scene import Scene, doubtful, guessed_muscles
from rbfmuscle.simulation.frame import Event, Frame, Mesh, ModelSurface

Values = dict[str, float]

# What lies so near to an overlap with a bone at rest [mm] is not held to the input mesh.
AROUND = 10.0
OVERLAP = 0.02  # depth [mm] below which nothing overlaps

_FROM_MODEL = (
    "solver_penetration_max",
    "lifted_penetration_max",
    "solver_sweeps",
    "solver_residual",
    "solid_volume_error",
    "unfitted_fraction",
    "condition",
    "time_fit",
    "time_extract",
)

# Events whose points stayed beyond a bone; those turned back or halved away are in events.csv only.
_THROUGH = ("reported", "unresolved")


class MuscleMeasures:
    """Measures muscles frame by frame, those with a material mesh (vertices, faces) at rest; keeps
    no surfaces.
    """

    def __init__(self, scene: Scene, material: Mapping[str, Mesh]) -> None:
        self.probes = [bone.exact for bone in scene.bones]
        surfaces = scene_surfaces(scene)
        guessed = guessed_muscles(scene.guesses)
        mine = [muscle for muscle in scene.muscles if muscle.name in material]
        self.trackers = each(lambda one: MuscleMeasurer(one, scene, *material[one.name]), mine)
        given = InputNeighbours(mine, scene.units)
        self.neighbours, self._carried = NeighbourMeasures(given), NeighbourMeasures(given)
        for muscle, tracker in zip(mine, self.trackers):
            tracker.once = {
                "neighbour_overlap_rest": given.deepest(muscle.name),
                "articular_share": articular_share(muscle, scene, surfaces)[0],
                "end_gap": end_gap(muscle, scene)[0],
                "guessed": muscle.name in guessed,
                "doubtful_guesses": len(doubtful(scene.guesses, "muscle", muscle.name)),
            }

    def measure_rest(
        self,
        surfaces: Mapping[str, ModelSurface],
        material: Mapping[str, Floats],
        poses: dict[str, Floats],
    ) -> None:
        """Measure the surfaces at rest, before the first frame, by muscle; ``material`` (n, 3) is
        the material there, ``poses`` (4, 4) are those of rest.

        The values are among those of the first frame that is measured.
        """
        given = self.probes, poses
        each(lambda t: t.measure_rest(surfaces[t.name], material[t.name], *given), self.trackers)

    def measure(self, frame: Frame) -> dict[str, Values]:
        """Measure a frame: for each muscle its values by quantity, in the order of `QUANTITIES`."""
        measured = each(lambda tracker: tracker.measure(frame, self.probes), self.trackers)
        found = {tracker.name: values for tracker, values in zip(self.trackers, measured)}
        shown = {t.name: t.shown for t in self.trackers if t.name in frame.surfaces and t.shown}
        carried = {t.name: t.carried for t in self.trackers if t.name in shown and t.carried}
        apart = self.neighbours.measure(frame.index, shown)
        within = apart
        if any(carried[name] is not surface for name, surface in shown.items()):
            within = self._carried.measure(frame.index, carried)
        for name, values in apart.items():
            found[name].update(values)
            found[name]["material_overlap_max"] = within[name]["neighbour_overlap_max"]
        return {
            name: {q: float(values[q]) for q in QUANTITIES if q in values}
            for name, values in found.items()
        }


class MuscleMeasurer:
    """What has to be kept of one muscle from frame to frame."""

    def __init__(self, muscle: Muscle, scene: Scene, vertices: Floats, faces: Integers) -> None:
        self.name = muscle.name
        self.mesh = muscle.mesh
        self.held = np.concatenate(
            [np.zeros(0, dtype=np.int64), *(held.vertices for held in muscle.attachments)]
        )
        self.least, self.around = from_mm(OVERLAP, scene.units), from_mm(AROUND, scene.units)
        self.rest_volume = float(muscle.mesh.volume)
        self.edges = EdgeLengths(vertices, faces)
        #: What is measured once, until the first frame takes it.
        self.once: Values = {}
        self.ends = [
            attachment.attachment_frame for attachment in muscle.attachments if attachment.tendon
        ]
        self.contracts = muscle.contraction is not None
        moving = moving_joints(scene)
        self.line = None
        if len([a for a in muscle.attachments if not a.via]) > 1:
            self.line = Centreline(muscle, scene.joints, vertices, faces, moving=moving)
        self.form = SurfaceForm()
        self.material = vertices
        # Of the last surface.
        self.shown: Shown | None = None
        self.carried: Shown | None = None  # the material, which may be what is shown
        self.offset: Floats | None = None
        self.index = 0
        self.near: Integers | None = None

    def measure(self, frame: Frame, probes: list[BoneDistance]) -> dict[str, float]:
        """What there is to measure of this muscle in a frame."""
        found = self.once
        self.once = {}
        lines = [frame.tendons[end].points[1:-1] for end in self.ends if end in frame.tendons]
        points = np.concatenate([np.empty((0, 3)), *lines])
        depth = surface_depth(points, probes, frame.poses)
        found["tendon_depth"] = float(depth.max(initial=0.0))
        material, surface = frame.material_meshes[self.name][0], frame.surfaces.get(self.name)
        if surface is not None:
            found.update(self._of_surface(frame.index, surface, material, probes, frame.poses))
            # The material as a surface of its own, unless it is shown.
            if np.array_equal(surface.vertices, material):
                self.carried = self.shown
            else:
                layout = None if self.carried is None else self.carried.distance.layout
                carried = MeshDistance(*frame.material_meshes[self.name], layout=layout)
                self.carried = Shown(carried, self.material)
            found.update({q: surface.quantities[q] for q in _FROM_MODEL if q in surface.quantities})
        mine = [event for event in frame.events if event.muscle == self.name]
        found["tunnelled"] = sum(event.count for event in mine if event.action in _THROUGH)
        found["edge_strain_rms"] = math.sqrt(np.mean((self.edges(material) - 1.0) ** 2))
        if self.line is not None:
            belly, found["bowing"] = self.line.measure(material, frame.poses, probes)
            if self.line.unsettled:
                count, self.line.unsettled = self.line.unsettled, 0
                frame.events.append(Event(frame.index, self.name, "", count, "iteration_cap"))
            tendons = self.line.tendon_length(frame.tendons)
            found["length"] = belly + tendons
            found["path_length"] = belly / found["bowing"] + tendons
        if self.name in frame.fibres:
            found.update(percentiles("fibre_stretch", frame.fibres[self.name].stretch))
        if self.contracts:
            found["activation"] = frame.activations[self.name]
            if surface is not None and self.line is not None:
                found.update(self.line.section(surface.vertices, surface.faces, frame.poses))
        times = frame.times.get(self.name, {})
        if times:
            found["time_solve"] = times.get("time_predict", 0.0) + times.get("time_solve", 0.0)
            found["time_frame"] = times["time_frame"]
        return found

    def _of_surface(self, index, surface, material, probes, poses):
        vertices, faces = surface.vertices, np.asarray(surface.faces)
        # Surfaces that keep their faces share the order of the tree, and places at rest.
        same = self.shown is not None and np.array_equal(self.shown.distance.faces, faces)
        if same:
            distance = MeshDistance(vertices, faces, layout=self.shown.distance.layout)
            self.shown = Shown(distance, self.shown.at_rest)
        else:
            distance = MeshDistance(vertices, faces)
            self.shown = Shown(distance, self._places_at_rest(vertices, material))
        volume = mesh_volume(vertices, faces)
        depth = surface_depth(vertices, probes, poses)
        form = self.form.measure(surface, same_faces=same)
        return {
            "volume": volume,
            "volume_error": volume / self.rest_volume - 1.0,
            "penetration_max": depth.max(),
            "penetration_fraction": np.mean(depth > 0.0),
            "bone_penetration_max": bone_depth(distance, probes, poses),
            **form,
            **self._flicker(index, material, vertices, same),
        }

    def _flicker(self, index, material, vertices, same):
        """Distances of the material to the surface, and their change since the frame before in the
        motion, where that was measured; of a mesh that is shown, none.
        """
        if np.array_equal(material, vertices):
            return {}
        if self.near is None or not same:
            self.near = np.full(len(material), -1)
        before, last = self.offset, self.index
        distance = self.shown.distance
        self.offset = distance.signed(material, near=self.near, simple=self.form.simple)
        self.index = index
        away = np.abs(self.offset)
        found = {"shown_shift_rms": math.sqrt(np.mean(away**2)), "shown_shift_max": away.max()}
        if before is not None and index == last + 1:
            found["flicker"] = np.abs(self.offset - before).max()
        return found

    def measure_rest(
        self,
        surface: ModelSurface,
        material: Floats,
        probes: list[BoneDistance],
        poses: dict[str, Floats],
    ) -> None:
        """What is measured once, before the first frame, with all bones at rest.

        The surface is compared with the input mesh, apart from what lies within `AROUND` of where
        that overlaps a bone: a muscle that was moved out of a bone shows what the scan is worth,
        not the model.
        """
        mesh = np.asarray(self.mesh.vertices, dtype=float), np.asarray(self.mesh.faces)
        given = MeshDistance(*mesh)
        # Its tree is that of the first frame too.
        shown = MeshDistance(surface.vertices, surface.faces)
        self.shown = Shown(shown, self._places_at_rest(shown.vertices, material))
        places, deepest = bone_overlap(given, self.held, probes, poses, self.least)
        found = {"input_overlap": deepest, **rest_errors(shown, given, places, self.around)}
        found["initial_overlap"] = max(
            float(surface_depth(surface.vertices, probes, poses).max()),
            bone_depth(shown, probes, poses),
        )
        if self.line is not None:
            found["thickness"] = self.line.section(*mesh, poses)["belly_thickness"]
            found["bowing_at_rest"] = self.line.measure(self.material, poses, probes)[1]
        self.once |= found

    def _places_at_rest(self, vertices: Floats, material: Floats) -> Floats:
        """Where vertices (n, 3) of a surface lie in the input, from the material (k, 3) there."""
        # The shifts of the three nearest places, weighted by 1 / distance^2.
        distance, near = cKDTree(material).query(vertices, k=3)
        weights = 1.0 / np.maximum(distance, 1e-9 * np.ptp(material)) ** 2
        weights /= weights.sum(axis=1, keepdims=True)
        return vertices + np.einsum("nk,nkd->nd", weights, (self.material - material)[near])


def bone_overlap(
    given: MeshDistance,
    held: Integers,
    probes: list[BoneDistance],
    poses: dict[str, Floats],
    least: float,
) -> tuple[Floats, float]:
    """Where an input mesh and bones overlap at rest by more than ``least``: vertices (n, 3) of
    either in the other, and the greatest depth; at its vertices that are ``held`` (k,) nothing
    counts.
    """
    free = np.ones(len(given.vertices), dtype=bool)
    free[held] = False
    depth = np.where(free, surface_depth(given.vertices, probes, poses), 0.0)
    places, depths = [given.vertices[depth > least]], [depth[depth > least]]
    tree = cKDTree(given.vertices)
    for probe in bones_about(given.vertices, probes, poses):
        pose = poses[probe.name]
        depth = given.depth(probe.vertices, pose=pose)
        points = to_world(probe.vertices[depth > least], pose)
        loose = free[tree.query(points)[1]]
        places.append(points[loose])
        depths.append(depth[depth > least][loose])
    return np.concatenate(places), float(np.concatenate(depths).max(initial=0.0))


def rest_errors(
    shown: MeshDistance, given: MeshDistance, places: Floats, around: float
) -> dict[str, float]:
    """Distances between a surface and the input mesh: RMS and greatest of both directions farther
    than ``around`` from places (n, 3), and the greatest nearer to these.
    """
    pairs = (given.unsigned(shown.vertices), shown.unsigned(given.vertices))
    far = [np.ones(len(distance), dtype=bool) for distance in pairs]
    if len(places):
        tree = cKDTree(places)
        far = [tree.query(mesh.vertices)[0] > around for mesh in (shown, given)]
    near = max(float(d[~f].max(initial=0.0)) for d, f in zip(pairs, far))
    found = {"rest_error_at_overlap": near} if len(places) else {}
    if all(f.any() for f in far):
        squares = [np.mean(d[f] ** 2) for d, f in zip(pairs, far)]
        found["rest_error_rms"] = math.sqrt(sum(squares) / 2)
        found["rest_error_max"] = max(float(d[f].max()) for d, f in zip(pairs, far))
    return found


def surface_distance(
    vertices: Floats, faces: Integers, other_vertices: Floats, other_faces: Integers
) -> tuple[float, float]:
    """Distance between two surfaces of vertices (n, 3) and faces (m, 3), from the vertices of each
    to the other [scene unit].

    Root of the mean of both directions' mean squares, and the greatest distance of either.
    """
    there = MeshDistance(other_vertices, other_faces).unsigned(vertices)
    back = MeshDistance(vertices, faces).unsigned(other_vertices)
    rms = math.sqrt((np.mean(there**2) + np.mean(back**2)) / 2)
    return rms, float(max(there.max(), back.max()))


def euler_characteristic(faces: Integers) -> int:
    """Vertices less edges plus triangles, of those that faces (m, 3) use; 2 for a sphere, two less
    for each handle.
    """
    faces = np.asarray(faces, dtype=np.int64)
    return len(np.unique(faces)) - len(unique_edges(faces)) + len(faces)


class SurfaceForm:
    """Pieces, handles and crossings of one muscle's surfaces, looked for again only where they can
    have changed.
    """

    def __init__(self) -> None:
        self._drawn: ModelSurface | None = None
        self._tree: FaceTree | None = None
        self._found: dict[str, float] = {}

    def measure(self, surface: "ModelSurface", *, same_faces: bool) -> dict[str, float]:
        """``components``, ``euler_characteristic`` and ``self_crossings``; ``same_faces`` where the
        last surface had these faces.
        """
        vertices, faces = surface.vertices, np.asarray(surface.faces)
        if self._tree is None or not same_faces:
            self._tree = FaceTree(vertices, faces)
            label = label_sheets(faces, len(vertices))[1]
            self._found["components"] = len(np.unique(label[faces[:, 0]]))
            self._found["euler_characteristic"] = euler_characteristic(faces)
        drawn = surface.origin[0] if surface.origin is not None else surface
        if self._drawn is not drawn:
            self._found["self_crossings"] = int(self._tree.crossing(vertices).sum())
        self._drawn = drawn
        return dict(self._found)

    @property
    def simple(self) -> bool:
        """Whether the last surface was one closed piece that nowhere crosses itself."""
        closed = self._tree is not None and self._tree.rings is not None
        return closed and self._found["components"] == 1 and not self._found["self_crossings"]
