"""How scenes and runs are shown. What draws lies above them: the top-level package registers it
when it is imported.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, Protocol


class ShownPage(Protocol):
    """A page in a browser: a notebook shows it where it is the value of a cell."""

    address: str

    def close(self) -> None:
        """End the page and what serves it."""


class Views(NamedTuple):
    """The functions that show a scene or a run in a browser, and draw it as HTML."""

    show: Callable[..., ShownPage]
    picture: Callable[..., str]


registered: list[Views] = []  # by the top-level package, one


class Displayed:
    """What is shown in a browser by ``show``, and in a notebook by a picture."""

    def show(self, *, model: str | None = None) -> ShownPage:
        """Show it in a browser or a notebook, to be moved by hand; see `rbfmuscle.show`."""
        return registered[0].show(self, model=model)

    def _repr_html_(self) -> str:
        return registered[0].picture(self)
