"""``rbfmuscle report``: the page of a run or a study, written again; the verdict of a run on a
terminal.
"""

import json
from collections.abc import Iterable, Iterator
from functools import partial
from itertools import chain
from pathlib import Path
from textwrap import fill, shorten
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from rbfmuscle.cli.options import (
    USUAL,
    FailOn,
    Printing,
    print_result,
)
from rbfmuscle.progress import Progress, stage
from rbfmuscle.validation import (
    LimitExceededError,
    UsageError,
)

if TYPE_CHECKING:
    from rbfmuscle.run.data import RunData

MOST = 3  # values beyond limits that are named
WIDTH = 80  # characters of a line
LONGEST = 140  # characters of a text: two lines


def verdict_lines(saved: "RunData") -> Iterator[str]:
    """Lines about a run in a folder, at most `WIDTH` characters each where no name is longer; what
    to do is not wrapped, so that commands can be copied.
    """
    from rbfmuscle.metrics.verdict import REMEDIES, Verdict, verdict_parts
    from rbfmuscle.scene.phantom import PHANTOM

    info = saved.info
    verdict = Verdict(info.outcome, info.beyond, info.not_measured, info.doubts)
    yield _wrapped(f"verdict: {info.outcome}")
    parts = verdict_parts(verdict, saved.summarise(), info.scene.missing_bones, values=MOST)
    for head, texts in parts.items():
        yield f"{head.lower()}:"
        for text in texts:
            if head == REMEDIES:
                text = text.replace("render RUN", f"render {saved.directory}")
                yield f"  {text.replace('check SCENE', f'check {info.scene.file or PHANTOM}')}"
            else:
                yield _wrapped(f"  {shorten(text, LONGEST)}")


def _wrapped(text: str) -> str:
    return fill(text, WIDTH, subsequent_indent="    ", break_on_hyphens=False)


def report(
    directory: Annotated[
        Path, Parameter(help="Folder of a run, a comparison, a study of kernels or a sweep.")
    ],
    *,
    fail_on: FailOn = None,
    pictures: bool = True,
    printing: Printing = USUAL,
) -> int:
    """Write the page of a run or a study again, for instance after a change of limits.

    Parameters
    ----------
    pictures
        Draw pictures and the animation.
    """
    from rbfmuscle.run.data import RunData

    with Progress(f"report {directory}"), stage("drawing pictures" if pictures else "writing"):
        from rbfmuscle.display.report import redraw_run

        failed, page = None, directory / "report.html"
        study = _redraw_study(directory, pictures=pictures)
        if study is not None:
            if fail_on is not None:
                raise UsageError(f"--fail-on is for the folder of a run, {directory} holds several")
            page, facts = study
        else:
            try:
                facts = redraw_run(directory, fail_on=fail_on, pictures=pictures).to_dict()
            except LimitExceededError as error:
                facts, failed = RunData.load(directory).info.to_dict(), error
    said: Iterable[str] = ()
    if page.name == "report.html":
        said = (
            [str(facts["answer"])] if "answer" in facts else verdict_lines(RunData.load(directory))
        )
    return print_result(printing, facts, chain(said, [f"open {page}"]), error=failed)


def _redraw_study(directory, *, pictures):
    """Write the page of a comparison, a study of kernels or a sweep again; the page, and what the
    JSON file beside it holds, or None where the folder holds none of these.
    """
    from rbfmuscle.folders import OutputFolder
    from rbfmuscle.studies import compare, kernels, sweep

    for name, study, write_page in (
        ("comparison.json", compare.Comparison, partial(compare.write_page, pictures=pictures)),
        ("kernels.json", kernels.KernelStudy, kernels.write_page),
        ("sweep.json", sweep.SweepTable, sweep.write_page),
    ):
        path = directory / name
        if not path.exists():
            continue
        OutputFolder(directory, study.command, [study.page])
        try:
            facts = json.loads(path.read_text(encoding="utf-8"))
            write_page(directory, study.model_validate(facts))
        except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
            raise UsageError(
                f"{path} is not as it was written ({error!r}); run the command again"
            ) from None
        return directory / study.page, facts
    return None
