"""A reader of XML for files that nobody vouches for: no entities, no outside files, bounded depth, size and count.

It is expat without namespaces, so that element names with two colons, which nine published models have, are read as
they stand. A document is a tree of `Node`.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from xml.parsers import expat

from rbfmuscle.validation import SceneError

# The largest published models have 3 MB, 60,000 elements and a depth of 14.
MOST_BYTES = 200_000_000
MOST_ELEMENTS = 2_000_000
MOST_DEPTH = 100
MOST_TEXT = 20_000_000
_CHUNK = 1 << 20


@dataclass
class Node:
    """One element: its tag, attributes, text and children."""

    tag: str
    attributes: dict[str, str]
    children: list[Node] = field(default_factory=list)
    text: str = ""

    def __iter__(self) -> Iterator[Node]:
        return iter(self.children)

    @property
    def name(self) -> str:
        """The attribute ``name``."""
        return self.attributes.get("name", "")

    def child(self, tag: str) -> Node | None:
        """The first child of that tag."""
        return next((node for node in self.children if node.tag == tag), None)

    def word(self, tag: str, default: str = "") -> str:
        """Text of the child of that tag, without white space around it; the default where it is missing or empty."""
        node = self.child(tag)
        return (node.text.strip() if node is not None else "") or default

    def objects(self, tag: str) -> list[Node]:
        """What a set holds: children of ``<tag><objects>``, or of ``<tag>`` itself where there is no such level."""
        node = self.child(tag)
        if node is None:
            return []
        inner = node.child("objects")
        return (inner or node).children if inner is not None else node.children


class _Builder:
    def __init__(self, path: Path) -> None:
        self.path, self.stack, self.count, self.size = path, [], 0, 0
        self.root: Any = None
        self.parts = []
        self.parser = expat.ParserCreate()
        self.parser.buffer_text = True
        self.parser.StartElementHandler, self.parser.EndElementHandler = self.start, self.end
        self.parser.CharacterDataHandler = self.data
        self.parser.StartDoctypeDeclHandler = self.refuse_doctype
        self.parser.EntityDeclHandler = self.refuse_doctype

    def refuse_doctype(self, *_: Any) -> None:
        raise SceneError(
            f"{self.path}: has a DOCTYPE or entities, which no model needs; delete the declaration"
        )

    def start(self, tag: Any, attributes: Any) -> None:
        self.count += 1
        if self.count > MOST_ELEMENTS:
            raise SceneError(f"{self.path}: more than {MOST_ELEMENTS} elements, this is no OpenSim model")
        if len(self.stack) >= MOST_DEPTH:
            raise SceneError(
                f"{self.path}: elements nested deeper than {MOST_DEPTH} (line {self.parser.CurrentLineNumber}), "
                "this is no OpenSim model"
            )
        node = Node(tag, attributes)
        if self.stack:
            self.stack[-1].children.append(node)
        else:
            self.root = node
        self.stack.append(node)
        self.parts.append([])

    def data(self, text: str) -> None:
        self.size += len(text)
        if self.size > MOST_TEXT:
            raise SceneError(
                f"{self.path}: more than {MOST_TEXT} characters of text, this is no OpenSim model"
            )
        if self.parts:
            self.parts[-1].append(text)

    def end(self, tag: Any) -> None:
        node = self.stack.pop()
        node.text = "".join(self.parts.pop())


def read_xml(path: Path) -> Node:
    """Return the root element of an XML file.

    Raises
    ------
    SceneError
        If the file is missing, unreadable, no XML, or beyond the limits of this module.
    """
    builder = _Builder(path)
    try:
        size = path.stat().st_size
        if size > MOST_BYTES:
            raise SceneError(
                f"{path}: {size / 1e6:.0f} MB, more than {MOST_BYTES / 1e6:.0f}: no OpenSim model"
            )
        with path.open("rb") as file:
            read = 0
            while chunk := file.read(_CHUNK):
                read += len(chunk)
                if read > MOST_BYTES:  # a pipe, or a file that grows
                    raise SceneError(f"{path}: more than {MOST_BYTES / 1e6:.0f} MB, this is no OpenSim model")
                builder.parser.Parse(chunk, False)
        builder.parser.Parse(b"", True)
    except SceneError:
        raise
    except OSError as error:
        raise SceneError(f"{path}: cannot read the model: {error.strerror}") from None
    except expat.ExpatError as error:
        what = expat.errors.messages.get(error.code, str(error))
        raise SceneError(f"{path}: not well-formed XML: {what} (line {error.lineno})") from None
    except (ValueError, LookupError) as error:  # an encoding that the text is not in, or that nobody knows
        raise SceneError(f"{path}: not readable as XML: {_short(error)}") from None
    return builder.root


def _short(error):
    return re.sub(r"\s+", " ", str(error))[:100]
