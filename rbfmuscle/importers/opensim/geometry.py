"""The meshes that a model shows: found as OpenSim finds them, scaled, placed, and joined to one mesh a body."""

from pathlib import Path

import numpy as np

from rbfmuscle.importers.opensim.model import ModelMesh, OsimModel
from rbfmuscle.scene.meshes.read import MESH_SUFFIXES, ReadMesh, prepare_mesh, read_arrays
from rbfmuscle.validation import MeshError, check_mesh

# A mesh wider than this [m] is a floor or a wall, not a bone.
WIDEST = 3.0
NARROWEST = 0.002


def find_mesh(name: str, folders: list[Path]) -> Path | None:
    """Return the first file of that name in some folders, or None; exact names before others in case or suffix."""
    plain = name.replace("\\", "/")
    for folder in folders:
        if (folder / plain).is_file():
            return folder / plain
    wanted = Path(plain).name.lower()
    endings = ("",) if Path(plain).suffix.lower() in MESH_SUFFIXES else MESH_SUFFIXES
    for parent in ((folder / plain).parent for folder in folders):
        for file in sorted(parent.iterdir()) if parent.is_dir() else ():
            if file.name.lower() in {wanted + ending for ending in endings}:
                return file
    return None


def body_meshes(
    model: OsimModel, places: dict[str, np.ndarray], geometry: list[Path]
) -> tuple[dict[str, ReadMesh], list[str]]:
    """One mesh for each body that shows any, in the scene's coordinates, and what could not be taken.

    ``places`` are (4, 4) from every body to the ground in the rest pose [metre]; ``geometry`` are folders with meshes,
    after the model's own and its ``Geometry``.
    """
    folders = [model.path.parent, model.path.parent / "Geometry", *geometry]
    parts, meshes, notes = {}, {}, []
    for mesh in model.meshes:
        try:
            file, vertices, faces = _placed(mesh, places[mesh.body], folders)
        except MeshError as error:
            notes.append(f"body {mesh.body!r}: mesh {mesh.file!r} is not taken: {error}")
            continue
        if file.name != Path(mesh.file).name:
            notes.append(f"body {mesh.body!r}: mesh {mesh.file!r} was read from {file.name!r}")
        parts.setdefault(mesh.body, []).append((vertices, faces, file.name))
    for body, found in parts.items():
        starts = np.cumsum([0, *(len(vertices) for vertices, _, _ in found)])
        vertices = np.concatenate([part[0] for part in found])
        faces = np.concatenate([part[1] + start for part, start in zip(found, starts)])
        source = ", ".join(part[2] for part in found)
        try:
            meshes[body] = prepare_mesh(vertices, faces, place=source, name=body, may_be_open=True)
        except MeshError as error:
            notes.append(f"body {body!r}: its meshes are not taken: {error}")
            continue
        meshes[body].source = source
    return meshes, notes


def _placed(mesh: ModelMesh, place: np.ndarray, folders: list[Path]) -> tuple[Path, np.ndarray, np.ndarray]:
    """File, vertices [metre, ground] and triangles of a mesh."""
    file = find_mesh(mesh.file, folders)
    if file is None:
        where = ", ".join(str(folder) for folder in folders)
        raise MeshError(f"it is not there (looked in {where}); give its folder with --geometry")
    vertices, faces = check_mesh(*read_arrays(file))
    transform = place @ mesh.transform
    vertices = (vertices * mesh.scale) @ transform[:3, :3].T + transform[:3, 3]
    size = float(np.linalg.norm(np.ptp(vertices, axis=0)))
    if not NARROWEST <= size <= WIDEST:
        raise MeshError(f"it is {size:.3g} m across, which no bone is")
    return file, vertices, faces[:, ::-1] if np.prod(mesh.scale) < 0 else faces
