"""Memory and time that a scene will take, from counts of its work and the measured speed of this machine.

Counts of work (how many visits a surface vertex costs, say) are properties of the code, fitted to runs of the real
and of the embedded hip; what has changed since is one factor for each model and part (`scales`), which
``benchmarks/plan_check.py --remake`` measures. Seconds come from `rbfmuscle.sim.plan.rates`, measured when the
forecast is made.
"""

from __future__ import annotations

import heapq
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from rbfmuscle.geometry.arrays import Floats
from rbfmuscle.sim.distance.build import CUT, OUTER, grid_shape
from rbfmuscle.sim.distance.cells import BLOCK
from rbfmuscle.sim.distance.sdf import BAND, CELL_SHARE, LEAST_CELLS, BoneSDF
from rbfmuscle.sim.plan.processes import HELPER_MEMORY, helpers_for
from rbfmuscle.sim.plan.rates import scales
from rbfmuscle.sim.scene.motion import bone_poses

if TYPE_CHECKING:
    import trimesh

    from rbfmuscle.sim.scene.scene import Scene


# Work: exact distances for a fine cell; visits for a vertex that is written, that a centreline hangs on, of a bone
# (for each muscle) and of a shown surface that are measured; exact distances for a bone's vertex while it is
# looked for bones that the motion drives into each other.
CELL_QUERIES = 2.3
WRITE_VISITS = 1600
LINE_VISITS = 49_000
BONE_VISITS = 370
SHOWN_QUERIES = 2.2
CHECK_QUERIES = 41
# Bytes: a triangle and a vertex of a bone's field, the lists of a fine cell; a bone's triangle in the metrics.
FIELD_TRIANGLE, FIELD_VERTEX, CELL_LISTS = 124, 12, 11.3
PROBE_TRIANGLE = 1050
# A field takes this much more while it is read from disk, or made.
READ_SPARE, BUILD_SPARE = 0.35, 1.5
# Visits for a byte that is read from the cache on disk.
READ_VISITS = 1.7
# What a run with a report loads beyond a plan [bytes].
REPORT_LIBRARIES = 25e6
# Muscles that run side by side wait for memory and for the interpreter.
CROWDED = 1.08
# Points at which the share of cut blocks is sampled.
SAMPLES = 4000


@dataclass(frozen=True)
class MuscleCost:
    """What one muscle takes.

    Attributes
    ----------
    build : float
        Time to build it [s].
    step : float
        One sub-step: prediction, solution, search for tunnelling [s].
    show : float
        Surface of a written frame [s].
    memory : float
        Kept through the run [bytes].
    working : float
        More while a frame is made [bytes].
    carried, shown : int
        Vertices of the carried mesh and of the surface.
    points : str
        How many points carry it, and why so many.
    """

    build: float
    step: float
    show: float
    memory: float
    working: float
    carried: int
    shown: int
    points: str = ""

    def scaled(self, *, build: float, motion: float) -> MuscleCost:
        """The same with other times to build it and to move it."""
        return replace(self, build=build * self.build, step=motion * self.step, show=motion * self.show)


@dataclass(frozen=True)
class FieldCost:
    """What one bone's distance field takes: fine cells, bytes, and whether it only has to be read from disk."""

    cells: float
    memory: float
    kept: bool


def estimate_field(mesh: trimesh.Trimesh, box: Floats, tolerance: float | None = None) -> Any:
    """What the field of a bone within a box takes.

    Parameters
    ----------
    mesh : trimesh.Trimesh
    box : (2, 3) ndarray
        Bone coordinates.
    tolerance : float, optional
        The scene's own.

    Returns
    -------
    FieldCost

    Notes
    -----
    Blocks whose centre is nearer to the surface than the outer band and half a diagonal are cut; their share is
    sampled. The spacing is the first that is tried: a tolerance of the scene's own may need a finer one.
    """
    from scipy.spatial import cKDTree

    vertices = np.asarray(mesh.vertices, dtype=float)
    corners = vertices[mesh.faces]
    edge = float(np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).mean())
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    spacing = min(CELL_SHARE * edge, float((high - low).max()) / LEAST_CELLS)
    block, band = BLOCK * spacing, BAND * spacing
    reach = band + OUTER * spacing + 0.5 * np.sqrt(3.0) * block
    start, end = np.maximum(box[0], low - reach), np.minimum(box[1], high + reach)
    centres = np.random.default_rng(0).uniform(start, end, (SAMPLES, 3))
    near = cKDTree(corners.mean(axis=1)).query(centres, distance_upper_bound=reach + 0.5 * edge)[0]
    # A block counts where any of it is in the box, so the box is half a block larger on each side.
    blocks = np.mean(near < reach) * np.prod((end - start) / block + 1.0)
    table = 4.0 * np.prod(BLOCK * grid_shape(low, high, spacing, band).astype(float))
    triangles = FIELD_TRIANGLE * len(corners) + FIELD_VERTEX * len(vertices)
    memory = table + blocks * CUT * (4.0 + CELL_LISTS) + triangles
    kept = BoneSDF.is_kept(mesh, tolerance=tolerance, region=box)
    return FieldCost(float(blocks * CUT), float(memory), kept)


