"""Small scenes whose runs are compared with what is kept of them."""

import math

import numpy as np
import trimesh
from contraction_scenes import spindle_scene
from peers.detectors import VoxelDetector
from peers.serendipity import SerendipityField
from spindle_scene import CENTRE, build_scene
from toy_scene import held

import rbfmuscle as rm
from rbfmuscle.scene.objects import Attachment
from rbfmuscle.scene.options import ContactOptions, DetectOptions, SlidingOptions, TunnellingOptions

RBF = {"name": "rbf", "centres": 80, "samples": 300, "resolution": 20}
# Of an RBF fit's condition, and of how often a solver went round, last digits decide.
LEFT_OUT = ("condition", "sweeps")
# Powers of the muscle's size that quantities in these units are divided by.
POWERS = {"mm": 1, "mm^2": 2, "mm^3": 3}


def _phantom(muscles, model, *, end=20.0, step=10.0, **tables):
    """Some muscles of the embedded hip, coarse, so that a run takes a second."""
    scene = rm.phantom_scene(model=model, end=end, step=step, spacing=6.0)
    scene.muscles = [scene.muscle(name) for name in muscles]
    for name, table in tables.items():
        setattr(scene, name, table)
    return scene


def _contact(model):
    return _phantom(["extensor"], model, end=40.0, step=20.0)


def _bent(model):
    """A spindle is bent over a ball by 30 degrees to either side and pressed on it."""
    scene = build_scene().with_options({}, model=model)
    scene.muscles[0].mesh.apply_translation([0.7, -4.0, 0.3])
    if model == "xpbd":  # held by a third bone, too
        x, _, z = scene.muscles[0].mesh.vertices.T
        held_by_ball = np.flatnonzero((x > 5.0) & (abs(z - 25.0) < 4.0))
        scene.muscles[0].attachments.append(Attachment("ball", held_by_ball))
    for name, bone in (("bend", "upper"), ("other", "lower")):
        scene.add_joint(name, "ball", bone, CENTRE.tolist(), {"flexion": (1, 0, 0)})
    stops = [{}, {"bend.flexion": 30.0, "other.flexion": -30.0}]
    scene.set_motion(waypoints=stops, step=15.0)
    return scene


def _sliding(model):
    return _phantom(["adductor_anterior", "adductor_posterior"], model, sliding=SlidingOptions())


def _substeps(model):
    """One frame of 30 degrees, in sub-steps of 5, and points that pass through bone looked for."""
    return _phantom(
        ["abductor"],
        model,
        end=30.0,
        step=30.0,
        contact=ContactOptions(substep_angle=5.0),
        detect=DetectOptions(tunnelling=TunnellingOptions(action="rotate")),
    )


def _contraction(model):
    tendon = {"length": 100.0, "strain": 0.08}
    return spindle_scene(model=model, frames=2, spacing=6.0, activation=[0, 1], tendon=tendon)


def _tunnelling(model, **options):
    """A bag held at both ends is swung through a fixed plate of 6 mm, by 40 degrees in one
    sub-step.
    """
    bag = (
        trimesh.creation.icosphere(subdivisions=3)
        .apply_scale([25, 25, 120])
        .apply_translation([201, 0, 1])
    )
    bag.apply_transform(trimesh.transformations.rotation_matrix(math.radians(-21.0), [0.1, 0, 1]))
    scene = rm.Scene("plate", units="mm")
    scene.add_bone("plate", trimesh.creation.box((240, 6, 800)).apply_translation([200, 0, 0]))
    for name, height in (("upper", 0), ("lower", 100)):
        scene.add_bone(name, trimesh.creation.box((20, 20, 20)).apply_translation([600, 0, height]))
    scene.add_joint("hinge", "plate", "upper", (0, 0, 0), {"turn": (0, 0, 1)})
    scene.add_joint("second", "upper", "lower", (0, 0, 0), {"turn": (1, 0, 0)})
    z = bag.vertices[:, 2]
    scene.add_muscle("bag", bag, model=model, attach=held(upper=z > 100, lower=z < -100))
    scene.set_motion(ramp={"hinge.turn": {"to": 40.0, "step": 40.0}})
    scene.contact = ContactOptions(substep_angle=40.0)
    scene.detect = DetectOptions(tunnelling=TunnellingOptions(**options))
    return scene


