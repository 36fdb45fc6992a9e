"""What a comparison measures of each model: one table."""

from typing import NamedTuple

LAW = "law"
MESH = "input mesh"
FIRST = "first model"
COST = "cost"


class Measure(NamedTuple):
    """A row of the table.

    ``kind`` is that of a unit: ``"1"``, ``"length"`` or ``"s"``; ``against`` says what a value is
    an error of or against; a value is better the smaller its distance from ``ideal``, and
    differences of less than ``floor`` (millimetres for lengths) do not count.
    """

    title: str
    kind: str
    against: str
    floor: float
    meaning: str
    ideal: float = 0.0


DEEPER = "depth_beyond_rest"
_ROWS: dict[str, tuple[str, str, str, float, str]] = {
    "volume_error": ("volume error", "1", LAW, 1e-5, "relative to the input mesh"),
    DEEPER: ("depth beyond rest", "length", LAW, 0.02, "of muscle and bones, less that at rest"),
    "penetration_max": ("surface in a bone", "length", LAW, 0.02, "deepest vertex, as at rest"),
    "bone_penetration_max": ("bone in the muscle", "length", LAW, 0.02, "the same of bones"),
    "solver_penetration_max": ("left by the solver", "length", LAW, 0.02, "its points in a bone"),
    "neighbour_overlap_max": ("muscles overlap", "length", LAW, 0.02, "deepest, beyond rest"),
    "neighbour_gap": ("muscles part", "length", LAW, 0.1, "where they touched at rest, 95 %"),
    "initial_overlap": ("overlap left at rest", "length", LAW, 0.02, "of muscle and bones"),
    "bowing": ("bowing", "1", LAW, 0.005, "centreline over shortest path"),
    "components": ("pieces", "1", LAW, 0.0, "connected pieces, most in any frame"),
    "euler_characteristic": ("Euler characteristic", "1", LAW, 0.0, "two less for a handle"),
    "self_crossings": ("self-crossings", "1", LAW, 0.0, "triangles that cross others"),
    "unfitted_fraction": ("surface not fitted", "1", LAW, 1e-4, "share of vertices off the field"),
    "flicker": ("flicker", "length", LAW, 0.05, "surface against material mesh, by frames"),
    "tunnelled": ("tunnelled points", "1", LAW, 0.0, "points beyond a bone"),
    "return_rms": ("return error (RMS)", "length", LAW, 0.02, "first pose, there and back"),
    "return_max": ("return error (greatest)", "length", LAW, 0.1, "greatest distance"),
    "step_rms": (
        "step dependence (RMS)",
        "length",
        LAW,
        0.02,
        "last pose by shorter sub-steps",
    ),
    "step_max": ("step dependence (greatest)", "length", LAW, 0.1, "greatest distance"),
    "rest_error_rms": ("rest error (RMS)", "length", MESH, 0.02, "surface to mesh at rest"),
    "rest_error_max": ("rest error (greatest)", "length", MESH, 0.1, "greatest distance"),
    "rest_error_at_overlap": ("rest beside overlaps", "length", MESH, 0.1, "within 10 mm of them"),
    "distance_rms": ("distance (RMS)", "length", FIRST, 0.0, "to the first's, worst pose"),
    "distance_max": ("distance (greatest)", "length", FIRST, 0.0, "greatest distance"),
    "length_rms": ("length (RMS)", "length", FIRST, 0.0, "difference over the frames"),
    "moment_arm_rms": ("moment arm (RMS)", "length", FIRST, 0.0, "difference over the frames"),
    "time_frame": ("time per frame", "s", COST, 0.0, "median of all muscles, with surfaces"),
    "time_frame_p95": ("time per frame (95 %)", "s", COST, 0.0, "exceeded by one in 20"),
    "time_one_thread": ("time on one thread", "s", COST, 0.0, "median of the first frames"),
    "time_build": ("build", "s", COST, 0.0, "all models, once, with filled caches"),
}
_IDEAL = {"bowing": 1.0, "euler_characteristic": 2.0}  # 0 of all others
MEASURES = {name: Measure(*row, _IDEAL.get(name, 0.0)) for name, row in _ROWS.items()}
FROM_METRICS = [name for name, m in MEASURES.items() if m.against in (LAW, MESH) and name != DEEPER]
