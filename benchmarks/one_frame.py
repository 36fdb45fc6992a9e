"""The functions of one frame, from ``simulate`` to its files: counted, and drawn with their shares
of its time.

    python benchmarks/one_frame.py [SCENE]

Ten frames of the RBF model are traced on one thread, with metrics and files. Nested functions count
with the outer one, those that only share work among threads are left out.
"""

import os
import sys
import tempfile
import time
from collections import defaultdict
from pathlib import Path

os.environ["NUMBA_NUM_THREADS"] = "1"

import rbfmuscle as rm
from rbfmuscle.recording import stream_run

OURS = str(Path(rm.__file__).parent) + os.sep
THREADS = OURS + "geometry/threads.py"
# frames that are traced; what takes less than a tenth of them is not drawn
FIRST = 4
LAST = 14
LEAST = 0.1
parts, stack = defaultdict(lambda: defaultdict(float)), []  # seconds of each function by its caller


def trace(frame, event, _argument):
    """Note the time of a call of one of our functions."""
    code = frame.f_code
    file = code.co_filename
    if not file.startswith(OURS) or file == THREADS or code.co_name.startswith("<"):
        return
    if event == "call":
        name = code.co_qualname.partition(".<locals>")[0]
        stack.append(((file[len(OURS) :], name), time.perf_counter()))
    elif event == "return" and stack:
        (function, start), above = stack.pop(), [name for name, _ in stack]
        if function not in above:
            parts[function][above[-1] if above else None] += time.perf_counter() - start


def draw(caller, whole, depth=0):
    """Print the functions that one calls above all, and what these call; how many, in which
    files."""
    drawn = []
    for function, found in parts.items():
        share = sum(found.values()) / whole
        if share >= LEAST and max(found, key=found.get) == caller:
            print(f"{100 * share:4.0f} %  {2 * depth * ' '}{function[1]}  ({function[0]})")
            drawn += [function, *draw(function, whole, depth + 1)]
    return drawn


def switch(done, _all):
    """Trace from one frame on to another."""
    if done in (FIRST, LAST):
        marks.append(time.perf_counter())
        sys.setprofile(trace if done == FIRST else None)


marks = []
scene = rm.Scene.load(sys.argv[1]) if len(sys.argv) > 1 else rm.phantom_scene()
with tempfile.TemporaryDirectory() as folder:
    stream_run(scene, folder, model="rbf", frames=f"0:{LAST + 1}", pictures=False, progress=switch)
for name, found in {"all": [*parts], "drawn": draw(None, marks[1] - marks[0])}.items():
    print(f"{name}: {len(found)} functions in {len({file for file, _ in found})} files")
