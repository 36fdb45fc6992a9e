"""A generic model brought to own bones: similarity transforms body by body, and the joints that come along."""

import csv
import itertools
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from rbfmuscle.opensim.match import mesh_files, name_score, split_name
from rbfmuscle.opensim.scene import Imported
from rbfmuscle.sim.joints.joint import Joint, frame_at
from rbfmuscle.sim.joints.skeleton import ordered, resolve
from rbfmuscle.sim.scene.meshes import read_mesh
from rbfmuscle.sim.scene.scene import Scene
from rbfmuscle.validation import UsageError

POINTS, ROUNDS, KEPT = 1500, 60, 0.9


@dataclass(frozen=True)
class Similarity:
    """``x -> scale * turn @ x + shift``, and how well it fits [scene unit]."""

    scale: float
    turn: np.ndarray
    shift: np.ndarray
    rms: float = 0.0
    greatest: float = 0.0

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """Move points (..., 3)."""
        return self.scale * points @ self.turn.T + self.shift


def fit_similarity(source: np.ndarray, target: np.ndarray) -> Similarity:
    """Return the similarity that takes corresponding points (n, 3) nearest to others (Umeyama 1991); no mirroring."""
    a, b = source.mean(axis=0), target.mean(axis=0)
    u, s, vt = np.linalg.svd((target - b).T @ (source - a) / len(source))
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    turn = u @ np.diag(sign) @ vt
    scale = float((s * sign).sum() / ((source - a) ** 2).sum(axis=1).mean())
    return Similarity(scale, turn, b - scale * turn @ a)


def register(source: Any, target: Any) -> Similarity:
    """Fit a mesh to another by a similarity: closest points both ways, from starts along the principal axes.

    Parameters
    ----------
    source, target : trimesh.Trimesh
    """
    points, aims = _spread(source), _spread(target)
    size = np.sqrt(aims.var(axis=0).sum() / points.var(axis=0).sum())
    first, second = (np.linalg.svd(p - p.mean(axis=0), full_matrices=False)[2] for p in (points, aims))
    starts = [np.eye(3)]
    for flips in itertools.product((1.0, -1.0), repeat=3):
        turn = second.T @ np.diag(flips) @ first
        if np.linalg.det(turn) > 0:
            starts.append(turn)
    found = [_closest(points, aims, size, turn, 15) for turn in starts]
    best = min(found, key=lambda fit: fit.rms)
    return _closest(points, aims, best.scale, best.turn, ROUNDS)


def _closest(points, aims, scale, turn, rounds):
    fit = Similarity(scale, turn, aims.mean(axis=0) - scale * turn @ points.mean(axis=0))
    tree = cKDTree(aims)
    for _ in range(rounds):
        moved = fit(points)
        there, near = tree.query(moved)
        back, nearest = cKDTree(moved).query(aims)
        forth = np.column_stack([np.arange(len(points)), near])
        pairs = np.concatenate([forth, np.column_stack([nearest, np.arange(len(aims))])])
        gap = np.concatenate([there, back])
        kept = pairs[gap <= np.quantile(gap, KEPT)]
        fit = fit_similarity(points[kept[:, 0]], aims[kept[:, 1]])
    moved = fit(points)
    gap = np.concatenate([tree.query(moved)[0], cKDTree(moved).query(aims)[0]])
    return replace(fit, rms=float(np.sqrt(np.mean(gap**2))), greatest=float(gap.max()))


def _spread(mesh):
    """Points evenly over a surface, the same every time."""
    random = np.random.default_rng(0)
    area = np.asarray(mesh.area_faces)
    chosen = random.choice(len(area), POINTS, p=area / area.sum())
    a, b = random.random((2, POINTS, 1))
    a, b = np.where(a + b > 1, 1 - a, a), np.where(a + b > 1, 1 - b, b)
    p, q, r = np.moveaxis(np.asarray(mesh.vertices)[np.asarray(mesh.faces)[chosen]], 1, 0)
    return p + a * (q - p) + b * (r - p)


def match_bones(found: Imported, folder: Path) -> dict[str, Path]:
    """Return the own bone of each of a scene's bones, by name."""
    chosen = {}
    for file in mesh_files(folder, "--bones"):
        words, side = split_name(file.stem)
        scores = {bone.name: name_score(bone.name, words, side) for bone in found.scene.bones}
        top = max(scores, key=lambda name: scores[name], default=None)
        if top is None or scores[top] < 0.5:
            found.notes.append(
                f"own bone {file.name!r}: no body has such a name: left out; add it with a fixed joint"
            )
        elif top in chosen:
            found.notes.append(
                f"own bone {file.name!r}: body {top!r} is {chosen[top].name!r} already: left out"
            )
        else:
            chosen[top] = file
    if not chosen:
        raise UsageError(
            f"--bones {folder}: no mesh has the name of a body; rename them, for instance femur_r.ply"
        )
    return chosen


