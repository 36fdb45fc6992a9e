"""``rbfmuscle plan``: what a scene will build and do, before it is run."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from rbfmuscle.commands.scenes import load_scene
from rbfmuscle.progress import Progress, stage


def plan(scene: Path, *, as_json: Annotated[bool, Parameter(name="--json", negative="")] = False) -> None:
    """List what a run of the scene would build and take, without building it.

    Parameters
    ----------
    scene
        Scene file.
    as_json
        Print JSON and nothing else.
    """
    with Progress(f"plan {scene.name}"):
        made = _plan(scene)
    print(json.dumps(made, indent=1) if as_json else "\n".join(_lines(made)))


def _plan(path):
    from rbfmuscle.models import check_models, estimate_model
    from rbfmuscle.sim.plan.plan import plan_scene

    loaded = load_scene(path)
    check_models(loaded)
    with stage("measuring this machine"):
        return plan_scene(loaded, estimate_model)


def _lines(made):
    lines = [f"{made['frames']} frames in {made['substeps']} sub-steps"]
    for muscle in made["muscles"]:
        bones = [pair["bone"] for pair in made["pairs"] if pair["muscle"] == muscle["name"]]
        meets = ", ".join(bones) or "no bone"
        lines.append(
            f"muscle {muscle['name']}: {muscle['model']}, {muscle['points'] or str(muscle['vertices']) + ' vertices'}, "
            f"can meet {meets}; "
            f"{_megabytes(muscle['memory'])}, {muscle['build']:.2g} s to build, "
            f"{1e3 * muscle['step']:.2g} ms a sub-step, {1e3 * muscle['show']:.2g} ms a surface; "
            f"{_work(muscle['work'])}"
        )
    for field in made["fields"]:
        size = " x ".join(f"{length:.4g}" for length in field["size"])
        lines.append(
            f"field of {field['bone']}: {size} {made['units']}, {field['share']:.0%} of the bone's box, "
            f"{field['triangles']} triangles{_field_size(field)}"
        )
    lines += made["ahead"]["messages"]
    on = [name for name, used in made["features"].items() if used]
    lines.append(f"switched on: {', '.join(on) or 'nothing'}")
    return lines + _forecast_lines(made["memory"], made["time"])


def _work(work):
    frames = ", ".join(
        f"{state} in {work[state]}" for state in ("solved", "carried", "skipped") if work[state]
    )
    return f"{frames or 'solved in 0'} frames ({work['reason']})"


def _field_size(field):
    if "memory" not in field:
        return ""
    return f"; {_megabytes(field['memory'])}, {'in the cache' if field['kept'] else 'to be built'}"


def _forecast_lines(memory, time):
    frame = ", ".join(f"{name} {1e3 * spent:.3g}" for name, spent in time["frame"].items() if name != "total")
    build = ", ".join(f"{name} {spent:.2g}" for name, spent in time["build"].items() if name != "total")
    return [
        f"expected memory: {_megabytes(memory['total'])} of the scene (fields {_megabytes(memory['fields'])}, "
        f"muscles {_megabytes(memory['muscles'])}, metrics {_megabytes(memory['metrics'])}), "
        f"peak of the process {_megabytes(memory['peak'])}{_together(memory)}",
        f"expected time: {time['total']:.3g} s without report and pictures; build {time['build']['total']:.2g} s "
        f"({build}), a frame {1e3 * time['frame']['total']:.3g} ms ({frame})",
    ]


def _together(memory):
    """What several processes take; they are quicker, and a setting keeps the run in one."""
    if memory["helpers"] < 2:
        return ""
    size = _megabytes(memory["together"])
    return (
        f"; in {memory['helpers']} processes, as it will be run, {size} (NUMBA_NUM_THREADS=1 keeps it in one)"
    )


def _megabytes(size):
    return f"{size / 1e6:.3g} MB"
