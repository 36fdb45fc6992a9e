"""Own muscle meshes beside a model's muscles: matched by name, with first attachments from path points and nearness."""

import csv
import re
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from rbfmuscle.opensim.model import ModelPath
from rbfmuscle.opensim.paths import active_points
from rbfmuscle.opensim.scene import Imported
from rbfmuscle.sim.scene.attachments import signed_distances
from rbfmuscle.sim.scene.meshes import MESH_SUFFIXES, read_mesh
from rbfmuscle.validation import UsageError

# Words that models shorten in no regular way.
IRREGULAR = {"peri": "piriformis", "gas": "gastroc", "gastroc": "gastrocnemius", "calcn": "calcaneus"}
COMPARTMENT = re.compile(r"(\d+|Dist|Isch|Mid|Prox|_[a-d])+$")
IDLE_WORDS = ("m", "muscle", "musculus", "the", "of")
SIDES = {"r": "r", "right": "r", "l": "l", "left": "l"}
# Share of a muscle's vertices that an end takes, and the least number.
HELD_SHARE, LEAST_HELD = 0.03, 12
COLUMNS = ("mesh", "muscles", "distance", "note")


@dataclass
class Match:
    """A mesh and the model's muscles that it is.

    Attributes
    ----------
    ends : list of (bone, vertices)
        First attachments: origin bones, then insertion bones; vertex numbers of the mesh as read.
    distance : float
        Mean distance of the paths' ends from the mesh [scene unit].
    """

    file: Path
    name: str
    paths: list[ModelPath] = field(default_factory=list)
    ends: list[tuple[str, np.ndarray]] = field(default_factory=list)
    distance: float = float("nan")
    note: str = ""


def split_name(name: str) -> tuple[list[str], str]:
    """Return the words of a name in lower case, and its side ("r", "l" or "")."""
    parts = [w.lower() for w in re.findall(r"[A-Z]?[a-z]+|[A-Z]+(?![a-z])", name)]
    side = next((SIDES[word] for word in parts if word in SIDES), "")
    return [word for word in parts if word not in SIDES and word not in IDLE_WORDS], side


def likeness(short: str, words: tuple[str, ...]) -> float:
    """Return how well a shortened name stands for some words, 0 for not at all and 1 for all of each.

    It does where it can be cut into pieces that begin one word each, in any order: ``bifemlh`` is
    ``biceps_femoris_long_head``.
    """

    @cache
    def best(at, left):
        if at == len(short):
            return 0.0
        found = -1.0
        for k, word in enumerate(left):
            length = 0
            while at + length < len(short) and length < len(word) and short[at + length] == word[length]:
                length += 1
                rest = best(at + length, left[:k] + left[k + 1 :])
                if rest >= 0.0:
                    found = max(found, rest + 1.0 + 0.2 * length / len(word))
        return found

    return max(0.0, best(0, tuple(words))) / (1.2 * len(words)) if words else 0.0


def name_score(muscle: str, words: list[str], side: str) -> float:
    """Return how likely a model's muscle is the one of a mesh with these words and side."""
    base = re.sub(r"_[rl]$", "", muscle)
    own = {"_r": "r", "_l": "l"}.get(muscle[-2:], "")
    if side and own and side != own:
        return 0.0
    base = COMPARTMENT.sub("", base)
    plain = re.sub(r"[^A-Za-z]", "", base).lower()
    forms = {plain, *(plain.replace(key, value) for key, value in IRREGULAR.items())}
    return max(likeness(form, tuple(words)) for form in forms if form)


def mesh_files(folder: Path, option: str) -> list[Path]:
    """Return the meshes of a folder that an option names, or raise UsageError where it has none."""
    files = sorted(file for file in folder.glob("*") if file.suffix.lower() in MESH_SUFFIXES)
    if not files:
        raise UsageError(f"{option} {folder}: no meshes there ({', '.join(MESH_SUFFIXES)})")
    return files


def match_meshes(found: Imported, folder: Path, table: Path | None = None) -> list[Match]:
    """Match the meshes of a folder to a model's muscles by name, or as a table says.

    Raises
    ------
    UsageError
        If the folder has no meshes, or the table names a mesh or a muscle that is not there.
    """
    files = mesh_files(folder, "--muscles")
    matches = [Match(file, re.sub(r"[^A-Za-z0-9_-]+", "_", file.stem)) for file in files]
    if table is not None:
        _from_table(matches, found, table)
        return matches
    for match in matches:
        words, side = split_name(match.file.stem)
        scores = {path.name: name_score(path.name, words, side) for path in found.model.paths}
        top = max(scores.values(), default=0.0)
        if top >= 0.3:
            match.paths = [path for path in found.model.paths if scores[path.name] >= top - 1e-9]
        else:
            match.note = "no muscle of the model has such a name"
    return matches