def bring_to_bones(found: Imported, folder: Path) -> list[dict]:
    """Put own bones in the place of a model's, move its joints along, and return the table of residuals.

    The scene of ``found`` is replaced, and its ``places`` follow, so that muscle paths come along too.
    """
    old, millimetre = found.scene, found.scene.length(1.0)
    chosen = match_bones(found, folder)
    scene = Scene(old.name, units=old.units)
    fits, rows, meshes = {}, [], {}
    for bone in old.bones:
        if bone.name in chosen:
            meshes[bone.name] = read_mesh(chosen[bone.name], name=bone.name, may_be_open=True)
            fits[bone.name] = register(bone.mesh, meshes[bone.name].mesh)
            fit = fits[bone.name]
            rows.append(
                {"what": bone.name, "file": chosen[bone.name].name, "scale": fit.scale,
                 "rms_mm": fit.rms / millimetre, "max_mm": fit.greatest / millimetre}
            )  # fmt: skip
    _spread_fits(old, fits)
    for bone in old.bones:
        if bone.name in meshes:
            scene.add_bone(bone.name, meshes[bone.name])
        else:
            scene.add_bone(
                bone.name, (fits[bone.name](np.asarray(bone.mesh.vertices)), np.asarray(bone.mesh.faces))
            )
    for link in old.links:
        scene.add_link(link)
    for joint in old.joints:
        moved, row = _moved(joint, old, fits, millimetre)
        before = row.pop("before")
        if joint.parent in old.links:  # nothing was scanned there that the child could disagree with
            moved.frame[:3, 3] += moved.frame[:3, 3] - before
        else:
            rows.append(row)
        scene.place_joint(moved)
    scene.couplings = ordered(old.couplings)
    for body, name in found.names.items():
        fit, place = fits[name], found.places[body]
        found.places[body] = np.eye(4)
        found.places[body][:3, :3] = fit.scale * fit.turn @ place[:3, :3]
        found.places[body][:3, 3] = fit(place[:3, 3])
    found.scene = scene
    return rows


def write_rows(rows: list[dict], file: Path) -> None:
    """Write the residuals: of joints, the columns are the gap [mm] and the turn left [degree]."""
    with file.open("w", encoding="utf-8", newline="") as out:
        writer = csv.DictWriter(out, fieldnames=list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def _spread_fits(scene, fits):
    """A body without an own bone goes with its nearest relative that has one."""
    ties = [(joint.parent, joint.child) for joint in scene.joints]
    ties += [tie[::-1] for tie in ties]
    while True:
        grown = [(new, known) for known, new in ties if known in fits and new not in fits]
        if not grown:
            break
        for new, known in grown:
            fits.setdefault(new, fits[known])
    for name in [*(bone.name for bone in scene.bones), *scene.links]:
        fits.setdefault(name, next(iter(fits.values())))


def _moved(joint, scene, fits, millimetre):
    """A joint between registered bones: axes with the parent, midway, at rest as the child was scanned."""
    parent, child = fits[joint.parent], fits[joint.child]
    resting = resolve({}, scene.joints, scene.couplings)
    start = {name: resting[f"{joint.name}.{name}"] for name in joint.coordinates}
    there = _displacement(joint, start)
    at_rest = np.linalg.inv(there) if joint.backward else there
    # The joint's frame on the child's side, as the model has it at rest and as the child's own bone puts it.
    onward = at_rest @ joint.frame
    turn = child.turn @ onward[:3, :3]
    frame = np.eye(4)
    frame[:3, :3] = parent.turn @ joint.frame[:3, :3]
    free = [n for n, c in joint.coordinates.items() if c.motion == "rotation" and not c.locked]
    follows = {coupling.coordinate for coupling in scene.couplings}
    free = [name for name in free if f"{joint.name}.{name}" not in follows]
    straight = Joint(joint.name, "", "", frame, joint.coordinates, joint.rotations, (), joint.kind)

    def misfit(values):
        got = _displacement(straight, {**start, **dict(zip(free, values))})[:3, :3] @ frame[:3, :3]
        return Rotation.from_matrix(got.T @ turn).as_rotvec()

    rest = dict(start)
    if free and not joint.backward:
        solved = least_squares(misfit, [start[name] for name in free])
        rest.update(zip(free, map(float, solved.x)))
        left = float(np.linalg.norm(solved.fun))
    else:
        left = float(np.linalg.norm(misfit([start[name] for name in free])))
    frame = frame_at(parent(joint.centre))
    frame[:3, :3] = straight.frame[:3, :3]
    translations = tuple(_scaled(axis, joint, parent.scale) for axis in joint.translations)
    coordinates = {
        name: replace(facts, rest=rest[name], default=None) for name, facts in joint.coordinates.items()
    }
    made = replace(joint, frame=frame, coordinates=coordinates, translations=translations, _rest=(None, None))
    reached = _displacement(made, rest) @ frame
    gap = child(onward[:3, 3]) - reached[:3, 3]
    before, made.frame = frame[:3, 3].copy(), frame.copy()
    made.frame[:3, 3] += 0.5 * gap
    row = {"what": f"joint {joint.name}", "file": "", "scale": parent.scale,
           "rms_mm": float(np.linalg.norm(gap)) / millimetre, "max_mm": np.degrees(left), "before": before}  # fmt: skip
    return made, row


def _displacement(joint, values):
    found = joint.displacement(values)
    return np.eye(4) if found is None else found


def _scaled(axis, joint, scale):
    """A shift by a turning coordinate grows with the bone; one that is itself a length stays what it says."""
    lengths = any(joint.coordinates[name].motion == "translation" for name in axis.coordinates)
    if lengths:
        return axis
    inputs = [1.0] * len(axis.coordinates)
    return replace(axis, function=axis.function.rescaled(inputs, scale))
