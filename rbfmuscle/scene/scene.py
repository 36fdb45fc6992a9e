"""`Scene`: bones, joints, muscles, a motion and settings; from a file, or built in code."""

from __future__ import annotations

import html
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Self, TypeAlias

from numpy.typing import ArrayLike

from rbfmuscle import showing
from rbfmuscle.geometry.arrays import MeshLike
from rbfmuscle.scene import settings as changes
from rbfmuscle.scene.activation.keys import contraction_keys
from rbfmuscle.scene.attachments import make_attachments, resolve_aponeuroses, tendon_ends
from rbfmuscle.scene.bone import Bone
from rbfmuscle.scene.build import check_runnable, made_motion
from rbfmuscle.scene.contents import SceneContents
from rbfmuscle.scene.extents import check_centre, check_place, check_size
from rbfmuscle.scene.file import SceneFile, given_muscle, read_scene_file
from rbfmuscle.scene.joints.joint import Coupling, Joint, check_tree, ordered
from rbfmuscle.scene.joints.tables import (
    CouplingTable,
    JointTable,
    make_coupling,
)
from rbfmuscle.scene.meshes.read import as_mesh, read_fibres, read_mesh
from rbfmuscle.scene.meshes.repair import ReadMesh
from rbfmuscle.scene.meshes.transform import TransformInput, mesh_transform
from rbfmuscle.scene.objects import (
    Attachment,
    Muscle,
    check_new_name,
    find_named,
    split_model,
)
from rbfmuscle.scene.options import (
    MotionOptions,
)
from rbfmuscle.scene.patches import AponeurosesTable, AttachTable
from rbfmuscle.scene.save import save_scene
from rbfmuscle.validation import MeshError, SceneError

MeshInput: TypeAlias = str | Path | ReadMesh | MeshLike


