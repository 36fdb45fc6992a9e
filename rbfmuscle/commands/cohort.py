"""``rbfmuscle sweep`` over many scenes: a cohort of subjects and trials."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rbfmuscle.progress import Progress
from rbfmuscle.validation import SolveError, UsageError

if TYPE_CHECKING:
    from rbfmuscle.study.cohort.jobs import CohortJob


def sweep_cohort(
    sources: tuple[str, ...],
    output: Path,
    *,
    asked: dict[str, Any],
    jobs: int | None,
    scheduler: str | None,
    retry: bool,
    as_json: bool,
) -> None:
    """Run every job of a cohort that is not done, and write its table and its page."""
    from rbfmuscle import interruption
    from rbfmuscle.study.cohort.jobs import read_cohort
    from rbfmuscle.study.cohort.page import write_cohort_page
    from rbfmuscle.study.cohort.runs import CohortRunner
    from rbfmuscle.study.cohort.table import write_cohort

    chosen = read_cohort(sources, asked)
    with (
        Progress(f"cohort of {len(chosen)} jobs", what="job") as progress,
        interruption.keeping(lambda: True),
    ):
        runner = CohortRunner(run_job, chosen, output, count=jobs, scheduler=scheduler, progress=progress)
        try:
            runner.run(retry=retry)
        except KeyboardInterrupt:
            raise KeyboardInterrupt(
                f"interrupted; frames and finished jobs are kept in {output}, the same command goes on"
            ) from None
    table = write_cohort(chosen, output)
    write_cohort_page(table, output, title=f"Cohort of {Path(output).resolve().name}")
    _tell(table, output, as_json)


def run_job(job: CohortJob, directory: Path) -> dict[str, Any]:
    """One run of a cohort into its folder; module-level, so that it can be sent away."""
    from rbfmuscle.commands.scenes import load_scene
    from rbfmuscle.run import stream_run

    scene = load_scene(job.scene)
    if job.motion:
        scene.set_motion(file=job.motion)
    options: dict[str, Any] = {
        "model": job.model or None,
        "frames": job.frames or None,
        "settings": job.settings,
        "pictures": False,
    }
    return stream_run(scene, directory, **options)


def _tell(table, output, as_json):
    from rbfmuscle.study.cohort.table import shown_name

    if as_json:
        from rbfmuscle.study.files.writer import json_text

        facts = {key: value for key, value in table.items() if key != "values"}
        print(json_text({"directory": str(output), **facts}))
    else:
        for one in table["outliers"][:5]:
            print(
                f"apart: {shown_name(one)}, {one['muscle']}: {one['quantity']} = {one['value']:.4g} {one['unit']}, "
                f"median {one['median']:.4g}"
            )
        print(
            f"{table['done']} jobs done, {table['failed']} failed, {len(table['outliers'])} values apart, "
            f"in {output}, open {output / 'cohort.html'}"
        )
    bad = [row for row in table["jobs"] if row["status"] != "done"]
    if bad:
        for row in bad[:5]:
            print(f"rbfmuscle: {shown_name(row)}: {row['error'] or row['status']}", file=sys.stderr)
        raise SolveError(
            f"{len(bad)} of {len(table['jobs'])} jobs failed; the others are kept, --retry runs these again"
        )


def check_options(**given: Any) -> None:
    """Refuse what goes with a grid over one scene only."""
    for name, value in given.items():
        if value:
            raise UsageError(
                f"--{name} belongs to a sweep over one scene; a cohort takes its settings from a table"
            )
