"""# A sweep: error against time

How many centres, how fine a grid? A sweep runs every combination, measures each against the finest,
and marks the Pareto front. Points that are in the folder already are not run again.
"""

import json
import shutil

from pictures import folder

from rbfmuscle.cli import main

out = folder("sweep")
words = ["sweep", "phantom", "-o", str(out / "sweep"), "--frames", "0:16:5"]
words += ["--grid", "model.centres=60,120,240", "--grid", "model.resolution=32,48"]
print("$ rbfmuscle", *words, flush=True)
try:
    main(words)
except SystemExit as end:
    assert end.code == 0, end.code

found = sorted((out / "sweep").iterdir())
print("files:", ", ".join(path.name for path in found))
for path in found:
    if path.suffix == ".png":
        shutil.copy(path, out / path.name)

# The check of this page: all points are measured (six, and the default), and there is a verdict on
# the default.
table = json.loads((out / "sweep" / "sweep.json").read_text(encoding="utf-8"))
assert len(table["rows"]) == 7
assert all(row["status"] == "done" for row in table["rows"])
assert table["verdicts"]
