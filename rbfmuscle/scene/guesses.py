"""Lines of a scene file that are guesses, until somebody removes the word GUESS from them."""

import re
from typing import NamedTuple

DOUBTFUL = 0.6  # a guess of less confidence is reported by check and by the verdict of a run

_TABLE = re.compile(r"\[\[?\s*(\w+)")
_NAME = re.compile(r"name\s*=\s*[\"']([^\"']*)[\"']")
_GUESS = re.compile(r"#.*?\bGUESS ([01]\.\d+): *(.*)")


class Guess(NamedTuple):
    """A guess in a scene file: the table (``"muscle"``, ``"joint"``) and the name of what it is
    about, its confidence (0 to 1), and what it says of itself.
    """

    table: str
    name: str
    confidence: float
    text: str


def find_guesses(text: str) -> list[Guess]:
    """The guesses in the text of a scene file; lines that are comments as a whole do not count."""
    found: list[tuple[int, float, str]] = []
    tables: list[tuple[str, str]] = [("", "")]
    for line in text.splitlines():
        if line.startswith("#"):
            continue
        if line.startswith("["):
            header = _TABLE.match(line)
            tables.append((header[1] if header else "", ""))
        elif name := _NAME.match(line):
            tables[-1] = tables[-1][0], name[1]
        if guess := _GUESS.search(line):
            found.append((len(tables) - 1, float(guess[1]), guess[2].strip()))
    return [Guess(*tables[at], confidence, said) for at, confidence, said in found]


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
