"""The scene that a command is given: a file, or the embedded hip by name."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rbfmuscle.scene.scene import Scene


PHANTOM = "phantom"


def is_mesh(source: str) -> bool:
    """Whether what a command is given is one mesh, not a scene."""
    return source != PHANTOM and Path(source).suffix.lower() != ".toml"


def load_scene(scene: str | Path, *, skeleton: bool = False) -> Scene:
    """The scene of a file, or the embedded hip for "phantom" where there is no file of that name; see `Scene.load`."""
    from rbfmuscle.scene.scene import Scene

    if str(scene) == PHANTOM and not Path(scene).exists():
        from rbfmuscle.scene.phantom import phantom_scene

        return phantom_scene()
    return Scene.load(Path(scene), skeleton=skeleton)
