"""A muscle that comes to each frame from rest: what it passed on the way is kept and used again where ways agree."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
    from rbfmuscle.sim.loop.stepper import MuscleStepper

Coordinates = Mapping[str, float]


class _Stop(NamedTuple):
    """A place on a muscle's way, and all that the next step depends on there."""

    coordinates: Coordinates
    activation: Mapping[str, float]
    model: Any
    contacts: Any
    carrier: Any


class Trail:
    """The way of one muscle from rest to where it is.

    Parameters
    ----------
    stepper : MuscleStepper
        Its model at rest.
    coordinates : mapping of str to float
        Of rest [radian].
    activation : mapping of str to float
        There, by muscle.
    """

    def __init__(
        self, stepper: MuscleStepper, coordinates: Coordinates, activation: Mapping[str, float]
    ) -> None:
        self.stepper = stepper
        self.kept: list[_Stop] = []
        self.passed(coordinates, activation)

    def passed(self, coordinates: Coordinates, activation: Mapping[str, float] | None) -> None:
        """Keep the muscle as it is here."""
        stepper = self.stepper
        carrier = {} if stepper.carrier is None else stepper.carrier.snapshot()
        state = stepper.model.snapshot(), stepper.contacts.snapshot(), carrier
        self.kept.append(_Stop(dict(coordinates), dict(activation or {}), *state))

    def rewind(
        self, stops: Sequence[Coordinates], activations: Sequence[Mapping[str, float]] = ()
    ) -> tuple[list[Coordinates], list[Mapping[str, float]]]:
        """Go back to the last place that a new way has in common with the one that was taken.

        Parameters
        ----------
        stops : list of dict
            The new way, from rest on.
        activations : list of dict
            At each stop but the first; empty where nothing contracts.

        Returns
        -------
        stops, activations : list of dict
            What is left of the way.
        """
        at = 0
        wanted = [(stop, activations[k] if activations else {}) for k, stop in enumerate(stops[1:])]
        for (coordinates, activation), known in zip(wanted, self.kept[1:]):
            if (known.coordinates, known.activation) != (coordinates, activation):
                break
            at += 1
        del self.kept[at + 1 :]
        self._return_to(self.kept[-1])
        return list(stops[at:]), list(activations[at:])

    def _return_to(self, stop: _Stop) -> None:
        stepper = self.stepper
        stepper.excite(stop.activation)
        stepper.model.restore(stop.model)
        stepper.contacts.restore(stop.contacts)
        stepper.restore_carrier(stop.carrier)
