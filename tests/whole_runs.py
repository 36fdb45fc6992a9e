"""Small scenes whose results are kept: no change of behaviour lands unseen.

``make references`` writes ``tests/data/references/*.json`` anew; the difference is part of the change and is reviewed
with it. ``python -m whole_runs --compare`` tells how far this machine is from what is kept, scene by scene.
"""

import json
import math
import sys
from pathlib import Path

import numpy as np
from contraction_scenes import spindle_scene

import rbfmuscle as rm
from rbfmuscle.sim.scene.options import ContactOptions, DetectOptions, SlidingOptions, TunnellingOptions

FOLDER = Path(__file__).resolve().parent / "data" / "references"
# A few points of each muscle say where all are: they hang together through one matrix.
POINTS = 12
RBF = {"name": "rbf", "centres": 80, "samples": 300, "resolution": 20}
QUANTITIES = ("volume_error", "penetration_max", "length", "moment_arm", "edge_strain_rms", "rest_error_rms")


def _phantom(muscles, model, *, end=20.0, step=10.0, **tables):
    """Some muscles of the embedded hip, coarse, so that a run takes a second."""
    scene = rm.phantom_scene(model=model, end=end, step=step, spacing=6.0)
    scene.muscles = [scene.muscle(name) for name in muscles]
    for name, table in tables.items():
        setattr(scene, name, table)
    return scene


def _contact(model):
    return _phantom(["extensor"], model, end=40.0, step=20.0)


def _sliding(model):
    return _phantom(["adductor_anterior", "adductor_posterior"], model, sliding=SlidingOptions())


def _substeps(model):
    """One frame of 30 degrees, in sub-steps of 5, and points that pass through bone looked for."""
    return _phantom(
        ["abductor"], model, end=30.0, step=30.0, contact=ContactOptions(substep_angle=5.0),
        detect=DetectOptions(tunnelling=TunnellingOptions(action="rotate")),
    )  # fmt: skip


def _contraction(model):
    return spindle_scene(
        model=model, frames=2, spacing=6.0, activation=[0, 1], tendon={"length": 100.0, "strain": 0.08}
    )


SCENES = {
    "contact_rbf": lambda: _contact(RBF),
    "contact_rbf_marching": lambda: _contact({**RBF, "surface": "marching", "placement": "even"}),
    "contact_rbf_inside": lambda: _contact({**RBF, "inside": 120, "fibre_ratio": 4.0}),
    "contact_pbd": lambda: _contact("pbd"),
    "contact_arap_volume": lambda: _contact("arap-volume"),
    "sliding_rbf": lambda: _sliding(RBF),
    "sliding_xpbd": lambda: _sliding("xpbd"),
    "substeps_rbf": lambda: _substeps(RBF),
    "substeps_arap_interleaved": lambda: _substeps("arap-interleaved"),
    "contraction_rbf": lambda: _contraction(RBF),
    "contraction_arap_volume": lambda: _contraction("arap-volume"),
}


def measure(scene):
    """What is kept of a run: some carried points, moments of each surface, rows of the metrics.

    Lengths stand in shares of the muscle's longest side, areas and volumes in shares of its square and cube, so one
    tolerance is for all.
    """
    run = rm.simulate(scene)
    found = {}
    for muscle in scene.muscles:
        low, high = muscle.mesh.bounds
        size, middle = float((high - low).max()), 0.5 * (low + high)
        frames = []
        for frame in run.frames:
            points = (frame.carried[muscle.name][0] - middle) / size
            surface = frame.surfaces[muscle.name]
            a, b, c = (
                ((surface.vertices - middle) / size)[np.asarray(surface.faces)[:, k]] for k in range(3)
            )
            cross = np.cross(b - a, c - a)
            triple = np.einsum("ij,ij->i", a, np.cross(b, c)) / 6.0
            frames.append(
                {
                    "points": points[np.linspace(0, len(points) - 1, POINTS).astype(int)].ravel().tolist(),
                    "area": 0.5 * float(np.linalg.norm(cross, axis=1).sum()),
                    "volume": float(triple.sum()),
                    "moment": (triple[:, None] * (a + b + c) / 4.0).sum(axis=0).tolist(),
                }
            )
        metrics = {}
        for name in QUANTITIES:
            values = np.array(run.values(muscle.name, name), dtype=float)
            share = 1.0 if name in ("volume_error", "edge_strain_rms") else 1.0 / size
            metrics[name] = [None if np.isnan(v) else float(v * share) for v in values]
        found[muscle.name] = {"frames": frames, "metrics": metrics}
    return found


def differences(kept, found, place=""):
    """Largest difference by kind of number, and where it is: a dict of kind to (difference, place)."""
    worst = {}
    _compare(kept, found, place, "", worst)
    return worst


def _compare(kept, found, place, kind, worst):
    if isinstance(kept, dict):
        if sorted(kept) != sorted(found):
            raise AssertionError(f"{place}: {sorted(kept)} are kept, {sorted(found)} are there")
        for key in kept:
            _compare(kept[key], found[key], f"{place} {key}", key, worst)
    elif isinstance(kept, list):
        if len(kept) != len(found):
            raise AssertionError(f"{place}: {len(kept)} are kept, {len(found)} are there")
        for k, (a, b) in enumerate(zip(kept, found)):
            _compare(a, b, f"{place} {k}", kind, worst)
    elif (kept is None) != (found is None):
        raise AssertionError(f"{place}: {kept} is kept, {found} is there")
    elif kept is not None:
        gap = abs(kept - found) if math.isfinite(found) else math.inf
        if kind not in worst or gap > worst[kind][0]:
            worst[kind] = gap, place


def write(name):
    """Write one reference anew; twelve digits, a number a line, so that a change reads as a difference."""
    text = json.dumps(measure(SCENES[name]()), indent=0)
    rounded = json.loads(text, parse_float=lambda t: float(f"{float(t):.12g}"))
    FOLDER.mkdir(parents=True, exist_ok=True)
    (FOLDER / f"{name}.json").write_text(json.dumps(rounded, indent=0) + "\n", encoding="utf-8")


def read(name):
    """One reference."""
    return json.loads((FOLDER / f"{name}.json").read_text(encoding="utf-8"))


def main(arguments):
    """The command."""
    names = [name for name in arguments if not name.startswith("-")] or list(SCENES)
    for name in names:
        if "--compare" in arguments:
            worst = differences(read(name), measure(SCENES[name]()))
            print(name, " ".join(f"{kind} {value:.1e}" for kind, (value, _) in worst.items()), flush=True)
        else:
            write(name)
            print(name, flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
