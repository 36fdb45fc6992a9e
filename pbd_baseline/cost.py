"""Memory and time that a mesh muscle will take, from its mesh and settings."""

from collections.abc import Mapping

from pbd_baseline.options import PBDOptions
from pbd_baseline.rest import weights_are_cached
from pbd_baseline.shapes import METHODS, sweeps
from rbfmuscle.sim.plan.forecast import MuscleCost
from rbfmuscle.sim.scene.objects import Muscle
from rbfmuscle.sim.scene.scene import Scene

# Of the contacts and the volume after the last sweep: calls, and visits for a vertex.
FINISH_CALLS, FINISH_VISITS = 1000, 870
# Of a muscle kept sound besides: calls, and visits for a vertex.
SOUND_CALLS, SOUND_VISITS = 3000, 5000
# A sub-step besides: calls, and visits for a contact point in the search for tunnelling.
PREDICT_CALLS, CROSSING_VISITS = 1100, 200
# To build: visits for a vertex, and for its weights between the bones where these are not on disk.
VERTEX_VISITS, WEIGHT_VISITS = 9500, 105_000
# A surface: visits for a vertex, which is only copied.
SHOW_VISITS = 30
# Bytes for a vertex with its edges, faces and constraints; more where a factor is kept; while a frame is made.
VERTEX_BYTES, FACTOR_BYTES, WORKING_BYTES = 700, 450, 200
# Contact points for a vertex of a closed mesh: with the middles of edges and faces 1 + 3 + 2.
POINTS = {"vertices": 1, "faces": 6}


def estimate_muscle(
    muscle: Muscle, scene: Scene, rates: Mapping[str, float], options: PBDOptions
) -> MuscleCost:
    """What a mesh muscle with these options takes, as `rbfmuscle.models.estimate_model` says it."""
    count, call, visit = len(muscle.mesh.vertices), rates["call"], rates["visit"]
    method, rounds = METHODS[options.method], sweeps(options)
    search = CROSSING_VISITS * POINTS[options.contact] * count if scene.detect is not None else 0
    weights = 0 if weights_are_cached(muscle, options.swelling_reach) else WEIGHT_VISITS
    sound = (SOUND_CALLS, SOUND_VISITS) if options.sound else (0, 0)
    factor = FACTOR_BYTES if method.factored else 0
    return MuscleCost(
        build=visit * count * (VERTEX_VISITS + weights),
        step=call * (PREDICT_CALLS + FINISH_CALLS + sound[0] + rounds * method.calls)
        + visit * (count * (FINISH_VISITS + sound[1] + rounds * method.visits) + search),
        show=visit * SHOW_VISITS * count,
        memory=count * (VERTEX_BYTES + factor),
        working=WORKING_BYTES * count,
        carried=count,
        shown=count,
    )
