"""``rbfmuscle compare``: models on one scene, beside each other."""

from __future__ import annotations

from typing import Any

from rbfmuscle.cli.options import Frames, Output, SceneName, Settings
from rbfmuscle.progress import Progress
from rbfmuscle.validation import SolveError


def compare(
    scene: SceneName,
    *,
    output: Output,
    models: str | None = None,
    settings: Settings = None,
    frames: Frames = None,
    pictures: bool = True,
) -> None:
    """Run models on one scene: the same motion, contacts and measures; tables, report, pictures.

    Each model's run is in a folder of its own; MODEL:KEY=VALUE is a setting for one model.

    Parameters
    ----------
    models
        Names with commas between; distances are measured to the first. The sweeps of a mesh model with "-converged"
        after its name go on until no vertex moves.
    pictures
        Draw pictures and the animation.
    """
    from rbfmuscle import interruption
    from rbfmuscle.compare import compare_models
    from rbfmuscle.models import COMPARED
    from rbfmuscle.scene.phantom import open_scene
    from rbfmuscle.scene.settings import parse_settings

    names = [name.strip() for name in (models or "").split(",") if name.strip()] or list(COMPARED)
    changes = parse_settings(settings)
    kept = f"finished runs are kept in {output}"
    with Progress("compare") as progress, interruption.keeping(lambda: kept if output.exists() else ""):

        def advance(model, done, total):
            if done == 0:
                progress.show(model, done, total)
            progress(done, total)
            interruption.check()

        options: dict[str, Any] = {"frames": frames, "settings": changes, "pictures": pictures}
        table = compare_models(open_scene(scene), output, names, progress=advance, **options)
    _print_table(table, output)
    if table["failed"]:
        reasons = "; ".join(f"{name}: {reason}" for name, reason in table["failed"].items())
        raise SolveError(f"{reasons}; the other models are in {output}")


def _print_table(table, output):
    from rbfmuscle.report.comparison_page import LIGHTS, shown

    print(" " * 24 + "".join(f"{name:>18}" for name in table["models"]))
    for quantity in LIGHTS:
        values = [table["results"][name]["all"].get(quantity) for name in table["models"]]
        print(f"{quantity:24}" + "".join(f"{shown(table, quantity, value):>18}" for value in values))
    print(table["answer"])
    print(f"{table['frames']} frames, in {output}, open {output / 'report.html'}")
