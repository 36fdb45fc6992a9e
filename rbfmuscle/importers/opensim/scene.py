"""A scene from an OpenSim model: bodies as bones where the default pose puts them, joints as they
are; its files.
"""

import re
from dataclasses import dataclass, field, replace
from itertools import chain
from pathlib import Path

import numpy as np

from rbfmuscle.folders import OutputFolder
from rbfmuscle.geometry.arrays import box_size, to_world
from rbfmuscle.geometry.exact_distance import ExactDistance
from rbfmuscle.geometry.surfaces import joined_meshes
from rbfmuscle.importers.opensim.elements import ModelMesh, OsimModel
from rbfmuscle.importers.opensim.read import read_osim
from rbfmuscle.importers.opensim.tubes import TUBE_MODEL, make_tube
from rbfmuscle.scene.joints import all_coordinates
from rbfmuscle.scene.meshes.read import ALL, MESH_SUFFIXES, prepare_mesh, read_part
from rbfmuscle.scene.meshes.repair import ReadMesh
from rbfmuscle.scene.scene import Scene
from rbfmuscle.validation import MeshError, SceneError, check_mesh

WIDEST = 3.0  # a mesh wider than this [m] is a floor or a wall, not a bone
NARROWEST = 0.002  # one narrower [m] is in another unit
LEAST_MISSED = 1e-3  # share of a muscle's volume that its tube may miss without a word
SCENE = "scene.toml"


@dataclass
class Imported:
    """A scene made from a model.

    ``places`` are (4, 4) from every body of the model to the scene, rest pose [metre]; ``notes``
    say what was not taken, or taken otherwise than one may expect; what makes it another model than
    the file's is in the scene's ``doubts``.
    """

    scene: Scene
    model: OsimModel
    places: dict[str, np.ndarray]
    notes: list[str] = field(default_factory=list)


def import_osim(
    path: Path | str, *, geometry: list[Path] | None = None, muscles: bool = True
) -> Imported:
    """Make a scene of an OpenSim model (``.osim``), in metres as it is, with a tube for each of its
    ``muscles``.

    Meshes stand where the model's default pose puts them, which is then the rest pose of the scene.
    A body without a mesh becomes a bone without one. Meshes are looked for in the model's folder,
    its ``Geometry``, then in ``geometry``. SceneError if the model cannot be read, or has a joint
    that the table of joints lacks.
    """
    model = read_osim(path)
    scene, places = Scene(model.name, units="m"), model.transforms()
    meshes, notes = _body_meshes(model, places, list(geometry or []))
    notes = [*model.notes, *notes]
    for body in model.bodies:
        if body in meshes:
            scene.add_bone(body, meshes[body])
            notes += [f"body {body!r}: {note}" for note in meshes[body].notes]
        else:
            scene.add_bone(body)
            scene.missing_bones += [body] if any(mesh.body == body for mesh in model.meshes) else []
    steps, _, _ = model.walk()
    for joint, backward in steps:
        parent, child = (joint.child, joint.parent) if backward else (joint.parent, joint.child)
        placed = joint.moved(places[joint.parent] @ joint.parent_frame)
        scene.add_joint(replace(placed, parent=parent, child=child, backward=backward))
    known = all_coordinates(scene.joints)
    for coupling in model.couplings:
        missing = [n for n in (coupling.coordinate, *coupling.of) if n not in known]
        if not missing:
            scene.add_coupling(coupling)
        elif coupling.coordinate in known:
            scene.doubts.append(f"{coupling.coordinate} does not follow {missing[0]}, not taken")
    scene.doubts += model.doubts
    scene.superior, scene.anterior = [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]
    found = Imported(scene, model, places, notes)
    if muscles:
        _add_muscles(found, steps)
    return found


def _add_muscles(found, steps):
    """A tube for each muscle of the model. As round tubes about lines lie in each other, muscles do
    not meet.
    """
    scene = found.scene
    scene.neighbours = None
    bones = {bone.name: ExactDistance(bone.mesh.vertices, bone.mesh.faces) for bone in scene.bones}
    attachment_frames = _attachment_frames(steps, found.model.bodies, bones)
    for muscle in found.model.muscles:
        try:
            tube = make_tube(muscle, found.places, bones, attachment_frames)
            attach = [
                {"bone": body, "vertices": rows.tolist(), "via": via}
                for held, via in ((tube.held, False), (tube.via, True))
                for body, rows in held.items()
            ]
            scene.add_muscle(
                muscle.name, (tube.vertices, tube.faces), attach=attach, model=dict(TUBE_MODEL)
            )
            if tube.crossed:
                scene.doubts.append(
                    f"{muscle.title}: its path goes through {', '.join(tube.crossed)}, and so does "
                    "its tube; give it a mesh"
                )
            if tube.volume_error > LEAST_MISSED:
                scene.doubts.append(
                    f"{muscle.title}: its tube misses the volume by {100 * tube.volume_error:.2g} %"
                )
        except (SceneError, MeshError) as error:
            scene.doubts.append(f"{muscle.title} is not taken: {error}")


