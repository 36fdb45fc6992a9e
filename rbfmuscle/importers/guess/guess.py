"""A scene guessed from a folder of meshes: what each mesh is, the unit, joints and attachments; a
confidence and its reason for each.
"""

import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from tempfile import TemporaryDirectory
from typing import Literal

import numpy as np

from rbfmuscle.anatomy.bones import EXACT, Orientation, Part, find_cut, find_orientation
from rbfmuscle.anatomy.names import name_facts
from rbfmuscle.geometry.arrays import Booleans
from rbfmuscle.geometry.surfaces import clustered
from rbfmuscle.importers.guess.attachments import (
    FEWEST,
    MuscleGuess,
    guess_attachments,
    unused_tendons,
)
from rbfmuscle.importers.guess.joints import JointGuess, guess_joints, rounded
from rbfmuscle.importers.guess.sites import Skeleton, bone_frames
from rbfmuscle.scene.bone import Bone
from rbfmuscle.scene.check import articular_points
from rbfmuscle.scene.file import FORMAT, MAIN, attachment_file, table_text
from rbfmuscle.scene.meshes.read import MESH_SUFFIXES, prepare_mesh, read_file
from rbfmuscle.scene.muscles import LARGEST_MM, SMALLEST_MM
from rbfmuscle.scene.objects import MM_PER_UNIT, Muscle, from_mm, new_name, plain_name
from rbfmuscle.scene.scene import DOUBTFUL, Scene
from rbfmuscle.validation import MeshError, SceneError, UsageError

# Folders below the one that is given, as people sort their meshes.
FOLDERS = {"bones": "bone", "bone": "bone", "knochen": "bone", "os": "bone"}
FOLDERS |= {"muscles": "muscle", "muscle": "muscle", "muskeln": "muscle"}
FOLDERS |= {"tendons": "tendon", "tendon": "tendon", "sehnen": "tendon"}
# Length of a bone [mm] by its class, and of the largest one where none is known, from child to
# large adult.
LENGTHS = {"femur": (200, 600), "tibia": (150, 500), "humerus": (120, 420), "pelvis": (100, 450)}
LARGEST_BONE = (90, 900)
# Meshes of more triangles are made coarser, to about as many.
MOST_TRIANGLES = 400_000


@dataclass
class SceneGuess:
    """What was guessed of the meshes of a folder: bones and muscles, the unit of their lengths,
    joints, directions and attachments.

    ``unusable`` gives reasons by file, ``missing_bones`` names those that are no muscles;
    ``notes`` name what was left out, misspelt or made coarser, and the unit where it was guessed.
    """

    folder: Path
    units: str = ""
    bones: list[Part] = field(default_factory=list)
    joints: list[JointGuess] = field(default_factory=list)
    orientation: Orientation | None = None
    muscles: list[MuscleGuess] = field(default_factory=list)
    unusable: dict[str, str] = field(default_factory=dict)
    missing_bones: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def doubts(self) -> list[str]:
        """One line for each guess that wants a look, the least sure first."""
        rows = [(0.3, f"bone {bone.name}: {bone.doubt}") for bone in self.bones if bone.doubt]
        rows += [
            (0.0, f"{file} cannot be used: {reason}") for file, reason in self.unusable.items()
        ]
        rows += [(0.1, doubt) for doubt in (self.orientation.doubts if self.orientation else ())]
        rows += [
            (joint.confidence, f"joint of {joint.child.name}: {joint.reason}")
            for joint in self.joints
        ]
        for muscle in self.muscles:
            reasons = "; ".join(filter(None, [muscle.wrong, *muscle.reasons]))
            rows.append((muscle.confidence, f"muscle {muscle.muscle.name}: {reasons}"))
        return [text for sure, text in sorted(rows, key=lambda row: row[0]) if sure < DOUBTFUL]


