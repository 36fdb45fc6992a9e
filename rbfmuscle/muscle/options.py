"""Settings of an RBF muscle, and what they may be."""

from collections.abc import Mapping
from typing import Annotated, ClassVar, Literal

from pydantic import AfterValidator, Field
from pydantic_core import PydanticCustomError

from rbfmuscle.implicit.kernels import get_kernel
from rbfmuscle.scene.options import NotNegative, Table
from rbfmuscle.validation import UsageError

FEWEST_CENTRES = 4  # a linear polynomial in space has four coefficients


def _known_bound(condition: float) -> float:
    if 0.0 < condition < 1.0:
        raise ValueError("condition must be at least 1, or 0 for no bound")
    return condition


def _enough_centres(count: int) -> int:
    if 0 < count < FEWEST_CENTRES:
        raise ValueError(f"centres must be at least {FEWEST_CENTRES}, or 0 for as many as it needs")
    return count


def _known_kernel(name: str) -> str:
    try:
        get_kernel(name)
    except UsageError as error:
        raise PydanticCustomError("unknown_key", "{reason}", {"reason": str(error)}) from None
    return name


class RBFOptions(Table):
    """``[muscle.model]`` of an RBF muscle.

    ``centres``, where none are given, follow from the muscle's area, and are more where the surface
    at rest would err by more than ``rest_error`` (RMS; 0 for 0.5 mm, or a tenth of the muscle's
    thickness where that is less), and ``epsilon`` (a kernel's shape parameter) from the error at
    rest. A ridge keeps the ``condition`` of every fit below a bound, 0 for 1e10 where the kernel
    has a shape parameter and none where not. ``samples`` of the surface meet the bones: the
    vertices of a mesh that has as many. ``nodes`` of the elastic solid that carries the centres,
    and the greatest number of ``iterations`` of a
    solve. Fibres shorten without resistance from their length in the scan to 1 / ``slack_ratio`` of
    it (1: no slack); beyond, the solid is stiffer along them than across by ``fibre_ratio``, a
    ratio of Young's moduli. ``surface`` is shown by a mesh of the ``material`` that is
    brought onto the level set, by the same mesh ``embedded`` in the solid without a field, or by
    ``marching`` cubes; ``resolution`` is the number of edges or cells along the longest side, 0 for
    the input mesh.
    """

    hints: ClassVar[Mapping[str, str]] = {
        "placement": "remove it: centres lie where a fit misses the surface"
    }
    centres: Annotated[int, Field(ge=0, le=20_000), AfterValidator(_enough_centres)] = 0
    rest_error: NotNegative = 0.0
    samples: Annotated[int, Field(ge=50, le=50_000)] = 6000
    nodes: Annotated[int, Field(ge=30, le=3000)] = 300
    iterations: Annotated[int, Field(ge=1, le=1000)] = 150
    slack_ratio: Annotated[float, Field(ge=1.0, le=5.0)] = 1.8
    surface: Literal["material", "embedded", "marching"] = "material"
    resolution: Annotated[int, Field(ge=0, le=1000)] = 0
    kernel: Annotated[str, AfterValidator(_known_kernel)] = "cubic"
    epsilon: NotNegative = 0.0
    condition: Annotated[NotNegative, AfterValidator(_known_bound)] = 0.0
    fibre_ratio: Annotated[float, Field(ge=1.0, le=1e4)] = 1.5
