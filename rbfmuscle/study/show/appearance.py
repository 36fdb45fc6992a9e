"""Colours shared by pictures, plots and exported files."""

from __future__ import annotations

from typing import Any

BONE_COLOUR = "#ece2cb"
BACKGROUND = "#ffffff"
# Flesh tones of different lightness and hue, so that neighbours stand apart.
MUSCLE_COLOURS = ("#b5443f", "#dd8468", "#7f2638", "#c96a80", "#e9b39a", "#a1562f", "#94404f", "#d2505a")
# Plots need more distance between lines than flesh tones give.
LINE_COLOURS = ("#b5443f", "#2f6f8f", "#d99a2b", "#4f8a5b", "#7a5aa6", "#8c6d5a", "#c86fa0", "#5d6d7e")


def muscle_colours(names: list[str]) -> dict[str, str]:
    """Dict of muscle name to its colour in pictures."""
    return {name: MUSCLE_COLOURS[k % len(MUSCLE_COLOURS)] for k, name in enumerate(names)}


def line_colours(names: dict[str, Any] | list[str]) -> dict[str, str]:
    """Dict of muscle name to its colour in plots."""
    return {name: LINE_COLOURS[k % len(LINE_COLOURS)] for k, name in enumerate(names)}
