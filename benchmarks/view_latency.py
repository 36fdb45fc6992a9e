"""From a slider's move to the picture that shows it, in a real window (under Xvfb: software rendering).

    xvfb-run -a python benchmarks/view_latency.py [SCENE.toml]

Prints milliseconds: all of it, and the part that is drawing.
"""

import sys
import time
from pathlib import Path

import numpy as np

from rbfmuscle.commands.scenes import load_scene
from rbfmuscle.commands.view import _open_scene
from rbfmuscle.study.show.view.window import Window

PICTURES = 24


def main():
    scene = Path(sys.argv[1]) if len(sys.argv) > 1 else Path("phantom")
    for quality in ("as given", "fast"):
        viewer, motion, title = _open_scene(load_scene(scene), None)
        viewer.switch(quality=quality)
        window = Window(viewer, "view", motion=motion, title=title)
        window.open(until_closed=False)
        coordinate = next(iter(viewer.coordinates))
        drawing = []
        for k in range(PICTURES):
            window._set(coordinate, 2.0 * (k + 1))
            while window.tick():
                pass
            start = time.perf_counter()
            window.plotter.render()
            drawing.append(time.perf_counter() - start)
        waits = 1e3 * np.array(window.latencies[4:])
        print(
            f"{title}, {len(viewer.muscles)} muscles, {viewer.model}, {quality}: slider to picture "
            f"{np.median(waits):.0f} ms (least {waits.min():.0f}, 90 % {np.percentile(waits, 90):.0f}), "
            f"of which drawing {1e3 * np.median(drawing[4:]):.0f}",
            flush=True,
        )
        window.close()


if __name__ == "__main__":
    main()
