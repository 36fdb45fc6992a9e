"""The meshes that a model shows: found as OpenSim finds them, scaled, placed, and joined to one mesh a body."""

from pathlib import Path
from typing import Any

import numpy as np

from rbfmuscle.importers.opensim.model import ModelMesh, OsimModel
from rbfmuscle.scene.meshes.read import MESH_SUFFIXES, ReadMesh, prepare_mesh, read_arrays
from rbfmuscle.validation import MeshError

# A mesh wider than this [m] is a floor or a room, not a bone.
WIDEST = 3.0
NARROWEST = 0.002


def find_mesh(name: str, folders: list[Path]) -> Path | None:
    """Return the first file of that name in some folders, or None.

    A name in the wrong case, or without its suffix, is found too, after the exact ones.
    """
    plain = name.replace("\\", "/")
    for folder in folders:
        if (folder / plain).is_file():
            return folder / plain
    wanted = Path(plain).name.lower()
    endings = ("",) if Path(plain).suffix.lower() in MESH_SUFFIXES else MESH_SUFFIXES
    for folder in folders:
        parent = (folder / plain).parent
        if not parent.is_dir():
            continue
        for file in sorted(parent.iterdir()):
            if file.name.lower() in {wanted + ending for ending in endings}:
                return file
    return None


def body_meshes(
    model: OsimModel, places: dict[str, np.ndarray], metre: float, geometry: list[Path]
) -> tuple[dict[str, ReadMesh], list[str]]:
    """Return one mesh for each body that shows any, in the scene's coordinates, and what could not be taken.

    Parameters
    ----------
    places : dict of str to (4, 4) ndarray
        From every body to the ground in the rest pose [metre].
    metre : float
        Scene units in a metre.
    geometry : list of path
        Folders with meshes, after the model's own and its ``Geometry``.

    Returns
    -------
    meshes, notes
    """
    folders = [model.path.parent, model.path.parent / "Geometry", *geometry]
    parts, notes = {}, []
    for mesh in model.meshes:
        try:
            made = _placed(mesh, places[mesh.body], folders)
        except MeshError as error:
            notes.append(f"body {mesh.body!r}: mesh {mesh.file!r} is not taken: {error}")
            continue
        if isinstance(made, str):
            notes.append(f"body {mesh.body!r}: {made}")
            continue
        note, vertices, faces, file = made
        notes += [f"body {mesh.body!r}: {note}"] if note else []
        parts.setdefault(mesh.body, []).append((vertices * metre, faces, file))
    meshes = {}
    for body, found in parts.items():
        try:
            meshes[body] = _joined(body, found)
        except MeshError as error:
            notes.append(f"body {body!r}: its meshes are not taken: {error}")
    return meshes, notes


def _placed(mesh: ModelMesh, place: Any, folders: Any) -> Any:
    """A note, vertices [metre, ground], triangles and file; or a text that says why there are none."""
    file = find_mesh(mesh.file, folders)
    if file is None:
        where = ", ".join(str(folder) for folder in folders)
        return f"mesh {mesh.file!r} is not there (looked in {where}); give its folder with --geometry"
    vertices, faces = read_arrays(file)
    if len(vertices) == 0 or len(faces) == 0:
        return f"mesh {mesh.file!r} has no triangles: not taken"
    if faces.min() < 0 or faces.max() >= len(vertices):
        return f"mesh {mesh.file!r} is not taken: a triangle names a vertex that is not there"
    scale = np.array(mesh.scale)
    transform = place @ mesh.transform
    vertices = (vertices * scale) @ transform[:3, :3].T + transform[:3, 3]
    if np.prod(scale) < 0:
        faces = faces[:, ::-1]
    size = float(np.linalg.norm(np.ptp(vertices, axis=0)))
    if not NARROWEST <= size <= WIDEST:
        return f"mesh {mesh.file!r} is {size:.3g} m across, which no bone is: not taken"
    note = "" if file.name == Path(mesh.file).name else f"mesh {mesh.file!r} was read from {file.name!r}"
    return note, vertices, faces, file


def _joined(body, found):
    """One mesh of all of a body's."""
    source = ", ".join(file.name for _, _, file in found)
    starts = np.cumsum([0, *(len(vertices) for vertices, _, _ in found)])
    vertices = np.concatenate([part[0] for part in found])
    faces = np.concatenate([part[1] + start for part, start in zip(found, starts)])
    read = prepare_mesh(vertices, faces, place=source, name=body, may_be_open=True)
    read.source = source
    return read
