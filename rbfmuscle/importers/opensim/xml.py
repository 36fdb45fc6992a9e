"""A reader of XML for files that nobody vouches for: no entities, no outside files, bounded depth and size."""

from __future__ import annotations

import re
from pathlib import Path
from typing import NoReturn, cast
from xml.etree import ElementTree

from rbfmuscle.validation import SceneError

# The largest published models have 3 MB and a depth of 14.
MOST_BYTES = 30_000_000
MOST_DEPTH = 100


class Node(ElementTree.Element):
    """One element."""

    @property
    def name(self) -> str:
        """The attribute ``name``."""
        return self.get("name", "")

    def child(self, tag: str) -> Node | None:
        """The first child of that tag."""
        return next((node for node in self.nodes() if node.tag == tag), None)

    def nodes(self) -> list[Node]:
        """All children."""
        return [node for node in self if isinstance(node, Node)]

    def word(self, tag: str, default: str = "") -> str:
        """Text of the child of that tag, without white space around it; the default where it is missing or empty."""
        return (self.findtext(tag) or "").strip() or default

    def objects(self, tag: str) -> list[Node]:
        """What a set holds: children of ``<tag><objects>``, or of ``<tag>`` itself where there is no such level."""
        node = self.child(tag)
        inner = node.child("objects") if node is not None else None
        return inner.nodes() if inner is not None else node.nodes() if node is not None else []


class _Builder(ElementTree.TreeBuilder):
    """Stops at a document type, before any entity is read, and at elements that are nested too deep."""

    def __init__(self, path: Path) -> None:
        super().__init__(element_factory=Node)
        self.path, self.depth = path, 0

    def doctype(self, *_: str | None) -> NoReturn:
        raise SceneError(
            f"{self.path}: has a DOCTYPE or entities, which no model needs; delete the declaration"
        )

    def start(self, tag: str, attributes: dict[str, str], /) -> ElementTree.Element:
        self.depth += 1
        if self.depth > MOST_DEPTH:
            raise SceneError(
                f"{self.path}: elements nested deeper than {MOST_DEPTH}, this is no OpenSim model"
            )
        return super().start(tag, attributes)

    def end(self, tag: str, /) -> ElementTree.Element:
        self.depth -= 1
        return super().end(tag)


def _as_utf8(data):
    """The bytes of a file that says UTF-8, or nothing, and is in Latin-1 as UTF-8: OpenSim reads these too."""
    declared = re.match(rb"\s*<\?xml[^>]*encoding=[\"']([^\"']+)", data)
    if declared and declared[1].lower() not in (b"utf-8", b"utf8"):
        return data
    try:
        data.decode("utf-8")
    except UnicodeDecodeError:
        return data.decode("latin-1").encode("utf-8")
    return data


def read_xml(path: Path) -> Node:
    """Return the root element of an XML file; two colons in a name, which XML forbids, become two underscores.

    Raises
    ------
    SceneError
        If the file is missing, unreadable, no XML, or beyond the limits of this module.
    """
    try:
        with path.open("rb") as file:
            data = file.read(MOST_BYTES + 1)
        if len(data) > MOST_BYTES:
            raise SceneError(f"{path}: more than {MOST_BYTES / 1e6:.0f} MB, this is no OpenSim model")
        parser = ElementTree.XMLParser(target=_Builder(path))
        parser.feed(_as_utf8(data).replace(b"::", b"__"))  # nine published models have such names
        root = parser.close()
    except OSError as error:
        raise SceneError(f"{path}: cannot read the model: {error.strerror}") from None
    except ElementTree.ParseError as error:
        raise SceneError(f"{path}: not well-formed XML: {error}") from None
    except (ValueError, LookupError) as error:  # an encoding that the text is not in, or that nobody knows
        words = re.sub(r"\s+", " ", str(error))[:100]
        raise SceneError(f"{path}: not readable as XML: {words}") from None
    return cast("Node", root)
