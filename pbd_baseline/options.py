"""Options of a PBD muscle, as the scene's model table gives them."""

from typing import Annotated, Literal

from pydantic import Field

from rbfmuscle.scene.options import Fraction, NotNegative, Positive, Table


class PBDOptions(Table):
    """``[muscle.model]`` of the mesh models.

    ``iterations`` sweeps a solve (0: the method's own number). ``edge`` and ``bending`` are PBD stiffnesses,
    ``edge_compliance`` and ``bending_compliance`` those of XPBD, ``arap_compliance`` of the ARAP constraint,
    all over a time that passes by one for each two degrees of motion. ``arap_reach`` is how far one global
    step carries, as a share of the muscle's diagonal; ``swelling_reach``, another such share, over which the freedom
    to swell falls to nothing at held vertices. ``fibre_exponent`` is a of k = (1 - |cos|)^a. ``contact``: bones are
    met by the vertices alone, or by the middles of edges and faces too, for ridges between vertices. ``sound``
    keeps the surface one that could be a muscle's: held ends, too, give way to bones, faces to the vertices of bones,
    the sides of what is pressed on a bone stay apart, and what crosses itself is smoothed; several times the time.
    """

    method: Literal["pbd", "pbd-paper", "xpbd", "arap-pbd", "arap-volume", "arap-interleaved"] = "pbd"
    iterations: Annotated[int, Field(ge=0, le=10_000)] = 0
    fibre_exponent: NotNegative = 0.5
    edge: Fraction = 1.0
    bending: Fraction = 0.9
    edge_compliance: NotNegative = 0.2
    bending_compliance: NotNegative = 0.2
    arap_compliance: Positive = 1.0
    arap_reach: Positive = 0.03
    swelling_reach: Positive = 0.04
    sound: bool = False
    contact: Literal["vertices", "faces"] = "vertices"
