"""``make fuzz``: damaged scenes and meshes by the thousand, and a table of what became of them.

``--only scene:17`` (or ``mesh:17``, ``frames:17``) runs one case in this process and shows its file and its trace.
"""

import argparse
import os
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

for _name in ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_name] = "1"  # no thread may live in what is forked; before the libraries read it

import numpy as np  # noqa: E402

from fuzz import harness  # noqa: E402
from fuzz.base import base_scene, suffix_of, write_base  # noqa: E402
from fuzz.meshes import write_damaged  # noqa: E402
from fuzz.scenes import scene_text, to_toml  # noqa: E402

MODELS = ("rbf", "pbd")
WANTED = 5  # seconds of processor time after which a clean error is late
KINDS = {"scene": 1, "mesh": 2, "frames": 3}  # and what seeds them apart


class Cases:
    """The cases of each kind by number, over one folder with the files that they damage."""

    def __init__(self, folder):
        self.folder = folder
        self.forms = write_base(folder)

    def action(self, kind, number):
        """What the case does."""
        rng = np.random.default_rng([KINDS[kind], number])
        return {"scene": self._scene, "mesh": self._mesh, "frames": self._frames}[kind](rng, number)

    def _scene(self, rng, number):
        text = scene_text(rng)

        def act():
            path = self.folder / "damaged.toml"
            path.write_text(text, encoding="utf-8", errors="replace")
            return load(path)

        return act

    def _mesh(self, rng, number):
        def act():
            path = write_damaged(self.folder / "case", self.forms, rng)
            return read(path, may_be_open=bool(number % 4 == 3))

        return act

    def _frames(self, rng, number):
        """Three frames of a damaged scene, or of the whole one with a damaged muscle, with each model in turn."""
        model, damaged_mesh = MODELS[number % 2], number % 4 >= 2

        def act():
            path = self.folder / "frames.toml"
            if damaged_mesh:
                scene = base_scene()
                mesh = write_damaged(self.folder / "case", self.forms, rng)
                muscle = scene["muscle"][0]
                muscle["mesh"] = str(mesh.relative_to(self.folder))
                muscle["attach"] = [
                    {"bone": "upper", "sphere": {"centre": [34.0, 0.0, 45.0], "radius": 22.0}},
                    {"bone": "lower", "sphere": {"centre": [34.0, 0.0, -65.0], "radius": 22.0}},
                ]
                text = to_toml(scene)
            else:
                text = scene_text(rng, deep=True)
            path.write_text(text, encoding="utf-8", errors="replace")
            return run(path, self.folder / "case" / "out", None if number % 8 >= 4 else model)

        return act


def load(path: Path) -> int:
    """Read a scene with all that belongs to it, look it over, and prove its meshes."""
    from rbfmuscle.models import check_models
    from rbfmuscle.scene.scene import Scene
    from rbfmuscle.simulation.substeps import check_substeps
    from rbfmuscle.validation import RBFMuscleError

    try:
        scene = Scene.load(path)
        check_models(scene)
        scene.check()
        check_substeps(scene)
    except RBFMuscleError as error:
        return harness.tell(error)
    harness.check_meshes(scene)
    return 0


def read(path: Path, *, may_be_open: bool) -> int:
    """Read a mesh as a muscle's or, where it may be open, a bone's."""
    from rbfmuscle.scene.meshes.read import read_mesh
    from rbfmuscle.validation import MeshError

    try:
        found = read_mesh(path, may_be_open=may_be_open)
    except MeshError as error:
        return harness.tell(error)
    if not may_be_open:
        harness.check_volume(np.asarray(found.mesh.vertices), np.asarray(found.mesh.faces), path.name)
    elif not np.isfinite(found.mesh.vertices).all():
        raise harness.WrongResult("a vertex is not finite")
    return 0


def run(path: Path, output: Path, model: str | None) -> int:
    """Three frames by the command line itself, and a look at what it left."""
    from rbfmuscle.cli.app import run_command

    words = ["run", str(path), "-o", str(output), "--frames", "0:3", "--json"]
    shown = os.dup(1)
    with open(output.parent / "stdout.txt", "wb") as file:
        os.dup2(file.fileno(), 1)
        code = run_command([*words, *(["--model", model] if model else [])])
        sys.stdout.flush()
    os.dup2(shown, 1)
    if code == 0:
        check_run(output)
    return code


