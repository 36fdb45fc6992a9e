"""`Scene`: bones, joints, muscles, a motion and settings; from a file, or built in code."""

from __future__ import annotations

import copy
import html
from collections.abc import Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field, replace
from pathlib import Path
from typing import Any, Self, TypeAlias

from numpy.typing import ArrayLike

from rbfmuscle import showing
from rbfmuscle.geometry.arrays import Floats, MeshLike
from rbfmuscle.scene import settings as changes
from rbfmuscle.scene.activation.keys import contraction_keys
from rbfmuscle.scene.attachments import resolve_attachments, tendon_ends
from rbfmuscle.scene.bone import Bone
from rbfmuscle.scene.build import check_runnable, fill_scene, made_motion
from rbfmuscle.scene.file import read_scene_file
from rbfmuscle.scene.guesses import Guess
from rbfmuscle.scene.joints.joint import Coupling, Joint, check_tree, ordered
from rbfmuscle.scene.joints.tables import (
    CouplingTable,
    JointTable,
    make_coupling,
)
from rbfmuscle.scene.meshes.read import as_mesh, read_fibres
from rbfmuscle.scene.meshes.repair import ReadMesh
from rbfmuscle.scene.meshes.transform import TransformInput, mesh_transform
from rbfmuscle.scene.objects import (
    MM_PER_UNIT,
    Attachment,
    Motion,
    Muscle,
    body_axes,
    check_new_name,
    find_named,
    split_model,
)
from rbfmuscle.scene.options import (
    ContactOptions,
    DetectOptions,
    MotionOptions,
    OutputOptions,
    SlidingOptions,
)
from rbfmuscle.scene.patches import AttachTable
from rbfmuscle.scene.record import record_scene
from rbfmuscle.scene.save import save_scene
from rbfmuscle.validation import MeshError, SceneError

MeshInput: TypeAlias = str | Path | ReadMesh | MeshLike


