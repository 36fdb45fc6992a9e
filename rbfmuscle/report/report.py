"""The report of a run: one HTML file with pictures, animation, plots and tables; no network needed."""

from __future__ import annotations

import html
import math
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING

from rbfmuscle.metrics.quantities import QUANTITIES
from rbfmuscle.metrics.summary import LEAST, describe_verdict, exceeded
from rbfmuscle.output.saved import SavedRun
from rbfmuscle.report.appearance import USUAL_VIEWS, line_colours
from rbfmuscle.report.page import (
    EXPLANATION,
    MANY,
    PAGE,
    SORTING,
    STYLE,
    embedded_image,
    find_field,
    folded_events,
    sortable_table,
    worst_first,
)
from rbfmuscle.report.plots import plot_panels
from rbfmuscle.report.render import chosen_frames, draw_pictures
from rbfmuscle.validation import SolveError

if TYPE_CHECKING:
    from rbfmuscle.validation import MissingPartError


_PICTURE_SIZE = (330, 400)
_PREVIEW_SIZE = (330, 400)
_MOST_EVENTS = 60
# What frames took of a muscle.
_WORK = ("solved", "carried", "skipped", "substeps")
# Volume, moment arms and stage times have tables or plots of their own.
_ELSEWHERE = ("volume", "moment_arm", "time_solve", "time_fit", "time_extract")
_TABLE = [name for name in QUANTITIES if name not in _ELSEWHERE]


def write_report(
    directory: str | Path, *, report: bool = True, preview: bool = True, pictures: bool = True
) -> MissingPartError:
    """Write ``report.html`` and ``preview.webp`` for a saved run.

    Parameters
    ----------
    directory : path
        Folder of the run.
    report, preview : bool
        Which of both.
    pictures : bool
        Draw pictures of the poses; without, the report says that there are none.

    Returns
    -------
    MissingPartError or None
        Why there are no pictures, where drawing failed. The report is written all the same.

    Raises
    ------
    SolveError
        If the files cannot be written.
    """
    saved = SavedRun(directory)
    animation = saved.directory / "preview.webp"
    with ThreadPoolExecutor(1) as beside:
        # The child that draws leaves a core to the plots.
        drawing = beside.submit(
            draw_pictures,
            saved.directory,
            lambda folder: _jobs(saved, folder, animation, report and pictures, preview),
        )
        plots = plot_panels(saved) if report else []
        images, missing = drawing.result()
    if report:
        moving = animation.read_bytes() if animation.is_file() else None
        reason = str(missing) if missing else ("" if pictures else "pictures were switched off")
        try:
            (saved.directory / "report.html").write_text(
                _page(saved, plots, (images, moving, reason)), encoding="utf-8"
            )
        except OSError as error:
            raise SolveError(f"cannot write the report: {error.strerror}") from None
    return missing


