"""Estimate of the discretisation error of RBF muscles: their motion on a lattice twice as fine."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from rbfmuscle.geometry.arrays import Floats
from rbfmuscle.models import build_models, configure_scene
from rbfmuscle.muscle.rest import RBFOptions
from rbfmuscle.scene.scene import Scene
from rbfmuscle.simulation.frame_loop import simulate_frames
from rbfmuscle.validation import UsageError

FINER = 2  # times as many nodes


@dataclass(frozen=True)
class LatticeError:
    """How far a muscle's vertices are from where `FINER` times as many nodes bring them."""

    muscle: str
    nodes: int
    frame: int  # of the motion, where they are farthest (RMS)
    rms: float  # [scene unit]
    greatest: float  # of a vertex in that frame [scene unit]


def discretisation_error(scene: Scene) -> list[LatticeError]:
    """How far the RBF muscles of a scene move when their solids get twice as many nodes.

    Vertices of the solid's mesh are compared in every frame. On the phantom the difference falls to
    six tenths from doubling to doubling, so a very fine lattice is two to three times as far away
    as the next one. Muscles of other models are left out.

    Parameters
    ----------
    scene : Scene

    Raises
    ------
    UsageError
        If the scene has no RBF muscle.
    RBFMuscleError
        As `simulate` does.

    Examples
    --------
    >>> from rbfmuscle import phantom_scene
    >>> scene = phantom_scene(end=0.0, spacing=6.0).with_options({"model.nodes": 60})
    >>> [found.muscle for found in discretisation_error(scene)]
    ['extensor', 'abductor', ...]
    """
    coarse = configure_scene(scene)
    coarse.muscles = [muscle for muscle in coarse.muscles if muscle.model == "rbf"]
    if not coarse.muscles:
        raise UsageError(f"scene {scene.name!r} has no RBF muscle: no other model has a lattice")
    fine = coarse.with_options()
    nodes = {}
    for muscle in fine.muscles:
        nodes[muscle.name] = RBFOptions.model_validate(muscle.options).nodes
        muscle.options = {**muscle.options, "nodes": FINER * nodes[muscle.name]}
    fine = configure_scene(fine)
    worst: dict[str, LatticeError] = {}
    numbers = coarse.motion.numbers
    for k, (one, other) in enumerate(zip(_frames(coarse), _frames(fine))):
        for name in nodes:
            away = np.linalg.norm(one[name] - other[name], axis=1)
            rms = float(np.sqrt(np.mean(away**2)))
            if name not in worst or rms > worst[name].rms:
                found = LatticeError(name, nodes[name], int(numbers[k]), rms, float(away.max()))
                worst[name] = found
    return list(worst.values())


def _frames(scene: Scene) -> Iterator[dict[str, Floats]]:
    """Vertices (n, 3) of each muscle, frame by frame."""
    for frame in simulate_frames(scene, build_models(scene), surfaces=False):
        yield {name: mesh[0] for name, mesh in frame.material_meshes.items()}
