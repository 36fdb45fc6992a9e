"""Colours shared by pictures, plots and exported files."""

BONE_COLOUR = "#ece2cb"
BACKGROUND = "#ffffff"
# Reds of different lightness and warmth, so that neighbours stand apart, then tones for many muscles.
MUSCLE_COLOURS = ("#b5443f", "#d97b66", "#8f2f3c", "#c9605a", "#e09a86", "#a14d52", "#7b2a2f", "#d2706f")
# Plots need more distance between lines than flesh tones give.
LINE_COLOURS = ("#b5443f", "#2f6f8f", "#d99a2b", "#4f8a5b", "#7a5aa6", "#8c6d5a", "#c86fa0", "#5d6d7e")


def muscle_colours(names):
    """Dict of muscle name to its colour in pictures."""
    return {name: MUSCLE_COLOURS[k % len(MUSCLE_COLOURS)] for k, name in enumerate(names)}


def line_colours(names):
    """Dict of muscle name to its colour in plots."""
    return {name: LINE_COLOURS[k % len(LINE_COLOURS)] for k, name in enumerate(names)}
