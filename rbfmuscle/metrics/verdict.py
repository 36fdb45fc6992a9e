"""The verdict of a run, as data and in sentences."""

from collections.abc import Sequence
from typing import NamedTuple

from rbfmuscle.metrics.quantities import ALL, quantity_of, split_name
from rbfmuscle.metrics.summary import (
    LIMITS,
    LOWER_BOUNDS,
    Doubt,
    Exceedance,
    Limits,
    Table,
    Unmeasured,
    exceeded,
    shown_number,
    unmeasured,
)
from rbfmuscle.validation import LimitExceededError

MOST_NAMED = 6  # exceeded limits that a verdict names


class Verdict(NamedTuple):
    """What a run is worth: which muscles are within all limits in one sentence, what is beyond a
    limit, the limits without a value, and doubts.
    """

    outcome: str
    beyond: list[Exceedance]
    not_measured: list[Unmeasured]
    doubts: list[Doubt]


def judge(table: Table, limits: Limits, doubts: Sequence[Doubt] = ()) -> Verdict:
    """The verdict of a run's table."""
    found, missing = exceeded(table, limits), unmeasured(table, limits)
    return Verdict(_outcome(table, found, missing), found, missing, list(doubts))


def _outcome(table: Table, found: list[Exceedance], missing: list[Unmeasured]) -> str:
    """Which muscles are within all limits."""
    muscles = [name for name in table if name != ALL]
    wrong = [name for name in dict.fromkeys(row.muscle for row in found) if name != ALL]
    unknown = [name for name in dict.fromkeys(row.muscle for row in missing) if name != ALL]
    if not muscles:
        text = "nothing was measured"
    elif not wrong:
        held = "all limits that were measured" if missing else "all limits"
        text = f"every muscle is within {held} in every frame"
    elif len(muscles) == 1:
        text = f"{muscles[0]} is not within all limits"
    else:
        right = len(set(muscles).difference(wrong, unknown))
        count = (
            f"{right} of {len(muscles)} muscles {'is' if right == 1 else 'are'} within all limits"
        )
        text = f"{count}; {_listed(wrong)} {'is' if len(wrong) == 1 else 'are'} not"
    bones = any(row.muscle == ALL for row in found) and not wrong
    return f"{text}; the bones are not" if bones else text


def describe_verdict(
    verdict: Verdict, table: Table, missing_bones: Sequence[str] = (), *, most_doubts: int = 1
) -> str:
    """A verdict in sentences: its outcome, the worst of what is beyond a limit, what to do, what
    was not measured, and what is doubtful; bones ``missing_bones``.
    """
    return ". ".join(
        [verdict.outcome, *describe_details(verdict, table, missing_bones, most_doubts)]
    )


def describe_details(
    verdict: Verdict, table: Table, missing_bones: Sequence[str], most_doubts: int
) -> list[str]:
    """The sentences of a verdict after its outcome."""
    texts = []
    if verdict.beyond:
        texts += _worst_and_remedies(verdict.beyond, table, missing_bones)
    if verdict.not_measured and set(table) - {ALL}:
        texts.append(f"Not measured: {describe_unmeasured(verdict.not_measured)}")
    if verdict.doubts:
        texts.append(f"Doubtful: {describe_doubts(verdict.doubts, most_doubts)}")
    return texts


def describe_doubts(doubts: Sequence[Doubt], most: int) -> str:
    """The first of some doubts, and how many more there are."""
    texts = [
        doubt.text if doubt.muscle == ALL else f"{doubt.muscle}: {doubt.text}" for doubt in doubts
    ]
    more = [f"and {len(texts) - most} more"] if len(texts) > most else []
    return "; ".join([*texts[:most], *more])


