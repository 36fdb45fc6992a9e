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
    "fibre_stretch": ("1", "length of a fibre without tendons / the same at rest"),
    "fibre_moment_arm": ("length", "moment arm of a fibre, tendons included"),
}

# Quantity: kind of unit (volume and length follow the scene's unit), meaning; in the order of the
# tables.
QUANTITIES = {
    "volume": ("volume", "volume enclosed by the surface"),
    "volume_error": ("1", "volume / volume of the input mesh, minus one"),
    "penetration_max": (
        "length",
        "greatest depth of a surface vertex below the triangles of a bone",
    ),
    "penetration_fraction": ("1", "share of surface vertices inside a bone"),
    "bone_penetration_max": ("length", "greatest depth of a bone vertex inside the muscle"),
    "solver_penetration_max": (
        "length",
        "greatest depth of one of the model's contact points in a bone at the end of the solve",
    ),
    "lifted_penetration_max": (
        "length",
        "the same after an RBF muscle's points are moved out of the bones, before its surface is "
        "computed",
    ),
    "solver_sweeps": ("1", "sweeps of the last solve of a mesh model"),
    "solver_residual": (
        "1",
        "estimated distance from equilibrium at the end of the solve (mesh models: the greatest "
        "motion in the last sweep), over the muscle's size; 1 where an RBF muscle's is greater or "
        "not known",
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
    "self_crossings": ("1", "triangles of the surface that cross another of its triangles"),
    "unfitted_fraction": (
        "1",
        "share of surface vertices that are not on the field's level set; 1 where the surface is "
        "shown without the field",
    ),
    "flicker": (
        "length",
        "greatest change, since the frame before, of the distance from a vertex of the material "
        "mesh to the surface; not measured in runs that leave frames out",
    ),
    "shown_shift_rms": (
        "length",
        "RMS distance from the material mesh to the surface; not measured where the surface is the "
        "material mesh",
    ),
    "shown_shift_max": ("length", "greatest of these distances"),
    "tunnelled": ("1", "contact points that passed through a bone and were not brought back"),
    "neighbour_overlap_max": (
        "length",
        "greatest depth of this muscle in another, or of another in it, beyond their overlap there "
        "at rest",
    ),
    "material_overlap_max": (
        "length",
        "the same between the material meshes, from which the surfaces are computed",
    ),
    "neighbour_overlap_rest": (
        "length",
        "greatest overlap of the input meshes of this muscle and another; first frame",
    ),
    "neighbour_gap": (
        "length",
        "distance to the muscles that it touched at rest, 95th percentile over these places",
    ),
    "rest_error_rms": (
        "length",
        "RMS distance between surface and input mesh at rest, in both directions, except within "
        "10 mm of an overlap with a bone",
    ),
    "rest_error_max": ("length", "greatest of these distances (Hausdorff)"),
    "rest_error_at_overlap": (
        "length",
        "greatest distance between them within 10 mm of an overlap with a bone",
    ),
    "input_overlap": (
        "length",
        "greatest overlap of the input mesh with a bone at rest, attached vertices left out",
    ),
    "thickness": (
        "length",
        "least width of the input mesh's largest section across its line from origin to insertion",
    ),
    "articular_share": (
        "1",
        "greatest share of an attachment that lies on an articular surface at rest",
    ),
    "tendon_depth": ("length", "greatest depth of a tendon inside a bone"),
    "initial_overlap": (
        "length",
        "greatest overlap of surface and bones that is left at rest",
    ),
    "end_gap": (
        "length",
        "greatest distance from an end without a tendon to its bone at rest",
    ),
    "edge_strain_rms": ("1", "relative change of edge lengths of the material mesh"),
    "condition": ("1", "condition estimate of the fit"),
    "length": (
        "length",
        "length of the centreline from origin to insertion, tendons included",
    ),
    "path_length": (
        "length",
        "length of the shortest path outside the bones between the ends of the centreline, tendons "
        "included",
    ),
    "bowing": (
        "1",
        "length of the centreline / length of the shortest path, both without tendons",
    ),
    "bowing_at_rest": ("1", "the same at rest, before the first frame"),
    "moment_arm": (
        "length",
        "minus the derivative of length with respect to the coordinate; NaN where the activation "
        "changes",
    ),
    "moment_arm_jump": (
        "length",
        "change of the moment arm over 5 degrees less its change over the 5 degrees before",
    ),
    "length_roughness": (
        "length",
        "second difference of the length over 2 degrees; measured where frames at most 2 degrees "
        "apart span 4 degrees or more",
    ),
    "path_roughness": ("length", "the same of path_length"),
    "roughness_beyond_path": (
        "length",
        "length_roughness minus the greatest path_roughness of the motion, at least 0",
    ),
    "moment_arm_reversal": (
        "length",
        "the smaller of the greatest positive and the greatest negative moment arm",
    ),
    **{
        f"{quantity}_{name}": (kind, f"{meaning}: {number}th percentile of the fibres")
        for quantity, (kind, meaning) in _FIBRES.items()
        for name, number in PERCENTILES.items()
    },
    "activation": ("1", "0 to 1; this and the next three are of muscles that contract"),
    "belly_thickness": (
        "length",
        "least width of the largest section across the line from origin to insertion",
    ),
    "csa_max": ("area", "area of that section"),
    "csa_place": ("1", "its place along the muscle: 0 at the origin, 1 at the insertion"),
    "bone_overlap": (
        "length",
        "greatest depth of two bones in each other beyond that at rest; muscle 'all', some frames",
    ),
    "joint_gap": (
        "length",
        "how much farther apart the bones of a joint are than at rest; muscle 'all', some frames",
    ),
    "guessed": ("1", "1 where an attachment of the muscle is a guess, else 0; first frame"),
    "doubtful_guesses": (
        "1",
        "number of doubtful guesses about the muscle, for muscle 'all' about joints; first frame",
    ),
    "missing_bones": ("1", "number of bones without a usable mesh; muscle 'all', first frame"),
    "time": ("s", "time of the frame in the motion file; muscle 'all'"),
    "time_solve": ("s", "prediction, solution and contacts"),
    "time_fit": ("s", "fit of the field"),
    "time_extract": ("s", "extraction of the surface"),
    "time_frame": ("s", "whole frame; muscle 'all': wall time of all muscles"),
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


def split_name(name: str) -> tuple[str, str]:
    """The quantity and the coordinate of a name in a table where some quantities stand by
    coordinate, as ``moment_arm:hip.flexion``; no coordinate for most.
    """
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
