"""`Scene`: the data of a scene with the functions that load, build, check and change it as
methods.
"""

from __future__ import annotations

import html
from typing import TYPE_CHECKING

from rbfmuscle.scene import build
from rbfmuscle.scene.check import check_scene
from rbfmuscle.scene.file import describe_scene, load_scene
from rbfmuscle.scene.objects import SceneData
from rbfmuscle.scene.settings import change_scene

if TYPE_CHECKING:
    import rbfmuscle


class Scene(SceneData):
    """Bones, joints, muscles, a motion and the settings of a simulation; attributes as of
    `SceneData`.

    Parameters
    ----------
    name : str
    units : {"mm", "cm", "m"}
        Unit of every length in the scene.

    Examples
    --------
    >>> import trimesh
    >>> scene = Scene("arm", units="mm")
    >>> bone = scene.add_bone("upper", trimesh.creation.capsule(200.0, 10.0))
    >>> [bone.name for bone in scene.bones]
    ['upper']
    """

    load = classmethod(load_scene)
    add_bone = build.add_bone
    add_joint = build.add_joint
    place_joint = build.place_joint
    add_coupling = build.add_coupling
    place_coupling = build.place_coupling
    add_muscle = build.add_muscle
    set_motion = build.set_motion
    validate = build.validate
    check = check_scene
    with_options = change_scene
    resolved = describe_scene

    def _repr_html_(self) -> str:
        import rbfmuscle

        if not self.bones:
            return html.escape(repr(self))
        oriented = rbfmuscle.orient_scene(self.copy())
        return rbfmuscle.figure_html(lambda file: rbfmuscle.draw_scene(oriented, file), repr(self))

    def show(self, *, model: str | None = None) -> rbfmuscle.Page:
        """Show the scene in a browser or a notebook, to be moved by hand; see `rbfmuscle.show`."""
        import rbfmuscle  # Scenes know nothing of viewers; the facade does.

        return rbfmuscle.show(self, model=model)
