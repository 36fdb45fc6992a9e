"""Guesses of a scene: joints and attachments with the key ``guess``, until somebody removes it."""

import re
from typing import Annotated, NamedTuple

from pydantic import Field

from rbfmuscle.scene.options import Table
from rbfmuscle.validation import SceneError

DOUBTFUL = 0.6  # a guess of less confidence is reported by check and by the verdict of a run

# How guesses were marked before they were keys.
_MARK = re.compile(r"#.*\bGUESS [01]\.\d")


class GuessTable(Table):
    """``guess`` of a joint or an attachment: that it is one, how sure, and why."""

    confidence: Annotated[float, Field(ge=0.0, le=1.0)]
    reason: str = ""


class Guess(NamedTuple):
    """A guess in a scene: the table (``"muscle"``, ``"joint"``) and the name of what it is about,
    its confidence (0 to 1), and the reason.
    """

    table: str
    name: str
    confidence: float
    text: str


def refuse_marks(text: str, *, context: str) -> None:
    """SceneError where a comment in a scene file marks a guess; lines that are comments as a whole
    may say anything.
    """
    for number, line in enumerate(text.splitlines(), start=1):
        if _MARK.search(line) and not line.lstrip().startswith("#"):
            raise SceneError(
                f"{context}line {number}: comments mark no guesses any more; give the joint or "
                'attachment guess = { confidence = 0.5, reason = "..." }, or remove the word GUESS'
            )


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
