"""What `rbfmuscle plan` foretells beside what runs take: time without report and pictures, peak of the memory.

python benchmarks/plan_check.py [SCENE ...] [--models rbf,pbd,...] [--set KEY=VALUE ...] [--wall] [-o OUT] [--remake]

Scenes are the embedded hip (``-``, the default) and scene files. Plan and run have a process of their own each, on one
thread, and all clocks in them are those of the processor, so that a busy machine changes little; with ``--wall`` they
are as users have them, for a quiet machine. Figures are expected / measured (factor). ``--remake`` writes what the
forecasts have to be multiplied by into ``rbfmuscle/sim/plan/scales.json``, the geometric mean over the scenes, and
tells the factors with that.
"""

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from evidence import provenance, write_evidence

ROOT = Path(__file__).resolve().parent.parent
SCALES = ROOT / "rbfmuscle" / "sim" / "plan" / "scales.json"
PLANS = 3  # of each scene and model; their median counts
PLAIN = {"output.report": False, "output.preview": False}
BEFORE, EACH = ("build", "checks", "lines"), ("motion", "metrics", "write")
PARTS = {"build": ("muscles s", 1), "checks": ("checks s", 1), "lines": ("lines s", 1),
         "motion": ("a frame: muscles ms", 1e3), "metrics": ("metrics ms", 1e3), "write": ("files ms", 1e3),
         "total": ("all s", 1), "peak": ("peak MB", 1e-6)}  # fmt: skip


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
        "build": build["muscles"],
        "checks": build["checks"],
        "lines": build["metrics"],
        "motion": frame["muscles"],
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
        "motion": times["simulate"] / frames,
        "metrics": times["metrics"] / frames,
        "write": times["write"] / frames,
        "total": times["wall"],
        "peak": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024.0,
        "frames": frames,
    }


def built(path, model, settings):
    """What a run does before its first frame, part by part."""
    from rbfmuscle.models import build_models
    from rbfmuscle.recording import _bones_driven_together, check_initial
    from rbfmuscle.study.measure.metrics import MuscleMeasures

    scene, clock = load(path, model, settings), [time.perf_counter()]

    def tick(found):
        clock.append(time.perf_counter())
        return found

    models = tick(build_models(scene))
    tick(MuscleMeasures(scene, {made.name: made.carried_mesh() for made in models}))
    tick((check_initial(scene), _bones_driven_together(scene)))
    return dict(zip(("build", "lines", "checks"), np.diff(clock).tolist(), strict=True))


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


def check(scenes, models, settings, *, wall=False):
    """For each scene and model the parts, expected and measured, and how many frames there are."""
    rows, frames = {}, {}
    for path in scenes:
        for model in models:
            name = f"{'embedded hip' if path == '-' else Path(path).stem}: {model}"
            case = path, model, settings
            child("measured", path, model, {**settings, "motion.step": 30.0}, wall=wall)  # fills the caches
            # What one unit of work takes varies with what else the machine does: asked on both sides of the run.
            plans = [child("planned", *case, wall=wall)]
            run = child("built", *case, wall=wall) | child("measured", *case, wall=wall)
            plans += [child("planned", *case, wall=wall) for _ in range(PLANS - 1)]
            rows[name] = {
                part: [float(np.median([plan[part] for plan in plans])), run[part]] for part in PARTS
            }
            frames[name] = run["frames"]
            print(line(name, rows[name]), flush=True)
    return rows, frames


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


def corrections(rows):
    """What each part has to be multiplied by: the geometric mean of measured / expected, of each model or of all."""

    def mean(part, model=""):
        found = [row[part] for name, row in rows.items() if name.endswith(model)]
        return float(np.exp(np.mean([np.log(run / plan) for plan, run in found])))

    names = {name.split(": ")[1] for name in rows}
    models = {
        name: {"build": mean("build", f": {name}"), "motion": mean("motion", f": {name}")} for name in names
    }
    return {"models": models, **{part: mean(part) for part in ("checks", "lines", "metrics", "write")}}


def remade(scales, found):
    """The scales times what was found; models that were not run keep theirs."""
    models = {
        name: {
            part: round(value * found["models"].get(name, {}).get(part, 1.0), 3)
            for part, value in old.items()
        }
        for name, old in scales["models"].items()
    }
    return {"models": models} | {
        part: round(scales[part] * found[part], 3) for part in found if part != "models"
    }


def corrected(name, row, frames, found):
    """A row as it would be foretold with the scales made anew."""
    factors = {**found, **found["models"][name.split(": ")[1]]}
    new = {part: [pair[0] * factors.get(part, 1.0), pair[1]] for part, pair in row.items()}
    more = sum(new[part][0] - row[part][0] for part in BEFORE)
    more += frames * sum(new[part][0] - row[part][0] for part in EACH)
    return new | {"total": [row["total"][0] + more, row["total"][1]]}


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
    rows, frames = check(*cases, wall=chosen.wall)
    words = [word for word in given or sys.argv[1:] if word not in ("-o", str(chosen.output))]
    told = ["benchmarks/plan_check.py", *words]
    if chosen.remake:
        found = corrections(rows)
        new = remade(json.loads(SCALES.read_text(encoding="utf-8")), found)
        SCALES.write_text(json.dumps({**provenance(told), **new}, indent=1) + "\n", encoding="utf-8")
        rows = {name: corrected(name, row, frames[name], found) for name, row in rows.items()}
        print("\n".join(["", "with the scales made anew:", "", *head()]))
        print("\n".join(line(name, row) for name, row in rows.items()))
    if chosen.output:
        write_evidence(chosen.output, told, rows)


if __name__ == "__main__":
    main()