def _read_parts(found, units, base, source):
    """Muscles and tendons of a folder, and of its folders ``bones``, ``muscles`` and ``tendons``;
    bones, unit and notes go to the guess ``found``. Files are relative to ``base``, messages name
    the ``source`` of the meshes.

    Where no unit is given it is the one in which the bones have the size that they have in people.
    """
    bones = found.bones
    parts: dict[str, list[Part]] = {"bone": bones, "muscle": [], "tendon": [], "": []}
    muscles = parts["muscle"]
    names = set()
    other = []
    for path, stem, mesh in _file_meshes(found.folder, found.notes):
        facts = name_facts(stem)
        if facts.tissue == "other":
            other.append(path.name)
            continue
        # A tendon by its name, else by the folder that it is in, else by its name.
        by_name = facts.tissue == "tendon" or path.parent == found.folder
        tissue = facts.tissue if by_name else FOLDERS[path.parent.name.lower()]
        try:
            part = _read_part(
                path, stem, mesh, base, names, facts, found, closed=tissue == "muscle"
            )
        except MeshError as error:
            found.unusable[path.name] = str(error).removeprefix(f"{path}: ")
            found.missing_bones += [stem] if tissue in ("bone", "") else []
            continue
        if facts.spelling:
            found.notes.append(f"{path.name}: {facts.spelling}")
        parts[tissue].append(part)
    if other:
        found.notes.append(f"left out, neither bone nor muscle: {', '.join(other)}")
    # The largest of the others are bones until there are two, the rest muscles if they can be.
    for part in sorted(parts[""], key=lambda part: -part.size):
        is_bone = len(bones) < 2 or not _can_be_muscle(part)
        part.doubt = f"{'a bone' if is_bone else 'a muscle'} by its size, as its name is not known"
        (bones if is_bone else muscles).append(part)
    if not bones or not muscles:
        kind, rest = ("bone", "muscles") if not bones else ("muscle", "bones")
        listed = [Path(part.file).name for part in bones or muscles]
        listed += [f"{file} ({why})" for file, why in found.unusable.items()]
        raise UsageError(
            f"{source} holds no {kind} (by names or sizes all are {rest}, or cannot be "
            f"used: {', '.join(listed) or 'no files'}); name files ({' '.join(MESH_SUFFIXES)}) or "
            "labels after what they are, or sort files into folders bones and muscles"
        )
    found.units = units or _guess_units(found)
    for bone in list(bones):  # a scene would refuse those of wrong sizes
        if not SMALLEST_MM <= bone.size / from_mm(1.0, found.units) <= LARGEST_MM:
            words = f"it is {bone.size:.4g} {found.units} across"
            bones.remove(bone)
            found.missing_bones.append(bone.name)
            found.unusable[Path(bone.file).name] = words
    if not bones:
        raise UsageError(f"{bone.file} cannot be a bone: {words}; correct the units")
    return muscles, parts["tendon"]


def _can_be_muscle(part):
    """Whether a mesh is one closed surface."""
    try:
        prepare_mesh(part.mesh.vertices, part.mesh.faces, context=part.file, name=part.name)
    except MeshError:
        return False
    return True


def _file_meshes(folder, notes):
    """Path, name and FilePart of each mesh in the files of a folder and of its folders for bones,
    muscles and tendons, several of a file as ``FILE#NAME``; of a file that cannot be read its
    MeshError.
    """
    if not folder.is_dir():
        raise UsageError(f"{folder} is no folder; give the folder of the meshes")
    inner = [
        path for path in sorted(folder.iterdir()) if path.name.lower() in FOLDERS and path.is_dir()
    ]
    files = [path for place in [folder, *inner] for path in sorted(place.iterdir())]
    for path in (file for file in files if file.suffix.lower() in MESH_SUFFIXES):
        try:
            meshes = read_file(path)
        except MeshError as error:
            yield path, path.stem, error
            continue
        if len(meshes) == 1:
            yield path, path.stem, meshes[0]
            continue
        names = [mesh.name for mesh in meshes]
        notes.append(f"{path.name}: {len(names)} meshes in one file ({', '.join(names)})")
        for mesh in meshes:
            yield path.with_name(f"{path.name}#{mesh.name}"), mesh.name, mesh


def _read_part(path, stem, mesh, base, names, facts, found, *, closed):
    if isinstance(mesh, MeshError):
        raise mesh
    name = new_name(stem.lower().strip("_ ") or "part", names)
    names.add(name)
    vertices, faces = mesh.vertices, mesh.faces
    coarse = len(faces) > MOST_TRIANGLES and not closed  # cells of thin walls may open a surface
    if coarse:
        found.notes.append(
            f"{path.name}: {len(faces)} triangles, made coarser to about {MOST_TRIANGLES}"
        )
        vertices, faces = clustered(vertices, faces, MOST_TRIANGLES)
    read = prepare_mesh(vertices, faces, context=str(path), name=stem, may_be_open=not closed)
    read.notes[:0] = mesh.notes
    try:
        file = Path(os.path.relpath(path, base)).as_posix()
    except ValueError:  # there is no way from one to the other, as between drives
        file = path.absolute().as_posix()
    part = Part(name, file, read, facts.bone, facts.side, facts=facts.muscle, coarse=coarse)
    part.tendon_of = facts.tendon_of or ((facts.muscle.name,) if facts.muscle else ())
    return part


