"""A moving run as one USD file (.usdc): meshes whose points are sampled over time, bones that move
as rigid bodies.
"""

from itertools import count
from pathlib import Path
from typing import Any

import numpy as np

from rbfmuscle.geometry.surfaces import vertex_normals
from rbfmuscle.output.appearance import linear_rgb, rgb
from rbfmuscle.output.saved import FRAMES_A_SECOND, MovingPart, MovingRun
from rbfmuscle.scene.objects import MM_PER_UNIT
from rbfmuscle.validation import MissingPartError


def check_usd() -> None:
    """Raise MissingPartError where the package that writes USD is absent."""
    try:
        import pxr.Usd  # noqa: F401
    except ImportError:
        message = "export to usd needs usd-core: pip install -e '.[usd]' in rbfmuscle's folder"
        raise MissingPartError(message) from None


def write_usd(path: Path, run: MovingRun) -> None:
    """Write a run as one ``.usdc`` file; usd-core must be there (`check_usd`).

    Time codes count 24 a second. A surface that keeps its vertices has its topology once and its
    points at every time; another one has both at every time. Lengths stay in the run's unit, named
    by ``metersPerUnit``; the root brings superior to z.
    """
    from pxr import Gf, Usd, UsdGeom

    codes = (run.times * FRAMES_A_SECOND).tolist()
    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    UsdGeom.SetStageMetersPerUnit(stage, MM_PER_UNIT[run.unit] / 1000.0)
    stage.SetTimeCodesPerSecond(FRAMES_A_SECOND)
    stage.SetFramesPerSecond(FRAMES_A_SECOND)
    stage.SetStartTimeCode(codes[0])
    stage.SetEndTimeCode(codes[-1])
    place = f"/{identifier(run.name, set())}"
    root = UsdGeom.Xform.Define(stage, place)
    stage.SetDefaultPrim(root.GetPrim())
    upright = np.eye(4)
    upright[:3, :3] = run.body
    root.AddTransformOp().Set(Gf.Matrix4d(upright.T))
    used: set[str] = set()
    for part in (*run.bones, *run.muscles):
        mesh = UsdGeom.Mesh.Define(stage, f"{place}/{identifier(part.name, used)}")
        mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
        mesh.CreateOrientationAttr(UsdGeom.Tokens.rightHanded)
        _fill(mesh, part, codes)
        mesh.CreateDisplayColorAttr([Gf.Vec3f(*linear_rgb(rgb(part.colour)).tolist())])
        mesh.GetPrim().SetDisplayName(part.name)
    stage.GetRootLayer().Export(str(path))


def _fill(mesh: Any, part: MovingPart, codes: list[float]) -> None:
    """A muscle gets its points at each time, and its faces where they change; a bone its points
    once and its poses.
    """
    from pxr import Gf, UsdGeom, Vt

    for k, (vertices, faces) in enumerate(zip(part.vertices, part.faces)):
        at = (codes[k],) if part.poses is None else ()
        if k == 0 or not part.keeps_vertices:
            topology_at = () if part.keeps_vertices else at
            corners = np.ascontiguousarray(faces, dtype=np.int32).ravel()
            mesh.CreateFaceVertexCountsAttr().Set(Vt.IntArray(len(faces), 3), *topology_at)
            mesh.CreateFaceVertexIndicesAttr().Set(Vt.IntArray.FromNumpy(corners), *topology_at)
        points = np.ascontiguousarray(vertices, dtype=np.float32)
        extent = np.stack([points.min(axis=0), points.max(axis=0)])
        mesh.CreatePointsAttr().Set(Vt.Vec3fArray.FromNumpy(points), *at)
        mesh.CreateExtentAttr().Set(Vt.Vec3fArray.FromNumpy(extent), *at)
    if part.poses is not None:
        # Without normals a surface that is no subdivision surface is drawn facet by facet.
        normals = np.ascontiguousarray(
            vertex_normals(part.vertices[0], part.faces[0]), dtype=np.float32
        )
        mesh.CreateNormalsAttr(Vt.Vec3fArray.FromNumpy(normals))
        mesh.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
        place = mesh.AddTransformOp()
        for code, pose in zip(codes, part.poses):
            place.Set(Gf.Matrix4d(pose.T), *((code,) if part.moves else ()))


def identifier(name: str, used: set[str]) -> str:
    """A name as USD allows it, unlike those used before."""
    from pxr import Tf

    base = Tf.MakeValidIdentifier(name)
    found = next(text for k in count(1) if (text := base if k == 1 else f"{base}_{k}") not in used)
    used.add(found)
    return found