def key_frames(saved: SavedRun) -> list[int]:
    """First, middle and last written frame, each once."""
    middle = saved.frames[len(saved.frames) // 2]
    return list(dict.fromkeys([saved.frames[0], middle, saved.frames[-1]]))


def _jobs(saved, folder, animation, pictures, preview):
    if not saved.has_surfaces():
        return []
    jobs = []
    if pictures:
        for frame in key_frames(saved):
            job = {"file": str(folder / f"{frame:06d}.png"), "frames": [frame], "views": list(USUAL_VIEWS)}
            jobs.append({**job, "size": _PICTURE_SIZE, "fit": True})
    if preview and len(saved.frames) > 1:
        job = {
            "file": str(animation.resolve()),
            "frames": chosen_frames(saved.frames),
            "views": ["front", "side"],
        }
        jobs.append({**job, "size": _PREVIEW_SIZE, "fit": True})
    return jobs


def _page(saved, plots, drawn):
    info = saved.info
    return PAGE.format(
        style=STYLE,
        title=html.escape(info["scene"]["name"]),
        facts=_facts(saved),
        verdict=_verdict(saved),
        pictures=_pictures(*drawn),
        legend=_legend(saved),
        plots="".join(f"<figure>{embedded_image(data, 'svg+xml', title)}</figure>" for title, data in plots),
        table=_summary(saved),
        stages=_stages(saved),
        events=_events(saved),
        explanation=EXPLANATION,
        script=SORTING,
        neighbours=_neighbours(saved),
        quantities="".join(
            f"<dt>{name}</dt><dd>{html.escape(meaning)}</dd>" for name, (_, meaning) in QUANTITIES.items()
        ),
        versions=html.escape(", ".join(f"{name} {value}" for name, value in info["versions"].items())),
    )


def _facts(saved):
    info = saved.info
    models = sorted({muscle["model"]["name"] for muscle in info["scene"]["muscles"]})
    frame = info.get("frame_time") or {}
    facts = [
        ("model", ", ".join(models)),
        ("muscles", len(saved.muscles)),
        ("frames", len(saved.frames)),
        ("time a frame, median", f"{1000 * frame['median']:.0f} ms" if frame.get("median") else "-"),
        ("whole run", f"{info['times']['wall']:.1f} s"),
        ("status", info["status"]),
    ]
    return "".join(f"<div><b>{html.escape(str(value))}</b><span>{name}</span></div>" for name, value in facts)


def _beyond(saved):
    """Set of (muscle, quantity) beyond the limits in run.json."""
    return {(muscle, name) for muscle, name, *_ in exceeded(saved.info["muscles"], saved.info["limits"])}


def _verdict(saved):
    if saved.info["status"] != "complete":
        message = html.escape(saved.info["message"] or "")
        return f'<p class="bad">The run ended early ({saved.info["status"]}): {message}</p>'
    text = html.escape(describe_verdict(saved.info["muscles"], saved.info["limits"]))
    return f'<p class="{"bad" if _beyond(saved) else "good"}">{text[0].upper()}{text[1:]}.</p>'


def _pictures(images, moving, reason):
    if not images and moving is None:
        text = html.escape(reason or "this run kept no surfaces")
        return f'<p class="note">There are no pictures: {text}.</p>'
    parts = [embedded_image(data, "png", f"frame {int(name)}") for name, data in images.items()]
    if moving is not None:
        parts.insert(0, embedded_image(moving, "webp", "the whole motion"))
    note = f'<p class="note">{html.escape(reason)}</p>' if reason else ""
    return note + "".join(f"<figure>{part}</figure>" for part in parts)


def _legend(saved):
    if len(saved.muscles) >= MANY:
        return "In each plot the muscles that go furthest are named; all others are grey. <span>" + (
            '<i class="limit"></i>limit</span>'
        )
    chips = "".join(
        f'<span><i style="background:{colour}"></i>{html.escape(name)}</span>'
        for name, colour in line_colours(saved.muscles).items()
    )
    return f'{chips}<span><i class="limit"></i>limit</span>'


def _summary(saved):
    muscles, beyond = saved.info["muscles"], _beyond(saved)
    used = [name for name in _TABLE if any(name in found for found in muscles.values())]
    if len(muscles) >= MANY:
        return _by_muscle(saved, muscles, beyond, used)
    head = "".join(f"<th>{html.escape(name)}</th>" for name in muscles)
    rows = []
    for name in used:
        cells = []
        for muscle, found in muscles.items():
            mark = ' class="bad"' if (muscle, name) in beyond else ""
            cells.append(f"<td{mark}>{_cell(name, found.get(name))}</td>")
        rows.append(
            f"<tr><th>{_named(name, muscles)}</th>{''.join(cells)}<td>{_shown_limit(saved, name)}</td></tr>"
        )
    return f"<table><tr><th></th>{head}<th>limit</th></tr>{''.join(rows)}</table>"


def _by_muscle(saved, muscles, beyond, used):
    """A row a muscle, the worst first, for a report of many."""
    head = [
        "muscle",
        *(f"{_named(name, muscles)}<br><small>{_shown_limit(saved, name)}</small>" for name in used),
    ]
    rows = []
    for muscle in worst_first(muscles, beyond, saved.info["limits"]):
        found = muscles[muscle]
        cells = [(html.escape(muscle), muscle, False)]
        for name in used:
            facts = found.get(name) or {}
            value = facts.get("median" if name == "time_frame" else "worst")
            cells.append((_cell(name, facts), value, (muscle, name) in beyond))
        rows.append(cells)
    return find_field() + sortable_table(head, rows)


def _named(name, muscles):
    unit = next(found[name]["unit"] for found in muscles.values() if name in found)
    return name if unit in ("1", "s") else f"{name} <small>{unit}</small>"


def _shown_limit(saved, name):
    limit = saved.info["limits"].get(name)
    return "" if limit is None else f"{'≥' if name in LEAST else '≤'} {limit:g}"


def _cell(name, facts):
    if not facts or facts.get("worst") is None:
        return "-"
    if name in ("length", "edge_strain_rms"):
        return f"{facts['min']:.4g} … {facts['max']:.4g}"
    if name == "time_frame":
        return f"{1000 * facts['median']:.3g} ms <small>median</small>"
    small = f" <small>frame {facts['worst_frame']}</small>" if facts["worst"] else ""
    return f"{facts['worst']:.3g}{small}"


def _stages(saved):
    """What each stage took of each muscle, the most expensive first, and what its frames took."""
    stages, work = saved.info.get("stages") or {}, saved.info.get("work") or {}
    names = list(dict.fromkeys(key for table in stages.values() for key in table))
    rows = []
    for muscle, table in sorted(stages.items(), key=lambda row: -(_median(row[1].get("time_frame")) or 0.0)):
        cells = [(html.escape(muscle), muscle, False)]
        cells += [(_milliseconds(table.get(name)), _median(table.get(name)), False) for name in names]
        rows.append(cells + _work(work.get(muscle)))
    return sortable_table(["", *(name.removeprefix("time_") for name in names), *_WORK, "mostly for"], rows)


def _median(facts):
    value = facts and facts["median"]
    return value if value is not None and math.isfinite(value) else None


def _work(done):
    """Cells of what the frames took of a muscle."""
    if not done:
        return [("-", None, False)] * len(_WORK) + [("-", "", False)]
    most = max(done["reasons"], key=lambda state: done[state], default="")
    counts = [(str(done[name]), done[name], False) for name in _WORK]
    return [*counts, (html.escape(done["reasons"].get(most, "")), "", False)]


def _milliseconds(facts):
    if not facts or facts["median"] is None or not math.isfinite(facts["median"]):
        return "-"
    return f"{1000 * facts['median']:.1f} <small>{1000 * facts['p95']:.1f}</small>"


def _neighbours(saved):
    """Pairs of muscles that slide on each other, the deepest overlap first."""
    pairs = saved.info.get("neighbours") or []
    if not pairs:
        return ""
    rows = [
        [
            (html.escape(" and ".join(pair["muscles"])), "", False),
            (
                f"{pair['overlap_max']:.3g} <small>frame {pair['overlap_frame']}</small>",
                pair["overlap_max"],
                False,
            ),
            (f"{pair['gap_rms']:.3g} <small>frame {pair['gap_frame']}</small>", pair["gap_rms"], False),
        ]
        for pair in pairs
    ]
    unit = html.escape(saved.units)
    head = ["pair", f"overlap <small>{unit}</small>", f"gap opened, RMS <small>{unit}</small>"]
    return f'<h2>Neighbours</h2><div class="wide">{sortable_table(head, rows)}</div>'


def _events(saved):
    return folded_events(saved.events, _MOST_EVENTS) if saved.events else '<p class="note">None.</p>'
