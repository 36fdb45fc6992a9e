"""``make fuzz``: damaged scenes and meshes by the thousand, and a table of what became of them.

``--only scene:17`` (or ``mesh:17``, ``frames:17``) runs one case in this process and shows its file
and its trace.
"""

import argparse
import os
import sys
import tempfile
from collections import Counter
from pathlib import Path

for _name in ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_name] = "1"  # no thread may live in what is forked; before the libraries read it

import numpy as np  # noqa: E402

from fuzz import harness  # noqa: E402
from fuzz.meshes import base_scene, suffix_of, write_base, write_damaged  # noqa: E402
from fuzz.scenes import scene_text, to_toml  # noqa: E402

MODELS = ("rbf", "pbd")
FINITE = ("volume", "volume_error", "penetration_max", "length")


class Cases:
    """The cases of each kind by number, over one folder with the files that they damage."""

    def __init__(self, folder):
        self.folder = folder
        self.forms = write_base(folder)

    def action(self, kind, number):
        """What the case does: prints what a user would see, and returns the exit code."""
        rng = np.random.default_rng([KINDS.index(kind) + 1, number])
        return lambda: getattr(self, kind)(rng, number)

    def scene(self, rng, number):
        return load(self._write("damaged.toml", scene_text(rng)))

    def mesh(self, rng, number):
        path = write_damaged(self.folder / "case", self.forms, rng)
        return read(path, may_be_open=bool(number % 4 == 3))

    def frames(self, rng, number):
        """Three frames of a damaged scene, or of the whole one with a damaged muscle, with each
        model in turn.
        """
        if number % 4 >= 2:
            scene = base_scene()
            mesh = write_damaged(self.folder / "case", self.forms, rng)
            muscle = scene["muscle"][0]
            muscle["mesh"] = str(mesh.relative_to(self.folder))
            muscle["attach"] = [
                {"bone": bone, "points": [[34.0, 0.0, z]], "radius": 22.0}
                for bone, z in (("upper", 45.0), ("lower", -65.0))
            ]
            text = to_toml(scene)
        else:
            text = scene_text(rng, deep=True)
        model = None if number % 8 >= 4 else MODELS[number % 2]
        return run(self._write("frames.toml", text), self.folder / "case" / "out", model)

    def _write(self, name, text):
        (self.folder / name).write_text(text, encoding="utf-8", errors="replace")
        return self.folder / name


KINDS = ("scene", "mesh", "frames")


def load(path: Path) -> int:
    """Read a scene with all that belongs to it, look it over, and prove its meshes."""
    from rbfmuscle.models import check_models
    from rbfmuscle.scene.check import check_scene
    from rbfmuscle.scene.scene import Scene
    from rbfmuscle.simulation.substeps import check_substeps
    from rbfmuscle.validation import RBFMuscleError

    try:
        scene = Scene.load(path)
        check_models(scene)
        check_scene(scene)
        check_substeps(scene)
    except RBFMuscleError as error:
        return harness.tell(error)
    for muscle in scene.muscles:
        harness.check_volume(
            np.asarray(muscle.mesh.vertices), np.asarray(muscle.mesh.faces), muscle.name
        )
    for bone in scene.bones:
        harness.check_finite(bone.mesh.vertices, bone.name)
    return 0


def read(path: Path, *, may_be_open: bool) -> int:
    """Read a mesh as a muscle's or, where it may be open, a bone's."""
    from rbfmuscle.scene.meshes.read import read_mesh
    from rbfmuscle.validation import MeshError

    try:
        mesh = read_mesh(path, may_be_open=may_be_open).mesh
    except MeshError as error:
        return harness.tell(error)
    harness.check_finite(mesh.vertices, path.name)
    if not may_be_open:
        harness.check_volume(np.asarray(mesh.vertices), np.asarray(mesh.faces), path.name)
    return 0


def run(path: Path, output: Path, model: str | None) -> int:
    """Three frames by the command line itself, and a look at what it left."""
    from rbfmuscle.cli.app import report_in_lines, run_command
    from rbfmuscle.recording import Run

    report_in_lines()
    words = ["run", str(path), "-o", str(output), "--frames", "0:3", "--json"]
    shown = os.dup(1)
    with open(output.parent / "stdout.txt", "wb") as file:
        os.dup2(file.fileno(), 1)
        code = run_command([*words, *(["--model", model] if model else [])])
        sys.stdout.flush()
    os.dup2(shown, 1)
    if code == 0:
        saved = Run.load(output)
        for muscle in saved.muscles if saved.has_surfaces else []:
            for frame in saved.frame_numbers:
                harness.check_finite(saved.mesh(muscle, frame)[0], f"{muscle} in frame {frame}")
        for row in saved.metrics:
            if row.quantity in FINITE:
                harness.check_finite(
                    [row.value], f"{row.quantity} of {row.muscle} in frame {row.frame}"
                )
    return code


def warm_up(cases, models):
    """Load the program, and its compiled loops by a run with each model, before anything is
    forked."""
    path = cases.folder / "whole.toml"
    path.write_text(to_toml(base_scene()))
    (cases.folder / "case").mkdir(exist_ok=True)
    meshes = [cases.folder / f"muscle-{form}{suffix_of(form)}" for form in cases.forms]
    codes = [load(path), *(read(mesh, may_be_open=False) for mesh in meshes)]
    codes += [run(path, cases.folder / "case" / "out", model) for model in models]
    if any(codes):
        raise SystemExit("what is to be damaged is not whole")


def main() -> int:
    """Run the cases and print the table; 0 if every one was fine or a clean error."""
    parser = argparse.ArgumentParser(description=__doc__)
    for kind in KINDS:
        parser.add_argument(f"--{kind}", type=int, default=0, help="how many")
    parser.add_argument("--first", type=int, default=0, help="number of the first case")
    parser.add_argument("--only", help="kind:number")
    options = parser.parse_args()
    harness.show_warnings()
    cases = Cases(Path(tempfile.mkdtemp(prefix="fuzz-")))
    if options.only:
        kind, number = options.only.split(":")
        (cases.folder / "case").mkdir()
        print(f"exit code {cases.action(kind, int(number))()}, files in {cases.folder}")
        return 0
    warm_up(cases, MODELS if options.frames else ())
    table, slowest = {}, 0.0
    for kind in KINDS:
        table[kind] = Counter()
        for number in range(options.first, options.first + getattr(options, kind)):
            outcome, said, seconds = harness.run_case(
                cases.action(kind, number), cases.folder / "case"
            )
            table[kind][outcome] += 1
            if outcome == harness.CLEAN:
                slowest = max(slowest, seconds)
            elif outcome != harness.FINE:
                words = " / ".join(said.strip().splitlines()[-4:])
                print(f"{kind}:{number}: {outcome}: {words[:600]}", flush=True)
    for outcome in harness.OUTCOMES:
        print(
            f"{outcome:50}"
            + "".join(f"{found[outcome]:>8} {kind}" for kind, found in table.items())
        )
    print(
        f"{sum(map(Counter.total, table.values()))} cases; the slowest clean error took "
        f"{slowest:.2f} s"
    )
    return int(any(found[o] for found in table.values() for o in harness.OUTCOMES[2:]))


sys.exit(main())
