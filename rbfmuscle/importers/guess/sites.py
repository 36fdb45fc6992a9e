"""Sites of attachment on bones, found by landmarks of the bone itself.

A site lies about the places that ``sites.toml`` gives in the bone's frame, moved to the landmark
that stands out there. Articular surfaces belong to no site.
"""

import itertools
import tomllib
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from rbfmuscle.anatomy.bones import Part
from rbfmuscle.geometry.vectors import unit
from rbfmuscle.importers.guess.frames import PELVIS, BoneFrame

STEPS = 20  # points along a leg of a site's line
ASIDE = 0.005  # what is nearer to an articular surface than this, in sizes of the bone, is of it
MOST = 20_000  # points of a bone among which sites are looked for


class SiteFacts(NamedTuple):
    """A row of ``[sites]``: see the file."""

    bone: str
    at: np.ndarray
    radius: float
    out: np.ndarray | None = None
    reach: float = 0.0


class Anatomy(NamedTuple):
    """Names of the sites of a muscle's origin and insertion, and of the places that its tendon
    passes.
    """

    origin: tuple[str, ...]
    insertion: tuple[str, ...]
    via: tuple[str, ...]


class Site(NamedTuple):
    """Where a muscle attaches: ``core`` (k, 3) are its landmarks on the bone, ``points`` (n, 3)
    all of it.
    """

    name: str
    core: np.ndarray
    points: np.ndarray

    def nearest(self, place: np.ndarray) -> np.ndarray:
        """The landmark (3,) nearest to a place (3,)."""
        return self.core[np.argmin(((self.core - place) ** 2).sum(axis=1))]


@cache
def _tables() -> tuple[dict[str, SiteFacts], dict[str, Anatomy]]:
    table = tomllib.loads((Path(__file__).parent / "sites.toml").read_text(encoding="utf-8"))
    sites = {}
    for name, row in table["sites"].items():
        out = None if "out" not in row else unit(np.array(row["out"], dtype=float))
        at = np.array(row["at"], dtype=float)
        sites[name] = SiteFacts(row["bone"], at, row["radius"], out, row.get("reach", 0.0))
    muscles = {
        name: Anatomy(*(tuple(row.get(key, "").split()) for key in Anatomy._fields))
        for name, row in table["muscles"].items()
    }
    return sites, muscles


def anatomy_of(muscle: str) -> Anatomy | None:
    """Sites of a muscle by its name in ``names.toml``, None where they are not known."""
    return _tables()[1].get(muscle)


def sites_on(names: tuple[str, ...], bone: Part) -> list[str]:
    """Those of some sites that lie on bones of this one's class."""
    kind = "pelvis" if bone.kind in PELVIS else bone.kind
    return [name for name in names if _tables()[0][name].bone == kind]


def find_site(name: str, bone: Part, frame: BoneFrame, articular: np.ndarray) -> Site:
    """A site on a bone; ``articular`` (n, 3) are the points of its articular surfaces."""
    facts = _tables()[0][name]
    points = _covering(bone, articular)
    tree = cKDTree(points)
    stops = []
    for at in facts.at:
        place = frame.place(at)
        if facts.out is not None:
            near = points[tree.query_ball_point(place, facts.reach * frame.size)]
            if len(near):
                place = near[np.argmax(near @ (facts.out @ frame.axes))]
        stops.append(place)
    line = np.concatenate(
        [np.linspace(a, b, STEPS) for a, b in itertools.pairwise(stops)] or [np.array(stops)]
    )
    core = points[np.unique(tree.query(line)[1])]
    near = cKDTree(line).query(points)[0] < facts.radius * frame.size
    near[tree.query(line)[1]] = True
    return Site(name, core, points[near])


def whole_bone(bone: Part, articular: np.ndarray) -> Site:
    """All of a bone but its articular surfaces, where no site is known."""
    points = _covering(bone, articular)
    return Site(bone.name, points, points)


def _covering(bone: Part, articular: np.ndarray) -> np.ndarray:
    """Vertices and middles of the triangles of a bone off its articular surfaces, thinned."""
    points = np.concatenate([bone.points, bone.faces[0]])
    points = points[:: -(-len(points) // MOST)]
    if len(articular):
        points = points[cKDTree(articular).query(points)[0] > ASIDE * bone.size]
    return points
