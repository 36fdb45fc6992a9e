"""Two mesh models that stand in the paper and are no choice for users, added from outside.

Cervenka, Havlicek, Kohout and Váša (GRAPP 2023). ``register()`` makes them known by the names
``pbd-paper`` and ``arap-interleaved``, as any model of a user's own would be.
"""

import numpy as np

from pbd_baseline.constraints import TOUCHING, ContactConstraint, plane_depths
from pbd_baseline.muscle import PBDMuscle
from pbd_baseline.rest import PBDOptions, solved_points
from pbd_baseline.shapes import GlobalARAPShape, Method, PBDShape
from rbfmuscle.models import ModelKind, model_names, register_model

# Share of its velocity that a vertex keeps.
DAMPING = 0.99


class PaperShape(PBDShape):
    """PBD as printed: stiffness does not fall with an edge's length, limits are wide."""

    soft_length = np.inf
    limits = 0.01, 100.0


class InterleavedARAPShape(GlobalARAPShape):
    """ARAP with the rough volume step of figure 8: each of the two undoes what the other did."""

    def restore_volume(self, points, contact):
        """One projection along the plain gradient, in place, whatever lies in the way."""
        project_volume(self.volume, points, self.inverse_mass)


def project_volume(volume, points, inverse_mass):
    """One PBD projection along the plain gradient, in place."""
    step = volume.gradient(points) * inverse_mass[:, None]
    slope = (step * step).sum()
    if slope > 0.0:
        points += step * ((volume.rest - volume.volume(points)) / slope)


class DeepestContact(ContactConstraint):
    """A vertex in several bones moves by the longest of its ways out alone, not by their sum."""

    def project(self, points):
        """Push vertices out of the half-spaces, in place."""
        planes = self.planes
        depth = plane_depths(points, planes)
        if depth.max(initial=0.0) <= TOUCHING * self.reach:
            return
        deepest = np.zeros(len(points))
        np.maximum.at(deepest, planes.point, depth)
        depth[depth < deepest[planes.point]] = 0.0
        np.add.at(points, planes.point, depth[:, None] * planes.normal)


class PaperMuscle(PBDMuscle):
    """Plain PBD as printed: vertices keep their velocity, fibres have no slack."""

    def __init__(self, muscle, scene, options):
        options = options.model_copy(update={"slack_ratio": 1.0})
        super().__init__(muscle, scene, options, method=Method(PaperShape, 3))
        self.contact = DeepestContact(reach=self.contact.reach)
        self.before = self.points.copy()

    def predict(self, before, after):
        """Let free vertices go on as they went; held ones arrive exactly."""
        went_on = self.points + DAMPING * (self.points - self.before)
        self.before = self.points.copy()
        super().predict(before, after)
        free = self.attached_bone < 0
        self.points[free] = went_on[free]

    def transform(self, motion):
        """Go along with a rigid motion (4, 4), as the muscle is."""
        super().transform(motion)
        self.before = self.before @ motion[:3, :3].T + motion[:3, 3]

    def snapshot(self):
        """Everything that :meth:`restore` needs."""
        return super().snapshot(), self.before.copy()

    def restore(self, state):
        """Go back to a snapshot."""
        inner, before = state
        super().restore(inner)
        self.before = before.copy()


def _interleaved(muscle, scene, options):
    return PBDMuscle(muscle, scene, options, method=Method(InterleavedARAPShape, 6))


KINDS = {
    "pbd-paper": ModelKind(
        PaperMuscle, PBDOptions, solved_points, "PBD of the paper, {} sweeps", 3
    ),
    "arap-interleaved": ModelKind(
        _interleaved, PBDOptions, solved_points, "arap-interleaved, {} sweeps", 6
    ),
}


def register():
    """Make both models known to this process."""
    for name, kind in KINDS.items():
        if name not in model_names():
            register_model(name, kind)