def _guess_units(found):
    """The unit in which a bone has the size that it has in people, a note why; a UsageError where
    none fits.
    """
    known = [bone for bone in found.bones if bone.kind in LENGTHS]
    bone = max(known or found.bones, key=lambda bone: bone.size)
    low, high = LENGTHS.get(bone.kind, LARGEST_BONE)
    for units, millimetres in MM_PER_UNIT.items():
        if low <= bone.size * millimetres <= high:
            found.notes.append(f"units are {units}: {bone.name} is {bone.size:.4g} {units} long")
            return units
    raise UsageError(
        f"{bone.file} is {bone.size:.4g} across, which is no bone in mm, cm or m; give its units"
    )


_TAIL = """[contact]
initial = "keep"   # muscles that start inside a bone stay there; or "error"
"""


def guess_scene(
    folder: Path,
    units: str | None,
    base: Path,
    *,
    header: Orientation | None = None,
    capped: Mapping[str, Booleans] | None = None,
    source: str = "",
    unusable: Mapping[str, str] | None = None,
) -> SceneGuess:
    """Guess a scene from the meshes of a folder, or of folders ``bones`` and ``muscles`` in it.

    ``units`` are ``"mm"``, ``"cm"`` or ``"m"``, by the size of the bones where None; the scene's
    paths are relative to ``base``; a ``header`` holds anatomical directions where they are known;
    ``capped`` marks vertices (n,) of files, by their stems, to which nothing is attached;
    messages name the ``source`` of the meshes where it is not the folder, and what of it is
    ``unusable``, by name, and why. UsageError if the folder is missing, holds no bone or no muscle,
    or is of no known unit.
    """
    guess = SceneGuess(folder, unusable=dict(unusable or {}))
    muscles, tendons = _read_parts(guess, units, base, source or folder)
    bones = guess.bones
    millimetre = from_mm(1.0, guess.units)
    guess.orientation = find_orientation(bones, header)
    root, joints = guess_joints(bones, millimetre, guess.orientation)
    guess.joints = joints
    bodies = {bone: bone for bone in bones}
    for joint in joints:  # parents come before their children
        if joint.kind == "weld":
            bodies[joint.child] = bodies[joint.parent]
    meetings = [
        (j.parent.name, j.child.name, j.centre if j.kind == "ball" else None)
        for j in joints
        if j.kind != "weld"
    ]
    surfaces = articular_points(meetings, {bone.name: bone.mesh for bone in bones}, millimetre)
    skeleton = Skeleton(
        {bone: Bone(bone.name, bone.mesh) for bone in bones},
        bodies,
        joints,
        millimetre,
        bone_frames(bones, joints, guess.orientation, millimetre),
        {bone: surfaces[bone.name] for bone in bones},
        tendons,
    )
    guess.muscles = [guess_attachments(muscle, skeleton) for muscle in muscles]
    # Where the bones that names ask for are not here, what is there is taken.
    if len(bones) > 1 and all(muscle.wrong for muscle in guess.muscles):
        guess.muscles = [guess_attachments(muscle, skeleton, named=False) for muscle in muscles]
    holding = (hold.tendon for muscle in guess.muscles for hold in muscle.holds)
    used = {tendon.mesh for tendon in holding if tendon is not None and tendon.mesh is not None}
    unused = unused_tendons(tendons, muscles, used, skeleton)
    guess.unusable |= unused
    guess.notes += [f"{file} is not used: {reason}" for file, reason in unused.items()]
    for muscle in guess.muscles:
        _leave_caps(muscle, capped)
    order = [root, *(joint.child for joint in joints)]
    for muscle in guess.muscles:  # from the bone that stands still outwards
        muscle.holds.sort(key=lambda hold: order.index(hold.bone) if hold.bone in order else 0)
    return guess


