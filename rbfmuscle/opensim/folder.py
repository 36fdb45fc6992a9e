"""The folder that an import leaves behind."""

import os
from pathlib import Path

from rbfmuscle.opensim.scene import Imported
from rbfmuscle.opensim.write import skeleton_text, table_text, write_meshes
from rbfmuscle.sim.scene.options import MotionOptions
from rbfmuscle.validation import UsageError


def write_scene(found: Imported, directory: Path, *, motion: Path | None = None) -> Path:
    """Write ``scene.toml`` and the bones' meshes to a folder, and return the scene file.

    Parameters
    ----------
    found : Imported
    directory : path
        Made where it is missing.
    motion : path, optional
        A motion file that the scene shall follow; checked against its coordinates.

    Raises
    ------
    SceneError
        If the motion file does not fit.
    UsageError
        If the folder cannot be written to.
    """
    directory = Path(directory)
    meshes = write_meshes(found.scene, directory)
    parts = [skeleton_text(found.scene, head_text(found), meshes)]
    if motion is not None:
        file = os.path.relpath(Path(motion).resolve(), directory.resolve())
        found.scene.motion = found.scene.motion_from(MotionOptions(file=file), folder=directory)
        found.notes += found.scene.motion.notes
        parts.append(table_text("[motion]", {"file": file}))
    target = directory / "scene.toml"
    try:
        target.write_text("\n".join(parts), encoding="utf-8")
    except OSError as error:
        raise UsageError(f"cannot write {target}: {error.strerror}; choose another --output") from None
    return target


def head_text(found: Imported) -> str:
    """Return the comment that begins the file: where it is from, and what was not taken."""
    model = found.model
    lines = [
        f"Scene from the OpenSim model {model.path.name} (version {model.version}).",
        "Its meshes, authors and licence are the model's: see its <credits>.",
        "Meshes stand in the model's default pose; angles are degrees. All keys: docs/scene_file.md.",
        *(f"note: {note}" for note in found.notes),
    ]
    return "\n".join("# " + " ".join(line.split()) for line in lines) + "\n"