def check_run(output: Path) -> None:
    """Raise WrongResult for numbers that are not finite, or a volume that was not kept."""
    from rbfmuscle.output.saved import SavedRun

    saved = SavedRun(output)
    for muscle in saved.muscles if saved.has_surfaces() else []:
        for frame in saved.frames:
            vertices, faces = saved.surface(muscle, frame)
            if not (len(faces) and np.isfinite(vertices).all()):
                raise harness.WrongResult(f"the surface of {muscle} in frame {frame} is empty or not finite")
    for row in saved.metrics:
        finite = row.quantity not in ("volume", "volume_error", "penetration_max", "length")
        if not (finite or np.isfinite(row.value)):
            raise harness.WrongResult(f"{row.quantity} of {row.muscle} in frame {row.frame} is {row.value}")


def warm_up(cases, models):
    """Load the program, and its compiled loops by a run with each model, before anything is forked."""
    path = cases.folder / "whole.toml"
    path.write_text(to_toml(base_scene()))
    (cases.folder / "case").mkdir(exist_ok=True)
    codes = [load(path)]
    codes += [
        read(cases.folder / f"muscle-{form}{suffix_of(form)}", may_be_open=False) for form in cases.forms
    ]
    codes += [run(path, cases.folder / "case" / "out", model) for model in models]
    if any(codes):
        raise SystemExit("what is to be damaged is not whole")


def show_only(cases, word):
    """One case, with everything that it does in the open."""
    kind, number = word.split(":")
    (cases.folder / "case").mkdir(exist_ok=True)
    code = cases.action(kind, int(number))()
    for name in ("damaged.toml", "frames.toml"):
        if (cases.folder / name).exists():
            print((cases.folder / name).read_text(errors="replace")[:4000])
    print(f"exit code {code}, files in {cases.folder}")


def main() -> int:
    """Run the cases and print the table; 0 if every one was fine or a clean error."""
    parser = argparse.ArgumentParser(description=__doc__)
    for kind in KINDS:
        parser.add_argument(f"--{kind}", type=int, default=0, help="how many")
    parser.add_argument("--first", type=int, default=0, help="number of the first case")
    parser.add_argument("--only", help="kind:number")
    options = parser.parse_args()
    harness.show_warnings()
    folder = Path(tempfile.mkdtemp(prefix="fuzz-"))
    cases = Cases(folder)
    if options.only:
        show_only(cases, options.only)
        return 0
    warm_up(cases, MODELS if options.frames else ())
    start, table, times = time.monotonic(), {}, {}
    for kind in KINDS:
        table[kind], times[kind] = Counter(), []
        for number in range(options.first, options.first + getattr(options, kind)):
            outcome, said, seconds = harness.run_case(cases.action(kind, number), folder / "case")
            table[kind][outcome] += 1
            if outcome == harness.CLEAN:
                times[kind].append(seconds)
            if outcome not in (harness.FINE, harness.CLEAN):
                print(
                    f"{kind}:{number}: {outcome}: {' / '.join(said.strip().splitlines()[-4:])[:600]}",
                    flush=True,
                )
    return show_table(table, time.monotonic() - start, times)


def show_table(table, seconds, times):
    """Print the counts of each outcome, and how soon clean errors came; 1 if any is neither fine nor a clean error."""
    late, slowest = f"clean errors after more than {WANTED} s", "the slowest clean error, s"
    width = max(map(len, (*harness.OUTCOMES, late)))

    def line(name, values):
        print(f"{name:{width}}" + "".join(f"{value:>10}" for value in values))

    line("", (*table, "all"))
    for outcome in harness.OUTCOMES:
        counts = [found[outcome] for found in table.values()]
        line(outcome, (*counts, sum(counts)))
    every = [*times.values(), [t for taken in times.values() for t in taken]]
    line(late, (sum(t > WANTED for t in taken) for taken in every))
    line(slowest, (f"{max(taken, default=0.0):.2f}" for taken in every))
    print(f"{sum(map(Counter.total, table.values()))} cases in {seconds:.0f} s; times are of the processor")
    return int(any(found[o] for found in table.values() for o in harness.OUTCOMES[2:]))


sys.exit(main())
