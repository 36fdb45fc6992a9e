"""Sub-steps of muscles that slide on each other: each muscle takes its own, and all meet at the end of the frame."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING

from rbfmuscle.simulation.neighbours.extrapolation import coordinate_change
from rbfmuscle.simulation.stepper import MuscleStepper

if TYPE_CHECKING:
    from rbfmuscle.simulation.sliding import Sliding
    from rbfmuscle.simulation.substeps import SubSteps
    from rbfmuscle.simulation.workers import Workers


class CoupledStepper:
    """Advances muscles that exchange their surfaces through the sub-steps of a frame.

    The muscle with the most sub-steps divides the frame. Another muscle takes several of these at a time, as many as
    its own bones allow; in between its neighbours see its prediction. The result does not depend on the order of the
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
        """Solve all muscles at the coordinates of the sub-steps; the first of them are the present ones."""
        strides = {stepper.name: self._stride(stepper.name, stops) for stepper in self.steppers}
        last, here = len(stops) - 1, dict.fromkeys(strides, 0)
        for stop in range(1, last + 1):
            due = [s for s in self.steppers if stop == last or stop % strides[s.name] == 0]
            for stepper in due if len(activations) else ():
                stepper.set_activation(activations[stop - 1])
            workers.each(self._begin_to(stops, stop, here), due)
            if due:
                workers.each(self._carry_to(stops, stop, here), [s for s in self.steppers if s not in due])
            workers.each(self.sliding.update, due)
            workers.each(MuscleStepper.finish, due)
            workers.each(self._settled(stops, stop, here), due)
            here.update((stepper.name, stop) for stepper in due)

    def _stride(self, name: str, stops: list[dict]) -> int:
        """Number of sub-steps that a muscle takes at a time."""
        count = len(stops) - 1
        if name not in self.cuts or count < 2:
            return 1
        return max(1, count // max(1, len(self.cuts[name].split(stops[0], stops[-1]))))

    def _begin_to(
        self, stops: list[dict], stop: int, here: Mapping[str, int]
    ) -> Callable[[MuscleStepper], None]:
        """First half of a sub-step of one muscle."""

        def begin(stepper: MuscleStepper) -> None:
            before, after = stops[here[stepper.name]], stops[stop]
            stepper.begin(before, after)
            self.sliding.refresh(stepper, coordinate_change(before, after))

        return begin

    def _settled(
        self, stops: list[dict], stop: int, here: Mapping[str, int]
    ) -> Callable[[MuscleStepper], None]:
        """Update the extrapolation of a muscle's surface after its solve."""

        def settled(stepper: MuscleStepper) -> None:
            self.sliding.settled(stepper, coordinate_change(stops[here[stepper.name]], stops[stop]))

        return settled

    def _carry_to(
        self, stops: list[dict], stop: int, here: Mapping[str, int]
    ) -> Callable[[MuscleStepper], None]:
        """Show a muscle's prediction to its neighbours while it waits for its own sub-step."""

        def carry(stepper: MuscleStepper) -> None:
            before, after = stops[here[stepper.name]], stops[stop]
            state = stepper.model.snapshot()
            with stepper.timed("predict"):
                stepper.model.predict(stepper.poses(before), stepper.poses(after))
            self.sliding.refresh(stepper, coordinate_change(before, after))
            stepper.model.restore(state)

        return carry
