"""What is simulated: bones, joints, muscles, attachments, motion and settings.

A scene is loaded from a TOML file or built in code; both pass the same checks.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from numpy.typing import ArrayLike

from rbfmuscle.geometry.arrays import Floats, Integers
from rbfmuscle.scene.attachments import Attachment, resolve_attachments
from rbfmuscle.scene.joints.skeleton import ordered
from rbfmuscle.scene.joints.tables import CouplingTable, JointTable, make_coupling
from rbfmuscle.scene.meshes.read import ReadMesh, as_mesh
from rbfmuscle.scene.motion import Motion, coordinate_names
from rbfmuscle.scene.objects import (
    Bone,
    Joint,
    Muscle,
    as_vector,
    check_new_name,
    check_tree,
    find_named,
    split_model,
)
from rbfmuscle.scene.options import ContactOptions, MotionOptions, OutputOptions
from rbfmuscle.validation import SceneError

if TYPE_CHECKING:
    import trimesh


MM_PER_UNIT = {"m": 1000.0, "cm": 10.0, "mm": 1.0}


class Scene:
    """Bones, joints, muscles, a motion and the settings of a simulation.

    Parameters
    ----------
    name : str
    units : {"mm", "cm", "m"}
        Unit of every length in the scene.

    Attributes
    ----------
    bones : list of Bone
    joints : list of Joint
    couplings : list of Coupling
        Coordinates that follow others.
    links : list of str
        Bones without a mesh: they carry joints, and nothing meets them.
    muscles : list of Muscle
    motion : Motion
    contact : ContactOptions
    sliding : SlidingOptions or None
    detect : DetectOptions or None
    output : OutputOptions
    path : pathlib.Path or None
        The file it was loaded from.

    Examples
    --------
    >>> import trimesh
    >>> scene = Scene("arm", units="mm")
    >>> bone = scene.add_bone("upper", trimesh.creation.capsule(200.0, 10.0))
    >>> [bone.name for bone in scene.bones]
    ['upper']
    """

    def __init__(self, name: str = "scene", *, units: str = "mm") -> None:
        if units not in MM_PER_UNIT:
            raise SceneError(f"units must be m, cm or mm, got {units!r}")
        self.name = name
        self.units = units
        self.bones = []
        self.joints = []
        self.couplings = []
        self.links = []
        self.muscles = []
        self.motion = Motion()
        self.contact = ContactOptions()
        self.sliding = None
        self.detect: Any = None
        self.output = OutputOptions()
        self.path = None

    @classmethod
    def load(cls, path: str | Path, *, skeleton: bool = False) -> Scene:
        """Return the scene of a TOML file; its paths are relative to the file.

        Parameters
        ----------
        path : path
        skeleton : bool
            A scene without muscles will do; it can be looked over, not run.

        Raises
        ------
        SceneError
            If the file, or a name or value in it, is wrong; the message names it and the remedy.
        MeshError
            If a mesh cannot be used.
        """
        from rbfmuscle.scene.file import load_scene

        return load_scene(cls, Path(path), skeleton=skeleton)

    def length(self, millimetres: float) -> float:
        """Return a length given in millimetres in the scene's unit."""
        return millimetres / MM_PER_UNIT[self.units]

    def bone(self, name: str) -> Any:
        """Return the bone of that name, or raise SceneError naming the nearest."""
        return find_named(self.bones, name, "bone")

    def muscle(self, name: str) -> Muscle:
        """Return the muscle of that name, or raise SceneError naming the nearest."""
        return find_named(self.muscles, name, "muscle")

    def add_bone(
        self, name: str, mesh: ReadMesh | trimesh.Trimesh | tuple[Any, ...], *, scale: float = 1.0
    ) -> Scene:
        """Add a bone and return the scene.

        Parameters
        ----------
        name : str
        mesh : path, trimesh.Trimesh, (vertices, faces) or ReadMesh
            Mended where that is safe; holes are kept, with a note.
        scale : float
            Factor from the mesh's unit to the scene's.
        """
        self._check_new_bone(name)
        read = as_mesh(mesh, name, scale, may_be_open=True)
        self.bones.append(Bone(name, read.mesh, read.source, read.closed, read.notes))
        return self

    def _check_new_bone(self, name):
        check_new_name(self.bones, name, "bone")
        if name in self.links:
            raise SceneError(f"bone {name!r} is given twice")

    def add_link(self, name: str) -> Any:
        """Add a bone without a mesh, which carries joints only, and return the scene."""
        self._check_new_bone(name)
        self.links.append(name)
        return self

    def add_joint(
        self,
        name: str,
        parent: str,
        child: str,
        centre: ArrayLike | None = None,
        axes: Mapping[str, ArrayLike] | None = None,
        **keys: Any,
    ) -> Scene:
        """Add a joint, a ball where no ``type`` is given, and return the scene.

        Parameters
        ----------
        name, parent, child : str
            The child bone moves; a bone may be the child of one joint.
        centre : (3,) array_like
        axes : dict of str -> (3,) array_like
            Axis of each coordinate, in any length.
        **keys
            Any other key of ``[[joint]]`` [degree, scene unit]: ``type``, ``orientation``, ``coordinates``, ...
        """
        place = f"joint {name!r}"
        row = {"name": name, "parent": parent, "child": child, **keys}
        if centre is not None:
            row["centre"] = as_vector(centre, f"{place}: centre").tolist()
        if axes:
            row["axes"] = {
                k: as_vector(axis, f"{place}: axis {k!r}", unit=True).tolist() for k, axis in axes.items()
            }
        return self.place_joint(JointTable.build(row, place=f"{place}: ").joint())

    def place_joint(self, joint: Any) -> Any:
        """Add a `Joint` and return the scene; bones and joints form a tree."""
        check_new_name(self.joints, joint.name, "joint")
        for bone in (joint.parent, joint.child):
            if bone not in self.links:
                find_named(self.bones, bone, "bone", place=f"joint {joint.name!r}")
        check_tree(self.joints, joint)
        self.joints.append(joint)
        return self

    def add_coupling(self, coordinate: str, of: list[Any], **function: Any) -> Any:
        """Let a coordinate follow others by a function, as in ``[[coupling]]``, and return the scene.

        Parameters
        ----------
        coordinate : str
        of : list of str
        **function
            One of ``constant``, ``linear``, ``polynomial``, ``piecewise``, ``spline``, ``natural_spline``, and
            ``scale`` [degree, scene unit].
        """
        row = {"coordinate": coordinate, "of": list(of), **function}
        table = CouplingTable.build(row, place=f"coupling of {coordinate!r}: ")
        return self.place_coupling(make_coupling(table, self.joints))

    def place_coupling(self, coupling: Any) -> Any:
        """Add a `Coupling` and return the scene."""
        self.couplings = ordered([*self.couplings, coupling])
        return self

    def add_muscle(
        self,
        name: str,
        mesh: ReadMesh | trimesh.Trimesh | tuple[Floats, Integers],
        *,
        attach: Sequence[Any] = (),
        model: dict[str, Any] | str = "rbf",
        fibres: ArrayLike | None = None,
        scale: float = 1.0,
        folder: Path | None = None,
        **contraction: Any,
    ) -> Scene:
        """Add a muscle and return the scene.

        Parameters
        ----------
        name : str
        mesh : path, trimesh.Trimesh, (vertices, faces) or ReadMesh
            Closed; mended where that is safe.
        attach : list of Attachment or dict
            A dict holds ``bone`` and one of ``vertices`` (indices or a file), ``near`` (distance) and
            ``sphere`` (``centre``, ``radius``).
        model : str or dict
            A model's name, or a table with ``name`` and the model's own options.
        fibres : path or list of (k, 3) array_like, optional
        scale : float
            Factor from the mesh's unit to the scene's; fibres are scaled alike.
        folder : path, optional
            What the files of ``contraction`` are relative to.
        **contraction
            ``activation``, ``fibre_stretch_at_rest``, ``optimal_fibre_length``, ``shortening``, ``tendon``.
        """
        from rbfmuscle.scene.activation.resolve import contraction_keys
        from rbfmuscle.scene.fibres import read_fibres

        check_new_name(self.muscles, name, "muscle")
        read = as_mesh(mesh, name, scale, may_be_open=False)
        model_name, options = split_model(model, place=f"muscle {name!r}")
        attachments = resolve_attachments(attach, read, self.bones, muscle=name)
        lines = None if fibres is None else read_fibres(fibres, scale=scale, muscle=name)
        keys = contraction_keys(contraction, muscle=name, folder=folder)
        self.muscles.append(
            Muscle(name, read.mesh, model_name, options, attachments, lines, read.source, read.notes, keys)
        )
        return self

    def set_motion(self, *, folder: Path | None = None, **options: Any) -> Scene:
        """Set the motion from the keys of ``[motion]`` (angles in degrees) and return the scene."""
        table = MotionOptions.build(options, place="[motion] ")
        self.motion = self.motion_from(table, folder=folder)
        return self

    def motion_from(self, table: Any, *, folder: Any = None) -> Any:
        """Return the motion that a `MotionOptions` asks of this scene's joints."""
        return Motion.from_options(
            table, self.joints, couplings=self.couplings, metre=self.length(1000.0), folder=folder
        )

    def validate(self) -> Scene:
        """Raise SceneError if the scene cannot be simulated: no bones, no muscles, loose muscles."""
        for what in ("bones", "muscles"):
            if not getattr(self, what):
                raise SceneError(f"scene {self.name!r} has no {what}, add a [[{what[:-1]}]]")
        self.motion.check_names(set(coordinate_names(self.joints)))
        for muscle in self.muscles:
            bones = sorted({attachment.bone for attachment in muscle.attachments})
            if not bones:
                raise SceneError(
                    f"muscle {muscle.name!r} has no attachment, give attach a place on two bones"
                )
            if len(bones) == 1:
                raise SceneError(
                    f"muscle {muscle.name!r} is attached to {bones[0]!r} only, give attach a second bone"
                )
            if muscle.contraction is not None:
                self._check_contraction(muscle)
        return self

    def _check_contraction(self, muscle: Muscle) -> None:
        from rbfmuscle.scene.activation.curve import activation_curve
        from rbfmuscle.scene.activation.resolve import resolve_contraction

        resolve_contraction(muscle)
        activation_curve(muscle, self.motion)

    def check(self) -> list[Any]:
        """Return findings about the scene (errors, warnings, notes); nothing is solved.

        Returns
        -------
        list of rbfmuscle.scene.check.Finding
        """
        from rbfmuscle.scene.check import check_scene

        return check_scene(self)

    def copy(self) -> Scene:
        """Return a copy whose lists and tables are its own; meshes are shared."""
        other = copy.copy(self)
        other.bones = list(self.bones)
        other.joints = list(self.joints)
        other.couplings = list(self.couplings)
        other.links = list(self.links)
        other.muscles = [replace(muscle, options=dict(muscle.options)) for muscle in self.muscles]
        return other

    def with_options(
        self,
        settings: Mapping[str, Any] | None = None,
        *,
        model: str | dict | None = None,
        frames: slice | str | None = None,
    ) -> Scene:
        """Return a copy with other settings, another model or other frames; meshes are shared.

        Parameters
        ----------
        settings : mapping, optional
            Dotted keys with their values: ``{"model.centres": 200, "contact.substep_angle": 1}``.
            See :func:`rbfmuscle.scene.settings.apply_settings` for all of them.
        model : str or dict, optional
            For every muscle. Options of another model are dropped.
        frames : slice or str, optional
            Which frames of the motion, as a slice or "A:B:S".

        Raises
        ------
        UsageError
            If a key is unknown, with the nearest right one, or a value is not allowed.
        """
        from rbfmuscle.scene.settings import apply_model, apply_settings, choose_frames

        scene = self.copy()
        if model is not None:
            apply_model(scene, model)
        apply_settings(scene, settings or {})
        if frames is not None:
            choose_frames(scene, frames)
        return scene

    def resolved(self) -> dict[str, Any]:
        """Return the scene as plain data for ``run.json``: names, counts, options, sources and hashes."""
        from rbfmuscle.scene.file import describe_scene

        return describe_scene(self)

    def __repr__(self) -> str:
        muscles = ", ".join(f"{muscle.name} ({muscle.model})" for muscle in self.muscles) or "no muscles"
        counts = f"{len(self.bones)} bones, {muscles}, {len(self.motion)} frames"
        return f"<Scene {self.name!r}, {self.units}: {counts}>"


__all__ = ["Attachment", "Bone", "Joint", "Muscle", "Scene"]
