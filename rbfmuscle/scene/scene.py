"""`Scene`: bones, joints, muscles, a motion and settings; from a file, or built in code."""

from __future__ import annotations

import copy
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import KW_ONLY, dataclass, field, replace
from pathlib import Path
from typing import Literal, NamedTuple, Self

from numpy.typing import ArrayLike

from rbfmuscle.scene.bone import Bone
from rbfmuscle.scene.content import Compared
from rbfmuscle.scene.file import (
    ABOUT,
    FORMAT,
    SceneFile,
    SceneFiles,
    given_keys,
    read_scene_file,
    table_text,
)
from rbfmuscle.scene.frames import make_motion, slice_motion
from rbfmuscle.scene.joints import (
    Coupling,
    CouplingTable,
    Joint,
    JointTable,
    all_coordinates,
    check_tree,
    coupling_row,
    joint_row,
    make_coupling,
    ordered,
)
from rbfmuscle.scene.meshes.read import (
    MeshInput,
    MeshTransform,
    TransformInput,
    as_mesh,
    read_mesh,
)
from rbfmuscle.scene.muscles import (
    check_centre,
    check_file_names,
    check_muscle,
    check_place,
    check_size,
    make_muscle,
    tendon_ends,
)
from rbfmuscle.scene.objects import (
    MM_PER_UNIT,
    Attachment,
    Motion,
    Muscle,
    check_new_name,
    find_named,
    from_mm,
)
from rbfmuscle.scene.options import (
    ContactOptions,
    DetectOptions,
    MotionOptions,
    NeighbourOptions,
    OutputOptions,
    Table,
)
from rbfmuscle.scene.patches import AponeurosesTable, AttachTable
from rbfmuscle.scene.settings import TABLES, change_settings
from rbfmuscle.validation import MeshError, SceneError, UsageError, did_you_mean

DOUBTFUL = 0.6  # a guess of less confidence is reported by check and by the verdict of a run


class Guess(NamedTuple):
    """A guess in a scene: the table (``"muscle"``, ``"joint"``) and the name of what it is about,
    its confidence (0 to 1), and the reason.
    """

    table: str
    name: str
    confidence: float
    text: str


def guessed_muscles(guesses: list[Guess]) -> set[str]:
    """Names of the muscles about which there are guesses, however sure."""
    return {guess.name for guess in guesses if guess.table == "muscle"}


def doubtful(guesses: list[Guess], table: str, name: str = "") -> list[Guess]:
    """The doubtful ones of some guesses about a table, or about one name in it."""
    return [
        guess
        for guess in guesses
        if guess.table == table and guess.confidence < DOUBTFUL and name in ("", guess.name)
    ]


