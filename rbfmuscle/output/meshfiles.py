"""Triangle meshes to and from files, by suffix."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from rbfmuscle.geometry.arrays import Floats, Integers
from rbfmuscle.output.vtp import read_vtp, write_vtp
from rbfmuscle.validation import MeshError

SUFFIXES = {"pvd": ".vtp", "vtp": ".vtp", "ply": ".ply", "stl": ".stl", "obj": ".obj", "glb": ".glb"}


def write_mesh(path: str | Path, vertices: ArrayLike, faces: ArrayLike) -> None:
    """Write a triangle mesh in the format of the file's suffix.

    Parameters
    ----------
    path : path
        ``.vtp``, ``.ply``, ``.stl``, ``.obj`` or ``.glb``. PLY, STL and GLB hold single precision.
    vertices : (n, 3) array_like
    faces : (m, 3) array_like of int
    """
    path = Path(path)
    if path.suffix == ".vtp":
        write_vtp(path, vertices, faces)
        return
    import trimesh

    mesh = trimesh.Trimesh(vertices, faces, process=False)
    if path.suffix == ".obj":
        path.write_text(
            trimesh.exchange.obj.export_obj(mesh, include_normals=False, digits=12), encoding="ascii"
        )
    else:
        path.write_bytes(mesh.export(file_type=path.suffix[1:]))


def read_mesh(path: str | Path) -> tuple[Floats, Integers]:
    """Vertices and faces of a mesh file of a run.

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
        return read_vtp(path)
    import trimesh

    mesh = trimesh.load_mesh(path, process=path.suffix == ".stl")
    if not len(getattr(mesh, "faces", ())):
        raise MeshError(f"{path} holds no triangles")
    return np.asarray(mesh.vertices), np.asarray(mesh.faces)
