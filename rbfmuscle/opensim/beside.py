"""Lengths and moment arms of a model's own muscle paths, by OpenSim itself, wrapping and all.

OpenSim is asked in a process of its own, ``python -m rbfmuscle.opensim.beside JOB ANSWER``: it writes to standard
output and into the present folder, and what ends it must not end a run.
"""

from __future__ import annotations

import importlib
import importlib.util
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from rbfmuscle.opensim.scene import clean_name
from rbfmuscle.sim.scene.scene import MM_PER_UNIT

_TIMEOUT = 600
INSTALL = "OpenSim is not installed: pip install 'rbfmuscle[opensim]'"


def ask_opensim(
    model: str, units: str, frames: list[dict], muscles: dict[str, list[str]], wanted: dict[str, list[str]]
) -> tuple[dict[str, Any], str]:
    """Return what OpenSim says of a model's muscles at the frames of a motion.

    Parameters
    ----------
    model : path
        An ``.osim`` file.
    units : {"m", "cm", "mm"}
        Of the lengths that come back.
    frames : list of dict of str to float
        For each frame the coordinates, full names of the scene [radian or metre]; those of the model that are not
        among them keep its default.
    muscles : dict of str to list of str
        For each muscle of the scene those of the model.
    wanted : dict of str to list of str
        For each muscle of the scene the coordinates of its moment arms.

    Returns
    -------
    found : dict
        ``paths``: muscle of the scene -> muscle of the model -> ``length`` (list over frames) and ``arms``
        (coordinate -> list over frames) [units; a plain number for a shift]. ``notes``: list of str. Empty where
        OpenSim could not be asked.
    reason : str
        Why it could not, in one line, else empty.
    """
    if not _installed():
        return {}, INSTALL
    if not Path(model).is_file():
        return {}, f"the model {model} is not there any more"
    job = {"model": str(Path(model).resolve()), "frames": frames, "muscles": muscles, "wanted": wanted}
    with tempfile.TemporaryDirectory() as folder:
        ask, answer = Path(folder) / "ask.json", Path(folder) / "answer.json"
        ask.write_text(json.dumps(job), encoding="utf-8")
        try:
            done = subprocess.run(
                [sys.executable, "-m", "rbfmuscle.opensim.beside", str(ask), str(answer)],
                cwd=folder, capture_output=True, text=True, timeout=_TIMEOUT, check=False, env=_environment(),
            )  # fmt: skip
        except subprocess.TimeoutExpired:
            return {}, f"OpenSim took longer than {_TIMEOUT} s and was stopped"
        if not answer.is_file():
            words = [line.strip() for line in done.stderr.splitlines() if line.strip()]
            return {}, f"OpenSim ended with code {done.returncode}: {words[-1][:160] if words else 'no word'}"
        found = json.loads(answer.read_text(encoding="utf-8"))
    if "problem" in found:
        return {}, found["problem"]
    metre = 1000.0 / MM_PER_UNIT[units]
    for paths in found["paths"].values():
        for facts in paths.values():
            facts["length"] = [value * metre for value in facts["length"]]
            for name, arms in facts["arms"].items():
                factor = 1.0 if name in found["shifts"] else metre
                facts["arms"][name] = [value * factor for value in arms]
    return found, ""


def _installed():
    try:  # a module of the package: a folder of its name would pass for the package itself
        return importlib.util.find_spec("opensim.simulation") is not None
    except ModuleNotFoundError:
        return False


def _environment():
    """The child finds this package where the parent does, though it starts in another folder."""
    here = str(Path(__file__).resolve().parents[2])
    return {
        **os.environ,
        "PYTHONPATH": os.pathsep.join([here, *filter(None, [os.environ.get("PYTHONPATH")])]),
    }


def evaluate(job: dict[str, Any], osim: Any) -> dict[str, Any]:
    """Answer a job in the process that has OpenSim; lengths in metres.

    Parameters
    ----------
    job : dict
        ``model``, ``frames``, ``muscles`` and ``wanted`` of `ask_opensim`.
    osim : module
        OpenSim's own package.
    """
    model = osim.Model(job["model"])
    state = model.initSystem()
    known = _coordinates(model)
    notes = []
    lost = sorted({name for frame in job["frames"] for name in frame} - set(known))
    if lost:
        notes.append(f"the model has no coordinate {', '.join(lost)}, so it does not follow it")
    forces = model.getMuscles()
    paths: dict[str, Any] = {}
    for muscle, names in job["muscles"].items():
        for name in names:
            if forces.getIndex(name) < 0:
                notes.append(f"the model has no muscle {name!r}")
                continue
            arms = {c: [] for c in job["wanted"].get(muscle, []) if c in known}
            paths.setdefault(muscle, {})[name] = {"length": [], "arms": arms}
    for values in job["frames"]:
        _pose(model, state, known, values)
        for found in paths.values():
            for name, facts in found.items():
                force = forces.get(name)
                facts["length"].append(force.getLength(state))
                for coordinate, arms in facts["arms"].items():
                    arms.append(force.computeMomentArm(state, known[coordinate]))
    shifts = [name for name, c in known.items() if c.getMotionType() == osim.Coordinate.Translational]
    return {"paths": paths, "notes": notes, "shifts": shifts}


def _coordinates(model):
    """The model's coordinates by the full names that an import gives them."""
    found, joints, taken = {}, model.getJointSet(), set()
    for k in range(joints.getSize()):
        joint, own = joints.get(k), set()
        title = clean_name(joint.getName(), taken)
        taken.add(title)
        for i in range(joint.numCoordinates()):
            coordinate = joint.get_coordinates(i)
            name = clean_name(coordinate.getName(), own)
            own.add(name)
            found[f"{title}.{name}"] = coordinate
    return found


def _pose(model, state, known, values):
    """Bring the model to a pose: followers by its own couplers, everything else as given."""
    given = [
        (known[name], value)
        for name, value in values.items()
        if name in known and not known[name].isDependent(state)
    ]
    for coordinate, value in given:
        coordinate.setLocked(state, False)
        coordinate.setClamped(state, False)
        coordinate.setValue(state, value, False)
        coordinate.setLocked(state, True)  # what was asked for stands; assembly moves what follows
    model.assemble(state)
    for coordinate, _ in given:
        coordinate.setLocked(state, False)
    model.realizeVelocity(state)


def main(arguments: list[str]) -> int:
    """Read a job and write its answer."""
    ask, answer = map(Path, arguments)
    job = json.loads(ask.read_text(encoding="utf-8"))
    osim = importlib.import_module("opensim")
    osim.Logger.setLevelString("off")
    try:
        found = evaluate(job, osim)
    except RuntimeError as error:  # all that OpenSim throws comes as this
        words = " ".join(str(error).split())
        found = {"problem": f"OpenSim refused {Path(job['model']).name}: {words[:160]}"}
    answer.write_text(json.dumps(found), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
