"""How the cost of a frame grows with the muscles, on the whole leg in a squat.

    python benchmarks/leg_scale.py [--model rbf] [--frames 5] [--counts 1,4,10,20,38] [--hip]

Processor time of frames with surfaces, one thread, each number of muscles in turn within every round, so that whatever
else the machine does meets all of them alike; muscles are taken in an order in which every beginning has the area of
the whole on average. The exponent is the slope of log time over log number. With ``--hip`` the four muscles of
``data/hip`` are measured in the same rounds. ``--threads`` measures wall time of all muscles on one and on two threads
of one process, ``--processes`` of a run (frames solved, drawn and measured) in one process with one thread and in one
process a core, each in turn in an interpreter of its own.
"""

import argparse
import json
import os
import subprocess
import sys
import time

import numba
import numpy as np
from leg_joints import leg_folder

from rbfmuscle.models import build_models
from rbfmuscle.sim.loop.simulate import FrameLoop
from rbfmuscle.sim.plan.reach import build_fields, reached_bones
from rbfmuscle.sim.scene.scene import Scene

FIRST = 2  # frames that are gone to before any is measured


def evenly_mixed(scene):
    """Names of the muscles, each beginning of the list with the mean area of all."""
    area = {muscle.name: float(muscle.mesh.area) for muscle in scene.muscles}
    mean, chosen, total = np.mean(list(area.values())), [], 0.0
    while area:
        name = min(area, key=lambda name: abs((total + area[name]) / (len(chosen) + 1) - mean))
        total += area.pop(name)
        chosen.append(name)
    return chosen


class Track:
    """Some muscles of a scene on their way through its motion."""

    def __init__(self, scene, names, models, fields):
        self.scene = scene.copy()
        self.scene.muscles = [muscle for muscle in scene.muscles if names is None or muscle.name in names]
        self.models = [models[muscle.name] for muscle in self.scene.muscles]
        self.rest = [model.snapshot() for model in self.models]
        self.fields = fields

    def times(self, frames):
        """Processor and wall time of some frames, one after the other [s]."""
        for model, state in zip(self.models, self.rest):
            model.restore(state)
        path = self.scene.motion.frames
        with FrameLoop(self.scene, self.models, fields=self.fields) as loop:
            for coordinates in path[:FIRST]:
                loop.advance(coordinates)
            found = []
            for coordinates in path[FIRST : FIRST + frames]:
                start = time.process_time(), time.perf_counter()
                loop.advance(coordinates)
                found.append((time.process_time() - start[0], time.perf_counter() - start[1]))
        return np.array(found)


def loaded(path, model):
    scene = Scene.load(path).with_options({}, model=model)
    models = {built.name: built for built in build_models(scene)}
    return scene, models, build_fields(scene, reached_bones(scene))


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--model", default=None)
    parser.add_argument("--frames", type=int, default=5)
    parser.add_argument("--rounds", type=int, default=2)
    parser.add_argument("--counts", default="1,4,10,20,38")
    parser.add_argument("--hip", action="store_true")
    parser.add_argument("--threads", action="store_true")
    parser.add_argument("--processes", action="store_true")
    arguments = parser.parse_args()
    folder = leg_folder().parent
    if arguments.processes:
        _processes(folder / "leg" / "squat.toml", arguments)
        return
    scene, models, fields = loaded(folder / "leg" / "squat.toml", arguments.model)
    order = evenly_mixed(scene)
    tracks = {
        f"{count}": Track(scene, set(order[:count]), models, fields)
        for count in map(int, arguments.counts.split(","))
    }
    if arguments.hip:
        tracks["hip"] = Track(*_with_names(loaded(folder / "hip" / "flexion.toml", arguments.model)))
    if arguments.threads:
        _threads(Track(scene, None, models, fields), arguments)
        return
    numba.set_num_threads(1)
    found = {name: [] for name in tracks}
    for _ in range(arguments.rounds):
        for name, track in tracks.items():
            found[name].append(track.times(arguments.frames))
    medians = {name: float(np.median(np.concatenate(rounds)[:, 0])) for name, rounds in found.items()}
    for name, seconds in medians.items():
        print(f"{name:>4} muscles: {1e3 * seconds:8.1f} ms of processor time a frame")
    counts = [name for name in medians if name != "hip"]
    slope = np.polyfit(np.log([int(c) for c in counts]), np.log([medians[c] for c in counts]), 1)[0]
    print(f"exponent {slope:.3f}")
    if arguments.hip:
        print(f"squat beside the hip's four muscles: {medians[counts[-1]] / medians['hip']:.2f} times")


def run_frames(path, frames):
    """Wall and processor time of a run's frames behind the first, all processes together [s]."""
    from rbfmuscle.recording import Recording
    from rbfmuscle.run import configure_scene

    class Clock:
        """A sink that keeps the moments at which frames came."""

        def __init__(self):
            self.moments = []

        def write(self, frame, rows=()):
            self.moments.append(time.perf_counter())

        def keep(self, state):
            pass

        def close(self, rows=()):
            pass

        def write_info(self, info):
            pass

    clock = Clock()
    Recording(
        configure_scene(Scene.load(path), frames=f"0:{frames}"), resumable=True, models_here=False
    ).feed(clock)
    spent = os.times()
    return clock.moments[-1] - clock.moments[0], sum(spent[:4])


def _processes(path, arguments):
    code = (
        f"import json, leg_scale; print(json.dumps(leg_scale.run_frames({str(path)!r}, {arguments.frames})))"
    )
    cores, found = str(len(os.sched_getaffinity(0))), {}
    for _ in range(arguments.rounds):
        for threads in ("1", cores):
            child = subprocess.run(
                [sys.executable, "-W", "ignore", "-c", code],
                env={**os.environ, "NUMBA_NUM_THREADS": threads, "OPENBLAS_NUM_THREADS": "1"},
                cwd=os.path.dirname(os.path.abspath(__file__)), capture_output=True, text=True, check=True,
            )  # fmt: skip
            found.setdefault(threads, []).append(json.loads(child.stdout))
            wall, processor = found[threads][-1]
            print(
                f"{threads} process(es): {wall:.1f} s for the frames behind the first, processor {processor:.1f} in all"
            )
    one, all_cores = (np.median(found[threads], axis=0) for threads in ("1", cores))
    wall, processor = all_cores / one
    print(f"{cores} against 1: {wall:.2f} of the wall time, {processor:.2f} of the processor time")


def _with_names(parts):
    scene, models, fields = parts
    return scene, None, models, fields


def _threads(track, arguments):
    walls = {1: [], 2: []}
    for _ in range(arguments.rounds):
        for threads, wall in walls.items():
            numba.set_num_threads(threads)
            wall.append(track.times(arguments.frames))
    one, two = (np.concatenate(walls[threads]) for threads in (1, 2))
    print(
        f"one thread:  {1e3 * np.median(one[:, 1]):.0f} ms a frame, processor {1e3 * np.median(one[:, 0]):.0f}"
    )
    print(
        f"two threads: {1e3 * np.median(two[:, 1]):.0f} ms a frame, processor {1e3 * np.median(two[:, 0]):.0f}"
    )
    print(f"two against one: {np.median(two[:, 1]) / np.median(one[:, 1]):.2f} of the wall time, "
          f"{np.median(two[:, 0]) / np.median(one[:, 0]):.2f} of the processor time")  # fmt: skip


if __name__ == "__main__":
    main()
