"""How scenes are shown. What draws lies above them: the top-level package registers it when it is
imported.
"""

from collections.abc import Callable
from typing import NamedTuple, Protocol


class ShownPage(Protocol):
    """A page in a browser: a notebook shows it where it is the value of a cell."""

    address: str

    def close(self) -> None:
        """End the page and what serves it."""


class Views(NamedTuple):
    """The functions that show a scene in a browser (``model`` in place of its own), and draw it as
    HTML.
    """

    show: Callable[..., ShownPage]
    picture: Callable[..., str]


registered: list[Views] = []  # by the top-level package, one
