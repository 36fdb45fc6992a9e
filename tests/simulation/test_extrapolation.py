"""Where muscles that slide see each other: where their bones take them, and where settling will bring them."""

import igl
import numpy as np
import pytest
from toy_scene import ToyMuscle, attach, bone, box, ellipsoid, joint, muscle, scene, sphere

from rbfmuscle.scene.options import SlidingOptions
from rbfmuscle.simulation.frame_loop import FrameLoop
from rbfmuscle.simulation.neighbours.extrapolation import MotionExtrapolator, coordinate_change
from rbfmuscle.simulation.substeps import SubSteps


def _strap_on_an_arm(way=1.0):
    """A muscle of the trunk, and above it one whose far end hangs on an arm that swings."""
    fields = {"trunk": sphere(1.0, (0, 0, -60)), "arm": box((1, 1, 1), (60, 0, -40))}
    muscles = []
    for name, far, height in (("lower", "trunk", 0.0), ("upper", "arm", 9.0)):
        mesh = ellipsoid((30, 4, 4), (0, 0, height), subdivisions=3)
        ends = [attach(mesh, "trunk", lambda v: v[:, 0] < -25), attach(mesh, far, lambda v: v[:, 0] > 25)]
        muscles.append(muscle(name, mesh, ends))
    made = scene(
        [bone(name, field) for name, field in fields.items()],
        [joint("hinge", "trunk", "arm", (-30, 0, 0), press=(0, 1, 0))],
        muscles,
        [{"hinge.press": np.radians(way * angle)} for angle in (0, 2, 4, 6, 8, 10)],
        sliding=SlidingOptions(),
    )
    parts = {one.name: ToyMuscle(one, made, sweeps=4, reach=2.0) for one in muscles}
    return made, parts, fields


def test_between_its_sub_steps_a_muscle_is_seen_where_its_bones_have_taken_it():
    made, parts, fields = _strap_on_an_arm()
    held = parts["upper"].contact_bone == 1
    seen = []
    with FrameLoop(made, parts, fields=fields) as loop:
        # The lower one takes every sub-step, the upper one, as if nothing that moves were its own, the last alone.
        loop._together.cuts = {"upper": SubSteps(made, made.muscles[0])}
        update = loop._sliding.update

        def recorded(stepper):
            if stepper.name == "lower":
                seen.append((dict(stepper.path[1]), loop._sliding.surfaces["upper"].vertices[held].copy()))
            update(stepper)

        loop._sliding.update = recorded
        work = [loop.advance(coordinates).work for coordinates in made.motion.frames[:4:3]][-1]
        assert work["upper"].substeps == 1 < work["lower"].substeps
        here = parts["upper"].rest[held]
        for coordinates, vertices in seen:
            pose = loop.steppers[0].poses(coordinates)["arm"]
            np.testing.assert_allclose(vertices, here @ pose[:3, :3].T + pose[:3, 3], atol=1e-9)
    assert len({vertices[0, 2] for _, vertices in seen}) > 1


def test_a_muscle_is_seen_nearer_to_where_it_settles_than_its_bones_take_it():
    made, parts, fields = _strap_on_an_arm(way=-1.0)
    misses = []
    with FrameLoop(made, parts, fields=fields) as loop:
        settled = loop._sliding.settled

        def recorded(stepper, way):
            surface, now = loop._sliding.surfaces[stepper.name], stepper.model.contact_points()
            if stepper.name == "upper" and surface.extrapolator.parts:
                misses.append(
                    [
                        np.linalg.norm(part - now, axis=1).max()
                        for part in (surface._predicted[0], surface.points)
                    ]
                )
            settled(stepper, way)

        loop._sliding.settled = recorded
        for coordinates in made.motion.frames:
            loop.advance(coordinates)
    predicted, seen = np.array(misses).mean(axis=0)
    assert len(misses) > 3 and seen < 0.6 * predicted


@pytest.mark.parametrize(
    ("way", "share"),
    [({"q": 2.0}, 1.0), ({"q": 1.0}, 0.5), ({"p": 1.0}, 0.0), ({"q": -2.0}, 0.0), ({"q": 9.0}, 1.0)],
)
def test_what_settling_does_is_expected_again_as_far_as_the_motion_goes_on(way, share):
    lead, rng = MotionExtrapolator(), np.random.default_rng(4)
    before, moved = rng.normal(size=(2, 5, 3))
    assert lead.ahead([before], way)[0] is before
    lead.learn({"q": 2.0, "p": 0.0}, [before], [before + moved])
    np.testing.assert_allclose(lead.ahead([before], way)[0], before + share * moved, atol=1e-12)
    lead.learn({"q": 0.0}, [before], [before + moved])
    assert lead.share(way) == 0.0


def test_a_way_is_how_coordinates_change():
    assert coordinate_change({"a": 1.0}, {"a": 3.0, "b": 2.0}) == {"a": 2.0, "b": 2.0}


def _spike_into_a_belly(sliding):
    """How deep a thin muscle that an arm holds has come into a coarse belly below it."""
    fields = {"trunk": sphere(1.0, (0, 0, -60)), "arm": box((1, 1, 1), (60, 0, 40))}
    belly, spike = (
        ellipsoid((30, 9, 9), subdivisions=2),
        ellipsoid((1.5, 1.5, 15), (3, 0, 25), subdivisions=3),
    )
    muscles = [
        muscle("belly", belly, [attach(belly, "trunk", lambda v: np.abs(v[:, 0]) > 24)]),
        muscle("spike", spike, [attach(spike, "arm", lambda v: np.abs(v[:, 2] - 25) > 3)]),
    ]
    made = scene(
        [bone(name, field) for name, field in fields.items()],
        [joint("hinge", "trunk", "arm", (-30, 0, 0), press=(0, 1, 0))],
        muscles,
        [{"hinge.press": np.radians(angle)} for angle in range(0, 9, 2)],
        sliding=sliding,
    )
    parts = {one.name: ToyMuscle(one, made, sweeps=4, reach=2.0) for one in muscles}
    with FrameLoop(made, parts, fields=fields) as loop:
        for coordinates in made.motion.frames:
            loop.advance(coordinates)
    return -igl.signed_distance(parts["spike"].x, parts["belly"].x, parts["belly"].faces)[0].min()


def test_a_coarse_muscle_gives_way_to_a_thin_end_that_a_bone_drives_into_it():
    assert _spike_into_a_belly(None) > 3.0
    assert _spike_into_a_belly(SlidingOptions()) < 0.6
