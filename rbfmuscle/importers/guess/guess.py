"""A scene guessed from a folder of meshes: bones, joints, attachments, each with a confidence and its reason."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from rbfmuscle.importers.guess.attachments import MuscleGuess, guess_attachments
from rbfmuscle.importers.guess.joints import JointGuess, guess_joints
from rbfmuscle.importers.guess.orientation import Orientation, find_orientation
from rbfmuscle.importers.guess.parts import MILLIMETRE, Part, guess_units, read_parts
from rbfmuscle.importers.guess.tendons import guess_tendons, write_stubs
from rbfmuscle.importers.guess.text import scene_text
from rbfmuscle.scene.scene import Scene
from rbfmuscle.validation import MeshError, SceneError, UsageError

# Below this confidence a guess is listed on the terminal.
DOUBTFUL = 0.6


@dataclass
class SceneGuess:
    """What was guessed of a folder.

    Attributes
    ----------
    title : str
        What the comment at the top calls the source.
    name, units : str
        Of the scene.
    bones : list of Part
    root : Part
        The bone that stands still.
    joints : list of JointGuess
    muscles : list of MuscleGuess
    orientation : Orientation or None
    unusable : dict of str to str
        Why a bone or a muscle is not in the scene, by file.
    notes : list of str
        What was left out, taken for something, made coarser, and the unit where it was guessed.
    """

    title: str
    name: str
    units: str
    bones: list[Part]
    root: Part
    joints: list[JointGuess]
    muscles: list[MuscleGuess] = field(default_factory=list)
    orientation: Orientation | None = None
    unusable: dict[str, str] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)

    def doubts(self) -> list[str]:
        """One line for each guess that wants a look, the least sure first."""
        rows = [(0.3, f"bone {bone.name}: {bone.reason}") for bone in self.bones if not bone.sure]
        rows += [(0.0, f"{file} cannot be used: {reason}") for file, reason in self.unusable.items()]
        rows += [(0.1, doubt) for doubt in (self.orientation.doubts if self.orientation else ())]
        for joint in self.joints:
            if joint.confidence < DOUBTFUL:
                rows.append((joint.confidence, f"joint of {joint.child.name}: {joint.reason}"))
        for muscle in self.muscles:
            reasons = [muscle.wrong, *muscle.reasons] if muscle.wrong else muscle.reasons
            if muscle.wrong or muscle.confidence < DOUBTFUL:
                rows.append((muscle.confidence, f"muscle {muscle.muscle.name}: {'; '.join(reasons)}"))
        return [text for _, text in sorted(rows, key=lambda row: row[0])]


def guess_scene(
    folder: Path, units: str | None, base: Path, *, header: Orientation | None = None
) -> SceneGuess:
    """Guess a scene from the meshes of a folder.

    Parameters
    ----------
    folder : Path
        Meshes, or folders ``bones`` and ``muscles`` with them.
    units : str or None
        ``"mm"``, ``"cm"`` or ``"m"``; by the size of the bones where it is not given.
    base : Path
        Folder that the scene's paths are relative to.
    header : Orientation, optional
        Anatomical directions where they are known.

    Raises
    ------
    UsageError
        If the folder is missing, holds no bone or no muscle, or is of no known unit.
    """
    found = read_parts(folder, base)
    bones, muscles, notes = found.bones, found.muscles, found.notes
    if found.left_out:
        notes.append(f"left out, neither bone nor muscle: {', '.join(found.left_out)}")
    if units is None:
        units, reason = guess_units(bones)
        notes.append(f"units are {units}: {reason}")
    millimetre = MILLIMETRE[units]
    orientation = find_orientation(bones, header)
    for bone in bones:  # what its shape shows counts where its name says nothing
        bone.side = bone.side or (orientation.sides.get(id(bone), "") if orientation else "")
    root, joints = guess_joints(bones, millimetre, orientation)
    name = re.sub(r"[^A-Za-z0-9_-]+", "_", folder.resolve().name) or "scene"
    guess = SceneGuess(f"the meshes in {folder.name or folder}", name, units, bones, root, joints)
    guess.orientation, guess.unusable, guess.notes = orientation, found.unusable, notes
    bodies = _bodies(bones, joints)
    guess.muscles = [guess_attachments(muscle, bones, bodies, millimetre) for muscle in muscles]
    # Where the bones that names ask for are not here, what is there is taken.
    if all(muscle.wrong for muscle in guess.muscles):
        guess.muscles = [
            guess_attachments(muscle, bones, bodies, millimetre, named=False) for muscle in muscles
        ]
    guess_tendons(guess, millimetre)
    rank = {id(joint.child): k for k, joint in enumerate(joints, start=1)}
    for muscle in guess.muscles:  # from the bone that stands still outwards
        muscle.holds.sort(key=lambda hold: rank.get(id(hold.bone), 0))
    return guess


def _bodies(bones, joints):
    """Which bones move as one: place in the list -> place of the bone that it is fixed to."""
    place = {id(bone): k for k, bone in enumerate(bones)}
    bodies = {k: k for k in range(len(bones))}
    for joint in joints:  # parents come before their children
        if joint.kind == "fixed":
            bodies[place[id(joint.child)]] = bodies[place[id(joint.parent)]]
    return bodies


def write_scene(guess: SceneGuess, path: Path) -> Scene:
    """Write the scene file and its attachments; what cannot be loaded is commented out, with the reason.

    Parameters
    ----------
    guess : SceneGuess
    path : Path
        Of the scene file; attachments go to ``attachments/`` beside it.

    Returns
    -------
    Scene
        As loaded from the file.

    Raises
    ------
    UsageError
        If nothing can be written there, or no muscle can be held.
    """
    folder = path.parent / "attachments"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        _write_coarse(guess, path.parent)
        for muscle in guess.muscles:
            for hold in muscle.holds:
                np.savetxt(folder / hold_file(muscle, hold), _in_file(muscle.muscle, hold.vertices), fmt="%d")
        write_stubs(guess, path.parent, MILLIMETRE[guess.units])
        while True:
            path.write_text(scene_text(guess, hold_file), encoding="utf-8")
            if all(muscle.wrong for muscle in guess.muscles):
                raise UsageError(f"{path}: no muscle can be held by two bones ({guess.muscles[0].wrong})")
            try:
                return Scene.load(path)
            except (SceneError, MeshError) as error:
                _comment_out(guess, error)
    except OSError as error:
        raise UsageError(f"cannot write {path}: {error.strerror}; choose another --output") from None


def _write_coarse(guess, folder):
    """Meshes that were made coarser, beside the scene."""
    for part in [*guess.bones, *(m.muscle for m in guess.muscles)]:
        if part.coarse:
            (folder / "coarse").mkdir(exist_ok=True)
            part.file = f"coarse/{part.name}.ply"
            part.mesh.export(folder / part.file)
            part.read.vertex_map = np.arange(len(part.points))


def hold_file(muscle: Any, hold: Any) -> str:
    """Name of the file of a hold's vertices."""
    return f"{muscle.muscle.name}_{hold.bone.name}.txt"


def _in_file(part, vertices):
    """Numbers of a mended mesh's vertices in its file."""
    numbers = np.full(len(part.points), -1)
    mapped = part.read.vertex_map[::-1]  # of several in the file that became one, the first
    numbers[mapped[mapped >= 0]] = np.arange(len(mapped))[::-1][mapped >= 0]
    found = numbers[vertices]
    return found[found >= 0]


def _comment_out(guess, error):
    """Mark the muscle that an error names as wrong; an error that names none is nobody's guess."""
    for muscle in guess.muscles:
        if not muscle.wrong and f"{muscle.muscle.name!r}" in str(error):
            muscle.wrong, muscle.confidence = str(error), 0.0
            return
    raise error
