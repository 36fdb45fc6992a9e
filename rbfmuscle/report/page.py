"""The report's frame: markup, style, the words that explain it, and tables that hold dozens of muscles."""

from __future__ import annotations

import base64
import html
import math
from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Any

from rbfmuscle.metrics.summary import LEAST

STYLE = """
:root{--ink:#26282b;--soft:#6a6f76;--line:#e5e3de;--paper:#fbfaf8;--accent:#a63d38}
*{box-sizing:border-box}
body{margin:0;background:var(--paper);color:var(--ink);
font:15px/1.55 system-ui,"Segoe UI",Helvetica,Arial,sans-serif}
main{max-width:1120px;margin:0 auto;padding:36px 24px 60px}
h1{font-size:30px;margin:0 0 2px;font-weight:650;letter-spacing:-.01em}
h2{font-size:19px;margin:40px 0 12px;font-weight:650}
.sub{color:var(--soft);margin:0 0 22px}
.facts{display:flex;flex-wrap:wrap;gap:10px;margin:18px 0}
.facts div{background:#fff;border:1px solid var(--line);border-radius:9px;padding:9px 16px;min-width:104px}
.facts b{display:block;font-size:18px;font-weight:650}.facts span{color:var(--soft);font-size:12.5px}
p.good,p.bad{border-radius:9px;padding:11px 16px;margin:14px 0;font-weight:550}
p.good{background:#e9f4ec;color:#1f6138}p.bad{background:#fbeae8;color:#8e2a22}
.note{color:var(--soft)}
figure{margin:0 0 14px;padding:8px;overflow:hidden;
background:#fff;border:1px solid var(--line);border-radius:9px}
figure img{display:block;max-width:100%;height:auto;margin:auto}
.plots{display:grid;grid-template-columns:repeat(auto-fill,minmax(420px,1fr));gap:14px}
.plots figure{margin:0}.plots img{width:100%}
.legend{margin:0 0 12px;color:var(--soft);font-size:13.5px}.legend span{margin-right:20px;white-space:nowrap}
.legend i{display:inline-block;width:18px;height:4px;border-radius:2px;margin-right:7px;vertical-align:middle}
.legend i.limit{height:0;border-top:2px dashed #c0392b;border-radius:0}
.wide{overflow-x:auto}
table{border-collapse:collapse;background:#fff;border:1px solid var(--line);font-size:13.5px;min-width:60%}
th,td{padding:6px 13px;border-bottom:1px solid var(--line);text-align:right}
td{font-variant-numeric:tabular-nums}
th{font-weight:600}th:first-child,td:first-child{text-align:left}
td.bad{color:#8e2a22;background:#fbeae8;font-weight:600}
small{color:var(--soft);font-weight:400}
table.sortable thead th{cursor:pointer;vertical-align:bottom}
input.find{font:inherit;padding:3px 8px;border:1px solid var(--line);border-radius:6px}
details{margin:6px 0}summary{cursor:pointer}
dl{display:grid;grid-template-columns:max-content 1fr;gap:3px 18px;font-size:14px}
dt{font-weight:600}dd{margin:0}
footer{margin-top:44px;color:var(--soft);font-size:12.5px}
"""

EXPLANATION = """
<p>Each muscle is one closed surface in each frame. A good run keeps its <b>volume</b> (the error is
relative to the input mesh), stays out of the <b>bones</b> (deepest surface vertex inside a bone, and
deepest bone vertex inside the muscle, both by exact distance to the meshes) and in <b>one piece</b>.
Where the model cuts the bone out of the surface, <i>solver_penetration_max</i> tells how deep it was
before, so that the cut hides nothing. The table shows the worst frame of each quantity; cells in red are
beyond the limit in the last column, and dashed lines in the plots are the same limits. The first frame
may load and compile; times are therefore given as medians.</p>
"""

# From so many muscles on tables have a row a muscle, and pictures a colour that neighbours do not share.
MANY = 9

SORTING = """
<script>
document.querySelectorAll("table.sortable th").forEach(function(head){head.onclick=function(){
const table=head.closest("table"),body=table.tBodies[0],k=head.cellIndex,
down=head.dataset.down!=="1";head.dataset.down=down?"1":"0";
const value=function(row){const cell=row.cells[k],v=cell.dataset.v;
return v===undefined?cell.textContent:(v===""?-Infinity:parseFloat(v))};
[...body.rows].sort(function(a,b){const x=value(a),y=value(b);
return (x<y?-1:x>y?1:0)*(down&&typeof x==="number"?-1:1)*(!down&&typeof x==="string"?-1:1)})
.forEach(function(row){body.append(row)})}});
document.querySelectorAll("input.find").forEach(function(field){field.oninput=function(){
const words=field.value.toLowerCase().split(/[ ,]+/).filter(Boolean);
document.querySelectorAll("table.sortable tbody tr").forEach(function(row){
const name=row.cells[0].textContent.toLowerCase();
row.hidden=words.length>0&&!words.some(function(word){return name.includes(word)})})}});
</script>
"""

