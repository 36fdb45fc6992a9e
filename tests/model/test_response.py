"""The linearised equilibrium of a muscle with an inside: derivative of its forces, of its shapes, of its lengths."""

import numpy as np
import pytest
from elastic_bar import NO_BONES, bar, settle, shift

from rbfmuscle.model.inside.response import Response
from rbfmuscle.run import simulate
from rbfmuscle.sim.loop.contact import BoneContacts
from rbfmuscle.sim.scene.phantom import phantom_scene


def test_its_matrix_is_the_derivative_of_the_forces():
    solid = bar(nodes=60, regions=4)
    solid.reinforce(np.tile([0.8, 0.6, 0.0], (len(solid.weights), 1)), 4.0)
    rng = np.random.default_rng(1)
    base, way = solid.rest + rng.normal(0, 0.3, solid.rest.shape), rng.normal(size=solid.rest.shape)
    solid.pressure = rng.normal(size=len(solid.pressure))
    owner = np.repeat(np.arange(len(solid.pressure)), np.diff(solid.start))

    def force(y):
        solid.y = y
        solid.localise()
        total = solid.matrix @ y - solid.right
        np.add.at(total, solid.touched, -solid.pressure[owner][:, None] * solid.gradient)
        return total

    # Rotations are found to 1e-9 or so, and differences divide that by the step.
    h = 1e-4
    wanted = (force(base + h * way) - force(base - h * way)) / (2 * h)
    solid.y = base
    system = Response(solid, BoneContacts(*NO_BONES, contact_bone=solid.owner)).system()
    found = (system[: base.size, : base.size] @ way.ravel()).reshape(base.shape)
    assert np.abs(found - wanted).max() < 1e-5 * np.abs(wanted).max()


def test_bar_answers_as_it_settles():
    solid = bar(iterations=300)
    settle(solid, shift(3.0))
    settle(solid, shift(6.0))
    contacts = BoneContacts(*NO_BONES, contact_bone=solid.owner)
    there = solid.respond(contacts, {}, {0: np.eye(4), 1: shift(6.5)})
    here = solid.carry()
    settle(solid, shift(6.5))
    # The shift is 8 % of the stretch so far, and the answer is of first order.
    assert np.abs(solid.carry() - there).max() < 0.02
    assert np.abs(there - here).max() == pytest.approx(0.5, abs=0.05)


def test_arms_are_the_derivatives_of_lengths():
    scene = phantom_scene(end=24.0, step=4.0)
    scene.muscles = [scene.muscle("abductor")]
    asked = {"model.inside": 150, "output.surfaces": False, "output.moment_arms": True}
    run = simulate(scene, settings=asked)
    arms = {}
    for row in run.metrics:
        if row.quantity == "moment_arm":
            arms.setdefault(row.coordinate, []).append(row.value)
    assert set(arms) == {"hip.flexion", "hip.adduction", "hip.internal_rotation"}
    length, arm = run.values("abductor", "length"), np.array(arms["hip.flexion"])
    step = np.radians(4.0)
    # Simpson's rule over six steps; the bones are touched on the way.
    change = -step / 3 * (arm[0] + 4 * arm[1::2].sum() + 2 * arm[2:-1:2].sum() + arm[-1])
    assert length[-1] - length[0] == pytest.approx(change, abs=0.02 * abs(change))
    plain = simulate(scene, settings={**asked, "output.moment_arms": False})
    for one, two in zip(plain.frames, run.frames):
        assert np.array_equal(one.carried["abductor"][0], two.carried["abductor"][0])
