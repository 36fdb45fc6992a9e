"""Options of a PBD muscle, as the scene's model table gives them."""

from typing import Annotated

from pydantic import Field

from rbfmuscle.scene.options import NotNegative, Table


class PBDOptions(Table):
    """``[muscle.model]`` of the mesh models.

    Each solve makes ``iterations`` sweeps (0: the method's own number; of a converged model 2,000
    at most). ``bending`` is the stiffness of dihedral angles in PBD, 0 to 1; ``edge_compliance``
    and ``bending_compliance`` are those of XPBD, over a time that passes by one for each two
    degrees of motion. ``fibre_exponent`` is a of k = (1 - |cos|)^a. Fibres shorten without
    resistance from their length in the scan to 1 / ``slack_ratio`` of it (1: no slack).
    """

    iterations: Annotated[int, Field(ge=0, le=10_000)] = 0
    fibre_exponent: NotNegative = 0.5
    bending: Annotated[float, Field(ge=0.0, le=1.0)] = 0.9
    edge_compliance: NotNegative = 0.2
    bending_compliance: NotNegative = 0.2
    slack_ratio: Annotated[float, Field(ge=1.0, le=5.0)] = 1.6
