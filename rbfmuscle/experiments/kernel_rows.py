"""Rows of a kernel study: which is recommended, and what they say."""

import numpy as np

from rbfmuscle.implicit.selection import SCAN, SPAN

# Errors this much apart are alike: points of another seed move them as far.
ALIKE = 1.05
# Rows beyond this condition are taken only where none that is as accurate is below it.
SOUND = 1e10


ENDS = "epsilon lies at an end of its search"


def at_end(shape: float) -> bool:
    """Whether epsilon times the spacing lies at an end of its search, within a scan's step."""
    low, high = SPAN
    step = (high / low) ** (1.0 / (SCAN - 1))
    return shape <= low * step or shape >= high / step


def row_toml(row: dict) -> str:
    """The lines of a scene file's model table that give a row of a study."""
    lines = [
        "[muscle.model]",
        'name = "rbf"',
        f'kernel = "{row["kernel"]}"',
        f"centres = {row['centres']}",
    ]
    if row["epsilon"]:
        lines.append(f"epsilon = {row['epsilon']:.6g}")
    if row["bound"]:
        lines.append(f"condition = {row['bound']:g}")
    return "\n".join(lines)


def describe(rows: list[dict]) -> str:
    """What to use of the rows of a study, and why."""
    best = recommend(rows)
    if best is None:
        return "Every field is unfit; take more centres."
    good = [row for row in rows if not row["unfit"] and row["centres"] == best["centres"]]
    least = min(row["rms"] for row in good)
    tied = [row for row in good if row["rms"] <= ALIKE * least]
    use = f"Use {best['kernel']} with {best['centres']} centres"
    counts = {row["centres"] for row in rows}
    nearest = min((row for row in rows if not row["unfit"]), key=lambda row: row["rms"])
    most = len(counts) > 1 and nearest["centres"] == max(counts)
    more = " The most centres that were tried err least; more may err less still." if most else ""
    if len(tied) == 1:
        less = 100 * (
            1 - best["rms"] / min((row["rms"] for row in good if row is not best), default=np.inf)
        )
        behind = (
            f": its error is {less:.0f} % less than that of the next kernel"
            if len(good) > 1
            else ""
        )
        return f"{use}{behind}.{more}"
    names = ", ".join(row["kernel"] for row in tied)
    near = f"the errors of {names} are within {100 * (ALIKE - 1):.0f} % of the least"
    shape = "" if best["epsilon"] else " and needs no shape parameter"
    return f"{use}: {near}, and of these {best['kernel']} is among the quickest{shape}.{more}"


def row_name(row: dict) -> str:
    """A row in words."""
    return f"{row['kernel']}, {row['centres']} centres"


def cost(row: dict) -> float:
    """What a frame pays for a row's field: a fit and the values at 20,000 points [s of processor
    time].
    """
    return float(row["fit_time"] + row["evaluation_time"])


def recommend(rows: list[dict]) -> dict | None:
    """The quickest of the rows that err at most 5 % more than the best, None where every one is
    unfit.

    Sound conditions come first; of rows alike in time, within 15 %, those without a parameter to
    choose.
    """
    good = [row for row in rows if not row["unfit"]]
    if not good:
        return None
    least = min(row["rms"] for row in good)
    alike = [row for row in good if row["rms"] <= ALIKE * least]
    sound = [row for row in alike if row["condition"] <= SOUND] or alike
    quick = min(cost(row) for row in sound)
    alike = [row for row in sound if cost(row) <= 1.15 * quick]
    return min(alike, key=lambda row: (bool(row["epsilon"]), row["condition"]))
