"""What is known of an RBF muscle at rest, found once: where its points lie and what holds them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from rbfmuscle.geometry.arrays import Floats
from rbfmuscle.geometry.frames import RestFrame, principal_axes
from rbfmuscle.implicit.field import FieldFit
from rbfmuscle.muscle.options import RBFOptions
from rbfmuscle.muscle.placement import choose_centres, place_points
from rbfmuscle.scene.muscles import attachment_frames, ordered_muscle
from rbfmuscle.scene.objects import Muscle
from rbfmuscle.scene.scene import Scene
from rbfmuscle.surface.drawing import RestSurface
from rbfmuscle.validation import SceneError

# A patch smaller than the spacing of the centres still has to hold the muscle against turning.
LEAST_ATTACHED = 4


@dataclass(frozen=True)
class RestState:
    """An RBF muscle at rest: K centres, whose field is its surface, and S samples of the
    surface.
    """

    centres: np.ndarray  # (K, 3)
    normals: np.ndarray  # (K, 3)
    samples: np.ndarray  # (S, 3)
    sample_faces: np.ndarray  # (m, 3) closed outward triangulation of the samples
    fit: FieldFit  # how the field through the centres is fitted
    parts: np.ndarray  # (P, n) centres of its local fits
    bones: list[str]  # bones, and ends of tendons, that hold the muscle, by their names
    attached_bone: (
        np.ndarray
    )  # (K + S,) position in ``bones`` of what holds a contact point, -1 where free
    mesh_volume: float  # of the muscle's mesh [scene unit cubed]
    axes: np.ndarray  # (3, 3) principal axes as rows

    @classmethod
    def from_muscle(cls, muscle: Muscle, scene: Scene, options: RBFOptions) -> RestState:
        """Measure a muscle; SceneError if no centre is left free to move."""
        frame = RestFrame(np.asarray(muscle.mesh.vertices, dtype=float))
        count = choose_centres(muscle, scene, options).centres
        centres, samples, fit = place_points(muscle, frame, options, count)
        points = frame.points(centres.points)
        held_by = _Attachment(muscle, scene, frame, centres.points, samples.points)
        if (held_by.centres >= 0).all():
            raise SceneError(
                f"muscle {muscle.name!r}: every centre lies on an attachment; nothing is "
                "free to move"
            )
        attached_bone = np.concatenate([held_by.centres, held_by.samples])
        return cls(
            points,
            frame.directions(centres.normals),
            frame.points(samples.points),
            samples.control_faces,
            fit,
            fit.parts(centres.points),
            held_by.bones,
            attached_bone,
            float(muscle.mesh.volume),
            # Cells along the muscle's own axes are smaller than along the scene's, and turn with
            # the scene.
            frame.directions(principal_axes(samples.points)),
        )

    def surface(self) -> RestSurface:
        """What the surface is drawn from."""
        return RestSurface(
            self.fit,
            self.parts,
            self.centres,
            self.normals,
            self.contact_points(),
            self.attached_bone,
            self.mesh_volume,
            self.axes,
            self.bones,
        )

    def contact_points(self) -> np.ndarray:
        """Centres, then samples, (K + S, 3)."""
        return np.concatenate([self.centres, self.samples])


class _Attachment:
    """Which bone holds each centre and each sample, as a position in ``bones``; -1 where none
    does.
    """

    def __init__(
        self,
        muscle: Muscle,
        scene: Scene,
        frame: RestFrame,
        centres: np.ndarray,
        samples: np.ndarray,
    ) -> None:
        names = sorted(attachment_frames(scene.bones, muscle))
        patches = [np.asarray(attachment.vertices) for attachment in muscle.attachments]
        numbers = np.array(
            [names.index(attachment.attachment_frame) for attachment in muscle.attachments]
        )
        owner = np.full(len(frame.local), -1)
        for number, patch in zip(numbers, patches):
            owner[patch] = number
        used = np.unique(owner[owner >= 0])
        self.bones = [names[b] for b in used]
        place = np.full(len(names) + 1, -1)
        place[used] = np.arange(len(used))
        owner, numbers = place[owner], place[numbers]
        tree = cKDTree(frame.local)
        nearest = tree.query(centres)[1]
        self.centres, self.samples = owner[nearest], owner[tree.query(samples)[1]]
        for number, patch in zip(numbers, patches):
            if number >= 0 and np.isin(nearest, patch).sum() < LEAST_ATTACHED:
                self._claim(number, cKDTree(frame.local[patch]).query(centres)[0])

    def _claim(self, number: int, distance: Floats) -> None:
        """Give a bone the centres nearest to its patch, but none that a bone next to it needs."""
        held = np.bincount(self.centres[self.centres >= 0], minlength=len(self.bones))
        left = LEAST_ATTACHED
        for centre in np.argsort(distance, kind="stable"):
            own = self.centres[centre]
            if own >= 0 and own != number:
                if held[own] <= LEAST_ATTACHED:
                    continue
                held[own] -= 1
            self.centres[centre] = number
            left -= 1
            if left == 0:
                return


def solved_points(muscle: Muscle, scene: Scene, options: RBFOptions) -> str:
    """How many centres a muscle will have, and why."""
    chosen = choose_centres(ordered_muscle(muscle)[0], scene, options, known_only=True)
    return f"{chosen.centres} centres ({chosen.reason})"
