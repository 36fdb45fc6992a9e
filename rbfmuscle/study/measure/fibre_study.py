"""Fibres of the muscles through a motion: carried along by the deformation, and their lengths."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from rbfmuscle.geometry.arrays import Floats
from rbfmuscle.geometry.mean_value import mean_value_weights
from rbfmuscle.study.measure.centreline import MuscleAtRest, moving_joints, split_ends
from rbfmuscle.validation import MeshError

if TYPE_CHECKING:
    from rbfmuscle.sim.loop.frame import Frame
    from rbfmuscle.sim.scene.scene import Scene


class FibreLines(NamedTuple):
    """The fibres of one muscle in one frame.

    Attributes
    ----------
    points : (count, segments + 1, 3) ndarray
        From origin to insertion, world coordinates [scene unit].
    lengths : (count,) ndarray
        [scene unit].
    rest_lengths : (count,) ndarray
        The same at rest.
    """

    points: np.ndarray
    lengths: np.ndarray
    rest_lengths: np.ndarray


class FibreBundle:
    """The fibres of one muscle, bound to a mesh of constant topology.

    They are grown once in the input mesh at rest. Inner points are carried by mean value coordinates of the
    carried mesh, so that no model has to know of them; the ends move rigidly with the bones that they are
    attached to.

    Parameters
    ----------
    at_rest : MuscleAtRest
    count, segments : int

    Raises
    ------
    SolveError
        If origin and insertion are not joined by the inside of the muscle.
    """

    def __init__(self, at_rest: MuscleAtRest, *, count: int = 100, segments: int = 15) -> None:
        muscle, mesh = at_rest.muscle, np.asarray(at_rest.muscle.mesh.vertices, dtype=np.float64)
        groups = split_ends(muscle, at_rest.joints, at_rest.moving)
        self.rest = at_rest.grown_fibres(count, segments)
        self.rest_lengths = line_lengths(self.rest)
        self.holders = [_holders(mesh, group, self.rest[:, k]) for group, k in zip(groups, (0, -1))]
        inner = self.rest[:, 1:-1].reshape(-1, 3)
        # Half the memory, and an error of less than 1e-6 of the muscle's size: positions are taken about
        # a mean vertex.
        try:
            self.weights = mean_value_weights(inner, at_rest.vertices, at_rest.faces).astype(np.float32)
        except ValueError as error:
            raise MeshError(f"muscle {muscle.name!r}: fibre {error}") from None

    def lines(self, vertices: Floats, poses: dict[str, Floats]) -> FibreLines:
        """Fibres now.

        Parameters
        ----------
        vertices : (n, 3) ndarray
            The carried mesh.
        poses : dict of str to (4, 4) ndarray

        Returns
        -------
        FibreLines
        """
        points = np.empty_like(self.rest)
        middle = vertices.mean(axis=0)
        inner = self.weights @ (vertices - middle).astype(np.float32)
        points[:, 1:-1] = inner.reshape(len(points), -1, 3) + middle
        for k, holders in zip((0, -1), self.holders):
            for bone, which in holders.items():
                pose = poses[bone]
                points[which, k] = self.rest[which, k] @ pose[:3, :3].T + pose[:3, 3]
        return FibreLines(points, line_lengths(points), self.rest_lengths)


class FibreStudy:
    """Fibres of a scene's muscles, frame by frame.

    Parameters
    ----------
    scene : Scene
        Its ``output.fibres`` says how many.
    carried : dict of str to (vertices, faces)
        Carried meshes at rest, before the motion, of the models that are studied here.
    """

    def __init__(self, scene: Scene, carried: dict[str, Any]) -> None:
        options: Any = scene.output.fibres
        moving, self.bundles = moving_joints(scene), {}
        for muscle in scene.muscles:
            if muscle.name not in carried:
                continue
            vertices, faces = carried[muscle.name]
            rest = MuscleAtRest(muscle, scene.joints, vertices, faces, moving)
            self.bundles[muscle.name] = FibreBundle(rest, count=options.count, segments=options.segments)

    def at(self, frame: Frame) -> dict[str, FibreLines]:
        """Fibres in a frame: dict of muscle name to FibreLines."""
        return {
            name: bundle.lines(frame.carried[name][0], frame.poses) for name, bundle in self.bundles.items()
        }


def line_lengths(points: Floats) -> Floats:
    """Length of each polyline (n, k, 3), (n,)."""
    return np.linalg.norm(np.diff(points, axis=1), axis=2).sum(axis=1)


def _holders(mesh, group, points):
    """Which of the points each bone of an end holds: dict of bone to bool (n,)."""
    owner = np.concatenate([np.full(len(a.vertices), k) for k, a in enumerate(group)])
    attached = np.concatenate([np.asarray(a.vertices) for a in group])
    nearest = owner[cKDTree(mesh[attached]).query(points)[1]]
    held = {}
    for k, attachment in enumerate(group):
        which = nearest == k
        held[attachment.bone] = held.get(attachment.bone, np.zeros(len(points), dtype=bool)) | which
    return held
