"""Muscles of a model without meshes: tapered tubes along the model's own paths.

A tube has the volume of its fibres: maximum isometric force times optimal fibre length over the specific tension. Its
middle line is the model's path in its default pose, over its wrapping objects, kept out of the bones.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from rbfmuscle.geometry.exact_distance import ExactDistance
from rbfmuscle.geometry.surfaces import mesh_volume
from rbfmuscle.importers.opensim.frames import Frames
from rbfmuscle.importers.opensim.functions import find_function, numbers, read_function, truth, vector
from rbfmuscle.importers.opensim.model import OsimModel
from rbfmuscle.importers.opensim.muscle_paths import ModelMuscle, WrapShape
from rbfmuscle.importers.opensim.xml import Node
from rbfmuscle.scene.joints.joint import frame_at
from rbfmuscle.validation import SceneError

# Force per area of muscle [N/m2] (Arnold et al. 2010, Ann Biomed Eng 38: 269; Rajagopal et al. 2016 have 60 N/cm2).
SPECIFIC_TENSION = 61e4
# Sections along a tube and corners of each; radius at the ends against the middle; share of the length held at an end.
SECTIONS, CORNERS, END_RADIUS, HELD = 28, 12, 0.3, 0.06
# Rounds in which the middle line is drawn straight and put out of what is in its way.
ROUNDS = 60


def read_muscles(model: OsimModel, node: Node, bodies: list[Node], frames: Frames) -> list[ModelMuscle]:
    """The muscles of a model that have a path, a maximum isometric force and an optimal fibre length."""
    shapes = {}
    for body in [child for child in node.nodes() if child.tag == "Ground"] + bodies:
        for shape in body.objects("WrapObjectSet"):
            found = _wrap_shape(shape, body.name or "ground")
            if found is None:
                model.notes.append(f"wrapping object {shape.name!r} ({shape.tag}) is not taken")
            else:
                shapes[shape.name] = found
    muscles = []
    for force in node.objects("ForceSet"):
        path = force.child("GeometryPath")
        if path is None or not force.word("optimal_fiber_length"):
            continue
        place = f"muscle {force.name!r}"
        tension, fibre = (
            numbers(force.word(tag, "0"), place=f"{place}: {tag}", count=1)[0]
            for tag in ("max_isometric_force", "optimal_fiber_length")
        )
        points = [_path_point(point, frames, model, place) for point in path.objects("PathPointSet")]
        names = [wrap.word("wrap_object") for wrap in path.objects("PathWrapSet")]
        wraps = [shapes[name] for name in names if name in shapes]
        here = [point for point in points if point is not None]
        muscles.append(ModelMuscle(force.name, here, wraps, tension * fibre / SPECIFIC_TENSION))
    return muscles


def _wrap_shape(shape, body):
    place = f"wrapping object {shape.name!r}"
    if shape.tag == "WrapCylinder":
        radius, length = (
            numbers(shape.word(tag, "0"), place=place, count=1)[0] for tag in ("radius", "length")
        )
        radii = [radius, radius, 0.5 * length]
    elif shape.tag == "WrapSphere":
        radii = numbers(shape.word("radius", "0"), place=place, count=1) * 3
    elif shape.tag == "WrapEllipsoid":
        radii = numbers(shape.word("dimensions", "0 0 0"), place=place, count=3)
    else:
        return None
    turn = vector(shape, "xyz_body_rotation", "0 0 0", place=place)
    frame = frame_at(np.array(vector(shape, "translation", "0 0 0", place=place)), turn)
    if not truth(shape, "active", True) or min(radii) <= 0:
        return None
    return WrapShape(
        shape.name,
        body,
        frame,
        np.array(radii),
        shape.tag,
        shape.word("quadrant", "all")[:2].replace("al", ""),
    )


def _path_point(point, frames, model, place):
    """Body and place in it of a path point where coordinates are at their defaults; None where it is not active."""
    name = point.word("socket_parent_frame") or point.word("body")
    body, frame = frames.place(name, inside="/")
    values = {name: facts.resting for name, facts in model.coordinates().items()}

    def value_of(tag):
        coordinate = (point.word(f"socket_{tag}") or point.word(tag)).split("/")[-1]
        return values.get(coordinate, 0.0)

    if point.tag == "ConditionalPathPoint":
        low, high = numbers(point.word("range", "-1e9 1e9"), place=f"{place}: range", count=2)
        if not low <= value_of("coordinate") <= high:
            return None
    at = vector(point, "location", "0 0 0", place=place)
    if point.tag == "MovingPathPoint":
        for k, axis in enumerate("xyz"):
            inner = find_function(point.child(f"{axis}_location"))
            if inner is not None:
                at[k] = read_function(inner, place=place)(value_of(f"{axis}_coordinate"))
    return body, frame[:3, :3] @ np.array(at) + frame[:3, 3]


@dataclass
class Tube:
    """A tube: vertices [scene unit], triangles, and the vertices that each bone holds."""

    vertices: np.ndarray
    faces: np.ndarray
    held: dict[str, np.ndarray]


def make_tube(
    muscle: ModelMuscle, places: dict[str, np.ndarray], names: dict[str, str], bones: Any, metre: float
) -> Tube:
    """The tube of a muscle in the scene.

    Parameters
    ----------
    muscle : ModelMuscle
    places : dict of str to (4, 4) ndarray
        From every body of the model to the scene [scene unit].
    names : dict of str to str
        The scene's name of every body.
    bones : dict of str to ExactDistance
        Of the scene's bones by name.
    metre : float
        Scene units in a metre.

    Raises
    ------
    SceneError
        If a body that holds an end has no mesh, or the path has no length or no volume.
    """
    ends = [names[muscle.points[k][0]] for k in (0, -1)] if len(muscle.points) > 1 else []
    lost = [end for end in ends if end not in bones]
    if len(ends) < 2 or ends[0] == ends[1] or lost or muscle.volume <= 0.0:
        reason = f"body {lost[0]!r} has no mesh to hold it" if lost else "it has no two bodies, or no volume"
        raise SceneError(f"muscle {muscle.name!r}: {reason}")
    points = np.array([places[body][:3, :3] @ at * metre + places[body][:3, 3] for body, at in muscle.points])
    line, fixed = _middle_line(points)
    length = np.linalg.norm(np.diff(line, axis=0), axis=1).sum()
    share = END_RADIUS + (1.0 - END_RADIUS) * np.sin(np.pi * np.linspace(0.0, 1.0, len(line)))
    radius = share * np.sqrt(muscle.volume * metre**3 / (np.pi * length * np.mean(share**2)))
    wraps = [(wrap, places[wrap.body] @ scaled(wrap.frame, metre), metre) for wrap in muscle.wraps]
    line = _clear_line(line, fixed, radius, wraps, list(bones.values()))
    volume = mesh_volume(*_skin(line, radius))  # as its square, but for where sections run into each other
    vertices, faces = _skin(line, radius * np.sqrt(muscle.volume * metre**3 / volume))
    held = _held(muscle, names, fixed, len(line), bones)
    return Tube(vertices, faces, held)


def scaled(transform: np.ndarray, metre: float) -> np.ndarray:
    """Return a rigid (4, 4) transform with its shift in other units."""
    out = transform.copy()
    out[:3, 3] *= metre
    return out


def _middle_line(points):
    """Points (n, 3) evenly along a path, and the place in them of each of its points."""
    along = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))]
    along /= max(along[-1], 1e-300)
    marks = np.linspace(0.0, 1.0, SECTIONS)
    line = np.column_stack([np.interp(marks, along, points[:, k]) for k in range(3)])
    return line, np.rint(along * (SECTIONS - 1)).astype(int)


def _clear_line(line, fixed, radius, wraps, bones):
    """The line drawn straight between its points, out of wrapping shapes and, by its radius, out of bones."""
    line, start = line.copy(), line.copy()
    middle = np.arange(3, len(line) - 3)
    for number in range(ROUNDS):
        line[1:-1] = 0.25 * (line[:-2] + 2.0 * line[1:-1] + line[2:])
        line[fixed] = 0.5 * (line[fixed] + start[fixed])
        for wrap, frame, metre in wraps:
            back = np.linalg.inv(frame)
            local = (line @ back[:3, :3].T + back[:3, 3]) / metre
            line = (wrap.put_out(local) * metre) @ frame[:3, :3].T + frame[:3, 3]
        if number % 10 == 9:
            for bone in bones:
                line[middle] = _out_of(bone, line[middle], 0.8 * radius[middle])
    line[[0, -1]] = start[[0, -1]]
    return line


def _out_of(bone, points, reach):
    distance = bone.signed_distance(points, reach=float(reach.max()))
    near = np.isfinite(distance) & (distance < reach)
    if not near.any():
        return points
    closest = bone.closest_point(points[near])
    away = (points[near] - closest) * np.where(distance[near] < 0.0, -1.0, 1.0)[:, None]
    size = np.maximum(np.linalg.norm(away, axis=1), 1e-12)[:, None]
    out = points.copy()
    out[near] = closest + away / size * reach[near][:, None]
    return out


def _skin(line, radius):
    """Vertices and triangles of a tube about a line, closed at both ends; sections turn as little as they can."""
    tangent = np.gradient(line, axis=0)
    tangent /= np.maximum(np.linalg.norm(tangent, axis=1), 1e-12)[:, None]
    side = np.cross(tangent[0], np.eye(3)[np.argmin(np.abs(tangent[0]))])
    angle = np.linspace(0.0, 2.0 * np.pi, CORNERS, endpoint=False)
    rings = []
    for point, along, r in zip(line, tangent, radius):
        side = side - side @ along * along
        side = side / np.linalg.norm(side)
        rings.append(
            point + r * (np.outer(np.cos(angle), side) + np.outer(np.sin(angle), np.cross(along, side)))
        )
    count, k = len(line), np.arange(CORNERS)
    following = np.roll(k, -1)
    faces = [np.column_stack([following, k, np.full(CORNERS, count * CORNERS)])]
    for n in range(count - 1):
        a, b = n * CORNERS, (n + 1) * CORNERS
        faces += [
            np.column_stack([a + k, a + following, b + k]),
            np.column_stack([a + following, b + following, b + k]),
        ]
    last = (count - 1) * CORNERS
    faces.append(np.column_stack([last + k, last + following, np.full(CORNERS, count * CORNERS + 1)]))
    return np.vstack([*rings, line[:1], line[-1:]]), np.vstack(faces)


def _held(muscle, names, fixed, count, bones):
    """Vertices by bone: both ends with the points that follow on their body, a section at each point on another."""
    bodies = [names[body] for body, _ in muscle.points]
    few = max(1, round(HELD * count))
    first = next(k for k, body in enumerate(bodies) if body != bodies[0])
    last = next(k for k, body in enumerate(reversed(bodies)) if body != bodies[-1])
    start = min(max(few, fixed[first - 1]), count // 3)
    end = max(min(count - 1 - few, fixed[len(bodies) - last]), count - 1 - count // 3)
    sections = {k: bodies[0] for k in range(start + 1)} | {k: bodies[-1] for k in range(end, count)}
    for place, body in zip(fixed[first : len(bodies) - last], bodies[first : len(bodies) - last]):
        if body in bones and int(place) not in sections:
            sections[int(place)] = body
    held: dict[str, list[np.ndarray]] = {}
    for k, body in sections.items():
        held.setdefault(body, []).append(np.arange(k * CORNERS, (k + 1) * CORNERS))
    held[bodies[0]].append(np.array([count * CORNERS]))
    held[bodies[-1]].append(np.array([count * CORNERS + 1]))
    return {body: np.sort(np.concatenate(rows)) for body, rows in held.items()}


def bone_distances(scene: Any) -> dict[str, ExactDistance]:
    """Exact distances to every bone of a scene, by name."""
    return {bone.name: ExactDistance(bone.mesh.vertices, bone.mesh.faces) for bone in scene.bones}
