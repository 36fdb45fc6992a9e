"""Writing an imported scene to a folder: a TOML file that a person can read, and the meshes that it names."""

from pathlib import Path

import numpy as np

from rbfmuscle.importers.opensim.scene import Imported
from rbfmuscle.importers.toml_text import table_text
from rbfmuscle.scene.joints.tables import coupling_row, joint_row
from rbfmuscle.validation import UsageError


def write_scene(found: Imported, directory: Path) -> Path:
    """Write ``scene.toml``, meshes and attachments to a folder, and return the scene file."""
    directory, scene = Path(directory), found.scene
    target = directory / "scene.toml"
    facts = {"format": 1, "name": scene.name, "units": scene.units}
    try:
        directory.mkdir(parents=True, exist_ok=True)
        facts |= {"left_out": scene.left_out} if scene.left_out else {}
        facts |= {"superior": scene.superior, "anterior": scene.anterior}
        bones = [{"name": bone.name, "mesh": _write_mesh(directory, "bones", bone)} for bone in scene.bones]
        parts = [_head(found), table_text("[scene]", facts)]
        parts += [table_text("[[bone]]", row) for row in bones]
        parts += [table_text("[[bone]]   # no mesh: joints only", {"name": name}) for name in scene.links]
        parts += [table_text("[[joint]]", joint_row(joint)) for joint in scene.joints]
        parts += [table_text("[[coupling]]", coupling_row(c, scene.joints)) for c in scene.couplings]
        parts += [_muscle_text(directory, muscle) for muscle in scene.muscles]
        target.write_text("\n".join(parts), encoding="utf-8")
    except OSError as error:
        raise UsageError(f"cannot write to {directory}: {error.strerror}; choose another --output") from None
    return target


def _head(found):
    """The comment that begins the file: where it is from, and what was not taken."""
    model = found.model
    lines = [
        f"Scene from the OpenSim model {model.path.name} (version {model.version}).",
        "Its meshes, authors and licence are the model's: see its <credits>.",
        "Meshes stand in the model's default pose; angles are degrees. All keys: docs/scene_file.md.",
        *(f"note: {note}" for note in found.notes),
    ]
    return "\n".join("# " + " ".join(line.split()) for line in lines) + "\n"


def _muscle_text(directory, muscle):
    """The table of a muscle, its mesh and attachments written."""
    row = {"name": muscle.name, "mesh": _write_mesh(directory, "muscles", muscle), "attach": []}
    (directory / "attachments").mkdir(exist_ok=True)
    for held in muscle.attachments:
        file = f"attachments/{muscle.name}_{held.bone}.txt"
        np.savetxt(directory / file, held.vertices, fmt="%d")
        row["attach"].append({"bone": held.bone, "vertices": file})
    head = "[[muscle]]   # a tube along the model's path, of its fibres' volume; put a mesh of your own here"
    return table_text(head, row)


def _write_mesh(directory, folder, item):
    """Write a mesh and return its file."""
    file = f"{folder}/{item.name}.ply"
    (directory / folder).mkdir(exist_ok=True)
    item.mesh.export(directory / file)
    return file
