"""Damaged meshes of every form: bytes that are cut, flipped and moved, false numbers, shapes with no inside."""

import re
from pathlib import Path

import numpy as np
import trimesh

from fuzz.base import FORMS, muscle_mesh, suffix_of, write_mesh
from fuzz.scenes import pick

NUMBERS = (
    b"0", b"-1", b"1", b"3", b"163", b"99999", b"4294967295", b"4294967296", b"9223372036854775807", b"9" * 30,
    b"9" * 5000, b"nan", b"inf", b"1e308", b"-1e300", b"1e400", b"1.5", b"abc", b"", b"0x10",
)  # fmt: skip


def write_damaged(folder: Path, forms: dict[str, bytes], rng: np.random.Generator) -> Path:
    """Write one damaged mesh and return its file."""
    form = pick(rng, FORMS)
    path = folder / f"damaged{suffix_of(form)}"
    if rng.random() < 0.4:
        write_mesh(path, damaged_shape(rng), form)
        if rng.random() < 0.9:
            return path
        content = path.read_bytes()
    else:
        content = forms[form]
    for _ in range(rng.integers(1, 3)):
        content = _damage(content, rng) or b" "
    path.write_bytes(content)
    if rng.random() < 0.03:
        path = path.rename(path.with_suffix(suffix_of(pick(rng, FORMS))))
    return path


def _damage(content, rng):
    at, other = sorted(rng.integers(0, len(content), 2).tolist())
    kind = rng.integers(7)
    if kind == 0:
        return content[:other]
    if kind == 1:
        damaged = bytearray(content)
        for place in rng.integers(0, len(content), rng.integers(1, 30)):
            damaged[place] = int(rng.integers(256))
        return bytes(damaged)
    if kind == 2:
        return content[:at] + content[min(other, at + int(rng.integers(1, 400))) :]
    if kind == 3:
        return content[:other] + content[at:]
    if kind == 4:
        return content[:at] + bytes(min(200, other - at)) + content[other:]
    return _change_number(content, rng, head=kind == 5)


def _change_number(content, rng, *, head):
    """Another number in the text: in the head, where the counts are, or anywhere."""
    found = list(re.finditer(rb"(?<![\w.])-?\d[\d.e+-]*", content[:1500] if head else content))
    if not found:
        return content
    place = pick(rng, found)
    return content[: place.start()] + pick(rng, NUMBERS) + content[place.end() :]


KINDS = 14


def damaged_shape(rng: np.random.Generator, kind: int | None = None) -> trimesh.Trimesh:
    """The muscle's mesh with vertices moved, joined or lost, or with triangles lost, turned or repeated."""
    mesh = muscle_mesh()
    vertices, faces = np.array(mesh.vertices), np.array(mesh.faces)
    few = rng.choice(len(faces), int(rng.integers(1, 12)), replace=False)
    axis = int(rng.integers(3))
    kind = rng.integers(KINDS) if kind is None else kind
    if kind == 0:
        vertices[faces[few]] = vertices[faces[few]].mean(axis=1)[:, None]
    elif kind == 1:
        vertices[faces[few, 0]] = vertices[faces[few, 1]]
    elif kind == 2:
        vertices[faces[few, 0]] = vertices[faces[few, 1:]].mean(axis=1)
    elif kind == 3:
        vertices[faces[few][:, [0, 1]]] = vertices[faces[few][:, [1, 0]]]
    elif kind == 4:
        middle = vertices[:, axis].mean()
        vertices[:, axis] = middle + (vertices[:, axis] - middle) * 10.0 ** -rng.uniform(0, 12)
    elif kind == 5:
        turn = vertices[:, 2] * rng.uniform(0.01, 0.2)
        x, y = (vertices[:, :2] - vertices[:, :2].mean(axis=0)).T
        vertices[:, 0] = x * np.cos(turn) - y * np.sin(turn) + 34.0
        vertices[:, 1] = x * np.sin(turn) + y * np.cos(turn)
    elif kind == 6:
        upper = vertices[:, 2] > rng.uniform(-50, 40)
        vertices[upper, :2] = (
            2.0 * vertices[:, :2].mean(axis=0) - vertices[upper, :2]
        )  # a bow tie about its waist
    elif kind == 7:
        vertices = vertices + rng.normal(size=vertices.shape) * 10.0 ** rng.uniform(-6, 4)
    elif kind == 8:
        vertices = vertices * 10.0 ** rng.uniform(-30, 30)
    elif kind == 9:
        vertices[faces[few, 0]] = pick(rng, [np.nan, np.inf, 1e38, -1e30, 1e13])
    elif kind == 10:
        faces = np.delete(faces, few, axis=0)
    elif kind == 11:
        faces[few] = faces[few, ::-1]
    elif kind == 12:
        faces = np.vstack([faces, faces[few], np.roll(faces[few], 1, axis=1)])
    else:
        faces = faces[few[:1]] if rng.random() < 0.3 else rng.permutation(faces.ravel()).reshape(-1, 3)
    return trimesh.Trimesh(vertices, faces, process=False)
