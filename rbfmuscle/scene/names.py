"""Names that a scene may have, and what they name."""

import re
import unicodedata
from collections.abc import Iterable, Sequence
from typing import TypeVar

from rbfmuscle.scene.bone import Bone
from rbfmuscle.scene.joints import Joint
from rbfmuscle.scene.objects import Muscle
from rbfmuscle.validation import SceneError, did_you_mean, shown

_CHARACTERS = set("abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789_-")
# Devices on Windows, in any case and with any ending: no file can have such a name.
DEVICES = {"con", "prn", "aux", "nul"} | {
    f"{kind}{k}" for kind in ("com", "lpt") for k in range(10)
}
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
    """The plain name, numbered where it is taken; of a ``file`` in letters of another case too, and
    where it names a device.
    """
    plain, number = plain_name(name)[: LONGEST_NAME - 5], 2
    # "all" is the whole scene.
    known = {one.lower() if file else one for one in taken} | {"all"} | DEVICES
    found = plain
    while (found.lower() if file else found) in known:
        found = f"{plain}_{number}"
        number += 1
    return found


NamedItem = TypeVar("NamedItem", Bone, Muscle)


def find_named(items: Sequence[NamedItem], name: str, what: str, *, context: str = "") -> NamedItem:
    """Return the item of that name, or raise SceneError naming the nearest."""
    for item in items:
        if item.name == name:
            return item
    hint = did_you_mean(name, [item.name for item in items])
    raise SceneError(f"{context}unknown {what} {name!r}, {hint}")


def check_name(name: object, what: str) -> str:
    """Return the name, or raise SceneError if it is no name for a file."""
    if not isinstance(name, str) or not name or not set(name) <= _CHARACTERS:
        raise SceneError(
            f"{what} name {shown(repr(name))} may hold "
            "letters, digits, '_' and '-' only (it becomes a file name)"
        )
    if len(name) > LONGEST_NAME:
        raise SceneError(
            f"{what} name {shown(repr(name))} has {len(name)} letters, at most {LONGEST_NAME} are "
            "allowed (it becomes a file name)"
        )
    if name.lower() in DEVICES:
        raise SceneError(
            f"{what} name {name!r} is that of a device on Windows (it becomes a file name); choose "
            "another"
        )
    return name


def check_new_name(
    items: Sequence[Bone] | Sequence[Joint] | Sequence[Muscle], name: str, what: str
) -> None:
    """Raise SceneError if a name is no name for a file, or taken, in letters of another case
    too.
    """
    check_name(name, what)
    if name == "all":
        raise SceneError(f"{what} name 'all' stands for the whole scene in tables, choose another")
    same = [item.name for item in items if item.name.lower() == name.lower()]
    if name in same:
        raise SceneError(f"{what} {name!r} is given twice")
    if same and what != "joint":
        raise SceneError(
            f"{what} {name!r} differs from {same[0]!r} in case alone, and their files would be one "
            "on some systems; choose another name"
        )
