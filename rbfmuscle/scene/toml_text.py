"""Tables of a scene file as TOML that a person can read."""

import json
from collections.abc import Mapping

FORMAT = 2  # of scene files
MAIN = "main"  # the class of all muscles


def value_text(value: object) -> str:
    """A value as TOML on one line; numbers to 13 digits."""
    if isinstance(value, float):
        return f"{value + 0.0:.13g}"  # no -0
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{_key(k)} = {value_text(v)}" for k, v in value.items()) + " }"
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(map(value_text, value)) + "]"
    if isinstance(value, str):
        value = "".join(c if c.isprintable() else " " for c in value)
    return json.dumps(value, ensure_ascii=False)  # of text, whole numbers and truth TOML is JSON


def _key(key):
    bare = key.replace("_", "").replace("-", "")
    return key if bare.isascii() and bare.isalnum() else value_text(key)


def table_text(
    head: str, row: Mapping[str, object], comments: Mapping[str, str | list[str]] | None = None
) -> str:
    """A table as TOML, lists of tables with one a line, after its first line ``head``, as
    ``[[bone]]``.

    ``comments`` stand after the line of a key, or after each table of its list.
    """
    lines = [head]
    for key, value in row.items():
        said = (comments or {}).get(key, "")
        if isinstance(value, list) and value and isinstance(value[0], dict):
            words = said if isinstance(said, list) else [""] * len(value)
            rows = [_commented(f"  {value_text(item)},", text) for item, text in zip(value, words)]
            lines += [f"{_key(key)} = [", *rows, "]"]
        else:
            lines.append(_commented(f"{_key(key)} = {value_text(value)}", str(said)))
    return "\n".join(lines) + "\n"


def _commented(line, text):
    return f"{line}   # {text}" if text else line


def attachment_file(muscle: str, bone: str) -> str:
    """File of the vertices of a muscle that a bone holds, relative to the scene's.

    No name holds a full stop, so that no two pairs share a file.
    """
    return f"attachments/{muscle}.{bone}.txt"