def _leave_caps(muscle, capped):
    """Take the vertices on the cap at the scan's end from what holds a muscle: those that are
    ``capped``, by file, where that is known.
    """
    part = muscle.muscle
    if capped is None:
        cut = find_cut(part.mesh, depth=EXACT)
        on_cap = np.flatnonzero([] if cut is None else cut.on)
    else:
        marked = capped.get(Path(part.file).stem, np.empty(0, dtype=bool))
        on_cap = part.read.vertex_map[np.flatnonzero(marked)]
    if not len(on_cap):
        return
    for hold in list(muscle.holds):
        hold.vertices = np.setdiff1d(hold.vertices, on_cap)
        if len(hold.vertices) < FEWEST:
            muscle.holds.remove(hold)
            muscle.reasons.append(f"not held by {hold.bone.name}: its end is where the scan ends")
    if len(muscle.holds) < 2 and not muscle.wrong:
        muscle.wrong, muscle.confidence = "an end of it is where the scan ends", 0.0


def write_scene(guess: SceneGuess, path: Path, stage: Path) -> Scene:
    """Write the scene of a file ``path``, and ``attachments/``, into a folder ``stage`` beside it,
    from which they are moved to their places; return the scene as loaded.

    What cannot be loaded is commented out, with the reason. UsageError if no muscle can be held.
    """
    _check_runs(guess, path)
    _write_coarse(guess, stage)
    for muscle in guess.muscles:
        for hold in muscle.holds:
            file = stage / attachment_file(muscle.muscle.name, hold.bone.name)
            file.parent.mkdir(parents=True, exist_ok=True)
            in_file = np.flatnonzero(np.isin(muscle.muscle.read.vertex_map, hold.vertices))
            np.savetxt(file, in_file, fmt="%d")
    # Paths in a scene file are relative to its folder, so a trial stands beside the final one.
    trial = path.with_name(f"{stage.name}.toml")

    def final(text):
        return text.replace(trial.name, path.name).replace(f"{stage.name}/", "")

    scene = None
    try:
        while scene is None:
            trial.write_text(_scene_text(guess, stage.name), encoding="utf-8")
            try:
                scene = Scene.load(trial)
            except (SceneError, MeshError) as error:
                # The muscle that it is about is wrong; an error about none is raised.
                about = next((m for m in guess.muscles if m.muscle.name == error.muscle), None)
                if about is None or about.wrong:
                    raise
                about.wrong = final(str(error))
                about.confidence = 0.0
                _check_runs(guess, path)
    finally:
        trial.unlink(missing_ok=True)
    (stage / path.name).write_text(final(_scene_text(guess)), encoding="utf-8")
    scene.path = path
    return scene


def _write_coarse(guess, stage):
    """Meshes that were made coarser, staged beside the scene."""
    muscles = [muscle.muscle for muscle in guess.muscles]
    for folder, parts in (("bones", guess.bones), ("muscles", muscles)):
        for part in parts:
            if part.coarse:
                file = stage / "coarse" / folder / f"{part.name}.ply"
                file.parent.mkdir(parents=True, exist_ok=True)
                part.file = file.relative_to(stage.parent).as_posix()
                part.mesh.export(file)
                part.read.vertex_map = np.arange(len(part.points))


def _check_runs(guess, path):
    if all(muscle.wrong for muscle in guess.muscles):
        reasons = [guess.muscles[0].wrong]
        reasons += [f"{file} cannot be used: {why}" for file, why in guess.unusable.items()]
        raise UsageError(f"{path}: no muscle can be held by two bones ({'; '.join(reasons)})")


def _scene_text(guess: SceneGuess, stage: str = "") -> str:
    """The scene file of a guess: what is guessed has the key guess, what cannot run is a comment.

    ``stage`` is the folder of the attachments' folder, relative to the file.
    """
    bones = [
        table_text(_headed("[[bone]]", bone), {"name": bone.name, "mesh": bone.file}, _doubt(bone))
        for bone in guess.bones
    ]
    movable = [joint for joint in guess.joints if joint.axes and not joint.follows]
    motion = [_motion(movable[0])] if movable else []
    muscles = [_muscle(muscle, stage) for muscle in guess.muscles]
    return "\n".join([_head(guess), *bones, *map(_joint, guess.joints), *motion, *muscles, _TAIL])


def _headed(head, part, reasons=()):
    """The line that begins a table, and comments: what was mended of the mesh, and reasons."""
    return "\n".join([head, *(f"# {line}" for line in (*part.read.notes, *reasons))])


def _doubt(part):
    return {"name": f"doubtful: {part.doubt}"} if part.doubt else {}


