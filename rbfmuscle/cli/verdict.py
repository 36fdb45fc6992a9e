"""The verdict of a run on a terminal: the count, the worst, what to do, where to look."""

from collections.abc import Iterator
from pathlib import Path
from textwrap import fill, shorten

from rbfmuscle.metrics.quantities import quantity_of
from rbfmuscle.metrics.summary import LIMITS, LOOK, Summary
from rbfmuscle.metrics.verdict import (
    describe_doubts,
    describe_excess,
    describe_unmeasured,
    find_remedy,
    worst_first,
)
from rbfmuscle.run.data import RunData
from rbfmuscle.scene.phantom import PHANTOM

MOST = 3  # values beyond limits that are named
WIDTH = 80  # characters of a line
LONGEST = 140  # characters about what was not measured or is doubtful: two lines


def verdict_lines(directory: Path) -> Iterator[str]:
    """Lines about a run in a folder, at most `WIDTH` characters each where no name is longer."""
    saved = RunData.load(directory)
    info, summary = saved.info, Summary()
    summary.add(saved.metrics)
    table = summary.table()
    yield _wrapped("verdict: ", info.outcome)
    named = worst_first(info.beyond)[:MOST]
    for row in named:
        yield _wrapped("  ", describe_excess(row, table, info.scene.missing_bones))
    if len(info.beyond) > len(named):
        yield f"  and {len(info.beyond) - len(named)} more values beyond their limits"
    missing = info.not_measured
    if missing:
        yield _wrapped("not measured: ", shorten(describe_unmeasured(missing), LONGEST))
    if info.doubts:
        yield _wrapped("doubtful: ", shorten(describe_doubts(info.doubts, MOST), LONGEST))
    known = [row for row in named if quantity_of(row.quantity) in LIMITS]
    remedies = dict.fromkeys(find_remedy(row, table) for row in known)
    remedies.pop(LOOK, None)  # said below, for all of them
    for remedy in remedies:
        yield _wrapped("what to do: ", remedy.replace("SCENE", info.scene.file or PHANTOM))
    if named and saved.has_surfaces and named[0].frame is not None:
        frame = named[0].frame
        yield f"where to look: rbfmuscle render {directory} --frame {frame} -o frame.png"


def _wrapped(head: str, text: str) -> str:
    return fill(head + text, WIDTH, subsequent_indent="    ", break_on_hyphens=False)
