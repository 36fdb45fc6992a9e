"""Bones and their directions, which way is up and forwards, the axes of knee and ankle: from the
shapes of the bones.

Knee: the line through the centres of spheres fitted to the posterior part of both condyles
(Kurosawa et al. 1985; Iwaki et al. 2000; the cylindrical axis of Eckhoff et al. 2005). Ankle: the
cylinder of the talar dome, fitted with the tibial plafond above it, each with its own radius (Singh
et al. 1992; Siegler et al. 2014).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import trimesh
from scipy.spatial import ConvexHull, cKDTree

from rbfmuscle.anatomy.names import MuscleFacts, name_facts
from rbfmuscle.geometry.arrays import across, box_size, unit
from rbfmuscle.scene.meshes.repair import boundary_rims
from rbfmuscle.scene.scene import Scene

# A cap's faces look along its normal (cosine), lie within a share of the part's size of its end,
# and are most of what lies there.
CUT_ALONG, DEPTH, FLAT = 0.99, 0.005, 0.6
EXACT = 2e-4  # share for a muscle, which is nearly flat where it lies on a bone
LEAST_AREA = 0.005  # of the surface: a smaller flat place is no cut
TRIED = 6  # directions tried of those in which most of the surface lies flat
ROUNDED = 50.0  # normals are counted in cells of one over this
LEAST_RIM = 8  # edges of a rim that is a cut end
PLANE = 0.005  # of the size: how far a rim's points may lie from their plane


class Cut(NamedTuple):
    """A flat end: its middle (3,), outward unit normal (3,), and which vertices (n,) lie on it."""

    middle: np.ndarray
    normal: np.ndarray
    on: np.ndarray


def find_cut(mesh: trimesh.Trimesh, *, depth: float = DEPTH) -> Cut | None:
    """The largest flat end of a mesh, None where all its ends are round.

    ``depth`` is the share of its size within which a cap is flat.
    """
    vertices = np.asarray(mesh.vertices)
    points, normals, areas = (
        np.asarray(values) for values in (mesh.triangles_center, mesh.face_normals, mesh.area_faces)
    )
    depth *= box_size(vertices)
    # Normals that most of the area has, and the axes of the coordinates.
    cells, number = np.unique(np.rint(ROUNDED * normals).astype(int), axis=0, return_inverse=True)
    most = np.argsort(-np.bincount(number.ravel(), weights=areas))[:TRIED]
    tried = np.concatenate([unit(cells[most].astype(float)), np.eye(3), -np.eye(3)])
    found, largest = None, LEAST_AREA * areas.sum()
    for direction in tried:
        height = points @ direction
        near = height > height.max() - depth
        cap = near & (normals @ direction > CUT_ALONG)
        area = areas[cap].sum()
        if area > largest and area > FLAT * areas[near].sum():
            largest = area
            normal = unit(areas[cap] @ normals[cap])
            top = vertices @ normal
            middle = np.average(points[cap], axis=0, weights=areas[cap])
            found = Cut(middle, normal, top > top.max() - depth)
    return found if found is not None else _open_cut(mesh)


def _open_cut(mesh):
    """The largest hole whose rim lies in a plane at the end of the mesh."""
    found, largest = None, LEAST_AREA * float(mesh.area)
    vertices = np.asarray(mesh.vertices)
    size = box_size(vertices)
    for rim in boundary_rims(np.asarray(mesh.faces)):
        points = vertices[rim]
        middle = points.mean(axis=0)
        spokes = points - middle
        # Rims run as their faces do, and so around the hole from behind.
        vector = -0.5 * np.cross(spokes, np.roll(spokes, -1, axis=0)).sum(axis=0)
        area = float(np.linalg.norm(vector))
        if len(rim) < LEAST_RIM or area <= largest:
            continue
        normal = vector / area
        height = (vertices - middle) @ normal
        if np.abs(spokes @ normal).max() < PLANE * size and height.max() < PLANE * size:
            found, largest = Cut(middle, normal, height > -PLANE * size), area
    return found


FEWEST = 3000  # triangles of a mesh that fits take their points from


@dataclass(eq=False)
class Part:
    """One mesh and what it is taken for."""

    name: str  # in the scene
    file: str  # path as the scene file gives it
    read: Any  # ReadMesh, of a bone of a scene Bone; muscles need the map of its vertices
    kind: str = ""  # class of bone, empty where the name says none
    side: str = ""  # "l", "r" or empty
    doubt: str = ""  # what speaks for a bone or a muscle where the name does not
    facts: MuscleFacts | None = None
    tendon_of: tuple[str, ...] = ()  # muscles of which it is a tendon by its name
    coarse: bool = False  # whether the mesh was made coarser than its file
    frame: Any = None  # Orientation, of a femur

    @cached_property
    def cut(self) -> Cut | None:
        """Where a scan ends, None where the part is whole."""
        return find_cut(self.mesh)

    @property
    def mesh(self) -> trimesh.Trimesh:
        """The mended mesh, trimesh.Trimesh [scene unit]."""
        return self.read.mesh

    def may_be_beside(self, other: Part) -> bool:
        """Whether it may be of the same side of the body as another."""
        return not self.side or not other.side or self.side == other.side

    @property
    def size(self) -> float:
        """Diagonal of its box [scene unit]."""
        return float(np.linalg.norm(self.mesh.extents))

    @cached_property
    def points(self) -> np.ndarray:
        """Vertices (n, 3)."""
        return np.asarray(self.mesh.vertices, dtype=np.float64)

    @cached_property
    def faces(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Middles, normals and areas of the triangles; those of a coarse mesh are divided."""
        mesh = self.mesh
        while len(mesh.faces) < FEWEST:
            mesh = mesh.subdivide()
        return (
            np.array(mesh.triangles_center),
            np.array(mesh.face_normals),
            np.array(mesh.area_faces),
        )

    @cached_property
    def tree(self) -> cKDTree:
        """Tree over the middles of the faces."""
        return cKDTree(self.faces[0])


