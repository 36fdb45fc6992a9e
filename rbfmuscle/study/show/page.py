"""The report's frame: markup, style and the words that explain it."""

from __future__ import annotations

import base64
import html

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

PAGE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8">
<meta name="viewport" content="width=device-width,initial-scale=1">
<title>{title}</title><style>{style}</style></head><body><main>
<h1>{title}</h1><p class="sub">Report of a muscle simulation</p>
{verdict}
<div class="facts">{facts}</div>
<h2>Motion</h2>{pictures}
<h2>Over the motion</h2><p class="legend">{legend}</p><div class="plots">{plots}</div>{beside}
<h2>Summary</h2><div class="wide">{table}</div>
<h2>Events</h2>{events}
<h2>Time of each stage</h2><p class="note">Milliseconds a frame: median, and the 95th percentile in grey; then in
how many frames a muscle was solved, carried along as it was, or left where it was, in how many sub-steps, and why.</p>
<div class="wide">{stages}</div>
<h2>How to read this</h2>{explanation}<dl>{quantities}</dl>
<footer>{versions}</footer>
</main></body></html>
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