@dataclass(eq=False, repr=False)
class Scene(Compared):
    """Bones, joints, muscles, a motion and the settings of a simulation.

    Two are equal where all that they hold is, wherever their files lie.

    Examples
    --------
    >>> import trimesh
    >>> scene = Scene("arm", units="mm")
    >>> bone = scene.add_bone("upper", trimesh.creation.capsule(200.0, 10.0))
    >>> [bone.name for bone in scene.bones]
    ['upper']
    """

    not_compared = ("path",)

    name: str = "scene"
    _: KW_ONLY
    units: str = "mm"  # of every length in the scene: "mm", "cm" or "m"
    bones: list[Bone] = field(default_factory=list)
    joints: list[Joint] = field(default_factory=list)
    couplings: list[Coupling] = field(default_factory=list)  # coordinates that follow others
    meshless_bones: list[str] = field(default_factory=list)  # they carry joints only
    muscles: list[Muscle] = field(default_factory=list)
    motion: Motion = field(default_factory=Motion)
    contact: ContactOptions = field(default_factory=ContactOptions)
    neighbours: NeighbourOptions | None = field(default_factory=NeighbourOptions)  # None: unfelt
    detect: DetectOptions = field(default_factory=DetectOptions)
    output: OutputOptions = field(default_factory=OutputOptions)
    path: Path | None = None  # the file it was loaded from
    # These two are in the verdict of a run, and so are guesses.
    missing_bones: list[str] = field(default_factory=list)  # those without a usable mesh
    doubts: list[str] = field(default_factory=list)  # what differs from the source, in sentences
    notes: list[str] = field(default_factory=list)  # what was assumed or left out, for a check
    # Anatomical directions (3,) at rest: those of the file, or found from the bones before a run.
    superior: list[float] | None = None
    anterior: list[float] | None = None

    def __post_init__(self) -> None:
        if self.units not in MM_PER_UNIT:
            raise SceneError(f"units must be m, cm or mm, got {self.units!r}")

    def __repr__(self) -> str:
        muscles = ", ".join(f"{muscle.name} ({muscle.model})" for muscle in self.muscles)
        return (
            f"<Scene {self.name!r}, {self.units}: {len(self.bones)} bones, "
            f"{muscles or 'no muscles'}, {len(self.motion)} frames>"
        )

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
        tables = read_scene_file(Path(path))
        scene = cls(
            tables.scene.name or Path(path).stem,
            path=Path(path),
            **{key: getattr(tables.scene, key) for key in ABOUT},
        )
        try:
            _add_rows(scene, tables)
            _take_settings(scene, {key: getattr(tables, key) for key in TABLES})
            if scene.muscles or not skeleton:
                require_complete(scene)
        except (SceneError, MeshError) as error:
            found = type(error)(f"{path}: {error}")
            found.muscle = error.muscle
            raise found from None
        return scene

    @classmethod
    def from_meshes(
        cls, folder: str | Path, *, units: Literal["mm", "cm", "m"] | None = None
    ) -> Scene:
        """Return the scene that ``rbfmuscle new`` guesses from a folder of meshes; no file is
        written.

        Parameters
        ----------
        folder : path
            One bone or muscle a file (STL, OBJ, PLY, VTK, VTP), or in folders ``bones`` and
            ``muscles``.
        units : {"mm", "cm", "m"}, optional
            Unit of the meshes; by the size of the bones where not given.

        Raises
        ------
        UsageError
            If the folder holds no bone or no muscle, or is of no known unit.
        MeshError
            If a mesh cannot be used.
        """
        from rbfmuscle.importers.guess.guess import scene_from_meshes

        return scene_from_meshes(Path(folder), units=units)

    @classmethod
    def from_labels(cls, path: str | Path, *, labels: str | Path | None = None) -> Scene:
        """Return the scene that ``rbfmuscle new`` guesses from a segmentation, in mm; no file is
        written.

        Parameters
        ----------
        path : path
            A volume of labels (.nii, .nii.gz, .nrrd, .nhdr), or a folder with one file a mask.
        labels : path, optional
            Names of the labels: a file (JSON, CSV, TSV, ITK-SNAP) or a known table, as
            ``totalsegmentator``.

        Raises
        ------
        MeshError
            If the volume cannot be read or used.
        UsageError
            If it holds no bone or no muscle.
        """
        from rbfmuscle.importers.volumes import scene_from_labels

        return scene_from_labels(Path(path), labels=None if labels is None else Path(labels))

    @classmethod
    def from_osim(
        cls, path: str | Path, *, geometry: Sequence[str | Path] = (), muscles: bool = True
    ) -> Scene:
        """Return the scene of an OpenSim model (.osim), in metres; no file is written.

        Parameters
        ----------
        path : path
            The model, of version 2 to 4.
        geometry : sequence of path
            Folders with meshes, besides the model's own and its ``Geometry``.
        muscles : bool
            Make a tube of each muscle of the model, along its path.

        Raises
        ------
        SceneError
            If the model cannot be read.
        """
        from rbfmuscle.importers.opensim.scene import import_osim

        found = import_osim(path, geometry=[Path(one) for one in geometry], muscles=muscles)
        found.scene.notes += found.notes
        return found.scene

    def save(self, path: str | Path, *, folder: Path | None = None, comment: str = "") -> Path:
        """Write the scene as a TOML file that loads as the same scene, and return its path.

        Meshes, lists of attached vertices, fibres and a motion's file go into ``folder``, by
        default a new one, ``NAME_files``, beside it. A ``comment`` begins the file.

        Raises
        ------
        UsageError
            If the file or the new folder is there already.
        SceneError
            If the frames of the motion were not made from the keys of ``[motion]``.
        """
        rest = _made_motion(self, MotionOptions()).frames[0]
        own = [{**rest, **frame} for frame in self.motion.frames]
        if list(_made_motion(self, self.motion.options).frames) != own:
            raise SceneError(
                "the frames of the motion are not those of its table [motion]; give it by "
                "set_motion before the scene is saved"
            )
        files = SceneFiles(Path(path), folder)
        about = {key: getattr(self, key) for key in ABOUT if getattr(self, key)}
        with files.kept_whole():
            rows: list[tuple[str, Mapping[str, object]]] = [
                ("[scene]", {"format": FORMAT, "name": self.name, **about})
            ]
            for bone in self.bones:
                mesh = files.mesh("bones", bone.name, bone.mesh)
                rows.append(("[[bone]]", {"name": bone.name, "mesh": mesh}))
            rows += [("[[bone]]", {"name": name}) for name in self.meshless_bones]
            rows += [("[[joint]]", joint_row(joint)) for joint in self.joints]
            rows += [("[[coupling]]", coupling_row(one, self.joints)) for one in self.couplings]
            rows += [("[[muscle]]", files.muscle(muscle)) for muscle in self.muscles]
            for key, table in _settings(self).items():
                if table is None:
                    rows.insert(0, ("", {key: False}))
                elif row := files.settings(table):
                    rows.append((f"[{key}]", row))
            parts = [comment] if comment else []
            parts += [table_text(head, row) for head, row in rows]
            files.path.write_text("\n".join(parts), encoding="utf-8")
        return files.path

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
        lies = MeshTransform.build(
            {"scale": scale, "mirror": mirror, "transform": transform}, context=f"bone {name!r}: "
        )
        if name in self.meshless_bones:
            raise SceneError(f"bone {name!r} is given twice")
        if mesh is None:
            self.meshless_bones.append(name)
        else:
            read = as_mesh(mesh, name, lies, may_be_open=True)
            self.bones.append(
                Bone(name, read.mesh, read.source, read.closed, read.notes, read.doubt)
            )
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
            row = {
                "name": joint,
                "parent": parent,
                "child": child,
                "centre": centre,
                "axes": axes and dict(axes),
                **keys,
            }
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
        **keys: object,
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
        **keys
            ``scale``, ``mirror`` and ``transform`` of the mesh and the fibres, as for a bone;
            ``activation``, ``fibre_stretch_at_rest`` and ``tendon_region`` of one that contracts.
        """
        check_new_name(self.muscles, name, "muscle")
        muscle = make_muscle(name, mesh, self.bones, attach, model, fibres, aponeuroses, keys)
        muscle.tendons = tendon_ends(muscle, self.bones, self.joints)
        self.muscles.append(muscle)
        return self

    def set_motion(self, **options: object) -> Self:
        """Set the motion from the keys of ``[motion]`` (angles in degrees) and return the scene:
        ``ramp``, ``waypoints`` with ``step``, or ``file``, relative to the scene's own file.
        """
        folder = self.path and self.path.parent
        table = MotionOptions.build(options, context="[motion] ", folder=folder)
        _take_settings(self, {"motion": table})
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
        own = {name: list(held) for name, held in vars(self).items() if isinstance(held, list)}
        own["muscles"] = [replace(muscle, options=dict(muscle.options)) for muscle in self.muscles]
        changed = copy.copy(self)
        vars(changed).update(own)
        wanted = {**({} if model is None else {"model": model}), **(settings or {})}
        tables, folder = _settings(self), self.path and self.path.parent
        try:
            change_settings(wanted, tables, changed.muscles, folder=folder)
            _take_settings(changed, tables)
            if frames is not None:
                changed.motion = slice_motion(changed.motion, frames)
        except SceneError as error:
            raise UsageError(str(error)) from None
        return changed

    @property
    def guesses(self) -> list[Guess]:
        """Those of joints and of muscles' attachments."""
        marked = [("joint", joint.name, joint.guess) for joint in self.joints]
        for muscle in self.muscles:
            marked += [("muscle", muscle.name, held.guess) for held in muscle.attachments]
        return [
            Guess(table, name, guess.confidence, guess.reason)
            for table, name, guess in marked
            if guess is not None
        ]

    def bone(self, name: str) -> Bone:
        """Return the bone of that name, or raise SceneError naming the nearest."""
        return find_named(self.bones, name, "bone")

    def muscle(self, name: str) -> Muscle:
        """Return the muscle of that name, or raise SceneError naming the nearest."""
        return find_named(self.muscles, name, "muscle")