def _from_table(matches, found, table):
    paths = {path.name: path for path in found.model.paths}
    by_mesh = {match.file.name: match for match in matches}
    try:
        # Spreadsheets write a mark before the first column's name.
        text = table.read_text(encoding="utf-8-sig", errors="replace")
        rows = list(csv.DictReader(text.splitlines()))
    except OSError as error:
        raise UsageError(f"--matches {table}: {error.strerror}") from None
    except csv.Error as error:
        raise UsageError(
            f"--matches {table}: {error}; give a table like the matches.csv of an import"
        ) from None
    for row in rows:
        if row.get("mesh") not in by_mesh:
            raise UsageError(f"--matches {table}: no mesh {row.get('mesh')!r} in the folder; correct the row")
        for name in (row.get("muscles") or "").split():
            if name not in paths:
                raise UsageError(f"--matches {table}: the model has no muscle {name!r}; correct the row")
            by_mesh[row["mesh"]].paths.append(paths[name])


def attach(found: Imported, match: Match) -> None:
    """Guess where a muscle is held: the vertices nearest to the ends of its paths and to the bones these are on.

    Of paths of both sides those nearer to the mesh are kept. A bone without a mesh holds nothing, which is noted.
    """
    mesh: Any = read_mesh(match.file, name=match.name).mesh
    points = np.asarray(mesh.vertices)
    if not match.paths:
        return
    ends = {path.name: _ends(found, path) for path in match.paths}
    gaps = {name: np.mean([_gap(place, points) for _, place in pair]) for name, pair in ends.items()}
    if len({path.name[-2:] for path in match.paths} & {"_r", "_l"}) == 2:
        nearest = min(gaps, key=lambda name: gaps[name])[-2:]
        match.paths = [path for path in match.paths if path.name.endswith(nearest)]
    match.distance = float(np.mean([gaps[path.name] for path in match.paths]))
    wanted = {}
    for which in (0, 1):
        for path in match.paths:
            body, place = ends[path.name][which]
            wanted.setdefault(body, []).append(place)
    bones = {bone.name: bone.mesh for bone in found.scene.bones}
    held = {found.names[body]: np.array(places) for body, places in wanted.items()}
    lost = [bone for bone in held if bone not in bones]
    if lost:
        match.note = f"{', '.join(lost)} has no mesh to hold it"
    match.ends = _nearest(points, {bone: held[bone] for bone in held if bone in bones}, bones)


def _ends(found, path):
    """Body and place in the scene of a path's two ends, at rest."""
    points = active_points(found.model, path)
    metre = found.scene.length(1000.0)
    out = []
    for point, place in (points[0], points[-1]):
        pose = found.places[point.body]
        out.append((point.body, pose[:3, :3] @ (place * metre) + pose[:3, 3]))
    return out


def _gap(place, points):
    return float(np.linalg.norm(points - place, axis=1).min())


def _nearest(points, held, bones):
    """For each bone the vertices nearest to its path points and to itself; a vertex goes to the bone it suits more."""
    if not held:
        return []
    cost = {}
    for bone, places in held.items():
        to_point = np.linalg.norm(points[:, None] - places[None], axis=2).min(axis=1)
        cost[bone] = to_point + np.maximum(signed_distances(points, bones[bone]), 0.0)
    names = list(cost)
    table = np.array([cost[name] for name in names])
    count = max(LEAST_HELD, int(HELD_SHARE * len(points)))
    owner, found = table.argmin(axis=0), []
    for k, name in enumerate(names):
        mine = np.flatnonzero(owner == k)
        if len(mine) == 0:
            mine = np.array([table[k].argmin()])
        found.append((name, np.sort(mine[np.argsort(table[k][mine], kind="stable")[:count]])))
    return found


def write_table(matches: list[Match], file: Path) -> None:
    """Write which mesh is which muscles, to be corrected and given back with --matches."""
    with file.open("w", encoding="utf-8", newline="") as out:
        writer = csv.writer(out, lineterminator="\n")
        writer.writerow(COLUMNS)
        for match in matches:
            names = " ".join(path.name for path in match.paths)
            distance = "" if np.isnan(match.distance) else f"{match.distance:.6g}"
            writer.writerow([match.file.name, names, distance, match.note])
