"""How muscles, tendons, bones and views look in files, pictures and pages: colours, groups,
directions.
"""

from collections.abc import Mapping, Sequence

import numpy as np

from rbfmuscle.geometry.arrays import Floats, Integers, unit
from rbfmuscle.geometry.lines import distance_along, tube_mesh
from rbfmuscle.geometry.surfaces import joined_meshes
from rbfmuscle.run.info import JointInfo
from rbfmuscle.scene.joints import Joint
from rbfmuscle.scene.objects import Muscle
from rbfmuscle.scene.tendons import TendonLine

BONE_COLOUR, TENDON_COLOUR = "#e9e0cd", "#cfd8dc"
# People who are colour-blind can distinguish them (P. Tol, "muted"); its sand is left out, as bones
# have that colour.
MUSCLE_COLOURS = (
    "#cc6677",
    "#332288",
    "#44aa99",
    "#882255",
    "#88ccee",
    "#117733",
    "#aa4499",
    "#999933",
)
# Stretch of fibres that has the last colour of the scale, and the colours at its ends and middle.
SHORT, LONG = 0.6, 1.4
STRETCH_COLOURS = ("#2166ac", "#f7f7f7", "#b2182b")
# How much nearer to white or black the muscles of one group are, one after the other.
_SHADES = (0.0, 0.3, -0.25)
# From the subject to the camera, along the body's axes: left, posterior, superior.
VIEWS: dict[str, tuple[float, float, float]] = {
    "front": (0.0, -1.0, 0.12),
    "back": (0.0, 1.0, 0.12),
    "left": (1.0, -0.12, 0.12),
    "right": (-1.0, -0.12, 0.12),
    "top": (0.0, 0.0, 1.0),
    "bottom": (0.0, 0.0, -1.0),
}
UPRIGHT = 0.99  # cosine from which a direction counts as that of the body's axis
# Length over which a tube tapers, in radii of the belly's end.
TAPER = 2.5
# No taper is longer than this share of the tendon.
LONGEST_TAPER = 0.6


def muscle_groups(
    joints: Sequence[Joint] | Sequence[JointInfo], held: Mapping[str, Sequence[str]]
) -> dict[str, str]:
    """Group of each muscle by the joints that it crosses.

    ``held`` names the bones that each muscle is attached to, once for each attachment. Joints that
    carry a single bone without another joint (a patella, a tendon's end) are left out; a muscle
    that crosses no other belongs to the bone that it lies along.
    """
    above = {joint.child: joint.parent for joint in joints}
    carrying = set(above.values())

    def chain(bone: str) -> list[str]:
        found = []
        while bone in above and bone not in found:
            found.append(bone)
            bone = above[bone]
        return [*found, bone]

    groups = {}
    for muscle, bones in held.items():
        chains = [chain(bone) for bone in bones]
        crossed = {
            bone for one in chains for bone in one if any(bone not in other for other in chains)
        }
        names = [joint.name for joint in joints if joint.child in crossed & carrying]
        if len(joints) == 1 and crossed:
            names = [joints[0].name]
        shared = [bone for one in chains[:1] for bone in one if bone not in crossed]
        along = f"along {shared[0]}" if shared else "without a joint"
        groups[muscle] = f"across {', '.join(names)}" if names else along
    return groups


def muscle_colours(names: Sequence[str], groups: Mapping[str, str] | None = None) -> dict[str, str]:
    """Dict of muscle name to its colour in pictures and plots; of many muscles a hue for each of
    their groups.
    """
    if groups is None or len(names) <= len(MUSCLE_COLOURS):
        return {name: MUSCLE_COLOURS[k % len(MUSCLE_COLOURS)] for k, name in enumerate(names)}
    kinds = list(dict.fromkeys(groups[name] for name in names))
    found, seen = {}, dict.fromkeys(kinds, 0)
    for name in names:
        kind = groups[name]
        hue = MUSCLE_COLOURS[kinds.index(kind) % len(MUSCLE_COLOURS)]
        found[name] = mixed_colour(hue, _SHADES[seen[kind] % len(_SHADES)])
        seen[kind] += 1
    return found


