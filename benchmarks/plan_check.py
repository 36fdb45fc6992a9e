"""What `rbfmuscle plan` foretells beside what runs take: time without report and pictures, peak of the memory.

python benchmarks/plan_check.py [SCENE] [--models rbf,pbd,...] [--set KEY=VALUE ...]      without SCENE the embedded hip

Plan and run have a process of their own each, so that the peak is theirs. Factors are expected / measured.
"""

import argparse
import json
import resource
import subprocess
import sys
import tempfile
from pathlib import Path

PLAIN = {"output.report": False, "output.preview": False}


def load(path, model, settings):
    from rbfmuscle.sim.scene.phantom import phantom_scene
    from rbfmuscle.sim.scene.scene import Scene

    scene = phantom_scene(model=model) if path == "-" else Scene.load(path)
    return scene.with_options({**PLAIN, **settings}, model=model)


def planned(path, model, settings):
    from rbfmuscle.models import estimate_model
    from rbfmuscle.sim.plan.plan import plan_scene

    made = plan_scene(load(path, model, settings), estimate_model)
    return {
        "build": made["time"]["build"]["total"],
        "frame": made["time"]["frame"]["total"],
        "muscles": made["time"]["frame"]["muscles"],
        "total": made["time"]["total"],
        "peak": made["memory"]["peak"],
        "fields": made["memory"]["fields"],
    }


def measured(path, model, settings):
    from rbfmuscle.run import stream_run

    scene = load(path, model, settings)
    with tempfile.TemporaryDirectory() as folder:
        info = stream_run(scene, folder, pictures=False)
    times, frames = info["times"], len(info["frames"])
    return {
        "build": times["build"],
        "frame": (times["simulate"] + times["metrics"] + times["write"]) / frames,
        "muscles": info["frame_time"]["median"],
        "total": times["wall"],
        "peak": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024.0,
        "fields": field_memory(scene),
    }


def field_memory(scene):
    from rbfmuscle.sim.plan.reach import build_fields, reached_bones

    return float(sum(field.memory for field in build_fields(scene, reached_bones(scene)).values()))


def child(act, *arguments):
    code = f"import json, plan_check as p; print(json.dumps(p.{act}(*{arguments!r})))"
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", code],
        capture_output=True, text=True, check=True, env=environment(),
    )  # fmt: skip
    return json.loads(done.stdout.splitlines()[-1])


def environment():
    import os

    here = Path(__file__).resolve().parent
    return {**os.environ, "PYTHONPATH": f"{here}{os.pathsep}{here.parent}"}


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("scene", nargs="?", default="-")
    parser.add_argument("--models", default="rbf,pbd,xpbd,arap-pbd,arap-volume,arap-interleaved")
    parser.add_argument("--set", nargs="*", default=[], dest="settings")
    arguments = parser.parse_args()
    settings = {key: json.loads(value) for key, value in (pair.split("=") for pair in arguments.settings)}
    print("| model | build s | a frame ms | muscles ms | all s | peak MB | fields MB |\n|" + "---|" * 7)
    for model in arguments.models.split(","):
        plan, run = (child(act, arguments.scene, model, settings) for act in ("planned", "measured"))
        cells = [
            f"{scale * plan[key]:.3g} / {scale * run[key]:.3g} ({plan[key] / run[key]:.2f})"
            for key, scale in (
                ("build", 1), ("frame", 1e3), ("muscles", 1e3), ("total", 1), ("peak", 1e-6), ("fields", 1e-6)
            )
        ]  # fmt: skip
        print(f"| {model} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