def require_complete(scene: Scene) -> Scene:
    """Return the scene, or raise SceneError if it cannot be simulated: no bones, no muscles, loose
    muscles.
    """
    for what in ("bones", "muscles"):
        if not getattr(scene, what):
            raise SceneError(f"scene {scene.name!r} has no {what}, add a [[{what[:-1]}]]")
    check_file_names(scene.bones, scene.muscles)
    _check_neighbours(scene, scene.neighbours)
    known = all_coordinates(scene.joints)
    for name in (name for frame in scene.motion.frames for name in frame):
        if name not in known:
            raise SceneError(
                f"[motion]: unknown coordinate {name!r}, {did_you_mean(name, sorted(known))}"
            )
    for muscle in scene.muscles:
        with _naming(muscle.name):
            check_muscle(muscle, scene.motion)
    return scene


def _check_neighbours(scene: Scene, options: NeighbourOptions | None) -> None:
    """Raise SceneError where ``[neighbours]`` names an unknown muscle or bone."""
    if options is None:
        return
    for pair in options.pairs or []:
        for name in pair:
            find_named(scene.muscles, name, "muscle", context="[neighbours] pairs: ")
    for muscle, bone in options.bones:
        find_named(scene.muscles, muscle, "muscle", context="[neighbours] bones: ")
        find_named(scene.bones, bone, "bone", context="[neighbours] bones: ")


