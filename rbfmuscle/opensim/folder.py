"""The folder that an import leaves behind."""

import os
from pathlib import Path

from rbfmuscle.opensim.match import Match
from rbfmuscle.opensim.scene import Imported
from rbfmuscle.opensim.write import skeleton_text, table_text, value_text, write_meshes
from rbfmuscle.sim.scene.options import MotionOptions
from rbfmuscle.validation import UsageError


def write_scene(
    found: Imported, directory: Path, *, motion: Path | None = None, matches: list[Match] | None = None
) -> Path:
    """Write ``scene.toml`` and the bones' meshes to a folder, and return the scene file.

    Parameters
    ----------
    found : Imported
    directory : path
        Made where it is missing.
    motion : path, optional
        A motion file that the scene shall follow; checked against its coordinates.

    matches : list of Match, optional
        Muscles, with first attachments.

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
    parts.append(model_text(found, directory, matches or []))
    parts += [muscle_text(match, directory) for match in matches or []]
    target = directory / "scene.toml"
    try:
        target.write_text("\n".join(parts), encoding="utf-8")
    except OSError as error:
        raise UsageError(f"cannot write {target}: {error.strerror}; choose another --output") from None
    return target


def model_text(found: Imported, directory: Path, matches: list[Match]) -> str:
    """Return the table that tells a scene of which model it is, and of which muscles its own are."""
    file = os.path.relpath(found.model.path.resolve(), directory.resolve())
    held = {match.name: [path.name for path in match.paths] for match in matches if len(match.ends) > 1}
    return table_text("[opensim]", {"model": file, **({"muscles": held} if held else {})})


def muscle_text(match: Match, directory: Path) -> str:
    """Return the table of a muscle, or a comment where it has not two ends; writes its lists of vertices."""
    file = os.path.relpath(match.file.resolve(), directory.resolve())
    names = " ".join(path.name for path in match.paths)
    if len(match.ends) < 2:
        why = match.note or f"{names}: both ends are on one bone"
        return f"# {match.file.name} is left out: {why}. Add it by hand, or correct matches.csv.\n"
    folder = directory / "attachments"
    folder.mkdir(parents=True, exist_ok=True)
    lines = ["[[muscle]]", f"name = {value_text(match.name)}", f"mesh = {value_text(file)}", "attach = ["]
    for bone, vertices in match.ends:
        name = f"attachments/{match.name}_{bone}.txt"
        (directory / name).write_text("\n".join(map(str, vertices)) + "\n", encoding="utf-8")
        entry = value_text({"bone": bone, "vertices": name})
        lines.append(f"  {entry},   # GUESS: path points, nearness")
    head = (
        f"# GUESS: {match.file.name} is {names} of the model, its ends {match.distance:.4g} from the mesh\n"
    )
    return head + "\n".join([*lines, "]"]) + "\n"


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
