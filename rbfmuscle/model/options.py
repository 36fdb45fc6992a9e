"""Settings of an RBF muscle, and what they may be."""

from typing import Annotated, Literal

from pydantic import AfterValidator, Field
from pydantic_core import PydanticCustomError

from rbfmuscle.implicit.kernels.table import get_kernel
from rbfmuscle.sim.scene.options import NotNegative, Share, Table
from rbfmuscle.validation import UsageError


def _known_bound(condition: float) -> float:
    if 0.0 < condition < 1.0:
        raise ValueError("condition must be at least 1, or 0 for no bound")
    return condition


def _known_kernel(name: str) -> str:
    try:
        get_kernel(name)
    except UsageError as error:
        raise PydanticCustomError("unknown_key", "{reason}", {"reason": str(error)}) from None
    return name


class RBFOptions(Table):
    """``[muscle.model]`` of an RBF muscle.

    ``centres``, where none are given, follow from the muscle's area, and are more where the surface at rest would
    err by more than ``rest_error`` (RMS; 0 for 0.5 mm, or a tenth of the muscle's thickness where that is less), and
    ``epsilon`` (a kernel's shape parameter) from the error at rest. A ridge keeps the ``condition`` of every fit below
    a bound, 0 for 1e10 where the kernel has a shape parameter and none where not. ``samples`` of the surface meet the
    bones; ``contacts`` of them join in one round. ``iterations`` a solve, ``acceleration`` of them remembered
    (Anderson). The fibre stretch is free from ``stretch_low`` to ``stretch_high`` but for the share ``stretch_hold``
    that pulls it back to one; ``across`` links a centre go through the thickness, each counting ``across_weight``.
    ``surface`` is shown by a mesh of the ``material`` that is brought onto the level set, or by ``marching`` cubes;
    ``resolution`` is the number of edges or cells along the longest side, 0 for as many as the muscle's thickness
    wants. ``placement`` of the centres: ``greedy`` where a fit misses the surface, or ``fitted`` beside it so that all
    of it is met, for slower fits; ``seed`` of what is drawn by chance. ``inside`` is the number of nodes of an elastic
    solid that carries the centres, 0 for none; it is stiffer along the fibres by ``fibre_ratio``, a ratio of Young's
    moduli.
    """

    centres: Annotated[int, Field(ge=0, le=20_000)] = 0
    rest_error: NotNegative = 0.0
    samples: Annotated[int, Field(ge=50, le=200_000)] = 2000
    iterations: Annotated[int, Field(ge=1, le=1000)] = 8
    contacts: Annotated[int, Field(ge=1, le=10_000)] = 24
    surface: Literal["material", "marching"] = "material"
    resolution: Annotated[int, Field(ge=0, le=1000)] = 0
    kernel: Annotated[str, AfterValidator(_known_kernel)] = "cubic"
    epsilon: NotNegative = 0.0
    condition: Annotated[NotNegative, AfterValidator(_known_bound)] = 0.0
    stretch_low: Annotated[float, Field(ge=0.01, le=1.0)] = 0.5
    stretch_high: Annotated[float, Field(ge=1.0, le=100.0)] = 2.0
    stretch_hold: Share = 0.3
    across: Annotated[int, Field(ge=0, le=50)] = 3
    across_weight: Annotated[float, Field(ge=0.0, le=1e6)] = 1.0
    acceleration: Annotated[int, Field(ge=0, le=50)] = 5
    placement: Literal["greedy", "fitted"] = "greedy"
    inside: Annotated[int, Field(ge=0, le=3000)] = 0
    fibre_ratio: Annotated[float, Field(ge=1.0, le=1e4)] = 1.0
    seed: int = 0