def mixed_colour(colour: str, share: float) -> str:
    """A colour brought nearer to white (share above 0) or to black (below)."""
    values = bytes.fromhex(colour[1:])
    end = 255 if share > 0 else 0
    return "#" + bytes(round(value + abs(share) * (end - value)) for value in values).hex()


def rgb(colour: str) -> Floats:
    """Red, green and blue (3,) of a colour like "#cc6677", 0 to 1."""
    return np.array(list(bytes.fromhex(colour[1:]))) / 255.0


_SRGB_LINEAR = 0.04045  # below it sRGB is a line (IEC 61966-2-1)


def linear_rgb(colour: Floats) -> Floats:
    """A colour (3,) as screens show it in the linear light that USD and glTF count in."""
    return np.where(colour <= _SRGB_LINEAR, colour / 12.92, ((colour + 0.055) / 1.055) ** 2.4)


def stretch_colours(stretch: Floats) -> Floats:
    """Colours (..., 3) of a fibre's stretch (...), 0 to 1: blue from `SHORT` down, white at 1, red
    from `LONG` up.
    """
    ends = [rgb(colour) for colour in STRETCH_COLOURS]
    places = (SHORT, 1.0, LONG)
    return np.stack(
        [np.interp(stretch, places, [end[axis] for end in ends]) for axis in range(3)], axis=-1
    )


def view_axes(direction: Sequence[float] | Floats, body: Floats) -> Floats:
    """Right, up (superior, else anterior) and towards the camera (3, 3), from a direction along the
    body's axes.
    """
    ahead = unit(np.asarray(direction, dtype=float) @ body)
    right = unit(np.cross(body[2] if abs(ahead @ body[2]) < UPRIGHT else -body[1], ahead))
    return np.stack([right, np.cross(ahead, right), ahead])


def motion_direction(poses: Sequence[Mapping[str, Floats]], body: Floats) -> Floats:
    """Direction (3,) from which the motion is seen in its plane: along the axis about which a bone
    turns most.

    ``poses`` (4, 4) are those of each frame by bone. The direction is along ``body`` (3, 3): left,
    posterior and superior; it is from the right where no bone turns, or about an axis that is
    nearly upright.
    """
    from scipy.spatial.transform import Rotation

    usual = np.array(VIEWS["right"])
    pairs = [(start, pose[bone]) for bone, start in poses[0].items() for pose in poses[1:]]
    turns = [body @ pose[:3, :3] @ start[:3, :3].T @ body.T for start, pose in pairs]
    vectors = Rotation.from_matrix(turns).as_rotvec() if turns else np.zeros((1, 3))
    widest = max(vectors, key=np.linalg.norm)
    angle = float(np.linalg.norm(widest))
    if angle < np.radians(2.0) or abs(widest[2]) > 0.8 * angle:
        return usual
    axis = widest / angle
    return axis if axis @ usual > 0 or (axis @ usual == 0 and axis[1] < 0) else -axis


def fibres_name(muscle: str) -> str:
    """Name of the lines of a muscle's fibres in files."""
    return f"{muscle}_fibres"


def tendon_mesh(
    muscle: Muscle, tendons: Mapping[str, TendonLine]
) -> tuple[Floats, Integers] | None:
    """Vertices (n, 3) and outward faces (m, 3), always the same, of all tendons of a muscle; None
    where it has none.
    """
    tubes = [_tube(tendons[end.name]) for end in muscle.tendons if end.name in tendons]
    if not tubes:
        return None
    return joined_meshes(*zip(*tubes))


def _tube(tendon: TendonLine) -> tuple[Floats, Integers]:
    """One tendon, tapering from the belly's end on."""
    line, (wide, thin) = tendon.points, tendon.radii
    along = distance_along(line)
    share = np.clip(along / max(min(TAPER * wide, LONGEST_TAPER * along[-1]), 1e-300), 0.0, 1.0)
    radii = wide + (thin - wide) * share**2 * (3.0 - 2.0 * share)
    return tube_mesh(line, radii)
