"""The surface of an RBF muscle in one frame: compiled functions of constants, state and nodes.

The vertices are brought onto the level set that has the muscle's volume at rest (`level_set.py`),
out of bones and of each other (`surface_limits.py`). The volume is a cubic polynomial of a change
of the level, and is met by Newton steps.

The search starts from where the solid carries the vertex, moved along the normal there by the
height above it that the vertex had in the last frame.
"""

import numpy as np

from rbfmuscle.geometry.crossing import crossing_loop, no_boxes
from rbfmuscle.geometry.surfaces import _vertex_normal_loop, volume_cubic, volume_rate
from rbfmuscle.jit import compiled
from rbfmuscle.muscle.bone_distances import ask_bones
from rbfmuscle.muscle.level_set import (
    CROSSED,
    FARTHEST,
    FITTED,
    LEVELS,
    NO_FIT,
    NO_VOLUME,
    reach_level,
    shift,
)
from rbfmuscle.muscle.model import carry
from rbfmuscle.muscle.surface_limits import (
    Work,
    lift,
    mark_near,
    push_off,
    touching,
    untangle,
)

# Lengths below are in mean edges of the mesh at rest.
NEAR_BONE = 1.5  # what is within this of a bone may come to lie on it
SAME = 0.02  # what moved less than this by a bone need not be asked for anew
SUNK = 1.0  # deeper in a bone the material is sunk
LAMELLA = 0.02  # where both sides of a muscle sink into a bone, the far one stays above it by this
BLOWN = 1e-3  # a step of less of the material blown up to its volume, whose last digit follows
# Rounds, at most.
CUBIC = 4
MEET = 4
# Bones, crossings and volume are met up to so many times, as the way back to the volume can make
# triangles cross.
AGAIN = 4


@compiled
def start_surface(model, state, obstacles, nodes, fit, fitted):
    """The vertices on the level set at the volume, or where the material is if that cannot be;
    and how it ended.

    ``fit`` holds the `Terms` of the field and the kernel's form, and counts where ``fitted``.
    """
    work = _begin(model, state, obstacles, carry(model.embedding, nodes))
    outcome = NO_FIT
    if fitted:
        outcome = reach_level(model, state, obstacles, fit, work)
        if outcome == FITTED:
            # Those after crossings are undone would make every other frame cross anew.
            _keep_heights(state, work)
    if outcome != FITTED and not _embed(model, state, obstacles, work):
        outcome = NO_VOLUME
    return work, outcome


@compiled
def finish_surface(model, state, obstacles, work, outcome, excess):
    """Room made for neighbours, bone vertices pushed off, crossings undone and the volume met.

    ``excess`` (n,) says how far vertices move inwards, (0,) for none. Returns the triangles that
    cross all the same, and the outcome: where a fitted surface crosses itself it is that without a
    field, everywhere if that has fewer faults still or the fitted one has not the volume.
    """
    none, crossing = np.zeros((0, 3)), -1
    if outcome == FITTED:
        crossing = _finish(model, state, obstacles, work, excess, none, False)
        if crossing == 0:
            return 0, outcome
    fitted, left = work.vertices.copy(), work.left.copy()
    direction = work.direction.copy()
    other = -1
    if _embed(model, state, obstacles, work):
        other = _finish(model, state, obstacles, work, excess, none, True)
    if crossing > 0 and other == 0:
        sound = work.vertices.copy()
        work.vertices[:], work.left[:] = fitted, left
        work.direction[:] = direction
        if _finish(model, state, obstacles, work, np.zeros(0), sound, False) == 0:
            return 0, outcome
        work.vertices[:], work.left[:] = sound, True
    elif crossing >= 0 and (other < 0 or other >= crossing):
        work.vertices[:], work.left[:] = fitted, left
        return crossing, outcome
    return other, (NO_VOLUME if other < 0 else (CROSSED if outcome == FITTED else outcome))


@compiled
def clear_rest(model, state, obstacles, vertices, held):
    """Bring vertices (n, 3) at rest that a bone holds, marked by ``held`` (n,), out of the bones,
    without crossings.

    The bone takes them along, so they are out of it in all frames.
    """
    work = _begin(model, state, obstacles, vertices)
    work.near[:] = work.near & held
    if not lift(obstacles, state, work, np.flatnonzero(work.near)):
        return vertices
    everywhere = np.ones(len(model.faces), np.bool_)
    untangle(model, state, obstacles, work, True, np.zeros((0, 3)), everywhere, True)
    return work.vertices


