"""Names that a scene may have, from names of any kind."""

import re
import unicodedata
from collections.abc import Iterable

LONGEST_NAME = 100  # a file may be named after two of them, and systems allow 255 letters


def plain_name(name: str) -> str:
    """A name as a scene may have it, of letters, digits, ``_`` and ``-``.

    Accents are dropped; letters of other scripts become ``u`` and their number, so that different
    names stay different.
    """
    words = []
    for letter in name.strip():
        plain = unicodedata.normalize("NFKD", letter).encode("ascii", "ignore").decode()
        other = letter.isalnum() and not plain
        words.append(f"u{ord(letter):04x}" if other else plain or " ")
    return re.sub(r"[^A-Za-z0-9_-]+", "_", "".join(words)) or "_"


def new_name(name: str, taken: Iterable[str], *, file: bool = True) -> str:
    """The plain name, numbered where it is taken; of a ``file`` in letters of another case too."""
    plain, number = plain_name(name)[: LONGEST_NAME - 5], 2
    known = {one.lower() if file else one for one in taken} | {"all"}  # that is the whole scene
    found = plain
    while (found.lower() if file else found) in known:
        found = f"{plain}_{number}"
        number += 1
    return found
