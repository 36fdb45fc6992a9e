"""Options that several commands take."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from rbfmuscle.validation import SceneError, UsageError

if TYPE_CHECKING:
    from rbfmuscle.scene.objects import Muscle
    from rbfmuscle.scene.scene import Scene

SceneName = Annotated[Path, Parameter(help='Scene file (TOML), or "phantom" for the embedded hip.')]
Output = Annotated[Path, Parameter(name=["--output", "-o"], help="Folder for the results.")]
Model = Annotated[
    str | None,
    Parameter(
        help="Model of every muscle, in place of the scene's: rbf, pbd, pbd-converged, xpbd, ..."
    ),
]
Settings = Annotated[
    list[str] | None,
    Parameter(
        name="--set",
        negative="",
        help="KEY=VALUE, for instance model.centres=200 or contact.substep_angle=1; may be "
        "repeated.",
    ),
]
Frames = Annotated[
    str | None,
    Parameter(help="Frames FIRST:END:STEP of the motion, as a Python slice: END not included."),
]
Json = Annotated[bool, Parameter(name="--json", negative="", help="Print JSON and nothing else.")]
Flag = Annotated[bool, Parameter(negative="")]
Force = Annotated[bool, Parameter(negative="", help="Replace a scene file that exists.")]
Texts = Annotated[list[str] | None, Parameter(negative="", consume_multiple=True)]


def chosen_muscle(scene: "Scene", name: str) -> "Muscle":
    """The muscle that ``--muscle`` names; UsageError if there is none."""
    try:
        return scene.muscle(name)
    except SceneError as error:
        raise UsageError(f"--muscle: {error}") from None
