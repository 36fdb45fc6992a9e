"""What the example scripts share: where their files go, and pictures of a run.

Not an example itself.
"""

import sys
from pathlib import Path

from rbfmuscle.display.pictures import render_run


def folder(name):
    """Folder of an example's files: the first argument of the script, else example_output/NAME."""
    # In a notebook the arguments are those of its kernel.
    given = len(sys.argv) == 2 and not sys.argv[1].startswith("-")
    path = Path(sys.argv[1]) if given else Path("example_output") / name
    path.mkdir(parents=True, exist_ok=True)
    return path


def draw(run, file, *, frame=None, views=("right", "back")):
    """Picture of a frame of a run, or of the folder of one."""
    render_run(run, file, frame=frame, views=views)


def plot(file, draw_axes, *, size=(7.0, 3.6)):
    """Save a plot; ``draw_axes(axes)`` fills it."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=size, layout="constrained")
    draw_axes(axes)
    axes.grid(alpha=0.25)
    figure.savefig(file, dpi=110)
    plt.close(figure)