PAGE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8">
<meta name="viewport" content="width=device-width,initial-scale=1">
<title>{title}</title><style>{style}</style></head><body><main>
<h1>{title}</h1><p class="sub">Report of a muscle simulation</p>
{verdict}
<div class="facts">{facts}</div>
<h2>Motion</h2>{pictures}
<h2>Over the motion</h2><p class="legend">{legend}</p><div class="plots">{plots}</div>
<h2>Summary</h2><div class="wide">{table}</div>
{neighbours}<h2>Events</h2>{events}
<h2>Time of each stage</h2><p class="note">Milliseconds a frame: median, and the 95th percentile in grey; then in
how many frames a muscle was solved, carried along as it was, or left where it was, in how many sub-steps, and why.</p>
<div class="wide">{stages}</div>
<h2>How to read this</h2>{explanation}<dl>{quantities}</dl>
<footer>{versions}</footer>
</main>{script}</body></html>
"""


def embedded_image(data: bytes, kind: str, text: str) -> str:
    """An ``img`` element that holds the picture itself.

    Parameters
    ----------
    data : bytes
    kind : str
        Of image, as in its media type: png, webp, svg+xml.
    text : str
        What stands for the picture where it is not shown.
    """
    return f'<img alt="{html.escape(text)}" src="data:image/{kind};base64,{base64.b64encode(data).decode()}">'


def find_field() -> str:
    """A field that shows the rows of the muscles whose names hold what is typed."""
    return (
        '<p class="note">Click a heading to sort. Show muscles whose names hold '
        '<input class="find" placeholder="gluteus, vastus"></p>'
    )


def worst_first(
    muscles: Mapping[str, Mapping[str, Any]], beyond: Collection[tuple[str, str]], limits: Mapping[str, float]
) -> list[str]:
    """Names of the muscles: those with the most quantities beyond a limit first, then by how near they come to one."""

    def rank(name: str) -> tuple[float, ...]:
        found = muscles[name]
        count = sum((name, quantity) in beyond for quantity in found)
        shares = [
            abs(facts["worst"]) / limits[quantity]
            for quantity, facts in found.items()
            if limits.get(quantity) and quantity not in LEAST and facts.get("worst") is not None
        ]
        return -count, -max((share for share in shares if math.isfinite(share)), default=0.0)

    return sorted(muscles, key=rank)


def sortable_table(
    head: Sequence[str], rows: Iterable[Sequence[tuple[str, float | str | None, bool]]]
) -> str:
    """A table that a click on a heading sorts.

    Parameters
    ----------
    head : sequence of str
        Markup of the headings.
    rows : iterable of sequences of (markup, value, bad)
        Cells; a number is what the column is sorted by, a text means its own markup.
    """
    lines = []
    for row in rows:
        cells = []
        for k, (markup, value, bad) in enumerate(row):
            tag = "th" if k == 0 else "td"
            data = (
                "" if isinstance(value, str) else f' data-v="{"" if value is None else format(value, ".6g")}"'
            )
            mark = ' class="bad"' if bad else ""
            cells.append(f"<{tag}{data}{mark}>{markup}</{tag}>")
        lines.append(f"<tr>{''.join(cells)}</tr>")
    headings = "".join(f"<th>{text}</th>" for text in head)
    return (
        f'<table class="sortable"><thead><tr>{headings}</tr></thead><tbody>{"".join(lines)}</tbody></table>'
    )


def folded_events(events: Sequence[Sequence[Any]], most: int) -> str:
    """Events by action, each kind folded away, with the muscles that have most of them.

    Parameters
    ----------
    events : sequence of (frame, muscle, bone, count, action)
    most : int
        Rows of each kind that are shown.
    """
    kinds: dict[str, list[Sequence[Any]]] = {}
    for event in events:
        kinds.setdefault(event[4], []).append(event)
    parts = []
    for action, found in sorted(kinds.items(), key=lambda kind: -len(kind[1])):
        often = ", ".join(f"{name or 'bones'} {n}" for name, n in Counter(e[1] for e in found).most_common(6))
        head = "<tr><th>frame</th><th>muscle</th><th>bone</th><th>count</th></tr>"
        rows = "".join(
            "<tr>" + "".join(f"<td>{html.escape(str(value))}</td>" for value in event[:4]) + "</tr>"
            for event in found[:most]
        )
        left = len(found) - most
        more = f'<p class="note">and {left} more in events.csv</p>' if left > 0 else ""
        parts.append(
            f"<details><summary><b>{html.escape(action)}</b> {len(found)}: {html.escape(often)}</summary>"
            f"<table>{head}{rows}</table>{more}</details>"
        )
    return "".join(parts)
