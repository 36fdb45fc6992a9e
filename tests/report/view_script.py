"""Run in a child process under a virtual display: opens the window, drags, switches, and prints what it saw."""

import json
import sys
from pathlib import Path

import numpy as np

from rbfmuscle.cli.scenes import load_scene
from rbfmuscle.cli.view import _open_saved, _open_scene
from rbfmuscle.output.saved import SavedRun
from rbfmuscle.report.viewer.window import Window


def settle(window):
    while window.tick():
        pass


def drag(window, title, share):
    """Press on a slider's handle, move to a share of its way and let go, as a mouse would."""
    bar = window.sliders[title].GetRepresentation()
    left, right = (c.GetComputedDisplayValue(window.plotter.renderer) for c in _ends(bar))
    low, high, now = bar.GetMinimumValue(), bar.GetMaximumValue(), bar.GetValue()
    interactor = window.plotter.iren.interactor
    y = round(left[1])

    def at(part):
        interactor.SetEventInformation(round(left[0] + part * (right[0] - left[0])), y, 0, 0, chr(0), 0, None)

    def press():
        interactor.MouseMoveEvent()
        interactor.LeftButtonPressEvent()

    # A click on the bar brings the handle under the mouse; then it is dragged.
    at(min(max((now - low) / (high - low), 0.05), 0.95))
    press()
    interactor.LeftButtonReleaseEvent()
    press()
    at(share)
    interactor.MouseMoveEvent()
    interactor.LeftButtonReleaseEvent()


def _ends(bar):
    return bar.GetPoint1Coordinate(), bar.GetPoint2Coordinate()


def live(folder):
    viewer, motion, title = _open_scene(load_scene(Path("phantom")), None)
    window = Window(viewer, folder, motion=motion, title=title)
    window.open(until_closed=False)
    settle(window)
    seen = {"rest": {k: v[0].mean(axis=0).tolist() for k, v in window.view.surfaces.items()}}
    first = window.plotter.screenshot(None)
    drag(window, "hip.flexion", 0.6)
    seen["target"] = viewer.coordinates["hip.flexion"][2]
    settle(window)
    seen["here"] = float(np.degrees(viewer.session.here["hip.flexion"]))
    seen["moved"] = {k: v[0].mean(axis=0).tolist() for k, v in window.view.surfaces.items()}
    second = window.plotter.screenshot(None)
    seen["changed"] = float(np.mean(np.any(first != second, axis=2)))
    window.next_choice("colour")
    window.next_choice("colour")
    settle(window)
    seen["colouring"] = viewer.colouring
    third = window.plotter.screenshot(None)
    seen["recoloured"] = float(np.mean(np.any(third != second, axis=2)))
    seen["latency"] = window.latencies[0]
    seen["screenshot"] = str(window.screenshot())
    seen["exported"] = [str(path) for path in window.export()]
    window.play()
    window.tick()
    seen["played"] = viewer.session.target["hip.flexion"]
    window.close()
    return seen


def saved(folder, run):
    viewer, motion, title = _open_saved(SavedRun(Path(run)))
    window = Window(viewer, folder, motion=motion, title=title)
    window.open(until_closed=False)
    settle(window)
    first = window.plotter.screenshot(None)
    drag(window, "frame", 0.97)
    settle(window)
    second = window.plotter.screenshot(None)
    seen = {"place": viewer.place, "changed": float(np.mean(np.any(first != second, axis=2)))}
    window.close()
    return seen


if __name__ == "__main__":
    found = live(sys.argv[1]) if len(sys.argv) == 2 else saved(*sys.argv[1:])
    print("RESULT " + json.dumps(found))
