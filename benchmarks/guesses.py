"""What `new` writes loads, passes `check` and runs: random parts of a leg, and what people do to their meshes.

    python benchmarks/guesses.py --subsets 10 --seed 1

Ten random subsets of the bones and muscles of ``data/leg``; the phantom and the leg's thigh mirrored, in metres, and
with files named Segment_1 and on. Each goes through the commands as a user would type them.
"""

import argparse
import contextlib
import io
import random
import shutil
import sys
import tempfile
import time
from pathlib import Path

import trimesh

QUIET = ["--set", "output.report=false", "--set", "output.preview=false"]


def leg_files(data: Path) -> tuple[list[Path], list[Path]]:
    """Meshes of the bones, without the stubs that carry tendons, and of the muscles."""
    bones = [p for p in sorted((data / "leg" / "bones").glob("*.ply")) if "tendon" not in p.stem]
    return [p for p in bones if p.stem != "hamstring_origin"], sorted(
        (data / "leg" / "muscles").glob("*.ply")
    )


def subset(data: Path, folder: Path, draw: random.Random) -> str:
    """Some bones and muscles of the leg in a folder; what they are."""
    bones, muscles = leg_files(data)
    bones, muscles = draw.sample(bones, draw.randint(3, 9)), draw.sample(muscles, draw.randint(3, 8))
    for path in bones + muscles:
        shutil.copy(path, folder / path.name)
    return f"{len(bones)} bones, {len(muscles)} muscles"


def changed(meshes: list[tuple[str, trimesh.Trimesh]], folder: Path, how: str) -> str:
    """Meshes in a folder as they are, ``mirrored``, in ``metres`` or with ``plain names``; the unit."""
    for number, (name, mesh) in enumerate(meshes, start=1):
        mesh = mesh.copy()
        if how == "mirrored":
            mesh.vertices[:, 0] *= -1.0
            mesh.invert()
        elif how == "metres":
            mesh.apply_scale(0.001)
        mesh.export(folder / (f"Segment_{number}.ply" if how == "plain names" else f"{name}.ply"))
    return "m" if how == "metres" else "mm"


def run_commands(folder: Path, units: str) -> str:
    """Empty where all three commands end well, else the first that does not, with what it says."""
    from rbfmuscle.app import run_command

    scene = folder / "scene.toml"
    for words in (
        ["new", str(folder), "--units", units],
        ["check", str(scene)],
        ["run", str(scene), "-o", str(folder / "out"), "--frames", "0:5", *QUIET],
    ):
        said = io.StringIO()
        with contextlib.redirect_stderr(said), contextlib.redirect_stdout(io.StringIO()):
            code = run_command(words)
        if code:
            lines = [line for line in said.getvalue().splitlines() if line.startswith("rbfmuscle:")]
            return f"{words[0]} ends with {code}: {lines[-1] if lines else said.getvalue()[-300:]}"
    return ""


def main() -> int:
    """All cases, one line each."""
    from rbfmuscle.sim.scene.phantom import phantom_scene

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--subsets", type=int, default=10)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    asked = parser.parse_args()
    draw, bad = random.Random(asked.seed), 0
    scene = phantom_scene()
    phantom = [(item.name, item.mesh) for item in scene.bones + scene.muscles]
    thigh = (
        "pelvis",
        "femur",
        "tibia",
        "patella",
        "vastus_lateralis",
        "rectus_femoris",
        "gluteus_medius",
        "gracilis",
    )
    files = {path.stem: path for part in leg_files(asked.data) for path in part}
    leg = [(name, trimesh.load_mesh(files[name])) for name in thigh]
    cases = [(f"subset {k + 1}", None, "") for k in range(asked.subsets)]
    kinds = ("as it is", "mirrored", "metres", "plain names")
    cases += [
        (f"{title}, {how}", meshes, how)
        for title, meshes in (("phantom", phantom), ("thigh", leg))
        for how in kinds
    ]
    for title, meshes, how in cases:
        with tempfile.TemporaryDirectory() as home:
            folder, start, units = Path(home) / "meshes", time.process_time(), "mm"
            folder.mkdir()
            if meshes is None:
                title += f": {subset(asked.data, folder, draw)}"
            else:
                units = changed(meshes, folder, how)
            wrong = run_commands(folder, units)
            text = (
                (folder / "scene.toml").read_text(encoding="utf-8")
                if (folder / "scene.toml").exists()
                else ""
            )
            left = text.count("# NOT RUN")
            bad += bool(wrong)
            spent = time.process_time() - start
            print(f"{title}; {left} muscles commented out; {spent:.0f} s: {wrong or 'well'}", flush=True)
    print(f"{len(cases) - bad} of {len(cases)} end well")
    return bad > 0


if __name__ == "__main__":
    sys.exit(main())
