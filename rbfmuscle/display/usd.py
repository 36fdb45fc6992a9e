"""A moving run as one USD file (.usdc): meshes whose points are sampled over time, bones that move
as rigid bodies.
"""

from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from rbfmuscle.display.animation import (
    FRAMES_A_SECOND,
    AnimatedFibres,
    AnimatedMesh,
    Animation,
)
from rbfmuscle.run.appearance import linear_rgb, rgb, stretch_colours
from rbfmuscle.scene.objects import MM_PER_UNIT
from rbfmuscle.validation import MissingDependencyError

if TYPE_CHECKING:
    from pxr import Usd, UsdGeom


def check_usd() -> None:
    """Raise MissingDependencyError where the package that writes USD is absent."""
    try:
        import pxr.Usd  # noqa: F401
    except ImportError:
        raise MissingDependencyError(
            "export to usd needs usd-core: pip install -e '.[usd]' in rbfmuscle's folder"
        ) from None


def write_usd(path: Path, run: Animation) -> None:
    """Write a run as one ``.usdc`` file; usd-core must be there (`check_usd`).

    Time codes count 24 a second. A surface that keeps its vertices has its topology once and its
    points at every time; another one has both at every time. Lengths stay in the run's unit, named
    by ``metersPerUnit``; the root brings superior to z. The default value of whatever is sampled is
    that of the first frame.
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
    for fibres in run.fibres:
        curves = UsdGeom.BasisCurves.Define(stage, f"{place}/{identifier(fibres.name, used)}")
        _fill_curves(curves, fibres, codes)
        curves.GetPrim().SetDisplayName(fibres.name)
    stage.GetRootLayer().Export(str(path))


def _fill_curves(curves: "UsdGeom.BasisCurves", fibres: AnimatedFibres, codes: list[float]) -> None:
    """Fibres get their points and their colours, by their stretch, at each time."""
    from pxr import UsdGeom, Vt

    count, points = fibres.lines[0].points.shape[:2]
    curves.CreateTypeAttr(UsdGeom.Tokens.linear)
    curves.CreateCurveVertexCountsAttr(Vt.IntArray(count, points))
    colours = curves.CreateDisplayColorPrimvar(UsdGeom.Tokens.vertex)
    for code, lines in zip(codes, fibres.lines):
        places = np.ascontiguousarray(lines.points.reshape(-1, 3), dtype=np.float32)
        extent = np.stack([places.min(axis=0), places.max(axis=0)])
        shades = linear_rgb(stretch_colours(lines.local_stretch)).reshape(-1, 3)
        curves.CreatePointsAttr().Set(Vt.Vec3fArray.FromNumpy(places), code)
        curves.CreateExtentAttr().Set(Vt.Vec3fArray.FromNumpy(extent), code)
        colours.Set(Vt.Vec3fArray.FromNumpy(shades.astype(np.float32)), code)


def _fill(mesh: "UsdGeom.Mesh", part: AnimatedMesh, codes: list[float]) -> None:
    """A muscle gets its points at each time, and its faces where they change; a bone its points
    once and its poses.
    """
    from pxr import Gf, UsdGeom, Vt

    for k in range(len(part.vertices)):
        vertices, faces, normals = part.own(k)
        at = [codes[k]] if part.poses is None else []
        if k == 0 or not part.keeps_vertices:
            topology_at = [] if part.keeps_vertices else at
            corners = np.ascontiguousarray(faces, dtype=np.int32).ravel()
            counts = Vt.IntArray(len(faces), 3)
            _set(mesh.CreateFaceVertexCountsAttr(), counts, topology_at, first=k == 0)
            corners = Vt.IntArray.FromNumpy(corners)
            _set(mesh.CreateFaceVertexIndicesAttr(), corners, topology_at, first=k == 0)
        points = np.ascontiguousarray(vertices, dtype=np.float32)
        extent = np.stack([points.min(axis=0), points.max(axis=0)])
        _set(mesh.CreatePointsAttr(), Vt.Vec3fArray.FromNumpy(points), at, first=k == 0)
        _set(mesh.CreateExtentAttr(), Vt.Vec3fArray.FromNumpy(extent), at, first=k == 0)
        # Without normals a surface that is no subdivision surface is drawn facet by facet.
        turned = Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(normals, dtype=np.float32))
        _set(mesh.CreateNormalsAttr(), turned, at, first=k == 0)
    mesh.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
    if part.poses is not None:
        place = mesh.AddTransformOp()
        for k, (code, pose) in enumerate(zip(codes, part.poses)):
            _set(place, Gf.Matrix4d(pose.T), [code] if part.moves else [], first=k == 0)


def _set(attribute: "Usd.Attribute", value: object, at: list[float], *, first: bool) -> None:
    """Give an attribute a value at time codes; without any, or of the first frame, as its default
    too.
    """
    if first or not at:
        attribute.Set(value)
    for code in at:
        attribute.Set(value, code)


def identifier(name: str, used: set[str]) -> str:
    """A name as USD allows it, unlike those used before."""
    from pxr import Tf

    base = Tf.MakeValidIdentifier(name)
    found = next(text for k in count(1) if (text := base if k == 1 else f"{base}_{k}") not in used)
    used.add(found)
    return found
