"""The frame loop: any muscle model against any bones, and what a model must offer to be run by it."""

import itertools
import time
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any, Protocol

import numba
import numpy as np

from rbfmuscle.sim.contact import BoneContacts
from rbfmuscle.sim.lane import Event, Lane
from rbfmuscle.sim.motion import bone_poses
from rbfmuscle.sim.overlap import settle_rest
from rbfmuscle.sim.reach import Pace, build_fields, reached_bones

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
        Time for all muscles together [s], since the frame before.
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

    def surface(self, contacts: BoneContacts) -> ModelSurface:
        """Surface as it is shown: closed and outward."""


class _Crew:
    """Runs the lanes side by side, each with one thread."""

    def __init__(self, count):
        from threadpoolctl import ThreadpoolController

        self.blas = ThreadpoolController()
        workers = min(count, numba.get_num_threads())
        self.pool = None
        if workers > 1:
            self.pool = ThreadPoolExecutor(workers, initializer=numba.set_num_threads, initargs=(1,))

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


def simulate_frames(scene, models, *, surfaces=True, written=None, fields=None) -> Iterator[Frame]:
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
    crew = _Crew(len(lanes))
    try:
        yield from _run(scene, lanes, crew, surfaces, written)
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


def _run(scene, lanes, crew, surfaces, written):
    here = dict.fromkeys(scene.motion.frames[0], 0.0) if scene.motion.frames else {}
    pace = Pace(scene)
    start = time.perf_counter()
    with crew.one_thread_each():
        crew.each(lambda lane: settle_rest(lane, here), lanes)
        sliding = _sliding(scene, lanes)
    wall = time.perf_counter() - start
    for index, coordinates in enumerate(scene.motion.frames):
        start = time.perf_counter()
        shown = written is None or index in written
        show = shown and surfaces
        stops = [here, *pace.split(here, coordinates)]
        if sliding is None and crew.pool is not None:
            # Nothing waits for another muscle: each goes all the way, and no thread idles in between.
            with crew.one_thread_each():
                skins = crew.each(lambda lane: _go_alone(lane, index, stops, show), lanes)  # noqa: B023
                skins = skins if show else []
        else:
            with crew.one_thread_each():
                _go(lanes, crew, sliding, index, stops)
            with crew.all_threads():
                skins = _show(lanes, crew, sliding) if show else []
        wall += time.perf_counter() - start
        if shown:
            yield _frame(scene, lanes, index, coordinates, skins, wall)
            wall = 0.0
        here = coordinates


def _sliding(scene, lanes):
    """The links between muscles, or None where the scene asks for none."""
    if scene.sliding is None:
        return None
    from rbfmuscle.sim.sliding import Sliding

    return Sliding(scene, lanes)


def _go_alone(lane, index, stops, show):
    lane.frame = index
    lane.advance(stops)
    return lane.show() if show else None


def _go(lanes, crew, sliding, index, stops):
    for lane in lanes:
        lane.frame = index
    if sliding is None:
        crew.each(lambda lane: lane.advance(stops), lanes)
        return
    for before, after in itertools.pairwise(stops):
        crew.each(lambda lane: _begin(lane, sliding, before, after), lanes)  # noqa: B023
        crew.each(sliding.update, lanes)
        crew.each(Lane.finish, lanes)


def _begin(lane, sliding, before, after):
    lane.begin(before, after)
    sliding.refresh(lane)


def _show(lanes, crew, sliding):
    if sliding is not None:
        crew.each(sliding.refresh, lanes)
        for lane, measured in zip(lanes, crew.each(sliding.measure, lanes)):
            lane.measured = measured
        crew.each(sliding.fit, lanes)
    return crew.each(Lane.show, lanes)


def _frame(scene, lanes, index, coordinates, skins, wall):
    surfaces = {lane.name: skin for lane, skin in zip(lanes, skins)}
    carried = {lane.name: lane.model.carried_mesh() for lane in lanes}
    times, events = {}, []
    for lane in lanes:
        times[lane.name], happened = lane.collect()
        events.extend(happened)
    poses = bone_poses(scene, coordinates)
    return Frame(index, dict(coordinates), poses, surfaces, carried, events, times, wall)
