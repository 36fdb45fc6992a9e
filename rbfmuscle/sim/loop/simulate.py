"""The frame loop: any muscle model against any bones, and what a model must offer to be run by it."""

import itertools
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor, wait
from dataclasses import dataclass, field
from typing import Any, Protocol

import numba
import numpy as np

from rbfmuscle.sim.loop.contact import BoneContacts
from rbfmuscle.sim.loop.lane import Event, Lane
from rbfmuscle.sim.loop.overlap import settle_rest
from rbfmuscle.sim.plan.reach import Pace, build_fields, reached_bones
from rbfmuscle.sim.scene.motion import bone_poses

__all__ = ["Event", "Frame", "ModelSurface", "MuscleModel", "simulate_frames"]


@dataclass(frozen=True)
class ModelSurface:
    """A closed, outward surface and what the model knows about it.

    Attributes
    ----------
    vertices : (n, 3) ndarray
    faces : (m, 3) ndarray of int
    quantities : dict of str to float
        For example ``solver_penetration_max``, ``condition``, ``time_fit``, ``time_extract``.
    """

    vertices: np.ndarray
    faces: np.ndarray
    quantities: dict = field(default_factory=dict)


@dataclass
class Frame:
    """One written frame.

    Attributes
    ----------
    index : int
        Place in the scene's motion.
    coordinates : dict of str to float
        [radian].
    poses : dict of str to (4, 4) ndarray
    surfaces : dict of str to ModelSurface
        Empty where no surfaces were asked for.
    carried : dict of str to (vertices, faces)
        Material surfaces of constant topology.
    events : list of Event
        Since the frame written before.
    times : dict of str to dict
        For each muscle ``time_predict``, ``time_solve``, ... and their sum ``time_frame`` [s], since the
        frame before.
    wall : float
        Time for all muscles together [s], since the frame before. Where the next frame is solved while this one
        is drawn, both are in it; over a motion the sum is what counts.
    fibres : dict of str to FibreLines
        Empty where no fibres were asked for.
    """

    index: int
    coordinates: dict
    poses: dict
    surfaces: dict
    carried: dict
    events: list
    times: dict
    wall: float
    fibres: dict = field(default_factory=dict)


class MuscleModel(Protocol):
    """What the loop asks of a muscle.

    Attributes
    ----------
    name : str
        The muscle's name.
    contact_bone : (n,) ndarray of int
        Index of the bone that a contact point is attached to, -1 where it is free.
    """

    name: str
    contact_bone: np.ndarray

    def contact_points(self) -> np.ndarray:
        """Points (n, 3) that contacts act on, now; number and order never change."""

    def predict(self, before: Mapping[str, np.ndarray], after: Mapping[str, np.ndarray]) -> None:
        """Go along with the bones from one set of poses to the next."""

    def solve(self, contacts: BoneContacts) -> None:
        """Settle under the model's own constraints and these contacts."""

    def turn(self, which: np.ndarray, transform: np.ndarray) -> None:
        """Move the contact points marked in a bool mask (n,) by a (4, 4) transform."""

    def snapshot(self) -> Any:
        """Everything that :meth:`restore` needs to go back to this moment."""

    def restore(self, state: Any) -> None:
        """Go back to a snapshot; it can be used again."""

    def carried_mesh(self) -> tuple:
        """Vertices and faces of a surface that moves with the material, of constant topology."""

    def drawing(self, contacts: BoneContacts) -> Callable[[], ModelSurface]:
        """What makes the surface of this moment, closed and outward; called once, while the model goes on."""


