"""Tables and figures of the pages, from the JSON files in ``docs/evidence``.

    python docs/figures.py                   # write them anew into README.md and docs/*.md
    python docs/figures.py --measure [NAME]  # measure first: minutes to an hour, on a quiet machine

In a page a table of figures stands between ``<!-- evidence: NAME -->`` and ``<!-- end -->``, one of
the library's own facts between ``<!-- table: NAME -->`` and ``<!-- end -->``. A test fails where a
page says something else.
"""

import argparse
import json
import os
import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

import numpy as np  # noqa: E402

from rbfmuscle.display.plots import Band, Track, line_plot  # noqa: E402
from rbfmuscle.metrics.quantities import QUANTITIES  # noqa: E402
from rbfmuscle.metrics.summary import LIMITS, LOWER_BOUNDS, MORE_BOWING  # noqa: E402
from rbfmuscle.metrics.verdict import published_band  # noqa: E402
from rbfmuscle.run.appearance import MUSCLE_COLOURS  # noqa: E402

EVIDENCE = ROOT / "docs" / "evidence"
ARMS_IMAGE = ROOT / "docs" / "images" / "hip_fibres.svg"
_TABLE = re.compile(r"<!-- evidence: ([\w]+) -->\n.*?<!-- end -->", re.S)
_FACTS = re.compile(r"<!-- table: ([\w]+) -->\n.*?<!-- end -->", re.S)

# Name: what measures it, in minutes. DATA stands for the folder of the real hip and leg.
_FLEXION = "DATA/hip/flexion.toml"
COMMANDS = {
    "headline": f"headline.py {_FLEXION}",
    "known_answers": "known_answers.py",
    "phantom_solid": "fe_reference.py compare",
    "real_solids": "real_solids.py compare gluteus_maximus rectus_femoris",
    "touching_solids": "fe_touching.py compare",
    "mesh_models": "mesh_models.py",
    "one_pose": f"one_pose.py {_FLEXION}",
    "combined_motions": f"combined_motions.py {_FLEXION} --seeds 7 8",
    "bone_fields": "bench_sdf.py --data DATA --bones femur",
    "kernels": "kernel_table.py DATA --kernels cubic,quintic,gaussian,wendland_c4 --centres 300",
    "interpolation": "interpolation.py",
    "hip_fibres": "hip_moment_arms.py",
    "ischial_cover": "ischial_cover.py",
    "leg_arms": "leg_arms.py",
    "guess_confidence": "guess_confidence.py",
    "node_counts": "node_counts.py",
    "whole_run": f"whole_run.py {_FLEXION}",
    "before_after": "before_after.py",
}


def bound(value, digits):
    """A length as a table says it: rounded, or the bound that it keeps (``{"below": b}`` where that
    is all we know).
    """
    least = 10.0**-digits
    if isinstance(value, dict):
        return f"< {value['below']:g}"
    return f"< {least:.{digits}f}" if value < least else f"{value:.{digits}f}"


def volume(value):
    """A relative error of the volume."""
    if isinstance(value, dict):
        return f"< {value['below']:.0e}"
    return "< 1e-12" if value < 1e-12 else f"{value:.0e}"


LABELS = {"rbf": "RBF", "embedded": "the same solid, no field", "pbd": "PBD, 3 sweeps"}


def headline_table(facts):
    """How accurate and how fast the models are on the real hip: one column for each model."""
    rows = facts["rows"]
    reference = rows["rbf"]["time_frame"]

    def flicker(row):
        return "–" if row["flicker"] is None else bound(row["flicker"], 2)

    def time(row):
        return f"{1e3 * row['time_frame']:.0f} ms ({row['time_frame'] / reference:.2f})"

    steps, back = (lambda r, key=key: bound(r[key], 2) for key in ("steps_apart", "there_and_back"))
    shown = [
        ("volume error, relative", lambda r: volume(r["volume_error"])),
        (
            "depth of the surface inside a bone; PBD: of attached vertices (mm)",
            lambda r: bound(r["penetration_max"], 2),
        ),
        (
            "depth of a bone's vertices inside a muscle (mm)",
            lambda r: bound(r["bone_penetration_max"], 2),
        ),
        ("distance from the input mesh at rest, RMS (mm)", lambda r: bound(r["rest_error_rms"], 2)),
        ("flicker in steps of 2 degrees (mm)", flicker),
        ("bowing: length of the centreline / shortest path", lambda r: f"{r['bowing']:.2f}"),
        ("self-crossing triangles", lambda r: f"{r['self_crossings']:.0f}"),
        ("last pose, reached in steps of 2, 5, 10 and 30 degrees: difference, RMS (mm)", steps),
        ("first pose, before and after the motion there and back: difference, RMS (mm)", back),
        ("processor time per frame, four muscles, one thread (ratio to RBF)", time),
    ]
    overlap = "neighbour_overlap_max"
    if all(overlap in row for row in rows.values()):
        title = "overlap of neighbouring muscles, beyond that of their meshes at rest (mm)"
        shown.insert(3, (title, lambda r: bound(r[overlap], 2)))
    lines = [
        f"| worst of four muscles | {' | '.join(LABELS[name] for name in rows)} |",
        "|---" * (len(rows) + 1) + "|",
    ]
    lines += [
        f"| {what} | {' | '.join(text(row) for row in rows.values())} |" for what, text in shown
    ]
    return lines


def plain_table(facts):
    """Columns and rows as a file has them; numbers with three digits."""

    def cell(value):
        if isinstance(value, float):
            return f"{value:.0f}" if abs(value) >= 1000 else f"{value:.3g}"
        return "–" if value is None else str(value)

    lines = [f"| {' | '.join(facts['columns'])} |", "|---" * len(facts["columns"]) + "|"]
    return lines + [f"| {' | '.join(map(cell, row))} |" for row in facts["rows"]]