def _head(guess):
    folder = guess.folder
    lines = [
        f"# Scene guessed from the meshes in {folder.name or folder}. "
        "Check everything with the key guess, and remove the key of what is right.",
        "# All keys: docs/scene_file.md. Then: rbfmuscle check --picture, rbfmuscle run.",
        *(f"# NOT USED: {file}: {reason}" for file, reason in guess.unusable.items()),
    ]
    name = plain_name(folder.resolve().name or "scene")
    row = {"format": FORMAT, "name": name, "units": guess.units}
    comments = {
        "units": "of every length here; a mesh in another unit takes scale = ...",
        "missing_bones": "bones whose meshes cannot be used; every run counts them as beyond its "
        "limits",
        "notes": "what was assumed, left out or joined; check repeats it",
    }
    if guess.missing_bones:
        row["missing_bones"] = guess.missing_bones
    if guess.notes:
        row["notes"] = guess.notes
    for word in ("superior", "anterior") if guess.orientation is not None else ():
        row[word] = rounded(getattr(guess.orientation, word), 5)
        comments[word] = f"by {guess.orientation.source}"
    scene = table_text("[scene]", row, comments)
    models = {"model": 'or a table: { name = "rbf", centres = 300 }'}
    return "\n".join([*lines, scene, table_text(f"[classes.{MAIN}]", {"model": "rbf"}, models)])


def _joint(joint: JointGuess) -> str:
    comments = {"axes": "angles follow the right-hand rule"}
    if not joint.ranges:
        comments["axes"] += "; rename and turn them where angles should have the other sign"
    row = {**joint.row(), "guess": _confidence(joint.confidence, joint.reason)}
    text = table_text("[[joint]]", row, comments)
    if joint.follows:
        row = {"coordinate": joint.coordinate, "of": [joint.follows], "linear": [1, 0]}
        text += "\n" + table_text("[[coupling]]", row)
    return text


def _motion(joint):
    """A ramp of the joint's first coordinate, within its range."""
    _, high = joint.ranges.get(next(iter(joint.axes)), (0.0, joint.rest + 30.0))
    end = min(joint.rest + 30.0, high) if high > joint.rest else joint.rest
    ramp = {joint.coordinate: {"from": joint.rest, "to": end, "step": 2}}
    return table_text("[motion]   # degrees", {"ramp": ramp}, {"ramp": "an example"})


def _confidence(confidence, reason):
    """The key ``guess``."""
    return {"confidence": round(confidence, 1), "reason": reason}


def _attachment(hold, muscle, stage, cap):
    """A row of ``attach`` of a muscle, with its tendon; it is not surer than ``cap``."""
    file = PurePosixPath(stage, attachment_file(muscle, hold.bone.name)).as_posix()
    guess = _confidence(min(hold.confidence, cap), hold.reason)
    if hold.tendon is None:
        return {"bone": hold.bone.name, "vertices": file, "guess": guess}
    line = {"to": rounded(hold.tendon.to, 6)}
    if hold.tendon.via:
        line["via"] = [{"bone": bone.name, "point": rounded(at, 6)} for bone, at in hold.tendon.via]
    return {"bone": hold.tendon.bone.name, "vertices": file, "tendon": line, "guess": guess}


def _muscle(guess: MuscleGuess, stage: str) -> str:
    part = guess.muscle
    # What makes the muscle doubtful, not one attachment, makes all of them so.
    cap = guess.confidence if guess.doubted else 1.0
    attach = [_attachment(hold, part.name, stage, cap) for hold in guess.holds]
    row = {"name": part.name, "mesh": part.file, "attach": attach}
    head = _headed("[[muscle]]", part, guess.reasons)
    text = table_text(head, row, _doubt(part))
    if guess.wrong:
        text = "".join(f"# {line}\n" for line in [f"NOT RUN: {guess.wrong}", *text.splitlines()])
    return text


def scene_from_meshes(folder: Path, *, units: Literal["mm", "cm", "m"] | None) -> Scene:
    """The scene of `Scene.from_meshes`."""
    if units is not None and units not in MM_PER_UNIT:
        raise UsageError(f"units must be m, cm or mm, got {units!r}")
    with TemporaryDirectory() as base:
        return scene_in_memory(guess_scene(folder, units, Path(base)), Path(base))


def scene_in_memory(guess: SceneGuess, base: Path) -> Scene:
    """The scene of a guess whose file is in a folder that is removed."""
    stage = base / "scene"
    stage.mkdir()
    scene = write_scene(guess, base / "scene.toml", stage)
    scene.path = None
    # Names of files without a way through the folder that is removed; none for those in it.
    items: list[Bone | Muscle] = [*scene.bones, *scene.muscles]
    for item in items:
        source = os.path.normpath(item.source)
        item.source = "" if source.startswith(f"{base}{os.sep}") else source
    return scene
