"""Muscles that slide on each other on their way through a frame: each at its own pace, all of them there at its end."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING

from rbfmuscle.simulation.neighbours.extrapolation import way_between
from rbfmuscle.simulation.stepper import MuscleStepper

if TYPE_CHECKING:
    from rbfmuscle.simulation.sliding import Sliding
    from rbfmuscle.simulation.substeps import SubSteps
    from rbfmuscle.simulation.workers import Workers


class CoupledStepper:
    """Brings muscles that see each other's surfaces through the sub-steps of a frame.

    The scene's fastest muscle cuts the frame. Another one takes as many of these sub-steps at a time as leave it no
    longer steps than its own bones ask for; in between its neighbours see it where its bones have taken it. At the
    frame's end all of them meet. What a muscle does depends on the places of the stops alone, never on an order of
    muscles.

    Parameters
    ----------
    steppers : list of MuscleStepper
    sliding : Sliding
    cuts : mapping of str to SubSteps
        By muscle, as its own bones ask for; a muscle without takes every sub-step.
    """

    def __init__(self, steppers: list[MuscleStepper], sliding: Sliding, cuts: Mapping[str, SubSteps]) -> None:
        self.steppers, self.sliding, self.cuts = steppers, sliding, dict(cuts)

    def go(self, stops: list[dict], activations: Sequence[Mapping[str, float]], workers: Workers) -> None:
        """Solve all muscles through coordinates of sub-steps, the first of which is where they are."""
        strides = {stepper.name: self._stride(stepper.name, stops) for stepper in self.steppers}
        last, here = len(stops) - 1, dict.fromkeys(strides, 0)
        for stop in range(1, last + 1):
            due = [s for s in self.steppers if stop == last or stop % strides[s.name] == 0]
            for stepper in due if len(activations) else ():
                stepper.excite(activations[stop - 1])
            workers.each(self._begin_to(stops, stop, here), due)
            if due:
                workers.each(self._carry_to(stops, stop, here), [s for s in self.steppers if s not in due])
            workers.each(self.sliding.update, due)
            workers.each(MuscleStepper.finish, due)
            workers.each(self._settled(stops, stop, here), due)
            here.update((stepper.name, stop) for stepper in due)

    def _stride(self, name: str, stops: list[dict]) -> int:
        """How many of the sub-steps a muscle takes at a time."""
        count = len(stops) - 1
        if name not in self.cuts or count < 2:
            return 1
        return max(1, count // max(1, len(self.cuts[name].split(stops[0], stops[-1]))))

    def _begin_to(
        self, stops: list[dict], stop: int, here: Mapping[str, int]
    ) -> Callable[[MuscleStepper], None]:
        """First half of a sub-step of one muscle, from where it is."""

        def begin(stepper: MuscleStepper) -> None:
            before, after = stops[here[stepper.name]], stops[stop]
            stepper.begin(before, after)
            self.sliding.refresh(stepper, way_between(before, after))

        return begin

    def _settled(
        self, stops: list[dict], stop: int, here: Mapping[str, int]
    ) -> Callable[[MuscleStepper], None]:
        """What a muscle's neighbours learn from where it settled."""

        def settled(stepper: MuscleStepper) -> None:
            self.sliding.settled(stepper, way_between(stops[here[stepper.name]], stops[stop]))

        return settled

    def _carry_to(
        self, stops: list[dict], stop: int, here: Mapping[str, int]
    ) -> Callable[[MuscleStepper], None]:
        """Show a muscle where its bones take it meanwhile; left where it was, its neighbours would run into it."""

        def carry(stepper: MuscleStepper) -> None:
            before, after = stops[here[stepper.name]], stops[stop]
            state = stepper.model.snapshot()
            with stepper.timed("predict"):
                stepper.model.predict(stepper.poses(before), stepper.poses(after))
            self.sliding.refresh(stepper, way_between(before, after))
            stepper.model.restore(state)

        return carry
