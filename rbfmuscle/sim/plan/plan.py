"""What a scene will build and do, found without building it."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from rbfmuscle.sim.plan.ahead import describe, look_ahead
from rbfmuscle.sim.plan.reach import reached_bones, sampled_poses, union_of
from rbfmuscle.sim.plan.work import plan_work

if TYPE_CHECKING:
    from rbfmuscle.sim.scene.scene import Scene


def plan_scene(scene: Scene, estimate: Callable[..., Any] | None = None) -> dict[str, Any]:
    """Return what a run of the scene would build.

    Parameters
    ----------
    scene : Scene
    estimate : callable, optional
        ``estimate(muscle, scene, rates)`` gives a muscle's `MuscleCost`. With it memory [bytes] and time [s]
        are foretold, for this machine as it is now: a tenth of a second of measurements.

    Returns
    -------
    dict
        ``pairs``: muscles and bones that can meet. ``fields``: for each bone that any muscle can reach the
        size of the reached box [scene unit] and its share of the bone's own box. ``muscles``: model and size
        of the input, and its ``work``, see `plan_work`. ``frames`` of the motion; ``substeps`` of the muscle that
        takes most. ``ahead``: what the motion asks of held ends that no muscle can give. ``features``: what the
        scene switches on. With
        ``estimate`` also ``memory``, ``time`` and ``rates``, see `rbfmuscle.sim.plan.forecast`.

    Notes
    -----
    Boxes are those that the run itself takes: a muscle's box carried by the bones that it is attached to, so
    a pair may be listed that does not come to touch; a pair that is not listed costs nothing.
    """
    regions = reached_bones(scene)
    output = scene.output
    work = plan_work(
        scene,
        {muscle.name: [bone for name, bone in regions if name == muscle.name] for muscle in scene.muscles},
    )
    made = {
        "units": scene.units,
        "pairs": [{"muscle": muscle, "bone": bone} for muscle, bone in regions],
        "fields": _fields(scene, regions),
        "muscles": [
            {
                "name": muscle.name,
                "model": muscle.model,
                "vertices": len(muscle.mesh.vertices),
                "settings": dict(muscle.options),
                "work": work[muscle.name],
            }
            for muscle in scene.muscles
        ],
        "frames": len(scene.motion),
        "substeps": max((done["substeps"] for done in work.values()), default=0),
        "poses_sampled": len(sampled_poses(scene)),
        "ahead": _ahead(scene),
        "features": {
            "sliding": scene.sliding is not None and len(scene.muscles) > 1,
            "tunnelling": scene.detect is not None and scene.detect.tunnelling is not None,
            "metrics": bool(output.metrics),
            "surfaces": bool(output.surfaces),
            "report": bool(output.report),
            "preview": bool(output.preview),
        },
    }
    return made if estimate is None else {**made, **_forecast(scene, made, regions, estimate)}


def _ahead(scene):
    driven, stretched = look_ahead(scene)
    said = describe((driven, stretched), scene.units)
    return {
        "driven": [one._asdict() for one in driven],
        "stretched": [one._asdict() for one in stretched],
        "messages": [str(one) for one in said],
    }


def _forecast(scene, made, regions, estimate):
    """Memory and time; those of each field and muscle are written into ``made``."""
    import numba

    from rbfmuscle.sim.plan.forecast import estimate_field, forecast
    from rbfmuscle.sim.plan.rates import measure_rates, resident_memory

    rates = measure_rates()
    costs = [estimate(muscle, scene, rates) for muscle in scene.muscles]
    for muscle, cost in zip(made["muscles"], costs):
        muscle.update(
            memory=cost.memory, build=cost.build, step=cost.step, show=cost.show, points=cost.points
        )
    fields = []
    meshes = {bone.name: bone.mesh for bone in scene.bones}
    for field in made["fields"]:
        boxes = [box for (_, name), box in regions.items() if name == field["bone"]]
        cost = estimate_field(meshes[field["bone"]], union_of(boxes), scene.contact.tolerance)
        field.update(cells=cost.cells, memory=cost.memory, kept=cost.kept)
        fields.append(cost)
    memory, time = forecast(
        scene, fields, costs, work=[muscle["work"] for muscle in made["muscles"]], rates=rates,
        resident=resident_memory(), threads=numba.get_num_threads(),
    )  # fmt: skip
    return {"memory": memory, "time": time, "rates": rates}


def _fields(scene, regions):
    fields = []
    for bone in scene.bones:
        boxes = [box for (_, name), box in regions.items() if name == bone.name]
        if not boxes:
            continue
        own = np.asarray(bone.mesh.bounds, dtype=float)
        low = np.maximum(np.min([box[0] for box in boxes], axis=0), own[0])
        high = np.minimum(np.max([box[1] for box in boxes], axis=0), own[1])
        fields.append(
            {
                "bone": bone.name,
                "triangles": len(bone.mesh.faces),
                "size": (high - low).tolist(),
                "share": float(np.prod(high - low) / np.prod(own[1] - own[0])),
            }
        )
    return fields
