"""The tables of a scene file as they stand, with those of the files that it includes."""

import os
import tomllib
from pathlib import Path

from rbfmuscle.scene.guesses import refuse_marks
from rbfmuscle.scene.options import check_plain
from rbfmuscle.scene.toml_text import FORMAT
from rbfmuscle.validation import SceneError, shown, shown_path

Tables = dict[str, object]  # of a TOML file, unchecked

# A scene file is a page or two; long lists of vertices belong into files of their own.
LARGEST_FILE = 4_000_000
DEEPEST_INCLUDE = 8
LISTS = ("bone", "joint", "coupling", "muscle")
# Keys that name files, wherever they stand.
FILES = ("mesh", "fibres", "vertices", "points", "region", "file")


def read_tables(path: Path) -> Tables:
    """The tables of a scene file; names of files are relative to its folder."""
    return _read(path, (path,))


def _read(path: Path, chain: tuple[Path, ...]) -> Tables:
    text = _read_text(path)
    data = _parse(path, text)
    check_plain(data, context=f"{path}: ")
    about = data.get("scene")
    if isinstance(about, dict) and about.get("format") == 1:
        raise SceneError(
            f"{path}: files of format 1 are read no more; write the scene anew by "
            f"docs/scene_file.md, with format = {FORMAT}"
        )
    refuse_marks(text, context=f"{path}: ")
    names = data.pop("include", [])
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise SceneError(f"{path}: include must be a list of names of files")
    for name in reversed(names):
        file = path.parent / name
        if file.resolve() in [one.resolve() for one in chain] or len(chain) > DEEPEST_INCLUDE:
            raise SceneError(f"{path}: include {name!r}: a file would include itself")
        inner = _read(file, (*chain, file))
        moved = {key: _moved(value, Path(name).parent) for key, value in inner.items()}
        data = _merged(moved, data, f"{path}: include {name!r}: ")
    return data


def _merged(inner: Tables, own: Tables, context: str) -> Tables:
    """Tables of an included file, then those of the file itself: lists follow each other, other
    tables take the place of included ones; classes do so one by one, and ``[scene]`` by keys.
    """
    found = inner | own
    for key in LISTS:
        given = [data[key] for data in (inner, own) if key in data]
        lists = [part for part in given if isinstance(part, list)]
        if lists and len(lists) == len(given):
            found[key] = [row for part in lists for row in part]
    for key in ("scene", "classes"):
        first, second = inner.get(key), own.get(key)
        if isinstance(first, dict) and isinstance(second, dict):
            found[key] = first | second
    first, second = (_units(data) for data in (inner, own))
    if None not in (first, second) and first != second:
        raise SceneError(f"{context}its lengths are in {shown(first)}, not in {shown(second)}")
    return found


def _units(data: Tables) -> object:
    about = data.get("scene")
    return about.get("units") if isinstance(about, dict) else None


def _moved(value: object, folder: Path, key: str = "") -> object:
    """Tables whose names of files are relative to the folder of the file that includes them."""
    if isinstance(value, dict):
        return {name: _moved(inner, folder, name) for name, inner in value.items()}
    if isinstance(value, list):
        return [_moved(inner, folder) for inner in value]
    return (folder / value).as_posix() if isinstance(value, str) and key in FILES else value


def _read_text(path: Path) -> str:
    if path.is_dir():
        raise SceneError(f"{path}: is a folder, give a scene file (.toml)")
    if not os.path.isfile(path):
        raise SceneError(f"{shown_path(path)}: no such scene file")
    size = os.path.getsize(path)
    if size > LARGEST_FILE:
        raise SceneError(
            f"{path}: has {size} bytes, a scene file at most {LARGEST_FILE}; put long lists of "
            "vertices into files of their own"
        )
    try:
        return path.read_text(encoding="utf-8")
    except OSError as error:
        raise SceneError(f"{path}: cannot read the scene file: {error.strerror}") from None
    except UnicodeDecodeError:
        raise SceneError(f"{path}: not a text file in UTF-8, give a scene file (.toml)") from None


def _parse(path: Path, text: str) -> Tables:
    try:
        return tomllib.loads(text)
    except RecursionError:
        raise SceneError(f"{path}: not valid TOML: tables or lists are nested too deep") from None
    except ValueError as error:  # TOML, and integers of thousands of digits
        quotes = "; text stands in quotes" if str(error).startswith("Invalid value") else ""
        raise SceneError(f"{path}: not valid TOML: {shown(str(error))}{quotes}") from None
