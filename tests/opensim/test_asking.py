"""What OpenSim is asked and what becomes of its answers, with a package of its name whose lengths are known."""

import os

import pytest

from rbfmuscle.opensim import beside
from rbfmuscle.opensim.beside import ask_opensim

# Joints as (name, coordinates), these as (name, shift?, follows?); a length is its base plus slopes times values.
PACKAGE = '''
"""Stands in for OpenSim: lengths are linear in the coordinates, so arms are minus the slopes."""
JOINTS = [("hip", [("angle", False, False)]), ("knee", [("angle", False, False), ("roll", False, True)]),
          ("cap", [("slide", True, False)])]
MUSCLES = {"long": (0.5, {"hip.angle": 0.1, "knee.angle": -0.02, "cap.slide": 0.7}), "short": (0.2, {})}
class Logger:
    @staticmethod
    def setLevelString(text): print("chatter of a library")
class Coordinate:
    Translational, Rotational = 2, 1
    def __init__(self, joint, name, shift, follows):
        self.full, self.name, self.shift, self.follows = f"{joint}.{name}", name, shift, follows
        self.value, self.locked, self.clamped = 0.25, False, True
    def getName(self): return self.name
    def getMotionType(self): return self.Translational if self.shift else self.Rotational
    def isDependent(self, state): return self.follows
    def setLocked(self, state, on): self.locked = on
    def setClamped(self, state, on): self.clamped = on
    def setValue(self, state, value, enforce):
        assert not self.locked and not self.clamped and not self.follows and not enforce
        self.value = value
class Joint:
    def __init__(self, name, rows): self.name, self.rows = name, [Coordinate(name, *row) for row in rows]
    def getName(self): return self.name
    def numCoordinates(self): return len(self.rows)
    def get_coordinates(self, k): return self.rows[k]
class List(list):
    def getSize(self): return len(self)
    def get(self, k): return self[k] if isinstance(k, int) else next(m for m in self if m.name == k)
    def getIndex(self, name): return next((k for k, m in enumerate(self) if m.name == name), -1)
class Muscle:
    def __init__(self, model, name): self.model, self.name = model, name
    def getLength(self, state):
        base, slopes = MUSCLES[self.name]
        assert self.model.assembled == self.model.realised
        return base + sum(slopes.get(c.full, 0.0) * c.value for c in self.model.all())
    def computeMomentArm(self, state, coordinate): return -MUSCLES[self.name][1].get(coordinate.full, 0.0)
class Model:
    def __init__(self, path):
        text = open(path).read()
        if "broken" in text: raise RuntimeError("cannot read\\n  this   model")
        if "deadly" in text: raise SystemExit("licence\\n\\nhas ended\\n")
        self.joints, self.assembled, self.realised = List(Joint(*j) for j in JOINTS), 0, 0
    def all(self): return [c for joint in self.joints for c in joint.rows]
    def initSystem(self): return "state"
    def getJointSet(self): return self.joints
    def getMuscles(self): return List(Muscle(self, name) for name in MUSCLES)
    def assemble(self, state):
        for c in self.all():
            if c.follows: c.value = 2.0 * self.joints[1].rows[0].value
        self.assembled += 1
    def realizeVelocity(self, state):
        assert not any(c.locked for c in self.all())
        self.realised += 1
'''


@pytest.fixture
def model(tmp_path, monkeypatch):
    """A model's file, with the package in reach of child processes."""
    (tmp_path / "packages" / "opensim").mkdir(parents=True)
    (tmp_path / "packages" / "opensim" / "__init__.py").write_text(PACKAGE)
    before = os.environ.get("PYTHONPATH", "")
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(filter(None, [str(tmp_path / "packages"), before])))
    monkeypatch.setattr(beside, "_installed", lambda: True)
    (tmp_path / "leg.osim").write_text("fine")
    return tmp_path / "leg.osim"


FRAMES = [{"hip.angle": 0.0, "cap.slide": 0.0}, {"hip.angle": 0.4, "cap.slide": 0.01, "knee.roll": 9.0}]


def ask(model, **more):
    job = {
        "units": "mm", "frames": FRAMES, "muscles": {"strap": ["long", "nobody"], "fan": ["short", "long"]},
        "wanted": {"strap": ["hip.angle", "cap.slide", "no.such"], "fan": []},
    }  # fmt: skip
    return ask_opensim(model, **job | more)


@pytest.mark.parametrize(("units", "metre"), [("m", 1.0), ("cm", 100.0), ("mm", 1000.0)])
def test_lengths_and_arms_come_in_the_scenes_unit_and_arms_about_shifts_have_none(model, units, metre):
    found, reason = ask(model, units=units)
    assert reason == ""
    assert {name: set(paths) for name, paths in found["paths"].items()} == {
        "strap": {"long"},
        "fan": {"short", "long"},
    }
    strap = found["paths"]["strap"]["long"]
    # The knee stays at its default, 0.25, which no frame names; what follows it is not set.
    lengths = [0.5 - 0.02 * 0.25, 0.5 + 0.1 * 0.4 + 0.7 * 0.01 - 0.02 * 0.25]
    assert strap["length"] == pytest.approx([metre * value for value in lengths])
    assert set(strap["arms"]) == {"hip.angle", "cap.slide"}
    assert strap["arms"]["hip.angle"] == pytest.approx([-0.1 * metre] * 2)
    assert strap["arms"]["cap.slide"] == pytest.approx([-0.7] * 2)
    assert found["paths"]["fan"]["short"] == {"length": pytest.approx([0.2 * metre] * 2), "arms": {}}
    assert found["notes"] == ["the model has no muscle 'nobody'"]


def test_coordinates_that_the_model_lacks_are_noted_once(model):
    found, _ = ask(
        model, frames=[{"toe.angle": 0.1}, {"toe.angle": 0.2, "arm.x": 0.0}], muscles={"fan": ["short"]}
    )
    assert found["notes"] == ["the model has no coordinate arm.x, toe.angle, so it does not follow it"]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("broken", "OpenSim refused leg.osim: cannot read this model"),
        ("deadly", "OpenSim ended with code 1: has ended"),
    ],
)
def test_what_ends_opensim_is_told_in_one_line(model, text, words):
    model.write_text(text)
    assert ask(model) == ({}, words)


def test_model_that_is_gone_and_missing_opensim_are_told(model, monkeypatch):
    model.unlink()
    assert ask(model) == ({}, f"the model {model} is not there any more")
    monkeypatch.setattr(beside, "_installed", lambda: False)
    assert ask(model) == ({}, beside.INSTALL)


def test_time_is_bounded(model, monkeypatch):
    monkeypatch.setattr(beside, "_TIMEOUT", 0.01)
    assert ask(model) == ({}, "OpenSim took longer than 0.01 s and was stopped")
