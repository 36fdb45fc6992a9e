"""Guessing a scene from a folder of meshes: bones by name or size, joints and attachments by nearness."""

import os
import re
from dataclasses import dataclass

import numpy as np

from rbfmuscle.sim.scene.attachments import signed_distances
from rbfmuscle.sim.scene.meshes import MESH_SUFFIXES, read_mesh
from rbfmuscle.validation import MeshError, UsageError

BONE_WORDS = frozenset(
    [
        "bone",
        "pelvis",
        "hip_bone",
        "hipbone",
        "coxa",
        "innominate",
        "ilium",
        "ischium",
        "pubis",
        "sacrum",
        "femur",
        "tibia",
        "fibula",
        "patella",
        "calcaneus",
        "talus",
        "foot",
        "hand",
        "scapula",
        "clavicle",
        "humerus",
        "ulna",
        "radius",
        "rib",
        "ribs",
        "sternum",
        "vertebra",
        "spine",
        "skull",
        "mandible",
        "metatarsal",
    ]
)
MUSCLE_WORDS = frozenset(
    [
        "muscle",
        "gluteus",
        "glut",
        "adductor",
        "iliacus",
        "psoas",
        "iliopsoas",
        "rectus",
        "vastus",
        "biceps",
        "triceps",
        "semitendinosus",
        "semimembranosus",
        "gracilis",
        "sartorius",
        "tensor",
        "piriformis",
        "gastrocnemius",
        "soleus",
        "tibialis",
        "peroneus",
        "deltoid",
        "pectoralis",
        "brachialis",
    ]
)
ROOTS = ["pelvis", "hip_bone", "hipbone", "coxa", "innominate", "scapula"]
FIXED = ["sacrum", "ilium", "ischium", "pubis"]
ATTACHED_SHARE = 0.04  # of a muscle's vertices to each bone


@dataclass
class _Part:
    name: str
    file: str
    mesh: object
    by_name: bool = True


def guess_scene(folder, units, base):
    """Return the text of a scene file.

    Parameters
    ----------
    folder : pathlib.Path
        Of the meshes.
    units : str
    base : pathlib.Path
        Folder that the file's paths are relative to.

    Raises
    ------
    UsageError
        If the folder is missing or holds no bone or no muscle.
    MeshError
        If a mesh cannot be read.
    """
    if not folder.is_dir():
        raise UsageError(f"{folder} is no folder; give the folder of the meshes")
    paths = sorted(p for p in folder.iterdir() if p.suffix.lower() in MESH_SUFFIXES)
    if len(paths) < 2:
        raise UsageError(
            f"{folder} holds {len(paths)} meshes ({' '.join(MESH_SUFFIXES)}); a scene needs bones and muscles"
        )
    bones, muscles = _sort(paths, base)
    root, joints = _joints(bones)
    held = [_attach(muscle, bones, root, joints) for muscle in muscles]
    parts = [_head(folder, units), *(_bone_text(bone) for bone in bones), *(_joint_text(*j) for j in joints)]
    if joints:
        parts.append(_motion_text(joints[0][0]))
    parts += [_muscle_text(muscle, *places) for muscle, places in zip(muscles, held)]
    return "\n".join([*parts, _TAIL])


def _sort(paths, base):
    names, bones, muscles, unknown = set(), [], [], []
    for path in paths:
        name = re.sub(r"[^a-z0-9_-]+", "_", path.stem.lower()).strip("_") or "part"
        while name in names:
            name += "_2"
        names.add(name)
        part = _Part(
            name, os.path.relpath(path, base).replace(os.sep, "/"), read_mesh(path, may_be_open=True).mesh
        )
        words = set(re.split(r"[_\-\d]+", name))
        is_bone = bool(words & BONE_WORDS) or any(word in name for word in BONE_WORDS if len(word) > 5)
        if words & MUSCLE_WORDS:
            muscles.append(part)
        elif is_bone:
            bones.append(part)
        else:
            unknown.append(part)
    unknown.sort(key=lambda part: -np.linalg.norm(part.mesh.extents))
    for part in unknown:
        part.by_name = False
        (bones if len(bones) < 2 else muscles).append(part)
    if not bones or not muscles:
        kind, taken = ("bone", muscles) if not bones else ("muscle", bones)
        raise UsageError(
            f"{paths[0].parent} holds no {kind} (all are {'muscles' if not bones else 'bones'} by their names or "
            f"sizes: {', '.join(part.file for part in taken)}); name the files after what they are"
        )
    for part in muscles:
        if not part.mesh.is_watertight:
            raise MeshError(f"{part.file}: the surface is open; a muscle must be closed")
    return bones, muscles


def _joints(bones):
    """Hang each movable bone on the nearest of those already placed."""
    root = next((b for b in bones if any(word in b.name for word in ROOTS)), None)
    root = root or max(bones, key=lambda bone: bone.mesh.area)
    placed = [root, *(b for b in bones if b is not root and any(word in b.name for word in FIXED))]
    waiting = [bone for bone in bones if not any(bone is other for other in placed)]
    joints = []
    while waiting:
        gaps = [
            (signed_distances(np.asarray(child.mesh.vertices), parent.mesh).min(), i, j)
            for i, child in enumerate(waiting)
            for j, parent in enumerate(placed)
        ]
        _, i, j = min(gaps)
        child = waiting.pop(i)
        joints.append((child, placed[j], *_centre(child, placed[j])))
        placed.append(child)
    return root, joints


