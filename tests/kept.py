"""Numbers that are kept in ``tests/data/references`` and compared with; ``make references`` writes
them anew.
"""

import json
import math
import os
import re
from collections import Counter
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from pathlib import Path

import numpy as np
import trimesh
from conftest import MOVED

from rbfmuscle.output.vtp import read_vtp

FOLDER = Path(__file__).resolve().parent / "data" / "references"
WRITES = bool(os.environ.get("RBFMUSCLE_WRITE_REFERENCES"))
# Shares of the size of what is compared. Over one and two threads and the code that OpenBLAS has
# for four generations of processors (Nehalem, Haswell, SkylakeX, its own) results of the mesh
# models differed by 5e-12.
TOLERANCE = 1e-9
# By the key that is nearest to a number. Triangles equally near are told apart by rounding, so
# lists of them may differ by one in thousands; another release of matplotlib may move what it draws
# by a tenth of a pixel; in single precision a last digit may be rounded up or down.
LOOSE = {"about": 1e-3, "plots": 1e-3, "single": 1e-6}
NUMBER = re.compile(r"(?<![\w#.])-?\d+\.?\d*(?:e[-+]?\d+)?")


def check_kept(name, value, *, tolerance=TOLERANCE):
    """Compare what is found with what is kept under a name, or write it there."""
    found = digest(value)
    if WRITES:
        write(name, found)
    else:
        tolerance = max(tolerance, 1e7 * MOVED)
        worst = differences(read(name), found, name)
        beyond = {k: told for k, told in worst.items() if not told[0] <= LOOSE.get(k, tolerance)}
        assert not beyond, f"make references, if meant: {beyond}"


def digest(value):
    """A few numbers for arrays, meshes, texts and containers of them."""
    if isinstance(value, trimesh.Trimesh):
        value = {"vertices": value.vertices, "faces": value.faces}
    elif is_dataclass(value):
        value = {field.name: getattr(value, field.name) for field in fields(value)}
    elif hasattr(value, "_asdict"):
        value = value._asdict()
    if isinstance(value, Mapping):
        return {str(key): digest(one) for key, one in value.items()}
    if isinstance(value, str | Path):
        return len(re.findall(r"\w+", re.sub(r"\S*/", "", str(value))))  # without folders
    if value is None or isinstance(value, bool | int | float | np.number | np.bool_):
        return None if value is None or not math.isfinite(value) else float(value)
    if isinstance(value, list | tuple | set | frozenset):
        value = sorted(value) if isinstance(value, set | frozenset) else value
        if not value or not all(isinstance(one, int | float | np.number) for one in value):
            return {str(k): digest(one) for k, one in enumerate(value)}
    return _array_digest(np.asarray(value, dtype=float))


def _array_digest(array):
    """Shape, how many numbers are none, root mean square, mean, and two weighted means, which tell
    the order.
    """
    flat, wave = array.ravel(), np.sin(1.0 + np.arange(array.size))
    known = np.isfinite(flat)
    flat = np.where(known, flat, 0.0)
    count = max(array.size, 1)
    means = [
        math.sqrt((flat @ flat) / count),
        *(float(weight @ flat) / count for weight in (known, wave, wave**2)),
    ]
    return [*array.shape, int((~known).sum()), *means]


def text_facts(text):
    """Numbers of a text; of a page how many elements of each kind there are too, and where its
    plots draw.
    """
    plots = re.findall(r"<svg.*?</svg>", text, re.S)
    text = re.sub(r"<(svg|script|style)\b.*?</\1>", "", text, flags=re.S)
    tags = Counter(
        f"{tag} {kind}".strip() for tag, kind in re.findall(r'<(\w+)(?: class="([\w ]+)")?', text)
    )
    said = [one for one in re.findall(r">([^<>]+)<", text) or [text] if len(one) < 60 or not tags]
    drawn = [re.findall(rf' {key}="([^"]*)"', plot) for plot in plots for key in ("d", "x", "y")]
    found = [
        np.array([float(x) for x in NUMBER.findall(" ".join(part))]) for part in (said, *drawn)
    ]
    return {"tags": tags, "numbers": found[0], "plots": np.concatenate([np.zeros(0), *found[1:]])}


def file_facts(folder):
    """`text_facts` of the text files of a folder, and its meshes and animations."""
    texts = (".csv", ".html", ".pvd", ".toml", ".txt", ".obj", ".xml")
    read = dict.fromkeys(texts, lambda path: text_facts(path.read_text()))
    read |= dict.fromkeys(
        (".stl", ".ply"), lambda path: {"single": trimesh.load(path, process=False)}
    )
    read |= {".vtp": read_vtp, ".glb": lambda path: {"single": _glb_facts(path.read_bytes())}}
    files = [path for path in sorted(Path(folder).rglob("*")) if path.suffix in read]
    return {path.relative_to(folder).as_posix(): read[path.suffix](path) for path in files}


def _glb_facts(content):
    """Numbers of a glTF file: of its tree, and its arrays."""
    start = 20 + int.from_bytes(content[12:16], "little")
    tree, kinds = json.loads(content[20:start]), {5125: "<u4", 5126: "<f4"}
    views = [
        (kinds[a["componentType"]], tree["bufferViews"][a["bufferView"]]) for a in tree["accessors"]
    ]
    places = [(kind, start + 8 + view["byteOffset"], view["byteLength"]) for kind, view in views]
    numbers = np.array([float(text) for text in NUMBER.findall(content[20:start].decode())])
    return numbers, [np.frombuffer(content[at : at + size], kind) for kind, at, size in places]


def differences(kept, found, place=""):
    """Largest difference by kind of number, and where it is: a dict of kind to (difference, place).

    Differences are in shares of numbers beyond 1.
    """
    worst = {}
    for (where, kind, a), (other, _, b) in zip(
        _numbers(kept, place), _numbers(found, place), strict=True
    ):
        if where != other or (a is None) != (b is None):
            raise AssertionError(f"{where}: {a} is kept, {other}: {b} is there")
        if a is not None:
            gap = abs(a - b) / max(1.0, abs(a)) if math.isfinite(b) else math.inf
            if kind not in worst or gap > worst[kind][0]:
                worst[kind] = gap, where
    return worst


def _numbers(value, place, kind=""):
    """Place, nearest key and value of each number below a value; None with its length for each
    list.
    """
    if isinstance(value, dict):
        for key in sorted(value):
            yield from _numbers(value[key], f"{place} {key}", kind if kind in LOOSE else key)
    elif isinstance(value, list):
        yield f"{place} of {len(value)}", kind, None
        for k, one in enumerate(value):
            yield from _numbers(one, f"{place} {k}", kind)
    else:
        yield place, kind, value


def write(name, found):
    """Write one reference anew; twelve digits, and each list a line, so that a change reads as a
    difference.
    """
    rounded = json.loads(json.dumps(found), parse_float=lambda t: float(f"{float(t):.12g}"))
    text = re.sub(
        r"\[[^\[\]{}]*\]", lambda m: " ".join(m[0].split()), json.dumps(rounded, indent=0)
    )
    FOLDER.mkdir(parents=True, exist_ok=True)
    (FOLDER / f"{name}.json").write_text(text + "\n", encoding="utf-8")


def read(name):
    """One reference."""
    return json.loads((FOLDER / f"{name}.json").read_text(encoding="utf-8"))
