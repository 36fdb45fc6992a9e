"""What is measured of a frame, in which unit, and a row of it; for those who read what others
measured.
"""

from collections.abc import Mapping
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from rbfmuscle.geometry.arrays import Floats

# Of what is measured of every fibre of a muscle.
PERCENTILES: Mapping[str, int] = MappingProxyType({"p05": 5, "p50": 50, "p95": 95})
_FIBRES = {
    "fibre_stretch": ("1", "length of a fibre without tendons over that at rest"),
    "fibre_moment_arm": ("length", "moment arm of a fibre with its tendons"),
}

# Quantity: kind of unit (volume and length follow the scene's unit), meaning; in the order of the
# tables.
QUANTITIES = {
    "volume": ("volume", "volume enclosed by the surface"),
    "volume_error": ("1", "volume relative to the input mesh's, minus one"),
    "penetration_max": (
        "length",
        "deepest surface vertex inside a bone, by its triangles",
    ),
    "penetration_fraction": ("1", "share of surface vertices inside a bone"),
    "bone_penetration_max": ("length", "deepest bone vertex inside the muscle"),
    "solver_penetration_max": (
        "length",
        "deepest of the model's points inside a bone at the end of the solve",
    ),
    "lifted_penetration_max": (
        "length",
        "the same after RBF muscles have lifted these points out of bones, before the surface is "
        "drawn",
    ),
    "solver_sweeps": ("1", "sweeps of the last solve of a mesh model"),
    "solver_residual": (
        "1",
        "greatest unshortened motion of a point in the last iteration, over the muscle's size",
    ),
    "solid_volume_error": (
        "1",
        "greatest relative volume error of a region of the elastic solid",
    ),
    "components": ("1", "closed pieces of the surface"),
    "euler_characteristic": (
        "1",
        "Euler characteristic of the surface: 2 for a sphere, two less for each handle",
    ),
    "self_crossings": ("1", "triangles of the surface that cross others of it"),
    "unfitted_fraction": (
        "1",
        "share of surface vertices not on the field's level set; the limit is met unless it is 1, "
        "where the field is not shown",
    ),
    "flicker": (
        "length",
        "greatest change of distances from material mesh to surface since the frame before in the "
        "motion; none in runs that leave frames out",
    ),
    "shown_shift_rms": (
        "length",
        "distance of the carried material from the surface that is shown; none where it is shown",
    ),
    "shown_shift_max": ("length", "the same, greatest"),
    "tunnelled": ("1", "points that passed through a bone and were not brought back"),
    "neighbour_overlap_max": (
        "length",
        "deepest vertex of this muscle or another in the other, beyond their overlap at rest there",
    ),
    "material_overlap_max": (
        "length",
        "the same of the carried material, from which a model draws what it shows",
    ),
    "neighbour_overlap_rest": (
        "length",
        "deepest overlap of the input mesh with that of another muscle; first frame",
    ),
    "neighbour_gap": (
        "length",
        "how far the surface has parted from muscles that it touched at rest: 95th percentile",
    ),
    "rest_error_rms": (
        "length",
        "distance between surface and input mesh at rest, both ways, farther than 10 mm from where "
        "that overlaps a bone",
    ),
    "rest_error_max": ("length", "the same, greatest (Hausdorff)"),
    "rest_error_at_overlap": ("length", "the same, greatest, within 10 mm of an overlap"),
    "input_overlap": (
        "length",
        "deepest overlap of the input mesh with a bone at rest, apart from attachments",
    ),
    "thickness": (
        "length",
        "least width of the input mesh's greatest section across its line of action",
    ),
    "articular_share": (
        "1",
        "greatest share of an attachment on an articular surface at rest",
    ),
    "tendon_depth": ("length", "deepest point of a tendon inside a bone"),
    "initial_overlap": ("length", "deepest overlap of muscle and bones that is left at rest"),
    "end_gap": ("length", "distance of the end that lies furthest from its bone at rest"),
    "edge_strain_rms": ("1", "relative change of edge lengths of the material mesh"),
    "condition": ("1", "condition estimate of the fit"),
    "length": ("length", "centreline from origin to insertion, with its tendons"),
    "path_length": (
        "length",
        "shortest path over the bones between the ends of the centreline, with the tendons",
    ),
    "bowing": (
        "1",
        "length of the centreline without tendons / that of the shortest path between its ends",
    ),
    "bowing_at_rest": ("1", "the same at rest, before the first frame"),
    "moment_arm": (
        "length",
        "minus the change of length with the coordinate's angle; NaN where the activation changes",
    ),
    "moment_arm_jump": (
        "length",
        "change of the moment arm's slope over 5 degrees, times these",
    ),
    "length_roughness": (
        "length",
        "second difference of the length over 2 degrees; motions by at most these",
    ),
    "path_roughness": ("length", "the same of the shortest path"),
    "roughness_beyond_path": (
        "length",
        "how much length_roughness exceeds the greatest of the shortest path in the motion",
    ),
    "moment_arm_reversal": ("length", "how far the moment arm goes to either side of zero"),
    **{
        f"{quantity}_{name}": (kind, f"{meaning}: {number}th percentile of the fibres")
        for quantity, (kind, meaning) in _FIBRES.items()
        for name, number in PERCENTILES.items()
    },
    "activation": ("1", "activation, 0 to 1; this and the next three for muscles that contract"),
    "belly_thickness": ("length", "least width of the greatest section across the line of action"),
    "csa_max": ("area", "area of the greatest section across the line of action"),
    "csa_place": ("1", "where it lies: 0 at the origin, 1 at the insertion"),
    "bone_overlap": (
        "length",
        "depth of two bones in each other beyond rest; muscle 'all', some frames",
    ),
    "joint_gap": (
        "length",
        "a joint's bones farther apart than at rest; muscle 'all', some frames",
    ),
    "guessed": ("1", "1 where an attachment of the muscle is a guess, else 0; first frame"),
    "doubtful_guesses": (
        "1",
        "doubtful guesses about the muscle, under 'all' about joints; first frame",
    ),
    "missing_bones": ("1", "bones of which no mesh could be used; muscle 'all', first frame"),
    "time": ("s", "time of the frame in the motion file; muscle 'all'"),
    "time_solve": ("s", "prediction, solution and contacts"),
    "time_fit": ("s", "fit of the field"),
    "time_extract": ("s", "extraction of the surface"),
    "time_frame": ("s", "all of the frame; muscle 'all': wall time of all"),
}
ALL = "all"