def side_by_side(times: Any, threads: Any) -> Any:
    """Wall time of tasks that are taken in order by the first free thread [s]."""
    free = [0.0] * max(1, min(threads, len(times)))
    for time in times:
        heapq.heapreplace(free, free[0] + time)
    return max(free) * (CROWDED if len(free) > 1 else 1.0)


def forecast(
    scene: Scene,
    fields: list[Any],
    costs: list[Any],
    *,
    work: list[Any],
    rates: dict[str, Any],
    resident: float,
    threads: int,
) -> Any:
    """Memory and time of a run.

    Parameters
    ----------
    scene : Scene
    fields : list of FieldCost
        Of the bones that are reached.
    costs : list of MuscleCost
    work : list of dict
        What the motion asks of each muscle, from `plan_work`.
    rates : dict of str to float
        From `measure_rates`.
    resident : float
        Memory of this process [bytes].
    threads : int

    Returns
    -------
    memory, time : dict
        Bytes and seconds; ``peak`` of the memory in one process, ``together`` in that many ``helpers``.
    """
    return _memory(scene, fields, costs, resident, threads), _time(scene, fields, costs, work, rates, threads)


def _memory(scene, fields, costs, resident, threads):
    triangles = sum(len(bone.mesh.faces) for bone in scene.bones)
    parts = {
        "fields": sum(field.memory for field in fields),
        "muscles": sum(cost.memory for cost in costs),
        "metrics": PROBE_TRIANGLE * triangles if scene.output.metrics else 0.0,
    }
    parts["total"] = sum(parts.values())
    program = resident + (REPORT_LIBRARIES if scene.output.report else 0.0)
    working = sum(cost.working for cost in costs)
    working += sum((READ_SPARE if field.kept else BUILD_SPARE) * field.memory for field in fields)
    peak = parts["total"] + working + program
    helpers = max(helpers_for(scene, threads), 1)
    together = peak + (helpers * HELPER_MEMORY if helpers > 1 else 0.0)
    return {**parts, "program": program, "peak": peak, "helpers": helpers, "together": together}


def _time(scene, fields, costs, work, rates, threads):
    frames, output = max(len(scene.motion), 1), scene.output
    shows = bool(output.surfaces) or output.metrics
    visit, query, scale = rates["visit"], rates["query"], scales()
    bones = sum(len(bone.mesh.vertices) for bone in scene.bones)
    shown = sum(cost.shown for cost in costs)
    moving = _moving_vertices(scene)
    build = {
        "muscles": sum(cost.build for cost in costs),
        "fields": sum(
            visit * READ_VISITS * field.memory if field.kept else query * CELL_QUERIES * field.cells / threads
            for field in fields
        ),
        "checks": scale["checks"] * query * CHECK_QUERIES * bones if moving else 0.0,
        "metrics": scale["lines"] * visit * LINE_VISITS * sum(cost.carried for cost in costs)
        if output.metrics
        else 0.0,
    }
    # A muscle is drawn where it was solved, and once for the first frame.
    each = [
        (cost.step * done["substeps"] + (cost.show * min(frames, done["solved"] + 1) if shows else 0.0))
        / frames
        for cost, done in zip(costs, work)
    ]
    frame = {
        "muscles": side_by_side(each, threads),
        "metrics": scale["metrics"]
        * (visit * BONE_VISITS * bones * len(costs) + query * SHOWN_QUERIES * shown)
        if output.metrics
        else 0.0,
        "write": scale["write"] * visit * WRITE_VISITS * (shown + moving) if output.surfaces else 0.0,
    }
    build["total"], frame["total"] = sum(build.values()), sum(frame.values())
    motion = frames * frame["total"]
    return {"build": build, "frame": frame, "motion": motion, "total": build["total"] + motion}


def _moving_vertices(scene):
    """Vertices of the bones that the motion moves."""
    still = bone_poses(scene, {})
    moved = [bone_poses(scene, frame) for frame in scene.motion.frames[:: max(1, len(scene.motion) - 1)]]
    return sum(
        len(bone.mesh.vertices)
        for bone in scene.bones
        if any(not np.allclose(poses[bone.name], still[bone.name]) for poses in moved)
    )