# Radii that anatomy allows [mm]: head of the femur, posterior condyle, talar dome, all from child
# to large adult.
HEAD = (12.0, 35.0)
CONDYLE = (11.0, 30.0)
DOME = (11.0, 27.0)
HEAD_SHARE = 0.12  # of the height of a femur without its lower end: the top of its head
# How far below the head the shaft begins, over the breadth from the trochanter to the head.
BELOW_HEAD = 1.0
# Of its breadth: how far the middle of that lies aside of the shaft at least; a knee lies on it.
HEAD_ASIDE = 0.5
END, CONDYLES = 0.12, 0.16  # share of the femur's length that holds an end, and its condyles
BREADTHS = 5.2  # length of a femur over its breadth at the condyles (of the leg: 418 and 81 mm)
BREADTH_AT = 0.2  # share of what is left of a femur that holds its condyles
SHAFT, FOOT = (0.3, 0.7), 0.1  # the same of its shaft, from below, and of its lowest part
# Normals of a condyle that count: from above (-) to below the backward direction [degree], greatest
# cosine sideways.
POSTERIOR, SIDEWAYS = (-30.0, 60.0), 0.5
# Of the dome: half its arc [degree], band beyond the least gap [mm], least cosine of a normal and
# its radius.
ARC = 45.0
BAND = 8.0
RADIAL = 0.95
ALONG = 0.8  # cosine of normals that count as those of a sphere or of a plateau
# Greatest space between dome and plafond [mm]: 4.3 on the leg of the Visible Human Female,
# cartilage included.
SPACE = 6.0


@dataclass
class Orientation:
    """Directions of a body or of a long bone, unit (3,).

    ``side`` is the one that the bone's shape is of, ``"l"`` or ``"r"``; ``source`` is what those of
    a body were found from, ``doubts`` say what speaks against them.
    """

    superior: np.ndarray
    anterior: np.ndarray
    side: str = ""
    source: str = "the shapes of the bones"
    doubts: list[str] = field(default_factory=list)

    @property
    def right(self) -> np.ndarray:
        """To the body's right, unit (3,)."""
        return np.cross(self.anterior, self.superior)


# Rounds of the condyles' axis and of the dome, and evaluations of a coaxial fit, at most; real
# bones take 7, 7 and 67. What does not settle in these is refused.
AXIS_ROUNDS = 12
DOME_ROUNDS = 40
EVALUATIONS = 200
# The triangles that are fitted are chosen anew in each round, and some may come and go for ever: a
# fit has settled where its axis turns by less than this [degree], or less than this share of them
# changes.
STILL, CHANGED = 0.5, 0.02
UNSETTLED = "the fit does not settle"