class Row(NamedTuple):
    """One line of ``metrics.csv``, where ``coordinate_value`` [degree, of a translation scene unit]
    is the column ``angle``.
    """

    frame: int
    coordinate: str
    coordinate_value: float
    muscle: str
    quantity: str
    value: float
    unit: str


def of_coordinate(quantity: str, coordinate: str) -> str:
    """Name of a quantity that is known by coordinate, where many stand in one table."""
    return f"{quantity}:{coordinate}"


def split_name(name: str) -> tuple[str, str]:
    """The quantity and the coordinate of a name in such a table; no coordinate for most."""
    quantity, _, coordinate = name.partition(":")
    return quantity, coordinate


def quantity_of(name: str) -> str:
    """The quantity of a name in such a table."""
    return split_name(name)[0]


def percentiles(quantity: str, values: Floats) -> dict[str, float]:
    """`PERCENTILES` of a quantity's values (n,), by the names of `QUANTITIES`."""
    found = np.percentile(values, list(PERCENTILES.values())).tolist()
    return {f"{quantity}_{name}": value for name, value in zip(PERCENTILES, found)}


def unit_text(kind: str, units: str) -> str:
    """Unit of a quantity as written in tables: ``length`` and ``volume`` take the scene's unit."""
    return {"length": units, "area": f"{units}^2", "volume": f"{units}^3"}.get(kind, kind)
