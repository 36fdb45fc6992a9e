"""Scenes in memory from meshes, label volumes and OpenSim models."""

import os
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Literal, NamedTuple

from rbfmuscle.anatomy.bones import HEADER
from rbfmuscle.anatomy.names import name_facts
from rbfmuscle.geometry.arrays import Booleans
from rbfmuscle.importers.guess.guess import SceneGuess, guess_scene, write_scene
from rbfmuscle.importers.opensim.scene import import_osim
from rbfmuscle.importers.volumes import LabelVolume, label_surface, read_labels
from rbfmuscle.scene.names import new_name, plain_name
from rbfmuscle.scene.objects import MM_PER_UNIT
from rbfmuscle.scene.scene import Scene
from rbfmuscle.validation import MeshError, UsageError


class Surfaces(NamedTuple):
    """The ``folder`` of a volume's surfaces, vertices (n,) on caps by file, notes, and why labels
    have none, by their names.
    """

    folder: Path
    capped: dict[str, Booleans]
    notes: list[str]
    unusable: dict[str, str]


def scene_from_meshes(folder: Path, *, units: Literal["mm", "cm", "m"] | None) -> Scene:
    """The scene of `Scene.from_meshes`."""
    if units is not None and units not in MM_PER_UNIT:
        raise UsageError(f"units must be m, cm or mm, got {units!r}")
    with TemporaryDirectory() as base:
        guess = guess_scene(folder, units, Path(base))
        return _in_memory(guess, Path(base))


def scene_from_labels(path: Path, *, labels: Path | None) -> Scene:
    """The scene of `Scene.from_labels`."""
    volume = read_labels(path, names=labels)
    with TemporaryDirectory() as base:
        stage = Path(base, "surfaces")
        stage.mkdir()
        scene = _in_memory(guess_volume(volume, stage, Path(base)), Path(base))
    scene.name = plain_name(path.name.split(".")[0]) or "scene"
    return scene


def scene_from_osim(path: Path, *, geometry: list[Path], muscles: bool) -> Scene:
    """The scene of `Scene.from_osim`."""
    found = import_osim(path, geometry=geometry, muscles=muscles)
    found.scene.notes += found.notes
    return found.scene


def _in_memory(guess: SceneGuess, base: Path) -> Scene:
    """The scene of a guess whose file is in a folder that is removed."""
    stage = base / "scene"
    stage.mkdir()
    scene = write_scene(guess, base / "scene.toml", stage)
    scene.path = None
    for bone in scene.bones:
        bone.source = _lasting(bone.source, base)
    for muscle in scene.muscles:
        muscle.source = _lasting(muscle.source, base)
    return scene


def _lasting(source: str, base: Path) -> str:
    """The name of a file without a way through a folder that is removed; none for files in it."""
    source = os.path.normpath(source)
    return "" if source.startswith(f"{base}{os.sep}") else source


def guess_volume(
    volume: LabelVolume,
    stage: Path,
    base: Path,
    *,
    progress: Callable[[int, int], None] | None = None,
) -> SceneGuess:
    """The guess of a label volume, whose surfaces are written into a folder ``stage``; the scene's
    paths are relative to ``base``. ``progress`` is called with the labels that are done, and of how
    many.
    """
    found = write_surfaces(volume, stage, progress)
    guess = guess_scene(
        found.folder,
        "mm",
        base,
        header=HEADER if volume.directed else None,
        capped=found.capped,
        source=volume.source,
        unusable=found.unusable,
    )
    guess.parts.notes[:0] = found.notes
    return guess


def write_surfaces(
    volume: LabelVolume, stage: Path, progress: Callable[[int, int], None] | None = None
) -> Surfaces:
    """Surfaces of all labels as PLY in ``meshes`` of a folder; ``progress`` as of
    `guess_volume`.
    """
    meshes = stage / "meshes"
    meshes.mkdir()
    values = volume.values()
    capped: dict[str, Booleans] = {}
    unusable: dict[str, str] = {}
    frame = "right, forward, up (RAS), mm"
    notes = [f"surfaces of {Path(volume.source).name}, in its frame: {frame}", *volume.notes]
    for done, label in enumerate(values, start=1):
        tissue = name_facts(volume.name(label)).tissue
        if tissue == "other":
            notes.append(f"{volume.name(label)}: neither bone nor muscle, left out")
            continue
        try:
            surface = label_surface(volume, int(label), pieces=tissue == "bone")
        except MeshError as error:
            unusable[volume.name(label)] = str(error).removeprefix(f"{volume.source}: ")
            continue
        plain = plain_name(surface.name)
        file = new_name(surface.name, capped)
        if plain.lower() in map(str.lower, capped):  # they are two parts
            notes.append(f"several labels are named {plain}: one of them is {file} here")
        surface.mesh.export(meshes / f"{file}.ply")
        capped[file] = surface.capped
        notes += [f"{surface.name}: {note}" for note in surface.notes]
        if progress is not None:
            progress(done, len(values))
    return Surfaces(meshes, capped, notes, unusable)