class Scene(SceneContents):
    """Bones, joints, muscles, a motion and the settings of a simulation; what it holds is that of
    `SceneContents`.

    Examples
    --------
    >>> import trimesh
    >>> scene = Scene("arm", units="mm")
    >>> bone = scene.add_bone("upper", trimesh.creation.capsule(200.0, 10.0))
    >>> [bone.name for bone in scene.bones]
    ['upper']
    """

    @classmethod
    def load(cls, path: str | Path, *, skeleton: bool = False) -> Self:
        """Return the scene of a TOML file; its paths are relative to the file.

        Parameters
        ----------
        path : path
        skeleton : bool
            Accept a scene without muscles; it can be looked at, not run.

        Raises
        ------
        SceneError
            If the file, or a name or value in it, is wrong; the message names it and the remedy.
        MeshError
            If a mesh cannot be used.
        """
        path = Path(path)
        tables, guesses = read_scene_file(path)
        scene = cls(tables.scene.name or path.stem, units=tables.scene.units, path=path)
        try:
            scene.guesses = guesses
            _fill(scene, tables)
            return scene if skeleton and not scene.muscles else scene.validate()
        except (SceneError, MeshError) as error:
            raise type(error)(f"{path}: {error}") from None

    def save(self, path: str | Path) -> Path:
        """Write the scene as a TOML file that loads as the same scene, and return its path.

        Meshes, lists of attached vertices, fibres and a motion's file go into a new folder
        ``NAME_files`` beside it; nothing that exists is replaced.

        Raises
        ------
        UsageError
            If the file or the folder is there already.
        SceneError
            If the frames of the motion were not made from the keys of ``[motion]``.
        """
        return save_scene(self, Path(path))

    def add_bone(
        self,
        name: str,
        mesh: MeshInput | None = None,
        *,
        scale: float = 1.0,
        mirror: str | None = None,
        transform: TransformInput = None,
    ) -> Self:
        """Add a bone and return the scene.

        Parameters
        ----------
        name : str
        mesh : path, trimesh.Trimesh, (vertices, faces) or ReadMesh, optional
            Mended where that is safe; holes are kept, with a note. A bone without one carries
            joints only.
        scale : float
            Factor from the mesh's unit to the scene's.
        mirror : {"x", "y", "z"}, optional
            Coordinate of which the sign is changed, after the scale.
        transform : (4, 4) array_like or dict, optional
            Then applied; a dict holds ``rotate`` and ``translate``, as in ``[[bone]]``.
        """
        check_new_name(self.bones, name, "bone")
        lies = mesh_transform(scale, mirror, transform, context=f"bone {name!r}: ")
        if name in self.meshless_bones:
            raise SceneError(f"bone {name!r} is given twice")
        if mesh is None:
            self.meshless_bones.append(name)
        else:
            read = as_mesh(mesh, name, lies, may_be_open=True)
            self.bones.append(Bone(name, read.mesh, read.source, read.closed, read.notes))
        return self

    def add_joint(
        self,
        joint: str | Joint,
        parent: str = "",
        child: str = "",
        centre: ArrayLike | None = None,
        axes: Mapping[str, ArrayLike] | None = None,
        **keys: object,
    ) -> Self:
        """Add a joint, a ball where no ``type`` is given, and return the scene.

        Parameters
        ----------
        joint : str or Joint
            Its name; a `Joint` is complete and takes nothing else.
        parent, child : str
            The child bone moves; a bone may be the child of one joint.
        centre : (3,) array_like
        axes : dict of str -> (3,) array_like
            Axis of each coordinate, in any length.
        **keys
            Any other key of ``[[joint]]`` [degree, scene unit]: ``type``, ``coordinates``,
            ``rotations``, ...
        """
        if isinstance(joint, str):
            row = {"name": joint, "parent": parent, "child": child, "centre": centre, **keys}
            row["axes"] = axes and dict(axes)
            joint = JointTable.build(row, context=f"joint {joint!r}: ").joint()
        check_new_name(self.joints, joint.name, "joint")
        for bone in (joint.parent, joint.child):
            if bone not in self.meshless_bones:
                find_named(self.bones, bone, "bone", context=f"joint {joint.name!r}: ")
        check_tree(self.joints, joint)
        self.joints.append(joint)
        for muscle in self.muscles:
            muscle.tendons = tendon_ends(muscle, self.bones, self.joints)
        return self

    def add_coupling(
        self, coordinate: str | Coupling, of: Sequence[str] = (), **function: object
    ) -> Self:
        """Let a coordinate follow others by a function, as in ``[[coupling]]``, and return the
        scene.

        Parameters
        ----------
        coordinate : str or Coupling
            Its name; a `Coupling` is complete and takes nothing else.
        of : list of str
        **function
            One of ``constant``, ``linear``, ``polynomial``, ``piecewise`` and ``spline`` [degree,
            scene unit].
        """
        if isinstance(coordinate, str):
            row = {"coordinate": coordinate, "of": list(of), **function}
            table = CouplingTable.build(row, context=f"coupling of {coordinate!r}: ")
            coordinate = make_coupling(table, self.joints)
        self.couplings = ordered([*self.couplings, coordinate])
        return self

    def add_muscle(
        self,
        name: str,
        mesh: MeshInput,
        *,
        attach: Sequence[Attachment | AttachTable | Mapping[str, object]] = (),
        model: Mapping[str, object] | str = "rbf",
        fibres: str | Path | Sequence[ArrayLike] | None = None,
        aponeuroses: AponeurosesTable | Mapping[str, object] | None = None,
        scale: float = 1.0,
        mirror: str | None = None,
        transform: TransformInput = None,
        **contraction: object,
    ) -> Self:
        """Add a muscle and return the scene.

        Parameters
        ----------
        name : str
        mesh : path, trimesh.Trimesh, (vertices, faces) or ReadMesh
            Closed; mended where that is safe.
        attach : list of Attachment or dict
            A dict holds ``bone`` and one of ``vertices`` (indices or a file), ``near`` (distance)
            and the other keys of the scene file; a ``tendon`` (``to``, ``via``) where the mesh
            ends short of the bone.
        model : str or dict
            A model's name, or a table with ``name`` and the model's own options.
        fibres : path or list of (k, 3) array_like, optional
        aponeuroses : dict, optional
            Of a pennate muscle, ``origin`` and ``insertion``: patches of its surface between which
            fibres run, each a dict as of an attachment without the bone.
        scale, mirror, transform
            Where the mesh and the fibres lie, as for a bone.
        **contraction
            ``activation``, ``fibre_stretch_at_rest``, ``tendon_region``.
        """
        check_new_name(self.muscles, name, "muscle")
        lies = mesh_transform(scale, mirror, transform, context=f"muscle {name!r}: ")
        read = as_mesh(mesh, name, lies, may_be_open=False)
        model_name, options = split_model(model, context=f"muscle {name!r}")
        attachments = make_attachments(attach, read, self.bones, muscle=name, transform=lies)
        lines = None if fibres is None else read_fibres(fibres, transform=lies, muscle=name)
        keys = contraction_keys(contraction, muscle=name)
        muscle = Muscle(
            name, read.mesh, model_name, options, attachments, lines, read.source, read.notes, keys
        )
        muscle.given = read.given
        muscle.aponeuroses = resolve_aponeuroses(aponeuroses, read, muscle=name, transform=lies)
        muscle.tendons = tendon_ends(muscle, self.bones, self.joints)
        self.muscles.append(muscle)
        return self

    def set_motion(self, *, folder: Path | None = None, **options: object) -> Self:
        """Set the motion from the keys of ``[motion]`` (angles in degrees) and return the scene.

        Parameters
        ----------
        folder : path, optional
            What a relative ``file`` is relative to.
        **options
            ``ramp``, ``waypoints`` with ``step``, or ``file``.
        """
        table = MotionOptions.build(options, context="[motion] ", folder=folder)
        self.motion = made_motion(self, table)
        return self

    def validate(self) -> Self:
        """Return the scene, or raise SceneError if it cannot be simulated: no bones, no muscles,
        loose muscles.
        """
        check_runnable(self)
        return self

    def with_options(
        self,
        settings: Mapping[str, object] | None = None,
        *,
        model: str | Mapping[str, object] | None = None,
        frames: slice | str | None = None,
    ) -> Self:
        """Return a copy with other settings, another model or other frames; meshes are shared.

        Parameters
        ----------
        settings : mapping, optional
            Dotted keys with their values: ``{"model.centres": 200, "contact.substep_angle": 1}``,
            as in the page of the scene file. Whole models come first, as another model drops the
            settings of the one before.
        model : str or dict, optional
            For every muscle. Options of another model are dropped.
        frames : slice or str, optional
            Which frames of the motion, as a slice or "A:B:S".

        Raises
        ------
        UsageError
            If a key is unknown, with the nearest right one, or a value is not allowed.
        """
        changed = self.copy()
        changes.change_scene(changed, settings or {}, model, frames)
        return changed

    def show(self, *, model: str | None = None) -> showing.ShownPage:
        """Show the scene in a browser or a notebook, to be moved by hand; see `rbfmuscle.show`."""
        return showing.registered[0].show(self, model=model)

    def _repr_html_(self) -> str:
        return showing.registered[0].picture(self) if self.bones else html.escape(repr(self))