def describe_unmeasured(missing: Sequence[tuple[str, str]]) -> str:
    """Each limit that was not measured, with the muscles of which it was not."""
    by_quantity: dict[str, list[str]] = {}
    for muscle, quantity in missing:
        by_quantity.setdefault(quantity, []).extend([] if muscle == ALL else [muscle])
    texts = [f"{q}{f' of {_listed(n)}' if n else ''}" for q, n in by_quantity.items()]
    more = f" and {len(texts) - MOST_NAMED} more" if len(texts) > MOST_NAMED else ""
    return "; ".join(texts[:MOST_NAMED]) + more


def _worst_and_remedies(found, table, missing_bones):
    named = worst_first(found)[:MOST_NAMED]
    remedies: dict[str, str] = {}
    for row in named:
        if quantity_of(row.quantity) in LIMITS:
            remedy = find_remedy(row, table)
            remedies.setdefault(remedy, remedy.replace("FRAME", str(row.frame)))
    values = "; ".join(describe_excess(row, table, missing_bones) for row in named)
    more = f" and {len(found) - len(named)} more" if len(found) > len(named) else ""
    to_do = [f"What to do: {'; '.join(remedies.values())}"] if remedies else []
    return [f"Worst: {values}{more}", *to_do]


def worst_first(found: Sequence[Exceedance]) -> list[Exceedance]:
    """The worst excess of each muscle, then the others; ``found`` are the worst first."""
    first = {row.muscle: row for row in reversed(found)}.values()
    return sorted(found, key=lambda row: row not in first)


def find_remedy(row: Exceedance, table: Table) -> str:
    """What to do about one excess; smaller steps do not mend an overlap of the meshes at rest, and
    mesh models have no centres.
    """
    muscle, quantity, _, limit, _ = row
    overlap = table[muscle].get("initial_overlap", {}).get("worst")
    depth = quantity in ("penetration_max", "bone_penetration_max")
    at_rest = depth and overlap is not None and overlap > limit
    limit_kind = LIMITS["initial_overlap" if at_rest else quantity_of(quantity)]
    is_mesh = "unfitted_fraction" not in table[muscle]
    return (is_mesh and limit_kind.mesh_remedy) or limit_kind.remedy


def _listed(names):
    more = f" and {len(names) - MOST_NAMED} more" if len(names) > MOST_NAMED else ""
    return f"{', '.join(names[:MOST_NAMED])}{more}"


def describe_excess(row: Exceedance, table: Table, missing_bones: Sequence[str] = ()) -> str:
    """One value beyond its limit, in words; bones ``missing_bones``."""
    muscle, quantity, worst, limit, frame = row
    unit = table[muscle][quantity]["unit"]
    value = shown_number(worst, unit)
    shown_limit = f"{limit:.3g}"
    # Less than is shown elsewhere, or so near to the limit that it would look the same.
    if value.startswith("<") or shown_number(worst) == shown_limit:
        value = f"{worst:.5g} {unit}".removesuffix(" 1")
        shown_limit = f"{limit:.5g}"
    place = "the bones" if muscle == ALL else muscle
    quantity, coordinate = split_name(quantity)
    title = LIMITS[quantity].title if quantity in LIMITS else quantity
    title += f" ({coordinate})" if coordinate else ""
    title += f" ({_listed(missing_bones)})" if quantity == "missing_bones" else ""
    return f"{place}, {title} {value} at frame {frame} (limit {shown_limit})"


def require_limits(table: Table, limits: Limits) -> None:
    """Raise LimitExceededError naming everything beyond the limits of ``fail_on``, and those of
    them that were not measured.
    """
    failing = limits.failing()
    texts = [
        f"{m}: {q} = {v:.4g} {'<' if q in LOWER_BOUNDS else '>'} {limit:g} at frame {f}"
        for m, q, v, limit, f in exceeded(table, failing)
    ]
    missing = unmeasured(table, failing)
    texts += [f"not measured: {describe_unmeasured(missing)}"] if missing else []
    if texts:
        raise LimitExceededError("; ".join(texts))
