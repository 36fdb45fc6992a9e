"""A reader of XML for files of any origin: no entities, no outside files, bounded depth and
size.
"""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Any, NoReturn, cast
from xml.etree import ElementTree

import numpy as np

from rbfmuscle.validation import SceneError

# The largest published models have 3 MB and a depth of 14.
MOST_BYTES = 30_000_000
MOST_DEPTH = 100
# Levels of the file that are no components of the model.
_LEVELS = ("OpenSimDocument", "Model", "objects", "components", "frames")


def plain_name(name: str) -> str:
    """A name as a scene may have it, of letters, digits, ``_`` and ``-``; of a path every name."""
    return "/".join(
        word if word == ".." else re.sub(r"[^A-Za-z0-9_-]+", "_", word) for word in name.split("/")
    )


class Node(ElementTree.Element):
    """One element; ``owner`` is the element that it stands in."""

    owner: Node | None = None

    @property
    def name(self) -> str:
        """The attribute ``name``, plain."""
        return plain_name(self.get("name", ""))

    @property
    def path(self) -> str:
        """Path of the component in the model, as sockets write it."""
        above = self.owner.path if self.owner is not None else ""
        if self.tag in _LEVELS:
            return above
        is_set = self.tag.endswith("Set") or self.tag == "Ground"
        return f"{above}/{self.tag.lower() if is_set else self.name}"

    @property
    def place(self) -> str:
        """Tags and names of the component and of those that it stands in, for messages."""
        above = self.owner.place if self.owner is not None else ""
        if not self.name or self.tag in _LEVELS or self.tag.endswith("Set"):
            return above
        return f"{above}{': ' if above else ''}{self.tag} {self.name!r}"

    def error(self, message: str) -> SceneError:
        """An error that names the component."""
        return SceneError(f"{self.place}: {message}")

    def nodes(self) -> list[Node]:
        """All children."""
        return [node for node in self if isinstance(node, Node)]

    def child(self, tag: str) -> Node | None:
        """The first child of that tag."""
        return next((node for node in self.nodes() if node.tag == tag), None)

    def objects(self, tag: str) -> list[Node]:
        """What a set holds: children of ``<tag><objects>``, or of ``<tag>`` itself where there is
        no such level.
        """
        node = self.child(tag)
        inner = node.child("objects") if node is not None else None
        return inner.nodes() if inner is not None else node.nodes() if node is not None else []

    def word(self, tag: str, default: str = "") -> str:
        """Text of the child of that tag, without white space around it; the default where it is
        missing or empty.
        """
        return (self.findtext(tag) or "").strip() or default

    def names(self, tag: str) -> tuple[str, ...]:
        """The names in the child of that tag, plain."""
        return tuple(map(plain_name, self.word(tag).split()))

    def truth(self, tag: str, default: bool = False) -> bool:
        """Whether the child of that tag says true."""
        return self.word(tag, str(default)).lower() in ("true", "1", "yes")

    def numbers(self, tag: str, default: str = "", *, count: int | None = None) -> list[float]:
        """The finite numbers in the child of that tag; ``count`` says how many there must be."""
        text = self.word(tag, default)
        try:
            values = [float(word) for word in text.replace(",", " ").split()]
        except ValueError:
            raise self.error(f"{tag}: {text[:60]!r} is no list of numbers; correct it") from None
        if not all(map(math.isfinite, values)):
            raise self.error(f"{tag}: {text[:60]!r} is not finite; correct it")
        if count is not None and len(values) != count:
            raise self.error(f"{tag}: {count} numbers are needed, got {text[:60]!r}")
        return values

    def number(self, tag: str, default: float = 0.0) -> float:
        """The number in the child of that tag."""
        return self.numbers(tag, str(default), count=1)[0]

    def vector(self, tag: str, default: str = "0 0 0") -> np.ndarray:
        """The three numbers (3,) in the child of that tag."""
        return np.array(self.numbers(tag, default, count=3))


class _Builder(ElementTree.TreeBuilder):
    """Stops at a document type, before any entity is read, and at elements that are nested too
    deep.
    """

    def __init__(self) -> None:
        super().__init__(element_factory=Node)
        self.open: list[Any] = []

    def doctype(self, *_: str | None) -> NoReturn:
        raise SceneError("has a DOCTYPE or entities, which no model needs; delete the declaration")

    def start(self, tag: str, attributes: dict[str, str], /) -> ElementTree.Element:
        if len(self.open) == MOST_DEPTH:
            raise SceneError(f"elements nested deeper than {MOST_DEPTH}, this is no OpenSim model")
        node: Any = super().start(tag, attributes)
        node.owner = self.open[-1] if self.open else None
        self.open.append(node)
        return node

    def end(self, tag: str, /) -> ElementTree.Element:
        self.open.pop()
        return super().end(tag)


def _as_utf8(data):
    """The bytes of a file that says UTF-8, or nothing, and is in Latin-1 as UTF-8: OpenSim reads
    these too.
    """
    try:
        data.decode("utf-8")
    except UnicodeDecodeError:
        if not re.match(rb"\s*<\?xml[^>]*encoding=[\"'](?!utf-?8)", data, flags=re.IGNORECASE):
            return data.decode("latin-1").encode("utf-8")
    return data


def read_xml(path: Path) -> Node:
    """The root element of an XML file; two colons in a name, which XML forbids, become two
    underscores.

    SceneError if the file is missing, unreadable, no XML, or beyond the limits of this module.
    """
    try:
        with path.open("rb") as file:
            data = file.read(MOST_BYTES + 1)
        if len(data) > MOST_BYTES:
            raise SceneError(f"more than {MOST_BYTES / 1e6:.0f} MB, this is no OpenSim model")
        parser = ElementTree.XMLParser(target=_Builder())
        parser.feed(_as_utf8(data).replace(b"::", b"__"))  # nine published models have such names
        return cast("Node", parser.close())
    except OSError as error:
        reason = f"cannot read the model: {error.strerror}"
    except SceneError as error:
        reason = str(error)
    except (
        ElementTree.ParseError,
        ValueError,
        LookupError,
    ) as error:  # the latter of an unknown encoding
        reason = f"not well-formed XML: {' '.join(str(error).split())[:100]}"
    raise SceneError(f"{path}: {reason}") from None
