"""Comparing the folders of two runs: all that a clock did not write."""

import json


def timeless(path):
    """What a file holds, without what a clock wrote into it."""
    if path.name == "run.json":
        return without_times(json.loads(path.read_text(encoding="utf-8")))
    if path.name == "metrics.csv":
        lines = path.read_text(encoding="utf-8").splitlines()
        return [line.rsplit(",", 2)[0] if ",time_" in line else line for line in lines]
    return path.read_bytes()


def without_times(value):
    """A JSON value whose clock readings are None: their keys stay."""
    clocks = ("started", "written", "wall", "times", "frame_time")
    if isinstance(value, dict):
        kept = {key: without_times(item) for key, item in value.items()}
        for key in [key for key in value if key in clocks or key.startswith("time_")]:
            kept[key] = sorted(value[key]) if isinstance(value[key], dict) else None
        return kept
    return [without_times(item) for item in value] if isinstance(value, list) else value
