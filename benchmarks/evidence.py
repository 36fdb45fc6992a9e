"""Files of evidence: what the tables of the pages are made of, each with command, commit, machine
and date.
"""

import datetime
import json
import os
import platform
import subprocess
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent


def data_folder(name):
    """The folder of that name in the data, or an end with what to do."""
    for place in (os.environ.get("RBFMUSCLE_DATA"), ROOT.parent / "shared" / "data"):
        if place and (Path(place) / name).is_dir():
            return Path(place) / name
    raise SystemExit(
        f"data/{name} is not here; set RBFMUSCLE_DATA to the folder that holds {name}/"
    )


def machine():
    """What the figures hold for."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text(encoding="utf-8").splitlines() if info.exists() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor()


def commit():
    """The commit that was measured, with a plus where files were changed since."""
    run = {"cwd": ROOT, "capture_output": True, "text": True, "check": True}
    number = subprocess.run(["git", "rev-parse", "--short", "HEAD"], **run).stdout.strip()
    changed = subprocess.run(
        ["git", "status", "--porcelain", "--untracked-files=no"], **run
    ).stdout.strip()
    return number + ("+" if changed else "")


def provenance(command):
    """Where figures come from that are measured now; files in the command are named without their
    folders.
    """
    words = (Path(word).name if word.endswith(".toml") else word for word in command)
    return {
        "command": f"python {' '.join(words)}",
        "commit": commit(),
        "machine": machine(),
        "date": datetime.date.today().isoformat(),
    }


def write_evidence(path, command, rows, columns=None, **more):
    """Write the rows of a table with where they come from, and ``more``, such as what plots show.

    With ``columns``, the heads of the table, rows are lists of texts and numbers, None for an empty
    cell; without them a function of ``docs/figures.py`` draws the table.
    """
    heads = {"columns": columns} if columns else {}
    text = json.dumps({**provenance(command), **heads, "rows": rows, **more}, indent=1)
    Path(path).write_text(text + "\n", encoding="utf-8")