def quantities_table():
    """What `metrics.csv` holds, and the limits: a row for each quantity."""

    def limit(name):
        found = LIMITS.get(name)
        if found is None:
            return ""
        unit = " mm" if QUANTITIES[name][0] == "length" else ""
        least = "at least " if name in LOWER_BOUNDS else ""
        greater = f", or `bowing_at_rest` + {MORE_BOWING:g} if that is greater"
        return f"{least}{found.value:g}{unit}{greater if name == 'bowing' else ''}"

    lines = ["| quantity | what | limit |", "|---|---|---|"]
    for name, (_, what) in QUANTITIES.items():
        if name.endswith("_p05"):
            what = f"{what.partition(':')[0]}: percentiles of the fibres"
            lines.append(f"| `{name}`, `_p50`, `_p95` | {what} | |")
        elif not name.endswith(("_p50", "_p95")):
            lines.append(f"| `{name}` | {what} | {limit(name)} |".replace("|  |", "| |"))
    return lines


FACTS = {"quantities": quantities_table}


def facts_of(name):
    """What a file of evidence holds."""
    return json.loads((EVIDENCE / f"{name}.json").read_text(encoding="utf-8"))


def provenance(facts):
    """The line under a table: command, commit, machine, and what else has to be known."""
    note = f" {facts['note']}" if facts.get("note") else ""
    date = f", {facts['date']}" if facts.get("date") else ""
    return f"`{facts['command']}`, commit {facts['commit']}, {facts['machine']}{date}.{note}"


SIZE = ("width", "height")


def arms_plot(facts, colour):
    """Markup of a muscle's moment arms over a motion: band, median, and dashed the published."""
    name = facts["muscle"]
    angle, *curves = (np.array(facts[key]) for key in ("angle", "least", "median", "greatest"))
    bands = [Band(name, colour, angle, curves[0], curves[2])]
    known = published_band(name, f"hip.{facts['motion']}")
    shown = (known.angle >= angle[0]) & (known.angle <= angle[-1])
    edges = (values[shown] for values in (known.angle, known.least, known.greatest))
    bands.append(Band(name, colour, *edges, dashed=True))
    title = f"{name.replace('_', ' ').capitalize()}, {facts['motion']}"
    track = Track(name, colour, angle, curves[1])
    return line_plot(title, [track], ("degree", "mm"), bands=bands)


def arms_image():
    """Plots of `hip_fibres` as one picture: a row for each muscle, a column for each motion."""
    plots = facts_of("hip_fibres")["plots"]
    muscles = list(dict.fromkeys(facts["muscle"] for facts in plots))
    motions = list(dict.fromkeys(facts["motion"] for facts in plots))
    colours = dict(zip(muscles, MUSCLE_COLOURS))
    parts = []
    for facts in plots:
        markup = arms_plot(facts, colours[facts["muscle"]])
        wide, high = (float(re.search(rf' {key}="([\d.]+)pt"', markup)[1]) for key in SIZE)
        x = wide * motions.index(facts["motion"])
        y = high * muscles.index(facts["muscle"])
        markup = " ".join(re.sub(r"(\.\d)\d+", r"\1", markup).split())
        parts.append(markup.replace("<svg", f'<svg x="{x:g}" y="{y:g}"', 1))
    box = f"0 0 {wide * len(motions):g} {high * len(muscles):g}"
    space = 'xmlns="http://www.w3.org/2000/svg" xmlns:xlink="http://www.w3.org/1999/xlink"'
    return "\n".join([f'<svg {space} viewBox="{box}">', *parts, "</svg>", ""])


def written(text):
    """A page with its tables as the files of evidence and the library have them."""

    def table(match):
        facts = facts_of(match[1])
        draw = plain_table if "columns" in facts else headline_table
        body = "\n".join([*draw(facts), "", provenance(facts)])
        return f"<!-- evidence: {match[1]} -->\n{body}\n<!-- end -->"

    def own(match):
        body = "\n".join(FACTS[match[1]]())
        return f"<!-- table: {match[1]} -->\n{body}\n<!-- end -->"

    return _FACTS.sub(own, _TABLE.sub(table, text))


def page_files():
    """The README and the pages of ``docs``."""
    return [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]


def measure(names):
    """Run what measures; the real hip is found as tests find it."""
    places = [os.environ.get("RBFMUSCLE_DATA"), ROOT.parent / "shared" / "data"]
    data = next((str(p) for p in places if p and (Path(p) / "hip").is_dir()), None)
    for name in names:
        if data is None:
            sys.exit(
                f"{name}: the real hip is not here (set RBFMUSCLE_DATA to the folder that "
                "holds hip/)"
            )
        script, *words = COMMANDS[name].replace("DATA", data).split()
        command = [f"benchmarks/{script}", *words, "-o", str(EVIDENCE / f"{name}.json")]
        subprocess.run([sys.executable, *command], cwd=ROOT, check=True)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--measure", nargs="*", choices=sorted(COMMANDS), metavar="NAME")
    given = parser.parse_args()
    if given.measure is not None:
        measure(given.measure or sorted(COMMANDS))
    for path in page_files():
        text = path.read_text(encoding="utf-8")
        new = written(text)
        if new != text:
            path.write_text(new, encoding="utf-8")
            print(f"written: {path.relative_to(ROOT)}")
    ARMS_IMAGE.write_text(arms_image(), encoding="utf-8")


if __name__ == "__main__":
    main()
