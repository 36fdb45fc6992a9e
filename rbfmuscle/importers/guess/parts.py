"""The meshes of a folder, sorted into bones, muscles and tendons; the unit of their lengths."""

import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from rbfmuscle.anatomy.bones import Part
from rbfmuscle.anatomy.names import name_facts
from rbfmuscle.geometry.surfaces import clustered
from rbfmuscle.scene.meshes.read import MESH_SUFFIXES, prepare_mesh, read_file
from rbfmuscle.scene.muscles import LARGEST_MM, SMALLEST_MM
from rbfmuscle.scene.names import new_name
from rbfmuscle.scene.objects import MM_PER_UNIT, from_mm
from rbfmuscle.validation import MeshError, UsageError

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
class Parts:
    """What is in a folder, and the unit of its lengths.

    ``unusable`` gives reasons by file, ``missing_bones`` names those that are no muscles;
    ``notes`` name what was left out, misspelt or made coarser, and the unit where it was guessed.
    """

    units: str = ""
    bones: list[Part] = field(default_factory=list)
    muscles: list[Part] = field(default_factory=list)
    tendons: list[Part] = field(default_factory=list)
    unusable: dict[str, str] = field(default_factory=dict)
    missing_bones: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    @property
    def millimetre(self) -> float:
        """Its length in scene units."""
        return from_mm(1.0, self.units)


def read_parts(
    folder: Path,
    units: str | None,
    base: Path,
    *,
    source: str = "",
    unusable: Mapping[str, str] | None = None,
) -> Parts:
    """Bones, muscles and tendons of a folder, and of its folders ``bones``, ``muscles`` and
    ``tendons``; files relative to ``base``. Messages name the ``source`` of the meshes, the folder
    by default, and what of it was ``unusable`` before, by name, and why.

    Where no unit is given it is the one in which the bones have the size that they have in people.
    """
    found = Parts(unusable=dict(unusable or {}))
    unknown = []
    names = set()
    other = []
    for path, stem, mesh in _file_meshes(folder, found.notes):
        facts = name_facts(stem)
        if facts.tissue == "other":
            other.append(path.name)
            continue
        tissue = _tissue(facts, path.parent, folder)
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
        kinds = {"bone": found.bones, "muscle": found.muscles, "tendon": found.tendons}
        kinds.get(tissue, unknown).append(part)
    if other:
        found.notes.append(f"left out, neither bone nor muscle: {', '.join(other)}")
    # The largest of the others are bones until there are two, the rest muscles if they can be.
    for part in sorted(unknown, key=lambda part: -part.size):
        is_bone = len(found.bones) < 2 or not _can_be_muscle(part)
        part.doubt = f"{'a bone' if is_bone else 'a muscle'} by its size, as its name is not known"
        (found.bones if is_bone else found.muscles).append(part)
    if not found.bones or not found.muscles:
        kind, rest = ("bone", "muscles") if not found.bones else ("muscle", "bones")
        listed = [Path(part.file).name for part in found.bones or found.muscles]
        listed += [f"{file} ({why})" for file, why in found.unusable.items()]
        raise UsageError(
            f"{source or folder} holds no {kind} (by names or sizes all are {rest}, or cannot be "
            f"used: {', '.join(listed) or 'no files'}); name files ({' '.join(MESH_SUFFIXES)}) or "
            "labels after what they are, or sort files into folders bones and muscles"
        )
    found.units = units or _guess_units(found)
    _leave_out_wrong_sizes(found)
    return found


def _tissue(facts, parent, folder):
    """What a mesh is: a tendon by its name, else by the folder that it is in, else by its name."""
    if facts.tissue == "tendon" or parent == folder:
        return facts.tissue
    return FOLDERS[parent.name.lower()]


def _can_be_muscle(part):
    """Whether a mesh is one closed surface."""
    try:
        prepare_mesh(part.mesh.vertices, part.mesh.faces, context=part.file, name=part.name)
    except MeshError:
        return False
    return True


def _find_meshes(folder):
    """Mesh files of a folder and of its folders for bones, muscles and tendons, in order."""
    if not folder.is_dir():
        raise UsageError(f"{folder} is no folder; give the folder of the meshes")
    inner = [
        path for path in sorted(folder.iterdir()) if path.name.lower() in FOLDERS and path.is_dir()
    ]
    files = [path for place in [folder, *inner] for path in sorted(place.iterdir())]
    return [path for path in files if path.suffix.lower() in MESH_SUFFIXES]


def _file_meshes(folder, notes):
    """Path, name and FilePart of each mesh in the files of a folder, several of a file as
    ``FILE#NAME``; of a file that cannot be read its MeshError.
    """
    for path in _find_meshes(folder):
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
    part = Part(
        name,
        _path_from(base, path),
        read,
        facts.bone,
        facts.side,
        facts=facts.muscle,
        coarse=coarse,
    )
    part.tendon_of = facts.tendon_of or ((facts.muscle.name,) if facts.muscle else ())
    return part


def _path_from(base, path):
    """A path as the scene file in the folder ``base`` has it; whole where there is no way from one
    to the other, as between drives.
    """
    try:
        return Path(os.path.relpath(path, base)).as_posix()
    except ValueError:
        return Path(path).absolute().as_posix()


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


def _leave_out_wrong_sizes(found):
    """Bones that a scene would refuse for their size cannot be used; a UsageError where that is all
    of them.
    """
    for bone in list(found.bones):
        if not SMALLEST_MM <= bone.size / found.millimetre <= LARGEST_MM:
            words = f"it is {bone.size:.4g} {found.units} across"
            found.bones.remove(bone)
            found.missing_bones.append(bone.name)
            found.unusable[Path(bone.file).name] = words
    if not found.bones:
        raise UsageError(f"{bone.file} cannot be a bone: {words}; correct the units")