def _fill(scene: Scene, tables: SceneFile) -> None:
    """Add what the tables of a file say to an empty scene."""
    about = tables.scene
    scene.missing_bones = about.missing_bones
    scene.doubts = about.doubts
    scene.notes = about.notes
    scene.superior = about.superior
    scene.anterior = about.anterior
    for bone in tables.bone:
        scene.add_bone(**{key: getattr(bone, key) for key in bone.model_fields_set})
        if bone.mesh is not None:
            check_size("bone", bone.name, scene.bones[-1], scene.units)
    for joint in tables.joint:
        scene.add_joint(joint.joint())
        check_centre(joint.name, scene.joints[-1].centre, scene.bones, scene.units)
    for coupling in tables.coupling:
        scene.add_coupling(make_coupling(coupling, scene.joints))
    for muscle in tables.muscle:
        given = given_muscle(muscle, tables.classes)
        read = read_mesh(given.mesh, name=given.name, transform=given)
        check_size("muscle", given.name, read, scene.units)
        check_place(given.name, read, scene.bones, scene.units)
        scene.add_muscle(
            given.name,
            read,
            attach=given.attach,
            model=given.model,
            fibres=given.fibres,
            aponeuroses=given.aponeuroses,
            scale=given.scale,
            mirror=given.mirror,
            transform=given.transform,
            **given.contraction,
        )
    scene.motion = made_motion(scene, tables.motion)
    scene.contact = tables.contact
    scene.sliding = tables.sliding
    scene.detect = tables.detect
    scene.output = tables.output