@contextmanager
def _naming(muscle: str) -> Iterator[None]:
    """Give an error that is raised inside the name of a muscle."""
    try:
        yield
    except (SceneError, MeshError) as error:
        error.muscle = muscle
        raise


def _made_motion(scene: Scene, options: MotionOptions) -> Motion:
    """The motion that ``[motion]`` asks of a scene."""
    return make_motion(options, scene.joints, scene.couplings, metre=from_mm(1000.0, scene.units))


def _add_rows(scene: Scene, tables: SceneFile) -> None:
    """Add the bones, joints, couplings and muscles of a file to a scene that has none."""
    for bone in tables.bone:
        scene.add_bone(**given_keys(bone))
        if bone.mesh is not None:
            check_size("bone", bone.name, scene.bones[-1], scene.units)
    for joint in tables.joint:
        scene.add_joint(joint.joint())
        check_centre(joint.name, scene.joints[-1].centre, scene.bones, scene.units)
    for coupling in tables.coupling:
        scene.add_coupling(make_coupling(coupling, scene.joints))
    for muscle in tables.muscle:
        with _naming(muscle.name):
            read = read_mesh(muscle.mesh, name=muscle.name, transform=muscle)
            check_place(muscle.name, read, scene.bones, scene.units)
            scene.add_muscle(**{**given_keys(muscle), "mesh": read})


def _settings(scene: Scene) -> dict[str, Table | None]:
    """The tables of settings, by their names in a file; None where a scene has none."""
    return {key: getattr(scene, key) for key in TABLES} | {"motion": scene.motion.options}


def _take_settings(scene: Scene, tables: Mapping[str, Table | None]) -> None:
    """Give a scene tables of settings, and the motion of its own where that is another one."""
    for key, table in tables.items():
        if isinstance(table, NeighbourOptions):
            _check_neighbours(scene, table)
        if not isinstance(table, MotionOptions):
            setattr(scene, key, table)
        elif table is not scene.motion.options:
            scene.motion = _made_motion(scene, table)
