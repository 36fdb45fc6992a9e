"""What `rbfmuscle plan` foretells beside what runs take: time without report and pictures, peak of the memory.

python benchmarks/plan_check.py [SCENE ...] [--models rbf,pbd,...] [--set KEY=VALUE ...] [--wall] [-o OUT] [--remake]

Scenes are the embedded hip (``-``, the default) and scene files. Plan and run have a process of their own each, on one
thread, and all clocks in them are those of the processor, so that a busy machine changes little; with ``--wall`` they
are as users have them, for a quiet machine. Figures are expected / measured (factor). ``--remake`` writes what the
forecasts have to be multiplied by into ``rbfmuscle/sim/plan/scales.json``, the geometric mean over the scenes, and
checks again with that.
"""

import argparse
import datetime
import json
import os
import resource
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from table import machine

ROOT = Path(__file__).resolve().parent.parent
SCALES = ROOT / "rbfmuscle" / "sim" / "plan" / "scales.json"
PLANS = 3  # of each scene and model; their median counts
PLAIN = {"output.report": False, "output.preview": False}
PARTS = {"build": ("build s", 1), "motion": ("muscles ms", 1e3), "metrics": ("metrics ms", 1e3),
         "write": ("files ms", 1e3), "total": ("all s", 1), "peak": ("peak MB", 1e-6)}  # fmt: skip


def load(path, model, settings):
    from rbfmuscle.sim.scene.phantom import phantom_scene
    from rbfmuscle.sim.scene.scene import Scene

    scene = phantom_scene(model=model) if path == "-" else Scene.load(path)
    return scene.with_options({**PLAIN, **settings}, model=model)


def planned(path, model, settings):
    from rbfmuscle.models import estimate_model
    from rbfmuscle.sim.plan.plan import plan_scene

    made = plan_scene(load(path, model, settings), estimate_model)
    build, frame = made["time"]["build"], made["time"]["frame"]
    return {
        "build": build["total"] - build["fields"],
        "motion": frame["muscles"] + build["fields"] / made["frames"],
        "metrics": frame["metrics"],
        "write": frame["write"],
        "total": made["time"]["total"],
        "peak": made["memory"]["peak"],
    }


def measured(path, model, settings):
    from rbfmuscle.run import stream_run

    scene = load(path, model, settings)
    with tempfile.TemporaryDirectory() as folder:
        info = stream_run(scene, folder, pictures=False)
    times, frames = info["times"], len(info["frames"])
    return {
        "build": times["build"],
        "motion": times["simulate"] / frames,
        "metrics": times["metrics"] / frames,
        "write": times["write"] / frames,
        "total": times["wall"],
        "peak": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024.0,
    }


def child(act, path, model, settings, *, wall):
    """What one of both says, in a process of its own."""
    code = f"import json, plan_check as p; print(json.dumps(p.{act}(*{(path, model, settings)!r})))"
    here, one = Path(__file__).resolve().parent, {}
    if not wall:
        code = f"import time; time.perf_counter = time.process_time; {code}"
        one = dict.fromkeys(("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", code], capture_output=True, text=True, check=True,
        env={**os.environ, **one, "PYTHONPATH": f"{here}{os.pathsep}{here.parent}"},
    )  # fmt: skip
    return json.loads(done.stdout.splitlines()[-1])


def check(scenes, models, settings, *, wall=False, runs=None):
    """For each scene and model the parts, expected and measured; measured ones are taken from ``runs`` where given."""
    rows = {}
    for path in scenes:
        for model in models:
            name = f"{'embedded hip' if path == '-' else Path(path).stem}: {model}"
            case = path, model, settings
            if runs is None:
                short = {**settings, "motion.step": 30.0}
                child("measured", path, model, short, wall=wall)  # fills the caches
            # What one unit of work takes varies with what else the machine does: asked on both sides of the run.
            plans = [child("planned", *case, wall=wall)]
            run = runs[name] if runs else child("measured", *case, wall=wall)
            plans += [child("planned", *case, wall=wall) for _ in range(PLANS - 1)]
            rows[name] = {
                part: [float(np.median([plan[part] for plan in plans])), run[part][1] if runs else run[part]]
                for part in PARTS
            }
            print(line(name, rows[name]), flush=True)
    return rows


def line(name, row):
    cells = [
        f"{scale * row[part][0]:.3g} / {scale * row[part][1]:.3g} ({row[part][0] / row[part][1]:.2f})"
        for part, (_, scale) in PARTS.items()
    ]
    return f"| {name} | {' | '.join(cells)} |"


def head():
    return [
        f"| scene: model | {' | '.join(title for title, _ in PARTS.values())} |",
        "|---" * (len(PARTS) + 1) + "|",
    ]


def remade(rows, scales):
    """The scales times the geometric mean of measured / expected."""

    def mean(part, model=None):
        found = [row[part] for name, row in rows.items() if model is None or name.endswith(f": {model}")]
        return float(np.exp(np.mean([np.log(run / plan) for plan, run in found]))) if found else 1.0

    models = {
        name: {part: round(value * mean(part, name), 3) for part, value in old.items()}
        for name, old in scales["models"].items()
    }
    others = {part: round(scales[part] * mean(part), 3) for part in ("metrics", "write")}
    return {"models": models, **others}


def provenance(arguments):
    asked = ["git", "rev-parse", "--short", "HEAD"]
    commit = subprocess.run(asked, capture_output=True, text=True, cwd=ROOT, check=True)
    given = " ".join(Path(a).name if a.endswith(".toml") else a for a in arguments)
    return {
        "command": f"python benchmarks/plan_check.py {given}".strip(),
        "commit": commit.stdout.strip(),
        "machine": machine()["cpu"],
        "date": datetime.date.today().isoformat(),
    }


def main(given=None):
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("scenes", nargs="*", default=["-"])
    parser.add_argument("--models", default="rbf,pbd,xpbd,arap-pbd,arap-volume,arap-interleaved")
    parser.add_argument("--set", nargs="*", default=[], dest="settings")
    parser.add_argument("--wall", action="store_true")
    parser.add_argument("--remake", action="store_true")
    parser.add_argument("-o", "--output", type=Path)
    chosen = parser.parse_args(given)
    settings = {key: json.loads(value) for key, value in (pair.split("=") for pair in chosen.settings)}
    cases = chosen.scenes or ["-"], chosen.models.split(","), settings
    print("\n".join(head()))
    rows = check(*cases, wall=chosen.wall)
    told = [a for a in (given or sys.argv[1:]) if a not in ("-o", str(chosen.output))]
    if chosen.remake:
        new = remade(rows, json.loads(SCALES.read_text(encoding="utf-8")))
        SCALES.write_text(json.dumps({**provenance(told), **new}, indent=1) + "\n", encoding="utf-8")
        print("with these counts made anew:")
        rows = check(*cases, wall=chosen.wall, runs=rows)
    if chosen.output:
        text = json.dumps({**provenance(told), "rows": rows}, indent=1)
        chosen.output.write_text(text + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