@dataclass(eq=False, repr=False)
class Scene:
    """Bones, joints, muscles, a motion and the settings of a simulation.

    Attributes
    ----------
    name : str
    units : {"mm", "cm", "m"}
        Unit of every length in the scene.
    couplings : list of Coupling
        Coordinates that follow others.
    meshless_bones : list of str
        Bones without a mesh, which carry joints only.
    path : pathlib.Path or None
        The file it was loaded from.
    missing_bones : list of str
        Bones of which no mesh could be used; they count in the verdict of a run.
    doubts : list of str
        What makes the scene another one than its source, in sentences; warnings of a check, and in
        the verdict of a run.
    guesses : list of Guess
        Lines of the file that are marked GUESS; the doubtful ones count in the verdict of a run.
    notes : list of str
        What was assumed about the data or left out, for a check to repeat.
    superior, anterior : list of float or None
        Anatomical directions (3,) at rest: those of the file, or found from the bones before a run
        or a picture.

    Examples
    --------
    >>> import trimesh
    >>> scene = Scene("arm", units="mm")
    >>> bone = scene.add_bone("upper", trimesh.creation.capsule(200.0, 10.0))
    >>> [bone.name for bone in scene.bones]
    ['upper']
    """

    name: str = "scene"
    _: KW_ONLY
    units: str = "mm"
    bones: list[Bone] = field(default_factory=list)
    joints: list[Joint] = field(default_factory=list)
    couplings: list[Coupling] = field(default_factory=list)
    meshless_bones: list[str] = field(default_factory=list)
    muscles: list[Muscle] = field(default_factory=list)
    motion: Motion = field(default_factory=Motion)
    contact: ContactOptions = field(default_factory=ContactOptions)
    sliding: SlidingOptions | None = None
    detect: DetectOptions | None = None
    output: OutputOptions = field(default_factory=OutputOptions)
    path: Path | None = None
    missing_bones: list[str] = field(default_factory=list)
    doubts: list[str] = field(default_factory=list)
    guesses: list[Guess] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    superior: list[float] | None = None
    anterior: list[float] | None = None

    def __post_init__(self) -> None:
        if self.units not in MM_PER_UNIT:
            raise SceneError(f"units must be m, cm or mm, got {self.units!r}")

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
            fill_scene(scene, tables)
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
        **keys: Any,
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
            row = {"name": joint, "parent": parent, "child": child, "centre": centre}
            row |= {"axes": axes and dict(axes)} | keys
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
        self, coordinate: str | Coupling, of: Sequence[str] = (), **function: Any
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
        attach: Sequence[Attachment | AttachTable | dict[str, Any]] = (),
        model: dict[str, Any] | str = "rbf",
        fibres: str | Path | Sequence[ArrayLike] | None = None,
        scale: float = 1.0,
        mirror: str | None = None,
        transform: TransformInput = None,
        **contraction: Any,
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
        scale, mirror, transform
            Where the mesh and the fibres lie, as for a bone.
        **contraction
            ``activation``, ``fibre_stretch_at_rest``, ``tendon``.
        """
        check_new_name(self.muscles, name, "muscle")
        lies = mesh_transform(scale, mirror, transform, context=f"muscle {name!r}: ")
        read = as_mesh(mesh, name, lies, may_be_open=False)
        model_name, options = split_model(model, context=f"muscle {name!r}")
        attachments = resolve_attachments(attach, read, self.bones, muscle=name, transform=lies)
        lines = None if fibres is None else read_fibres(fibres, transform=lies, muscle=name)
        keys = contraction_keys(contraction, muscle=name)
        muscle = Muscle(
            name, read.mesh, model_name, options, attachments, lines, read.source, read.notes, keys
        )
        muscle.tendons = tendon_ends(muscle, self.bones, self.joints)
        self.muscles.append(muscle)
        return self

    def set_motion(self, *, folder: Path | None = None, **options: Any) -> Self:
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
        settings: Mapping[str, Any] | None = None,
        *,
        model: str | dict[str, Any] | None = None,
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

    def resolved(self) -> dict[str, Any]:
        """Return the scene as plain data for ``run.json``: names, counts, options, sources and
        hashes.
        """
        return record_scene(self)

    def length(self, millimetres: float) -> float:
        """Return a length given in millimetres in the scene's unit."""
        return millimetres / MM_PER_UNIT[self.units]

    @property
    def body(self) -> Floats:
        """Left, posterior and superior (3, 3); x, y and z where the directions are not known."""
        return body_axes(self.superior, self.anterior)

    def bone(self, name: str) -> Bone:
        """Return the bone of that name, or raise SceneError naming the nearest."""
        return find_named(self.bones, name, "bone")

    def muscle(self, name: str) -> Muscle:
        """Return the muscle of that name, or raise SceneError naming the nearest."""
        return find_named(self.muscles, name, "muscle")

    def attachment_frames(self, muscle: Muscle) -> list[str]:
        """Names of the bones, then of the ends that tendons of a muscle hold."""
        return [*(bone.name for bone in self.bones), *(end.name for end in muscle.tendons)]

    def copy(self) -> Self:
        """Return a copy whose lists and tables are its own; meshes are shared."""
        other = copy.copy(self)
        lists = (
            "bones",
            "joints",
            "couplings",
            "meshless_bones",
            "missing_bones",
            "doubts",
            "guesses",
            "notes",
        )
        for name in lists:
            setattr(other, name, list(getattr(self, name)))
        other.muscles = [replace(muscle, options=dict(muscle.options)) for muscle in self.muscles]
        return other

    def show(self, *, model: str | None = None) -> showing.ShownPage:
        """Show the scene in a browser or a notebook, to be moved by hand; see `rbfmuscle.show`."""
        return showing.registered[0].show(self, model=model)

    def __repr__(self) -> str:
        muscles = ", ".join(f"{muscle.name} ({muscle.model})" for muscle in self.muscles)
        counts = f"{len(self.bones)} bones, {muscles or 'no muscles'}, {len(self.motion)} frames"
        return f"<Scene {self.name!r}, {self.units}: {counts}>"

    def _repr_html_(self) -> str:
        return showing.registered[0].picture(self) if self.bones else html.escape(repr(self))
