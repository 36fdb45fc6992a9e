"""Rows of a kernel study: which is recommended, and what they say."""

import math

from pydantic import BaseModel

from rbfmuscle.implicit.selection import SCAN, SPAN

# Errors this much apart are alike: points of another seed move them as far.
ALIKE = 1.05
# Rows beyond this condition are taken only where none that is as accurate is below it.
SOUND = 1e10
ENDS = "epsilon lies at an end of its search"


class KernelRow(BaseModel):
    """A kernel with a number of centres: what its field and that field's surface miss.

    ``shape`` is epsilon times the spacing, ``bound`` that of the condition, 0 for none. Errors are
    in the mesh's unit, of normals in degrees, of the volume relative; ``fit_time`` and
    ``evaluation_time`` (of 20,000 values) in seconds of processor time. ``trials`` are pairs of a
    shape and its error, ``unfit`` says why the row cannot be used; ``front`` rows are beaten by no
    other both in error and in time. What was not measured is None.
    """

    surface: str = ""
    kernel: str
    centres: int
    epsilon: float = 0.0
    shape: float | None = None
    condition: float | None = None
    bound: float = 0.0
    rms: float | None = None
    hausdorff: float | None = None
    normal_error: float | None = None
    volume_error: float | None = None
    fit_time: float | None = None
    evaluation_time: float | None = None
    trials: list[tuple[float, float]] = []
    unfit: str = ""
    note: str = ""
    front: bool = False

    @property
    def error(self) -> float:
        """The RMS error, infinite where there is none or the row is unfit."""
        return math.inf if self.unfit or self.rms is None else self.rms

    @property
    def cost(self) -> float:
        """What a frame pays for the field: a fit and the values at 20,000 points [s of processor
        time]; NaN where they were not timed.
        """
        return math.nan if self.fit_time is None else self.fit_time + (self.evaluation_time or 0.0)

    @property
    def title(self) -> str:
        """The row in words."""
        return f"{self.kernel}, {self.centres} centres"

    def toml(self) -> str:
        """The lines of a scene file's model table that give the row."""
        lines = ["[muscle.model]", 'name = "rbf"', f'kernel = "{self.kernel}"']
        lines.append(f"centres = {self.centres}")
        if self.epsilon:
            lines.append(f"epsilon = {self.epsilon:.6g}")
        if self.bound:
            lines.append(f"condition = {self.bound:g}")
        return "\n".join(lines)


class KernelFacts(BaseModel):
    """What ``kernels.json`` holds: the unit, the library's version, the date, the hash of each mesh
    by its name, and the rows of all.
    """

    units: str
    version: str
    date: str
    meshes: dict[str, str]
    rows: list[KernelRow]


def at_end(shape: float) -> bool:
    """Whether epsilon times the spacing lies at an end of its search, within a scan's step."""
    low, high = SPAN
    step = (high / low) ** (1.0 / (SCAN - 1))
    return shape <= low * step or shape >= high / step


def describe(rows: list[KernelRow]) -> str:
    """What to use of the rows of a study, and why."""
    best = recommend(rows)
    if best is None:
        return "Every field is unfit; take more centres."
    good = [row for row in rows if not row.unfit and row.centres == best.centres]
    least = min(row.error for row in good)
    tied = [row for row in good if row.error <= ALIKE * least]
    use = f"Use {best.kernel} with {best.centres} centres"
    counts = {row.centres for row in rows}
    nearest = min((row for row in rows if not row.unfit), key=lambda row: row.error)
    most = len(counts) > 1 and nearest.centres == max(counts)
    more = " The most centres that were tried err least; more may err less still." if most else ""
    if len(tied) == 1:
        less = 100 * (
            1 - best.error / min((row.error for row in good if row is not best), default=math.inf)
        )
        behind = (
            f": its error is {less:.0f} % less than that of the next kernel"
            if len(good) > 1
            else ""
        )
        return f"{use}{behind}.{more}"
    names = ", ".join(row.kernel for row in tied)
    near = f"the errors of {names} are within {100 * (ALIKE - 1):.0f} % of the least"
    shape = "" if best.epsilon else " and needs no shape parameter"
    return f"{use}: {near}, and of these {best.kernel} is among the quickest{shape}.{more}"


def recommend(rows: list[KernelRow]) -> KernelRow | None:
    """The quickest of the rows that err at most 5 % more than the best, None where every one is
    unfit.

    Sound conditions come first; of rows alike in time, within 15 %, those without a parameter to
    choose.
    """
    good = [row for row in rows if not row.unfit]
    if not good:
        return None
    least = min(row.error for row in good)
    alike = [row for row in good if row.error <= ALIKE * least]
    sound = [row for row in alike if (row.condition or math.inf) <= SOUND] or alike
    quick = min(row.cost for row in sound)
    alike = [row for row in sound if row.cost <= 1.15 * quick]
    return min(alike, key=lambda row: (bool(row.epsilon), row.condition or math.inf))
