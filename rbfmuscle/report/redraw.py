"""Write the page of a saved run again, after a change of limits or texts."""

from pathlib import Path

from rbfmuscle.metrics.summary import Limits, Summary, parse_limits
from rbfmuscle.metrics.verdict import describe_verdict, judge, require_limits
from rbfmuscle.output.info import RunInfo
from rbfmuscle.output.run_data import RunData
from rbfmuscle.output.writer import PAGES, run_folder, write_json
from rbfmuscle.report.report import write_report
from rbfmuscle.scene.scene import Scene
from rbfmuscle.validation import UsageError


def redraw_run(
    directory: str | Path, *, fail_on: str | None = None, pictures: bool = True
) -> RunInfo:
    """Hold a saved run to limits again and write its pages; what ``run.json`` then holds.

    ``fail_on`` are limits as for `parse_limits`, those that the run had where not given;
    ``pictures`` are those of the report and the preview.

    Raises
    ------
    UsageError
        If the folder holds no run that has ended, or a file that is not the run's is in the way.
    LimitExceededError
        If a limit of ``fail_on`` is exceeded, or was not measured; everything is written.
    """
    directory = Path(directory)
    saved = RunData.load(directory)
    info = saved.info
    if info.status == "running":
        raise UsageError(f"{directory} holds a run that has not ended; run the scene again")
    folder = run_folder(directory)
    limits = _limits(saved, fail_on)
    summary = Summary()
    summary.add(saved.metrics)
    table = summary.table()
    verdict = judge(table, limits, info.doubts)
    info = info.replaced(
        limits=dict(limits.values),
        fail_on=dict(limits.fail_on),
        verdict=describe_verdict(verdict, table, info.scene.missing_bones),
        **verdict._asdict(),
    )
    drawn = pictures and saved.has_surfaces and len(saved.frames) > 1
    folder.add(*(PAGES if drawn else PAGES[:1]))
    write_json(directory / "run.json", info.to_dict())
    write_report(directory, pictures=pictures)
    require_limits(table, limits)
    return info


def _limits(saved: RunData, fail_on: str | None) -> Limits:
    given = saved.info.fail_on
    texts = [name if value is None else f"{name}={value!r}" for name, value in given.items()]
    return parse_limits(texts if fail_on is None else fail_on, Scene(units=saved.units))
