"""``rbfmuscle plan``: what a scene will build and do, before it is run."""

import json
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter


def plan(scene: Path, *, as_json: Annotated[bool, Parameter(name="--json", negative="")] = False):
    """List what a run of the scene would build, without building it.

    Parameters
    ----------
    scene
        Scene file.
    as_json
        Print JSON and nothing else.
    """
    from rbfmuscle.sim.plan import plan_scene
    from rbfmuscle.sim.scene import Scene

    made = plan_scene(Scene.load(scene))
    print(json.dumps(made, indent=1) if as_json else "\n".join(_lines(made)))


def _lines(made):
    lines = [f"{made['frames']} frames in {made['substeps']} sub-steps"]
    for muscle in made["muscles"]:
        bones = [pair["bone"] for pair in made["pairs"] if pair["muscle"] == muscle["name"]]
        meets = ", ".join(bones) or "no bone"
        lines.append(
            f"muscle {muscle['name']}: {muscle['model']}, {muscle['vertices']} vertices, can meet {meets}"
        )
    for field in made["fields"]:
        size = " x ".join(f"{length:.4g}" for length in field["size"])
        lines.append(
            f"field of {field['bone']}: {size} {made['units']}, {field['share']:.0%} of the bone's box, "
            f"{field['triangles']} triangles"
        )
    on = [name for name, used in made["features"].items() if used]
    lines.append(f"switched on: {', '.join(on) or 'nothing'}")
    return lines