def _attachment_frames(steps, bodies, bones):
    """For each body the one that holds its muscles: itself where it has a mesh, else one with a
    mesh that no coordinate moves against it; without one, itself.
    """
    groups = {body: body for body in bodies}
    for joint, _ in steps:
        if not joint.coordinates:
            first, second = groups[joint.parent], groups[joint.child]
            groups = {body: first if one == second else one for body, one in groups.items()}
    # Of several the last that is reached on the way out, which is nearest to what it carries.
    seen = {groups[body]: body for body in bodies if body in bones}
    return {body: body if body in bones else seen.get(groups[body], body) for body in bodies}


def _find_mesh(name: str, folders: list[Path]) -> Path | None:
    """Return the first file of that name in some folders, or None; exact names before others in
    case or suffix, and a whole path that is not here by its last part.
    """
    plain = name.replace("\\", "/")
    if re.match(r"/|[A-Za-z]:", plain) and not Path(plain).is_file():
        plain = Path(plain).name
    places = [folder / plain for folder in folders]
    endings = ("",) if Path(plain).suffix.lower() in MESH_SUFFIXES else MESH_SUFFIXES
    wanted = {Path(plain).name.lower() + ending for ending in endings}
    exact = (place for place in places if place.is_file())
    beside = (sorted(place.parent.iterdir()) for place in places if place.parent.is_dir())
    alike = (file for files in beside for file in files if file.name.lower() in wanted)
    return next(chain(exact, alike), None)


def _body_meshes(
    model: OsimModel, places: dict[str, np.ndarray], geometry: list[Path]
) -> tuple[dict[str, ReadMesh], list[str]]:
    """One mesh for each body that shows any, in the scene's coordinates [metre], and what could not
    be taken.
    """
    folders = [model.path.parent, model.path.parent / "Geometry", *geometry]
    parts = {}
    meshes = {}
    notes = []
    for mesh in model.meshes:
        try:
            file, vertices, faces = _placed(mesh, places[mesh.body], folders)
        except MeshError as error:
            notes.append(f"body {mesh.body!r}: mesh {mesh.file!r} is not taken: {error}")
            continue
        if file.name != Path(mesh.file).name or Path(mesh.file).is_absolute():
            notes.append(f"body {mesh.body!r}: mesh {mesh.file!r} was read from {str(file)!r}")
        parts.setdefault(mesh.body, []).append((vertices, faces, file.name))
    for body, found in parts.items():
        try:
            meshes[body] = _joined(found, body)
            continue
        except MeshError as error:
            whole = error
        sound = []
        for part in found if len(found) > 1 else ():
            try:
                _joined([part], body)
            except MeshError as error:
                notes.append(f"body {body!r}: mesh {part[2]!r} is not taken: {error}")
            else:
                sound.append(part)
        if sound and len(sound) < len(found):
            meshes[body] = _joined(sound, body)
        else:
            notes.append(f"body {body!r}: its meshes are not taken: {whole}")
    return meshes, notes


def _joined(parts, body):
    """Meshes of a body as one; MeshError where that cannot be used."""
    vertices, faces, files = zip(*parts)
    source = ", ".join(files)
    mesh = prepare_mesh(
        *joined_meshes(vertices, faces), context=source, name=body, may_be_open=True
    )
    mesh.source = source
    return mesh


def _placed(
    mesh: ModelMesh, place: np.ndarray, folders: list[Path]
) -> tuple[Path, np.ndarray, np.ndarray]:
    """File, vertices [metre, ground] and triangles of a mesh."""
    file = _find_mesh(mesh.file, folders)
    if file is None:
        where = ", ".join(str(folder) for folder in folders)
        raise MeshError(f"it is not there (looked in {where}); give its folder as geometry")
    part = read_part(file.with_name(f"{file.name}#{ALL}"))
    vertices, faces = check_mesh(part.vertices, part.faces)
    vertices = to_world(vertices * mesh.scale, place @ mesh.transform)
    size = box_size(vertices)
    if not NARROWEST <= size <= WIDEST:
        raise MeshError(f"it is {size:.3g} m across, which no bone is")
    return file, vertices, faces[:, ::-1] if np.prod(mesh.scale) < 0 else faces


def scene_folder(directory: Path, *, force: bool = False) -> OutputFolder:
    """The folder of an imported scene; UsageError if something is in the way, as an earlier scene
    is unless ``force`` replaces it.
    """
    return OutputFolder(
        directory, "import", (SCENE, "bones", "muscles", "attachments"), replace=force
    )


def write_imported(found: Imported, directory: Path, *, force: bool = False) -> Path:
    """Write ``scene.toml``, meshes and attachments to a folder, and return the scene file.

    The folder is that of `scene_folder`; files take their places when all are written.
    """
    directory = Path(directory)
    with scene_folder(directory, force=force).staged(replaces=()) as stage:
        found.scene.save(stage / SCENE, folder=stage, comment=_head(found))
    return directory / SCENE


def _head(found):
    """The comment that begins the file: where it is from, and what was not taken."""
    model = found.model
    lines = [
        f"Scene from the OpenSim model {model.path.name} (version {model.version}).",
        "Its meshes, authors and licence are the model's: see its <credits>.",
        "Meshes stand in the model's default pose; angles are degrees. All keys: "
        "docs/scene_file.md.",
        "A muscle is a tube along the model's path, of its fibres' volume: put a mesh of your own "
        "in its place, and leave out its model.",
        *(f"note: {note}" for note in found.notes),
    ]
    return "\n".join("# " + " ".join(line.split()) for line in lines) + "\n"
