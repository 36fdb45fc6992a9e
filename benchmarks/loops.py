"""Which loops commands compile: record the table of needs, or list them by the time they take.

    python benchmarks/loops.py --record         writes rbfmuscle/compiled/needs.json, on an empty cache
    python benchmarks/loops.py --list [TASK..]  compiles the table's loops in one process and lists them by time

Recording runs each task once in a process and folders of its own. Times are of the processor, as the machine may be
shared.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
FRAMES = ["--frames", "0:46:15"]
KERNELS = [
    "kernels",
    "phantom",
    "-o",
    "kernels",
    "--centres",
    "60",
    "--kernels",
    "cubic,gaussian",
    "--no-pictures",
]
# Task -> the command that shows what it needs; models are tasks of any command that runs them.
TASKS = {
    "rbf": ["demo", "--model", "rbf", *FRAMES],
    "pbd": ["demo", "--model", "pbd", *FRAMES],
    "xpbd": ["demo", "--model", "xpbd", *FRAMES],
    "arap-pbd": ["demo", "--model", "arap-pbd", *FRAMES],
    "arap-volume": ["demo", "--model", "arap-volume", *FRAMES],
    "arap-interleaved": ["demo", "--model", "arap-interleaved", *FRAMES],
    "kernels": KERNELS,
    "check": ["check", "scene/scene.toml"],
    "plan": ["plan", "scene/scene.toml"],
}


class Recorder:
    """Takes down what calls from Python needed, with types and compile times."""

    def __init__(self):
        self.rows, self.costs, self.depth = {}, {}, 0

    def needed(self, loop, arguments):
        from rbfmuscle.compiled.types import spell_type

        name = f"{loop.py_func.__module__}:{loop.py_func.__qualname__}"
        if not name.startswith(("rbfmuscle.", "pbd_baseline.")):
            return
        try:
            self.rows[name, json.dumps([spell_type(kind) for kind in arguments])] = 0.3
        except ValueError as error:
            print(f"{name}: {error}", file=sys.stderr)

    def ends(self, loop, seconds):
        name = f"{loop.py_func.__module__}:{loop.py_func.__qualname__}"
        for row in self.rows:
            if row[0] == name:
                self.rows[row] = seconds


def record_here(task, out):
    """In a process of its own: run a task's command and write what it needed."""
    from rbfmuscle.cli import main
    from rbfmuscle.compiled import needs
    from rbfmuscle.compiled.watch import watched_by

    # Nothing ahead: what an old table asks for would count as needed, whether it still fits or not.
    needs.TABLE = Path(out).with_name("no table")
    recorder = Recorder()
    code = 0
    with watched_by(recorder):
        try:
            main(TASKS[task])
        except SystemExit as end:
            code = end.code
    Path(out).write_text(json.dumps([[*row, cost] for row, cost in recorder.rows.items()]))
    raise SystemExit(code)


SCENE = """[scene]
format = 1
units = "mm"
[[bone]]
name = "pelvis"
mesh = "pelvis.stl"
[[bone]]
name = "femur"
mesh = "femur.stl"
[[joint]]
name = "hip"
parent = "pelvis"
child = "femur"
centre = [0.0, 0.0, 0.0]
axes = { flexion = [0.0, 0.0, 1.0] }
[motion]
ramp = { "hip.flexion" = { from = 0, to = 20, step = 10 } }
[[muscle]]
name = "adductor_posterior"
mesh = "adductor_posterior.stl"
attach = [{ bone = "pelvis", near = 3.0 }, { bone = "femur", near = 3.0 }]
"""


def write_scene(folder):
    """The phantom as files, for the commands that read some."""
    from rbfmuscle.sim.scene.phantom import phantom_scene

    scene = phantom_scene()
    folder.mkdir()
    for item in [*scene.bones, scene.muscle("adductor_posterior")]:
        item.mesh.export(folder / f"{item.name}.stl")
    (folder / "scene.toml").write_text(SCENE)


def record(tasks):
    """Run all tasks on empty caches and write the table."""
    from rbfmuscle.compiled.needs import TABLE

    old = json.loads(TABLE.read_text())["loops"] if TABLE.exists() else []
    costs = {(row["loop"], json.dumps(row["types"])): row["cost"] for row in old}
    found = {}
    for row in old:
        kept = [task for task in row["tasks"] if task not in tasks]
        if kept:
            found[row["loop"], json.dumps(row["types"])] = [kept, row["cost"]]
    with tempfile.TemporaryDirectory() as place:
        for task in tasks:
            folder = Path(place) / task
            folder.mkdir()
            write_scene(folder / "scene")
            out = folder / "needs.json"
            loops = os.environ.get("RBFMUSCLE_LOOPS", str(folder / "loops"))
            environment = {**os.environ, "RBFMUSCLE_CACHE": str(folder / "fields"), "RBFMUSCLE_LOOPS": loops}
            command = [sys.executable, __file__, "--one", task, str(out)]
            done = subprocess.run(command, env=environment, cwd=folder, check=False)
            print(f"{task}: exit code {done.returncode}")
            for name, types, cost in json.loads(out.read_text()):
                row = found.setdefault((name, types), [[], 0.0])
                row[0].append(task)
                row[1] = max(row[1], cost, costs.get((name, types), 0.0))
    rows = [
        {"loop": name, "types": json.loads(types), "tasks": sorted(tasks), "cost": round(cost, 2)}
        for (name, types), (tasks, cost) in sorted(found.items())
    ]
    lines = ",\n".join(json.dumps(row) for row in rows)
    TABLE.write_text('{"loops": [\n' + lines + "\n]}\n")
    print(f"{len(rows)} loops in {TABLE}")


def list_times(tasks):
    """Compile the loops of tasks here, on an empty cache, and print the times."""
    with tempfile.TemporaryDirectory() as place:
        os.environ["RBFMUSCLE_LOOPS"] = place
        from rbfmuscle.compiled.needs import loops_needed

        times = []
        for need in loops_needed(tasks):
            start = time.process_time()
            need.loop.compile(need.arguments)
            times.append((time.process_time() - start, need.name))
    for spent, name in sorted(times, reverse=True):
        print(f"{spent:6.2f} s  {name}")
    print(f"{sum(spent for spent, _ in times):6.2f} s  {len(times)} loops")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--record", nargs="*", metavar="TASK")
    parser.add_argument("--list", nargs="*", metavar="TASK")
    parser.add_argument("--one", nargs=2)
    chosen = parser.parse_args()
    if chosen.one:
        record_here(*chosen.one)
    if chosen.record is not None:
        record(chosen.record or list(TASKS))
    if chosen.list is not None:
        list_times(chosen.list or list(TASKS))
