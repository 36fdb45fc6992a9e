"""The law of the fibres: what stretch they are pulled to, and how much of the way."""

from __future__ import annotations

from typing import Any

import numpy as np

from rbfmuscle.geometry.arrays import Booleans, Floats


class FibreLaw:
    """Target stretch of each fibre element of a muscle, whatever the elements are.

    With λ the stretch against the scan pose, an element is pulled towards the nearest place of a band,

        λ* = min(max(λ, lower), upper),    t = λ* + (1 - share) (λ - λ*),

    by a share of the way, and its girth towards s = u^(-1/2) with u = λ* + (1 - across) (λ - λ*). A passive fibre is
    slack from 1 / stretch_at_rest to its stretch in the scan, 1, where nothing pulls (the scan itself is in balance;
    fibres slack in the scan lengthen freely to their slack length), and is pulled back by ``hold`` of what it lies
    outside. Activation a moves both ends of the band towards the stretch at which a fully activated fibre is
    content, and the share towards ``full``,

        lower = (1 - a) min(1, 1 / stretch_at_rest) + a shortening / stretch_at_rest,
        upper = (1 - a) max(1, 1 / stretch_at_rest) + a shortening / stretch_at_rest,
        share = hold + (full - hold) a,    across = hold (1 - a).

    So an active fibre pulls along itself alone: its girth follows from its volume at the length it has. (With the
    girth of t it would push outwards too, and the widest place of a belly would take all the shortening.)

    An element of tendon keeps its length, but may stretch by ``tendon_strain`` at full activation. At a = 0 and
    no other key lower = upper = 1 and share = hold, which is the law of a muscle that does not contract, to the
    last digit. It is a law of shapes: nothing here is a force.

    Parameters
    ----------
    tendon : (n,) ndarray of bool
        Elements that are tendon.
    contraction : Contraction or None
        None for a muscle that does not contract.
    hold : float
        Share of a passive element.
    full : float or (n,) ndarray
        Share of a fully activated one.

    Attributes
    ----------
    lower, upper, share, across : (n,) ndarray
    activation : float
    """

    def __init__(
        self, tendon: Booleans, contraction: Any, *, hold: float, full: Floats | float = 1.0
    ) -> None:
        self.tendon, self.contraction = np.asarray(tendon, dtype=bool), contraction
        self.hold, self.full = hold, full
        count = len(self.tendon)
        self.lower, self.upper, self.share = np.ones(count), np.ones(count), np.full(count, float(hold))
        self.across = self.share.copy()
        self.activation = 0.0
        if contraction is not None:
            self.activate(0.0)

    @property
    def passive(self) -> Any:
        """Whether the law is that of a muscle that does not contract."""
        given = self.contraction
        return given is None or (
            self.activation == 0.0 and given.stretch_at_rest == 1.0 and not self.tendon.any()
        )

    def activate(self, activation: Any) -> None:
        """Take an activation, 0 to 1."""
        given, self.activation = self.contraction, float(activation)
        slack, content = 1.0 / given.stretch_at_rest, given.shortening / given.stretch_at_rest
        self.lower[:] = min(1.0, slack) + activation * (content - min(1.0, slack))
        self.upper[:] = max(1.0, slack) + activation * (content - max(1.0, slack))
        self.share[:] = self.hold + (self.full - self.hold) * activation
        self.across[:] = self.hold * (1.0 - activation)
        self.lower[self.tendon] = 1.0
        self.upper[self.tendon] = 1.0 + activation * given.tendon_strain
        self.share[self.tendon] = self.across[self.tendon] = 1.0

    def goal(self, stretch: Any) -> Any:
        """Stretches t along and s across that elements of the given stretch (n,) are pulled to."""
        wanted = np.minimum(np.maximum(stretch, self.lower), self.upper)
        along = wanted + (1.0 - self.share) * (stretch - wanted)
        return along, (wanted + (1.0 - self.across) * (stretch - wanted)) ** -0.5
