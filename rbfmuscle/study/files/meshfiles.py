"""Triangle meshes to and from files, by suffix."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from rbfmuscle.geometry.arrays import Floats, Integers
from rbfmuscle.study.files.vtp import write_vtp
from rbfmuscle.validation import MeshError

SUFFIXES = {"pvd": ".vtp", "vtp": ".vtp", "ply": ".ply", "stl": ".stl", "obj": ".obj", "glb": ".glb"}


def write_mesh(
    path: str | Path,
    vertices: ArrayLike,
    faces: ArrayLike,
    *,
    single: bool = False,
    values: dict[str, Any] | None = None,
) -> None:
    """Write a triangle mesh in the format of the file's suffix.

    Parameters
    ----------
    path : path
        ``.vtp``, ``.ply``, ``.stl``, ``.obj`` or ``.glb``. PLY, STL and GLB hold single precision.
    vertices : (n, 3) array_like
    faces : (m, 3) array_like of int
    single : bool
        Positions in single precision where the format leaves the choice.
    values : dict of str to (n,) array_like, optional
        Of the vertices; VTP and PLY hold them.
    """
    path = Path(path)
    if path.suffix == ".vtp":
        write_vtp(path, vertices, faces, single=single, values=values)
        return
    import trimesh

    mesh = trimesh.Trimesh(vertices, faces, process=False)
    for name, value in (values or {}).items():
        mesh.vertex_attributes[name] = np.asarray(value, dtype=np.float32)
    if path.suffix == ".obj":
        path.write_text(_obj_text(mesh), encoding="ascii")
    else:
        path.write_bytes(mesh.export(file_type=path.suffix[1:]))


def read_mesh(path: str | Path) -> tuple[Floats, Integers]:
    """Vertices and faces of a mesh file that a run has left.

    Parameters
    ----------
    path : path

    Returns
    -------
    vertices : (n, 3) ndarray
    faces : (m, 3) ndarray of int

    Raises
    ------
    MeshError
        If the file is missing or holds no triangles.
    """
    path = Path(path)
    if not path.is_file():
        raise MeshError(f"{path} is missing")
    if path.suffix == ".vtp":
        from rbfmuscle.sim.formats.polydata import read_polydata, triangles_of

        data = read_polydata(path)
        return data.points, triangles_of(data)
    import trimesh

    mesh = trimesh.load_mesh(path, process=path.suffix == ".stl")
    if not len(getattr(mesh, "faces", ())):
        raise MeshError(f"{path} holds no triangles")
    return np.asarray(mesh.vertices), np.asarray(mesh.faces)


def _obj_text(mesh):
    points = "".join(f"v {x!r} {y!r} {z!r}\n" for x, y, z in mesh.vertices.tolist())
    return points + "".join(f"f {a} {b} {c}\n" for a, b, c in (mesh.faces + 1).tolist())
