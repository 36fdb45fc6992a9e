"""Sheets of a zero set in the whole box around a surface, those included that following the surface never meets."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from rbfmuscle.geometry.arrays import Floats
from rbfmuscle.geometry.fields import Field
from rbfmuscle.geometry.surfaces import label_sheets
from rbfmuscle.implicit.extraction.marching import Band, Grid

# Cells along the longest side of the boxes that are searched, and of another search where slender muscles fall into
# pieces between the nodes of these. A sheet between the nodes of one is found by the other, or is smaller than both.
BOXES, FINER = (40, 64), 160
# Of the longest side: what the box holds on every side of the points.
MARGIN = 0.075
# Finer cells on every side of what coarser ones crossed: as far as a straight line in one of these is off.
AROUND = 2


class Sheets(NamedTuple):
    """Sheets of a box.

    Attributes
    ----------
    number : int
        0 where the field has one sign.
    is_open : bool
        Whether one leaves the box.
    cells : int
        Along the longest side of the box.
    """

    number: int
    is_open: bool
    cells: int

    def sound(self, wanted: int = 1) -> bool:
        """Whether there are as many as wanted, and all are closed."""
        return self.number == wanted and not self.is_open


def count_sheets(
    field: Field,
    points: Floats,
    distance: Callable[[Floats], Floats],
    *,
    boxes: tuple[int, ...] = BOXES,
    wanted: int = 1,
) -> Sheets:
    """Sheets of the zero set in boxes around the points, of the first box that has not as many as wanted.

    Parameters
    ----------
    field : Field
        Negative inside.
    points : (n, 3) ndarray
        Points of the surface, which give the box [length].
    distance : callable
        ``(n, 3) -> (n,)``, distance to the surface, signed or not. Sheets none of which stands off the surface by a
        cell may be pieces of a muscle that is thinner than that: finer cells then decide.
    boxes : tuple of int
        Cells along the longest side.
    wanted : int
        Sheets of the surface.

    Returns
    -------
    Sheets
    """
    for cells in boxes:
        found, vertices, spacing = _search_box(field, points, cells)
        if found.number > wanted and np.abs(np.asarray(distance(vertices))).max() < spacing:
            found = _search_box(field, points, FINER, near=vertices)[0]
        if not found.sound(wanted):
            break
    return found


def _search_box(
    field: Field, points: Floats, cells: int, *, near: Floats | None = None
) -> tuple[Sheets, Floats, float]:
    """Sheets of one box, their vertices before projection, and the edge of a cell.

    Only of those near some points where these are given, for a fifth of the time with many cells.
    """
    grid = Grid.around(points, resolution=cells, padding=round(MARGIN * cells))
    band = Band(grid, field)
    if near is None:
        band.visit_all()
    else:
        band.visit(grid.cells(np.vstack([points, near])))
        for _ in range(AROUND):
            band.widen()
    band.follow(0.0)
    if not band.crosses(0.0):
        return Sheets(0, False, cells), np.zeros((0, 3)), grid.spacing
    coordinates, faces, on_border, _ = band.march(0.0)
    number, _ = label_sheets(faces, len(coordinates))
    return Sheets(number, bool(on_border.any()), cells), grid.positions(coordinates), grid.spacing
