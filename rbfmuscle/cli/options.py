"""Options that several commands take, and what commands print: lines or JSON on standard output,
errors on standard error.
"""

import sys
from collections.abc import Iterable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from rbfmuscle.validation import RBFMuscleError, SceneError, UsageError

if TYPE_CHECKING:
    from rbfmuscle.scene.scene import Scene


LONGEST_LINE = 1000  # characters of a message: what a hostile file holds is not all shown


@Parameter(name="*")
@dataclass(frozen=True)
class Printing:
    """Options for what a command prints."""

    as_json: Annotated[
        bool, Parameter(name="--json", negative="", help="Print JSON and nothing else.")
    ] = False
    quiet: Annotated[bool, Parameter(negative="", help="Show no progress.")] = False


USUAL = Printing()


def print_result(
    printing: Printing,
    facts: Mapping[str, object],
    lines: Iterable[str],
    *,
    error: RBFMuscleError | None = None,
) -> int:
    """Print what a command found, as JSON or as lines, then an error that it ends with; the exit
    code.
    """
    if printing.as_json:
        from rbfmuscle.run.writer import json_text

        failed = {} if error is None else {"error": str(error), "exit_code": error.exit_code}
        print(json_text({**facts, **failed}))
    else:
        print("\n".join(lines))
    if error is None:
        return 0
    print(f"rbfmuscle: {one_line(error)}", file=sys.stderr)
    return error.exit_code


def one_line(error: object) -> str:
    """Return a message as one line without control characters, shortened if it is very long."""
    text = " ".join(str(error).split())
    text = "".join(char if char.isprintable() else "?" for char in text)
    return text if len(text) <= LONGEST_LINE else f"{text[: LONGEST_LINE - 60]} ... {text[-50:]}"


SceneName = Annotated[
    Path, Parameter(help='Scene file (TOML), or "phantom" for a hip made by formulas.')
]
RunFolder = Annotated[Path, Parameter(help="Folder of the run.")]
Output = Annotated[Path, Parameter(name=["--output", "-o"], help="Folder for the results.")]
OwnFolder = Annotated[Path | None, Parameter(name=["--output", "-o"])]
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
Muscles = Annotated[
    str | None, Parameter(help="Muscles of the scene, separated by commas; all by default.")
]
FailOn = Annotated[
    str | None,
    Parameter(
        help="Limits, separated by commas: a value beyond one of them, or none at all, makes the "
        "exit code 6. For instance volume_error=0.001,penetration_max, or all."
    ),
]
Jobs = Annotated[int | None, Parameter(help="Cores to use; all by default.")]
Flag = Annotated[bool, Parameter(negative="")]
Force = Annotated[bool, Parameter(negative="", help="Replace a scene file that exists.")]
# KEY=VALUE, once each time that the option is given.
Pairs = Annotated[list[str] | None, Parameter(negative="")]


@Parameter(name="*")
@dataclass(frozen=True)
class Work(Printing):
    """Options for the cores that a command uses, and for what it prints."""

    jobs: Jobs = None

    def threads(self) -> AbstractContextManager[None]:
        """Context in which loops use as many threads as ``--jobs`` says."""
        from rbfmuscle.geometry.threads import cores_limited

        return cores_limited(self.jobs)


USUAL_WORK = Work()


def split_list(text: str | None) -> list[str]:
    """Words of a list, which commas separate; each once."""
    words = (word.strip() for word in (text or "").split(","))
    return list(dict.fromkeys(word for word in words if word))


def refuse(what: str, options: Mapping[str, object]) -> None:
    """UsageError if one of some options is given, which ``what`` leaves without effect."""
    given = [name for name, value in options.items() if value is not None]
    if given:
        raise UsageError(f"{what} does not take {' and '.join(given)}; leave it out")


def keep_muscles(scene: "Scene", names: str | None) -> None:
    """Keep of a scene the muscles that ``--muscles`` names, all where it is not given; UsageError
    if there is no such muscle.
    """
    named = named_muscles(names)
    if named is None:
        return
    try:
        scene.muscles = [scene.muscle(name) for name in named]
    except SceneError as error:
        raise UsageError(f"--muscles: {error}") from None
    if scene.neighbours is not None:
        scene.neighbours = scene.neighbours.among(named)


def named_muscles(names: str | None) -> list[str] | None:
    """The names of ``--muscles``, None for all; UsageError if there are none in it."""
    if names is not None and not split_list(names):
        raise UsageError("--muscles names no muscle; leave it out for all")
    return None if names is None else split_list(names)


def named_scenes(scenes: Sequence[str]) -> dict[str, str]:
    """Scene files by their names, or by those of their folders where names are the same."""
    folders = [Path(path).resolve().parent.name for path in scenes]
    for names in ([Path(path).stem for path in scenes], folders):
        if len(set(names)) == len(names):
            return dict(zip(names, scenes))
    raise UsageError("scenes need different names, or folders of different names")