class _Crew:
    """Runs what can go side by side, each with one thread.

    Parameters
    ----------
    lanes : int
    tasks : int
        Things that are done at a time; more than lanes where one frame is drawn while the next is solved.
    """

    def __init__(self, lanes, tasks):
        from threadpoolctl import ThreadpoolController

        self.blas = ThreadpoolController()
        threads = numba.get_num_threads()
        workers = min(tasks, threads)
        self.pool = None
        if workers > 1:
            # A muscle that is alone draws with every thread that its solver leaves free.
            each = 1 if lanes > 1 else threads
            self.pool = ThreadPoolExecutor(workers, initializer=numba.set_num_threads, initargs=(each,))

    def one_thread_each(self):
        """Context in which BLAS uses one thread: its workers spin, and take the cores from the loops."""
        return self.blas.limit(limits=1, user_api="blas")

    def all_threads(self):
        """Context for work of large matrices: a muscle that is alone takes every thread."""
        return self.blas.limit(limits=1 if self.pool else numba.get_num_threads(), user_api="blas")

    def each(self, act, items):
        """``[act(item) for item in items]``, in parallel where that pays."""
        if self.pool is None or len(items) < 2:
            return [act(item) for item in items]
        return list(self.pool.map(act, items))

    def close(self):
        if self.pool is not None:
            self.pool.shutdown(wait=True, cancel_futures=True)


def simulate_frames(
    scene, models, *, surfaces=True, written=None, fields=None, ahead=True
) -> Iterator[Frame]:
    """Run models through a scene's motion, from the rest pose on, and yield its frames one by one.

    Whatever ends it early (an interrupt, a ``SolveError``), the frames yielded so far stand.

    Parameters
    ----------
    scene : Scene
    models : list of MuscleModel, or dict of str to MuscleModel
        In their rest state.
    surfaces : bool
        Whether frames carry surfaces; without, none is extracted.
    written : collection of int, optional
        Indices of the frames to yield; all where not given. The others are simulated and not shown.
    fields : dict of str to BoneSDF, optional
        Distance fields of the bones; built for the bones that muscles can reach where not given.
    ahead : bool
        Solve a frame while the one before is drawn, where there are threads for both. Models are then a frame
        ahead of what was yielded. Without, no frame is asked of the motion before it is wanted.

    Raises
    ------
    SolveError
        If a muscle cannot be solved, naming muscle, frame and coordinates.
    SceneError
        If muscles overlap bones at rest and the scene's ``initial`` is ``"error"``.
    """
    models = list(models.values()) if isinstance(models, Mapping) else list(models)
    lanes = [
        Lane(model, contacts, scene) for model, contacts in zip(models, _obstacles(scene, models, fields))
    ]
    ahead = ahead and surfaces and scene.sliding is None
    crew = _Crew(len(lanes), 2 * len(lanes) if ahead else len(lanes))
    try:
        yield from _run(scene, lanes, crew, surfaces, written, ahead)
    finally:
        crew.close()


def _obstacles(scene, models, fields):
    """One BoneContacts for each model, with fields of the bones that it can reach."""
    regions = reached_bones(scene) if fields is None else None
    built = build_fields(scene, regions) if fields is None else fields
    names, margin = [bone.name for bone in scene.bones], scene.contact.margin
    for model in models:
        reached = [built.get(n) if regions is None or (model.name, n) in regions else None for n in names]
        yield BoneContacts(names, reached, contact_bone=model.contact_bone, margin=margin)


def _run(scene, lanes, crew, surfaces, written, ahead):
    here = dict.fromkeys(scene.motion.frames[0], 0.0) if scene.motion.frames else {}
    start = time.perf_counter()
    with crew.one_thread_each():
        crew.each(lambda lane: settle_rest(lane, here), lanes)
        sliding = _sliding(scene, lanes)
    wall = time.perf_counter() - start
    if ahead and crew.pool is not None:
        yield from _run_ahead(scene, lanes, crew, written, here, wall)
    else:
        yield from _run_in_turn(scene, lanes, crew, sliding, surfaces, written, here, wall)