def _centre(child, parent):
    """Centre, radius and misfit of the ball that fits the part of the child nearest to its parent."""
    points = np.asarray(child.mesh.vertices)
    distance = signed_distances(points, parent.mesh)
    count = min(len(points) - 1, max(20, len(points) // 25))
    near = points[distance <= np.partition(distance, count)[count]]
    middle = near.mean(axis=0)
    local = near - middle
    solution = np.linalg.lstsq(
        np.column_stack([2 * local, np.ones(len(local))]), (local**2).sum(axis=1), rcond=None
    )[0]
    radius = np.sqrt(max(solution[3] + solution[:3] @ solution[:3], 0.0))
    misfit = np.sqrt(np.mean((np.linalg.norm(local - solution[:3], axis=1) - radius) ** 2))
    return middle + solution[:3], radius, misfit


def _attach(muscle, bones, root, joints):
    """The two bones nearest to a muscle that move against each other, each with a distance."""
    movers = {id(child) for child, *_ in joints}
    points = np.asarray(muscle.mesh.vertices)
    distances = {bone.name: signed_distances(points, bone.mesh) for bone in bones}
    count = max(8, int(ATTACHED_SHARE * len(points)))
    ranked = sorted(bones, key=lambda bone: np.partition(distances[bone.name], count)[count])
    first = ranked[0]
    body = id(first) if id(first) in movers else id(root)
    others = [b for b in ranked[1:] if (id(b) if id(b) in movers else id(root)) != body]
    chosen = sorted([first, *others[:1]], key=lambda bone: id(bone) in movers)  # the origin does not move
    reach = {bone.name: float(np.partition(distances[bone.name], count)[count]) for bone in chosen}
    if len(chosen) == 2:
        _separate(reach, distances)
    return [(bone.name, reach[bone.name]) for bone in chosen], len(chosen) == 2


def _separate(reach, distances):
    """Shrink the distances until no vertex is held by both bones."""
    a, b = reach
    for _ in range(200):
        both = (distances[a] <= reach[a]) & (distances[b] <= reach[b])
        if not both.any():
            return
        wide = max(reach, key=reach.get)
        least = float(distances[wide].min())
        reach[wide] = least + 0.9 * (reach[wide] - least)


def _head(folder, units):
    return (
        f"# Scene guessed from the meshes in {folder.name or folder}. "
        "Lines marked GUESS want a look; the rest is as found.\n"
        f"# All keys: docs/scene_file.md. Then: rbfmuscle check, rbfmuscle run.\n"
        f'[scene]\nformat = 1\nname = "{re.sub(r"[^A-Za-z0-9_-]+", "_", folder.resolve().name) or "scene"}"\n'
        f'units = "{units}"   # of every length here; a mesh in another unit takes scale = ...\n\n'
        f'[defaults]\nmodel = "rbf"   # or a table: {{ name = "rbf", centres = 300 }}\n'
    )


def _bone_text(bone):
    mark = "" if bone.by_name else "   # GUESS: a bone, by its size"
    return f'[[bone]]\nname = "{bone.name}"{mark}\nmesh = "{bone.file}"\n'


def _joint_text(child, parent, centre, radius, misfit):
    x, y, z = (round(float(value), 6) for value in centre)
    ball = f"GUESS: ball of radius {radius:.4g} fitted where they meet, misfit {misfit:.2g}"
    return (
        f'[[joint]]   # GUESS: {child.name} turns against {parent.name}\nname = "{child.name}_joint"\n'
        f'parent = "{parent.name}"\nchild = "{child.name}"\n'
        f"centre = [{x}, {y}, {z}]   # {ball}\n"
        "# GUESS: the axes of the mesh files; rename and turn them, angles follow the right-hand rule\n"
        "axes = { rotation_x = [1, 0, 0], rotation_y = [0, 1, 0], rotation_z = [0, 0, 1] }\n"
    )


def _motion_text(child):
    ramp = f'{{ "{child.name}_joint.rotation_x" = {{ from = 0, to = 30, step = 2 }} }}'
    return f"[motion]   # degrees\nramp = {ramp}   # GUESS\n"


def _muscle_text(muscle, places, complete):
    mark = "" if muscle.by_name else "   # GUESS: a muscle, by its name or size"
    lines = [
        f'  {{ bone = "{bone}", near = {np.ceil(reach * 1e4) / 1e4:g} }},   # GUESS: all of it this near to the bone'
        for bone, reach in places
    ]
    if not complete:
        lines.append('  # a second bone is missing here: { bone = "...", near = ... }')
    return "\n".join(
        [f'[[muscle]]\nname = "{muscle.name}"{mark}\nmesh = "{muscle.file}"\nattach = [', *lines, "]\n"]
    )


_TAIL = """[contact]
initial = "resolve"   # muscles that start inside a bone are pushed out; or "keep", "error"

[detect]
tunnelling = { angle = 135, action = "substep" }   # points that pass through a bone in one step

[output]
surfaces = { format = "pvd" }   # or vtp, ply, stl, obj, glb
"""