@dataclass
class Fit:
    """A sphere, or spheres or cylinders on an axis: centre (3,), radii, misfit (RMS) [scene unit],
    unit axis (3,).

    ``cover`` is the share of a hemisphere that was fitted; ``wrong`` says why a fit is refused,
    empty where it is not.
    """

    centre: np.ndarray
    radii: np.ndarray
    misfit: float
    axis: np.ndarray = field(default_factory=lambda: np.zeros(3))
    cover: float = 0.0
    wrong: str = ""


def main_axes(points: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Weighted mean (3,) and principal directions in columns, the shortest first."""
    middle = np.average(points, axis=0, weights=weights)
    away = points - middle
    return middle, np.linalg.eigh((away * weights[:, None]).T @ away)[1]


def long_axis(bone: Part, bones: list[Part]) -> np.ndarray:
    """Direction (3,) up a long bone: from those of the bones that are below it to those above,
    else from its broad end.
    """
    points, _, areas = bone.faces
    middle, axes = main_axes(points, areas)
    up = axes[:, 2] if bone.cut is None else bone.cut.normal
    rise = sum((b.points.mean(axis=0) - middle) @ up for b in neighbours(bone, bones, _ABOVE))
    rise -= sum((b.points.mean(axis=0) - middle) @ up for b in neighbours(bone, bones, _BELOW))
    if not rise:
        share = (points @ up - (points @ up).min()) / np.ptp(points @ up)
        rise = areas[share < END].sum() - areas[share > 1.0 - END].sum()
    return up if rise >= 0.0 else -up


def femur_frame(femur: Part, bones: list[Part]) -> Orientation:
    """Directions of a femur by its own shape: shaft; breadth of the condyles, which lie behind it;
    head inwards.
    """
    if femur.cut is not None and _is_below(femur, femur.cut, bones):
        return _stump_frame(femur, femur.cut)
    points, _, areas = femur.faces
    up = long_axis(femur, bones) if femur.cut is None else femur.cut.normal
    share = (points @ up - (points @ up).min()) / np.ptp(points @ up)
    shaft = (share > SHAFT[0]) & (share < SHAFT[1])
    end = share < FOOT
    top = share > 1.0 - END
    middle, axes = main_axes(points[shaft], areas[shaft])
    up = axes[:, 2] * np.copysign(1.0, axes[:, 2] @ up)
    behind, axes = main_axes(across(points[end] - middle, up), areas[end])
    anterior = unit(np.cross(up, axes[:, 2]))
    frame = Orientation(up, anterior * -np.copysign(1.0, anterior @ behind))
    head = np.average(points[top], axis=0, weights=areas[top]) - middle
    frame.side = "r" if head @ frame.right < 0 else "l"
    return frame


def _is_below(femur: Part, cut: Cut, bones: list[Part]) -> bool:
    """Whether a femur is cut off at its lower end: by the bones beside it, else as a stump is less
    broad there than a knee.
    """
    near = [
        sign * np.sign((bone.points.mean(axis=0) - cut.middle) @ cut.normal)
        for table, sign in ((_ABOVE, -1.0), (_BELOW, 1.0))
        for bone in neighbours(femur, bones, table)
    ]
    if near:
        return sum(near) > 0
    far = (femur.points - cut.middle) @ -cut.normal
    broad = across(femur.points[far > (1.0 - END) * far.max()] - cut.middle, cut.normal)
    return float(np.linalg.norm(broad.mean(axis=0))) > HEAD_ASIDE * box_size(broad)


def _stump_frame(femur: Part, cut: Cut) -> Orientation:
    """Directions of a femur without its lower end: across its cut, and from there to its head.

    Scans end across the body, so a cut shows which way is up better than what is left of the shaft.
    Where it has no side, the head is in front of the shaft (anteversion) of what the axes of the
    coordinates have for the breadth of the body.
    """
    up = -cut.normal
    height = (femur.points - cut.middle) @ up
    top = femur.points[height > (1.0 - HEAD_SHARE) * height.max()]
    # Further down the shaft is bowed forwards.
    breadth = box_size(across(femur.points - cut.middle, up))
    below = max(height.max() - BELOW_HEAD * breadth, 0.0)
    shaft = femur.points[np.abs(height - below) < HEAD_SHARE * breadth].mean(axis=0)
    inward = unit(across(top.mean(axis=0) - shaft, up))
    axis = np.zeros(3)
    axis[np.argmax(np.abs(inward))] = np.copysign(1.0, inward[np.argmax(np.abs(inward))])
    broad = unit(across(axis, up))
    side = femur.side or ("l" if np.cross(up, broad) @ inward > 0.0 else "r")
    right = broad if side == "l" else -broad
    return Orientation(up, np.cross(up, right), side)


def sole_direction(points: np.ndarray, right: np.ndarray, up: np.ndarray) -> np.ndarray:
    """Direction (3,) forwards on the sole of a foot: the longest side below its outline, seen from
    the side.
    """
    top = unit(across(up, right))
    plane = np.stack([np.cross(top, right), top])
    flat = points @ plane.T
    corners = flat[ConvexHull(flat).vertices]  # in the plane, against the clock: forwards below
    sides = np.roll(corners, -1, axis=0) - corners
    return sides[np.argmax(np.where(sides[:, 0] > 0.0, np.hypot(*sides.T), 0.0))] @ plane


def fit_sphere(points: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, float]:
    """Centre and radius of the sphere, or circle, that fits weighted points: algebraic least
    squares.
    """
    middle, root = np.average(points, axis=0, weights=weights), np.sqrt(weights)
    local = points - middle
    matrix = np.column_stack([2.0 * local, np.ones(len(local))]) * root[:, None]
    *x, last = np.linalg.lstsq(matrix, (local**2).sum(axis=1) * root, rcond=None)[0]
    return middle + x, float(np.sqrt(max(last + np.dot(x, x), 0.0)))


def fit_condyles(femur: Part, millimetre: float) -> Fit | None:
    """The knee's axis; None where a condyle has too few triangles."""
    points = femur.faces[0]
    right = femur.frame.right
    along = points @ femur.frame.superior
    length = np.ptp(along)
    if femur.cut is not None:  # by its breadth at the knee
        length = BREADTHS * np.ptp(points[along < along.min() + BREADTH_AT * length] @ right)
    near = along < along.min() + CONDYLES * length
    points, normals, areas = (values[near] for values in femur.faces)
    for _ in range(AXIS_ROUNDS):
        anterior = unit(np.cross(femur.frame.superior, right))
        angle = np.degrees(np.arctan2(-normals @ np.cross(right, anterior), -normals @ anterior))
        chosen = (
            (np.abs(normals @ right) < SIDEWAYS) & (angle > POSTERIOR[0]) & (angle < POSTERIOR[1])
        )
        if chosen.sum() < 24:
            return None
        place = points @ right
        middle = 0.5 * (place[chosen].min() + place[chosen].max())
        groups = [chosen & (place < middle), chosen & (place > middle)]
        if min(group.sum() for group in groups) < 12:
            return None
        fits = [_fit_condyle(points[g], normals[g], areas[g], millimetre) for g in groups]
        before, right = right, unit(fits[1][0] - fits[0][0])
        settled = right @ before > np.cos(np.radians(STILL))
        if settled:
            break
    centres, radii, misfits = (np.array(values) for values in zip(*fits))
    return Fit(
        centres.mean(axis=0),
        radii,
        misfit=float(np.sqrt(np.mean(misfits**2))),
        axis=right,
        wrong=_refused("condyle", radii, CONDYLE, millimetre) if settled else UNSETTLED,
    )


def _fit_condyle(points, normals, areas, millimetre):
    """Centre, radius and misfit of a sphere; what does not lie on it loses its weight."""
    weights = areas
    # A choice: after these the sphere goes on moving by less than 1e-6 of its radius.
    for _ in range(15):
        centre, radius = fit_sphere(points, weights)
        away = np.linalg.norm(points - centre, axis=1)
        cosine = np.einsum("ij,ij->i", normals, points - centre) / np.maximum(away, 1e-12)
        off = (away - radius) / (1.5 * millimetre)
        weights = areas * (np.exp(-(off**2)) * (cosine > ALONG) + 1e-9)
    return centre, radius, float(np.sqrt(np.average((away - radius) ** 2, weights=weights)))


def _refused(what, radii, allowed, millimetre):
    low, high = allowed
    bad = [radius / millimetre for radius in radii if not low <= radius / millimetre <= high]
    return f"a {what} of radius {bad[0]:.3g} mm, anatomy has {low:g} to {high:g}" if bad else ""


def fit_dome(
    talus: Part, tibia: Part, up: np.ndarray, right: np.ndarray, millimetre: float
) -> Fit | None:
    """The ankle's axis; None where talus and tibia show no dome.

    ``up`` (3,) is the direction along the tibia, ``right`` (3,) about that of the axis.
    """
    patches = []
    for part, other, sign in ((talus, tibia, 1.0), (tibia, talus, -1.0)):
        points, normals, areas = part.faces
        distance, _ = other.tree.query(points)
        near = distance < distance.min() + BAND * millimetre
        patches.append((points[near], sign * normals[near], areas[near]))
    right = unit(across(right, up))
    points, normals, areas = patches[0]
    top = normals @ up > ALONG
    if top.sum() < 6:
        return None
    radii, before = np.array([20.0, 23.0]) * millimetre, np.empty(0, dtype=bool)
    centre = np.average(points[top], axis=0, weights=areas[top]) - radii[0] * up
    for _ in range(DOME_ROUNDS):
        chosen = [
            _on_cylinder(*patch[:2], centre, right, up, r) for patch, r in zip(patches, radii)
        ]
        if chosen[-1].sum() < 8 and len(chosen) == 2:  # no plafond: the dome alone
            patches = patches[:1]
            radii = radii[:1]
            chosen = chosen[:1]
        if chosen[0].sum() < 8:
            return None
        now = np.concatenate(chosen)
        settled = len(now) == len(before) and (now != before).sum() <= CHANGED * now.sum()
        before = now
        if settled:
            break
        used = [(patch[0][c], patch[2][c]) for patch, c in zip(patches, chosen)]
        fit = fit_coaxial(used, centre, right, radii, 0.5 * millimetre)
        centre = fit.centre
        right = fit.axis
        radii = fit.radii
    fit.centre = centre + ((used[0][0] - centre) @ right).mean() * right
    fit.wrong = fit.wrong or _refused("talar dome", radii[:1], DOME, millimetre)
    if not settled:
        fit.wrong = UNSETTLED
    space = np.ptp(radii) / millimetre
    if space > SPACE:
        fit.wrong = f"dome and plafond are {space:.2g} mm apart, at most {SPACE:g} are believed"
    return fit


def _on_cylinder(points, normals, centre, right, up, radius):
    """Which faces lie on a cylinder, about its top."""
    away = across(points - centre, right)
    distance = np.maximum(np.linalg.norm(away, axis=1), 1e-12)
    radial = np.einsum("ij,ij->i", normals, away) / distance
    upper = away @ unit(across(up, right)) / distance > np.cos(np.radians(ARC))
    level = np.abs(normals @ right) < SIDEWAYS
    return level & upper & (radial > RADIAL) & (np.abs(distance - radius) < 0.25 * radius)


def fit_coaxial(
    patches: list[tuple[np.ndarray, np.ndarray]],
    centre: np.ndarray,
    axis: np.ndarray,
    radii: np.ndarray,
    soft: float,
) -> Fit:
    """Cylinders with one axis, from a start on.

    ``patches`` holds points and weights of each cylinder; from the distance ``soft`` on a point
    loses its weight.
    """
    plane, size = np.linalg.svd(axis[None])[2][1:], float(radii[0])
    roots = [np.sqrt(weights / weights.mean() / len(patches)) for _, weights in patches]

    def line(x):
        return unit(axis + x[:2] @ plane), centre + size * x[2:4] @ plane

    def residual(x):
        turned, at = line(x)
        rows = [np.linalg.norm(across(points - at, turned), axis=1) / size for points, _ in patches]
        return np.concatenate(
            [root * (row - radius) for root, row, radius in zip(roots, rows, x[4:])]
        )

    start = np.r_[np.zeros(4), radii / size]
    from scipy.optimize import least_squares

    found = least_squares(
        residual, start, loss="soft_l1", f_scale=soft / size, max_nfev=EVALUATIONS
    )
    x = found.x
    parts = np.split(residual(x) * size, np.cumsum([len(root) for root in roots])[:-1])
    misfit = float(np.sqrt(sum(np.mean(part**2) for part in parts)))
    turned, at = line(x)
    return Fit(at, x[4:] * size, misfit, turned, wrong="" if found.success else UNSETTLED)


AGREE = 45.0  # directions of bones and header that differ by more than this [degree] are named
# Scans are saved along the body: an axis of the coordinates within this [degree] of what a thigh
# shows is taken.
NEAR_AXIS = 25.0
LEAST_TRIANGLES = 100  # of fewer triangles the shape of a bone says nothing
_ABOVE = {"femur": ("pelvis", "ilium", "sacrum"), "tibia": ("femur", "patella")}
_BELOW = {
    "femur": ("tibia", "patella", "fibula", "talus", "calcaneus", "foot"),
    "tibia": ("talus", "calcaneus", "foot"),
}


# The axes of NIfTI: x to the right, y forwards, z up.
HEADER = Orientation(
    np.array([0.0, 0.0, 1.0]), np.array([0.0, 1.0, 0.0]), source="the volume's header"
)


def find_orientation(bones: list[Part], header: Orientation | None = None) -> Orientation | None:
    """Anatomical directions, None where no bone shows them; femora get their ``frame``, and a side
    if they have none.

    Directions of a ``header`` count; the bones are held against them.
    """
    femora = [bone for bone in bones if bone.kind == "femur"]
    doubts = [
        f"{bone.name}: it is cut off where the scan ends; its directions are those of the cut and "
        "of what is left: check superior and anterior, and the axes of its joints"
        for bone in bones
        if bone.kind in ("femur", "tibia") and bone.cut is not None
    ]
    for bone in femora:
        bone.frame = femur_frame(bone, bones)
        bone.side = bone.side or bone.frame.side
        if bone.side != bone.frame.side:
            words = {"l": "left", "r": "right"}
            said, shape = words[bone.side], words[bone.frame.side]
            doubts.append(
                f"{bone.name}: named {said}, its shape is that of the {shape} one; is it mirrored?"
            )
    frames = [bone.frame for bone in femora]
    for bone in bones if not femora else ():  # of a shank its foot lies in front
        feet = [b.points.mean(axis=0) for b in neighbours(bone, bones, _BELOW) if b.kind == "foot"]
        if bone.kind == "tibia" and feet:
            up = long_axis(bone, bones)
            ahead = unit(across(np.mean(feet, axis=0) - bone.points.mean(axis=0), up))
            frames.append(Orientation(up, ahead))
    if not frames:
        return header
    superior = unit(np.sum([frame.superior for frame in frames], axis=0))
    anterior = unit(across(np.sum([frame.anterior for frame in frames], axis=0), superior))
    if header is None:
        found = np.stack([superior, anterior])
        axes = np.sign(found) * (np.abs(found) == np.abs(found).max(axis=1, keepdims=True))
        near = ((found * axes).sum(axis=1) > np.cos(np.radians(NEAR_AXIS))).all()
        up, front = axes if near else found
        return Orientation(up, front, doubts=doubts)
    for word, seen in {"superior": superior, "anterior": anterior}.items():
        angle = np.degrees(np.arccos(np.clip(seen @ getattr(header, word), -1.0, 1.0)))
        if angle > AGREE:
            doubts.append(
                f"{word} by the bones is {angle:.0f} degrees off {header.source}, which counts"
            )
    return Orientation(header.superior, header.anterior, source=header.source, doubts=doubts)


def orient_scene(scene: Scene) -> Scene:
    """Give a scene the directions that its bones show, by their names and shapes, where its file
    has none.
    """
    if scene.superior is None or scene.anterior is None:
        shapes = [bone for bone in scene.bones if len(bone.mesh.faces) >= LEAST_TRIANGLES]
        found = find_orientation([Part(b.name, "", b, name_facts(b.name).bone) for b in shapes])
        if found is not None:
            scene.superior, scene.anterior = found.superior.tolist(), found.anterior.tolist()
    return scene


def neighbours(bone: Part, bones: list[Part], table: dict[str, tuple[str, ...]]) -> list[Part]:
    """The bones of the classes that a table lists for a bone, on its side."""
    return [b for b in bones if b.kind in table.get(bone.kind, ()) and b.may_be_beside(bone)]
