"""Options of a PBD muscle, as the scene's model table gives them."""

from typing import Annotated, Literal

from pydantic import Field

from rbfmuscle.sim.scene.options import NotNegative, Positive, Share, Table


class PBDOptions(Table):
    """``[muscle.model]`` of the mesh models.

    ``iterations`` sweeps a solve (0: the method's own number). ``edge`` and ``bending`` are PBD stiffnesses,
    ``edge_compliance`` and ``bending_compliance`` those of XPBD, ``arap_compliance`` of the ARAP constraint,
    all over a time that passes by one for each two degrees of motion. ``arap_reach`` is how far one global
    step carries, as a share of the muscle's diagonal; ``swelling_reach``, another such share, over which the freedom
    to swell falls to nothing at held vertices. ``fibre_exponent`` is a of k = (1 - |cos|)^a; edges
    longer than ``soft_length`` medians are softer in inverse proportion (0: none); those shorter or longer
    than ``limits`` times their rest length are hard in any case. ``prediction``: vertices are carried along
    by the bones (see ``pbd_baseline.weights``), or keep their velocity times ``damping`` as the authors' do,
    or stay (none). ``response`` to several bones: the sum of the ways out, or the longest alone. ``contact``: bones are
    met by the vertices alone, or by the middles of edges and faces too, for ridges between vertices. ``sound``
    keeps the surface one that could be a muscle's: held ends, too, give way to bones, faces to the vertices of bones,
    the sides of what is pressed on a bone stay apart, and what crosses itself is smoothed; several times the time.
    """

    method: Literal["pbd", "xpbd", "arap-pbd", "arap-volume", "arap-interleaved"] = "pbd"
    iterations: Annotated[int, Field(ge=0, le=10_000)] = 0
    prediction: Literal["carried", "velocity", "none"] = "carried"
    damping: Share = 0.99
    fibre_exponent: NotNegative = 0.5
    limits: Annotated[list[Positive], Field(min_length=2, max_length=2)] = Field(
        default_factory=lambda: [0.6, 2.2]
    )
    soft_length: NotNegative = 0.3
    edge: Share = 1.0
    bending: Share = 0.9
    edge_compliance: NotNegative = 0.2
    bending_compliance: NotNegative = 0.2
    arap_compliance: Positive = 1.0
    arap_reach: Positive = 0.03
    swelling_reach: Positive = 0.04
    response: Literal["sum", "nearest"] = "sum"
    sound: bool = False
    contact: Literal["vertices", "faces"] = "vertices"
