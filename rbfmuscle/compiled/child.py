"""How a process that runs a module of ours is started, wherever the library lies."""

import os
import sys
from pathlib import Path


def child_call(module: str, *arguments: str) -> tuple[list[str], dict[str, str]]:
    """Command and environment of a process that runs one of our modules with this interpreter.

    Nothing that lies in the present folder takes the place of a module there.
    """
    command = [sys.executable, "-P", "-m", module, *arguments]
    places = [str(Path(__file__).resolve().parents[2]), os.environ.get("PYTHONPATH", "")]
    return command, {**os.environ, "PYTHONPATH": os.pathsep.join(place for place in places if place)}
