"""A reader of XML for files of any origin: no entities, no outside files, bounded depth and
size.
"""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import cast
from xml.etree import ElementTree

import defusedxml.ElementTree
import numpy as np

from rbfmuscle.validation import SceneError

# The largest published models have 3 MB and a depth of 14.
MOST_BYTES = 30_000_000
MOST_DEPTH = 100
# Levels of the file that are no components of the model.
_LEVELS = ("OpenSimDocument", "Model", "objects", "components", "frames")


class Node(ElementTree.Element):
    """One element.

    ``owner`` is the element that it stands in, ``prototype`` that of the file's defaults for its
    tag, which has what it does not say itself.
    """

    owner: Node | None = None
    prototype: Node | None = None

    @property
    def name(self) -> str:
        """The attribute ``name``, as it is written."""
        return self.get("name", "").strip()

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
        """The first child of that tag, the prototype's where there is none."""
        found = cast("Node | None", self.find(tag))
        if found is None and self.prototype is not None:
            return cast("Node | None", self.prototype.find(tag))
        return found

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
        node = self.child(tag)
        return ("" if node is None else node.text or "").strip() or default

    def truth(self, tag: str, default: bool = False) -> bool:
        """Whether the child of that tag says true."""
        return self.word(tag, str(default)).lower() in ("true", "1", "yes")

    def numbers(self, tag: str, default: str = "", *, count: int | None = None) -> list[float]:
        """The finite numbers in the child of that tag; ``count`` says how many there must be."""
        text = self.word(tag, default)
        try:
            # OpenSim also takes commas and brackets.
            values = [float(word) for word in re.sub(r"[,()\[\]~]", " ", text).split()]
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


def _link(root: Node) -> Node:
    """The root, every element with its owner; SceneError where they are nested too deep."""
    level = [root]
    for _ in range(MOST_DEPTH):
        for owner in level:
            for node in owner.nodes():
                node.owner = owner
        level = [node for owner in level for node in owner.nodes()]
    if level:
        raise SceneError(f"elements nested deeper than {MOST_DEPTH}, this is no OpenSim model")
    return root


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
        builder = ElementTree.TreeBuilder(element_factory=Node)
        parser = defusedxml.ElementTree.DefusedXMLParser(target=builder, forbid_dtd=True)
        parser.feed(_as_utf8(data).replace(b"::", b"__"))  # nine published models have such names
        return _link(cast("Node", parser.close()))
    except OSError as error:
        reason = f"cannot read the model: {error.strerror}"
    except SceneError as error:
        reason = str(error)
    except defusedxml.DefusedXmlException:
        reason = "has a DOCTYPE or entities, which no model needs; delete the declaration"
    except (ElementTree.ParseError, ValueError, LookupError) as error:  # of an unknown encoding
        reason = f"not well-formed XML: {' '.join(str(error).split())[:100]}"
    raise SceneError(f"{path}: {reason}") from None
