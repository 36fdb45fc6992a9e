"""What a sweep found: a row for each point, and a verdict on each default."""

import math

from pydantic import BaseModel


class SweepRow(BaseModel):
    """One point of a sweep.

    ``role`` is "reference", "default" or ""; ``status`` "done", "failed" or "missing"; ``values``
    are those of `VALUES` that are known, lengths in ``units``; ``reference`` is the key of the
    point that errors are measured against, "" where there is none.
    """

    scene: str
    units: str
    role: str = ""
    status: str = "done"
    front: bool = False
    settings: dict[str, object]
    values: dict[str, float]
    seconds: float | None = None
    threads: int | None = None
    machine: str = ""
    error: str = ""
    label: str
    reference: str
    key: str

    def value(self, quantity: str) -> float:
        """A value, NaN where it is not known."""
        return self.values.get(quantity, math.nan)


class FrontVerdict(BaseModel):
    """Where the default of a scene lies.

    ``factor`` is the least by which both error and time of the default must fall to lie on the
    front, 1 on it; ``near``: up to `NEAR`; ``faster``, ``better``: keys of the quickest point of
    no greater error and the most accurate of no greater time, None where there is none; ``text``:
    all of it in words.
    """

    scene: str
    factor: float
    near: bool
    faster: str | None
    better: str | None
    default: str
    text: str


class SweepTable(BaseModel):
    """What ``sweep.json`` holds; ``quantity`` is the error on the axis of the Pareto front, then
    follow counts of points.
    """

    quantity: str
    done: int
    failed: int
    missing: int
    verdicts: list[FrontVerdict]
    rows: list[SweepRow]