# No RBF muscle is swung through a plate here: its shape then depends on rounding errors.
# `test_models_contract` asserts what holds for any shape.
SCENES = {
    "contact_rbf": lambda: _contact(RBF),
    "contact_rbf_marching": lambda: _contact({**RBF, "surface": "marching"}),
    "contact_rbf_fibres": lambda: _contact(
        {**RBF, "nodes": 120, "fibre_ratio": 4.0, "resolution": 0}
    ),
    "contact_pbd": lambda: _bent("pbd"),
    "contact_pbd_serendipity": lambda: _bent("pbd"),
    "contact_pbd_voxel": lambda: _bent("pbd"),
    "contact_pbd_paper": lambda: _bent("pbd-paper"),
    "contact_xpbd": lambda: _bent("xpbd"),
    "contact_arap_pbd": lambda: _bent("arap-pbd"),
    "contact_arap_volume": lambda: _bent("arap-volume"),
    "sliding_rbf": lambda: _sliding(RBF),
    "sliding_xpbd": lambda: _sliding("xpbd"),
    "substeps_rbf": lambda: _substeps(RBF),
    "substeps_arap_interleaved": lambda: _substeps("arap-interleaved"),
    "contraction_rbf": lambda: _contraction(RBF),
    "contraction_arap_volume": lambda: _contraction("arap-volume"),
    "tunnelling_arap_volume": lambda: _tunnelling("arap-volume", action="rotate"),
    "tunnelling_arap_volume_angle": lambda: _tunnelling(
        "arap-volume", action="report", swept=False
    ),
}


# Runs whose bones have other fields than `BoneSDF`.
FIELDS = {"contact_pbd_serendipity": SerendipityField, "contact_pbd_voxel": VoxelDetector}


def measure(name):
    """What is kept of a run, in shares of the muscle's longest side, its square and cube: one
    tolerance is for all.
    """
    scene, kind = SCENES[name](), FIELDS.get(name)
    fields = {bone.name: kind.from_mesh(bone.mesh) for bone in scene.bones} if kind else None
    run = rm.simulate(scene, fields=fields)
    found = {}
    for muscle in scene.muscles:
        low, high = muscle.mesh.bounds
        size, middle = float((high - low).max()), 0.5 * (low + high)
        frames = []
        for frame in run.frames:
            surface = frame.surfaces[muscle.name]
            shown = trimesh.Trimesh(
                (surface.vertices - middle) / size, surface.faces, process=False
            )
            moment, points = (
                shown.volume * shown.center_mass,
                (frame.carried[muscle.name][0] - middle) / size,
            )
            lines = [
                line.points / size
                for end, line in frame.tendons.items()
                if end.startswith(f"{muscle.name} ")
            ]
            facts = {
                "area": shown.area,
                "volume": shown.volume,
                "moment": moment,
                "points": points,
                "tendons": lines,
            }
            frames.append(
                facts
                | {"work": frame.work[muscle.name], "active": frame.activations.get(muscle.name)}
            )
        metrics = {}
        for row in run.metrics:
            if row.muscle == muscle.name and row.unit != "s" and row.quantity not in LEFT_OUT:
                value = row.value / size ** POWERS.get(row.unit, 0)
                metrics.setdefault(f"{row.quantity} {row.coordinate}", []).append(value)
        metrics = {name: np.array(values) for name, values in metrics.items()}
        events = [
            [e.frame, e.count, len(e.bone), len(e.action)]
            for e in run.events
            if e.muscle == muscle.name
        ]
        found[muscle.name] = {"frames": frames, "metrics": metrics, "events": events}
    pairs = [
        {"+".join(pair): value for pair, value in frame.neighbours.items()} for frame in run.frames
    ]
    return {**found, "neighbours": pairs, "poses": [frame.poses for frame in run.frames]}