@compiled
def _begin(model, state, obstacles, carried):
    """The vertices where the solid carries them, moved by the last heights, and the bones there."""
    n, edge = len(model.offset), model.edge
    normals, flags = np.zeros((n, 3)), np.zeros((4, n), np.bool_)
    _vertex_normal_loop(carried, model.faces, normals)
    work = Work(
        carried,
        normals,
        carried.copy(),
        np.zeros((n, 3)),
        flags[0],
        np.empty(n),
        np.zeros(n),
        np.ones(n, np.bool_),
        flags[1],
        flags[2],
        edge,
    )
    rows = np.arange(n)
    limit = np.full(n, NEAR_BONE * edge)
    outward = np.empty((n, 3))
    ask_bones(obstacles, state, carried, rows, limit, SAME * edge, work.least, outward)
    for v in range(n):
        along = 0.0
        height = min(max(state.height[v], -FARTHEST * edge), FARTHEST * edge)
        for a in range(3):
            along += normals[v, a] * outward[v, a]
            work.vertices[v, a] += height * normals[v, a]
        if work.least[v] < limit[v]:
            work.near[v] = True
            work.odd[v] = work.least[v] < -SUNK * edge
            # Of what sinks into a bone, what looks away from it keeps off the rest.
            work.clearance[v] = LAMELLA * edge if along > 0.0 else 0.0
    return work


@compiled
def _level_step(model, work):
    """Change of the level that brings the mesh to its volume, by Newton steps; NaN where no level
    does.
    """
    c0, c1, c2, c3 = volume_cubic(work.vertices, model.faces, work.direction)
    change = 0.0
    for _ in range(CUBIC):
        lack = model.volume - (c0 + change * (c1 + change * (c2 + change * c3)))
        if lack == 0.0:
            break
        rate = c1 + change * (2.0 * c2 + change * 3.0 * c3)
        if not rate > 0.0:
            return np.nan
        change += lack / rate
    return change


@compiled
def _embed(model, state, obstacles, work):
    """The material out of the bones, blown up along its normals to the volume: the surface without
    a field. False where no such surface has the volume.
    """
    work.vertices[:] = work.carried
    work.left[:] = True
    near, most = np.flatnonzero(work.near), 0.5 * work.edge
    lift(obstacles, state, work, near)
    for _ in range(LEVELS):
        _take_normals(model, work)
        volume, rate = volume_rate(work.vertices, model.faces, work.direction)
        if not rate > 0.0:
            return False
        step = min(max((model.volume - volume) / rate, -most), most)
        shift(work, step)
        lift(obstacles, state, work, near)
        if abs(step) < BLOWN * work.edge:
            break
    return True


@compiled
def _take_normals(model, work):
    """Let vertices move along their normals when the level changes."""
    work.direction[:] = 0.0
    _vertex_normal_loop(work.vertices, model.faces, work.direction)


@compiled
def _give_room(model, state, obstacles, work, excess):
    """Move vertices inwards by their excess (n,) over neighbours, where they stay."""
    normals = np.zeros_like(work.vertices)
    _vertex_normal_loop(work.vertices, model.faces, normals)
    for v in range(len(excess)):
        if excess[v] > 0.0:
            work.odd[v] = True
            for a in range(3):
                work.vertices[v, a] -= excess[v] * normals[v, a]
                work.direction[v, a] = 0.0
    lift(obstacles, state, work, np.flatnonzero((excess > 0.0) & work.near))


@compiled
def _finish(model, state, obstacles, work, excess, sound, embedded):
    """`finish_surface` of a surface with a field, which goes back to a ``sound`` one where it
    crosses itself, or without a field; -1 where it has not the volume.
    """
    if len(excess) > 0:
        _give_room(model, state, obstacles, work, excess)
    push_off(model, state, obstacles, work, np.ones(len(work.vertices), np.bool_))
    # The material may have met itself anywhere.
    asked = np.ones(len(model.faces), np.bool_)
    for turn in range(AGAIN):
        if not _fill(model, state, obstacles, work, embedded):
            return -1
        if not embedded:
            touching(model.faces, work.odd | work.left, asked)
        elif turn > 0:
            touching(model.faces, work.odd, asked)
        moved = untangle(model, state, obstacles, work, embedded, sound, asked, turn == 0)
        if not moved.any():
            return 0
        # What was smoothed may lie over a bone's vertex again.
        push_off(model, state, obstacles, work, moved)
    if not _fill(model, state, obstacles, work, embedded):
        return -1
    found = np.zeros(len(model.faces), np.bool_)
    boxes = no_boxes(model.tree)
    return crossing_loop(work.vertices, model.tree, ~found, True, boxes, found.copy())


@compiled
def _fill(model, state, obstacles, work, embedded):
    """The volume to the last digit; what its last step drove into a bone is brought out and stays
    there. False where no level has the volume.
    """
    mark_near(work, np.arange(len(work.near)))
    near = np.flatnonzero(work.near)
    if embedded:
        # What was smoothed stays put otherwise, and that may be all of it.
        _take_normals(model, work)
        lift(obstacles, state, work, near)
    for turn in range(MEET + 1):
        step = _level_step(model, work)
        if np.isnan(step):
            return False
        if not embedded:
            state.level[0] += step
        shift(work, step)
        if turn == MEET or not lift(obstacles, state, work, near):
            break
    return True


@compiled
def _keep_heights(state, work):
    """Heights of the vertices above the carried material, for the next frame."""
    for v in range(len(work.normals)):
        height = 0.0
        for a in range(3):
            height += work.normals[v, a] * (work.vertices[v, a] - work.carried[v, a])
        state.height[v] = height