def _run_ahead(scene, lanes, crew, written, here, wall):
    """Each frame is solved while the one before is drawn, so that no thread waits for another muscle."""
    pace, frame, draws = Pace(scene), None, []
    for index, coordinates in enumerate(scene.motion.frames):
        start = time.perf_counter()
        show = written is None or index in written
        stops = [here, *pace.split(here, coordinates)]
        with crew.one_thread_each():
            going = [crew.pool.submit(_go_alone, lane, index, stops, show) for lane in lanes]
            skins = list(crew.pool.map(_call, draws if frame is not None else []))
            wait(going)
        wall += time.perf_counter() - start
        if frame is not None:
            yield _drawn(frame, skins, wall)
            frame, wall = None, 0.0
        draws = [done.result() for done in going]
        frame = _frame(scene, lanes, index, coordinates) if show else None
        here = coordinates
    if frame is not None:
        start = time.perf_counter()
        with crew.one_thread_each():
            skins = list(crew.pool.map(_call, draws))
        yield _drawn(frame, skins, wall + time.perf_counter() - start)


def _run_in_turn(scene, lanes, crew, sliding, surfaces, written, here, wall):
    """Each frame is solved and drawn before the next one is looked at."""
    pace = Pace(scene)
    for index, coordinates in enumerate(scene.motion.frames):
        start = time.perf_counter()
        shown = written is None or index in written
        stops = [here, *pace.split(here, coordinates)]
        show = shown and surfaces
        if show and sliding is None and crew.pool is not None:
            # Nothing waits for another muscle: each goes all the way, and no thread idles in between.
            with crew.one_thread_each():
                skins = crew.each(lambda lane: _go_alone(lane, index, stops, True)(), lanes)  # noqa: B023
        else:
            with crew.one_thread_each():
                draws = _go(lanes, crew, sliding, index, stops, show)
            with crew.all_threads():
                skins = crew.each(_call, draws)
        frame = _frame(scene, lanes, index, coordinates) if shown else None
        wall += time.perf_counter() - start
        if frame is not None:
            yield _drawn(frame, skins, wall)
            wall = 0.0
        here = coordinates


def _sliding(scene, lanes):
    """The links between muscles, or None where the scene asks for none."""
    if scene.sliding is None:
        return None
    from rbfmuscle.sim.loop.sliding import Sliding

    return Sliding(scene, lanes)


def _go_alone(lane, index, stops, show):
    """Bring a lane to a frame; what draws it, where it is shown."""
    lane.frame = index
    lane.advance(stops)
    return lane.drawing() if show else None


def _go(lanes, crew, sliding, index, stops, show):
    """Bring all lanes to a frame; what draws them, where it is shown."""
    if sliding is None:
        draws = crew.each(lambda lane: _go_alone(lane, index, stops, show), lanes)
        return draws if show else []
    for lane in lanes:
        lane.frame = index
    for before, after in itertools.pairwise(stops):
        crew.each(lambda lane: _begin(lane, sliding, before, after), lanes)  # noqa: B023
        crew.each(sliding.update, lanes)
        crew.each(Lane.finish, lanes)
    if not show:
        return []
    crew.each(sliding.refresh, lanes)
    for lane, measured in zip(lanes, crew.each(sliding.measure, lanes)):
        lane.measured = measured
    crew.each(sliding.fit, lanes)
    return [lane.drawing() for lane in lanes]


def _begin(lane, sliding, before, after):
    lane.begin(before, after)
    sliding.refresh(lane)


def _call(draw):
    return draw()


def _frame(scene, lanes, index, coordinates):
    """The frame as it was solved; `_drawn` adds its surfaces."""
    carried = {lane.name: lane.model.carried_mesh() for lane in lanes}
    times, events = {}, []
    for lane in lanes:
        times[lane.name], happened = lane.collect()
        events.extend(happened)
    poses = bone_poses(scene, coordinates)
    return Frame(index, dict(coordinates), poses, {}, carried, events, times, 0.0)


def _drawn(frame, skins, wall):
    for name, (surface, seconds) in zip(frame.carried, skins):
        frame.surfaces[name] = surface
        for key in ("time_surface", "time_frame"):
            frame.times[name][key] += seconds
    frame.wall = wall
    return frame
