"""A moving run as one USD file (.usdc): meshes whose points are sampled over time, bones that move as rigid bodies."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from rbfmuscle.geometry.arrays import Floats, Integers
from rbfmuscle.geometry.surfaces import vertex_normals
from rbfmuscle.sim.scene.scene import MM_PER_UNIT
from rbfmuscle.study.animation.moving import (
    FRAMES_A_SECOND,
    MovingBone,
    MovingMuscle,
    MovingRun,
    linear_rgb,
)
from rbfmuscle.validation import MissingPartError


def check_usd() -> None:
    """Raise MissingPartError where the package that writes USD is absent."""
    try:
        import pxr.Usd  # noqa: F401
    except ImportError:
        raise MissingPartError(
            "export to usd needs usd-core: pip install -e '.[usd]' in rbfmuscle's folder"
        ) from None


def write_usd(path: Path, run: MovingRun, *, normals: bool = False) -> None:
    """Write a run as one ``.usdc`` file.

    Parameters
    ----------
    path : pathlib.Path
    run : MovingRun
    normals : bool
        Of the muscles' vertices at every time, which makes the file twice as large; bones have theirs always.

    Raises
    ------
    MissingPartError
        Where usd-core is absent.

    Notes
    -----
    Time codes count 24 a second. A surface that keeps its vertices has its topology once and its points at every
    time; another one has both at every time. Lengths stay in the run's unit, which ``metersPerUnit`` tells.
    """
    check_usd()
    from pxr import Sdf, Usd, UsdGeom

    codes = run.times * FRAMES_A_SECOND
    stage = Usd.Stage.CreateInMemory()
    with Sdf.ChangeBlock():
        UsdGeom.SetStageUpAxis(stage, run.up.upper())
        UsdGeom.SetStageMetersPerUnit(stage, MM_PER_UNIT[run.unit] / 1000.0)
        stage.SetTimeCodesPerSecond(FRAMES_A_SECOND)
        stage.SetFramesPerSecond(FRAMES_A_SECOND)
        stage.SetStartTimeCode(float(codes[0]))
        stage.SetEndTimeCode(float(codes[-1]))
    place = f"/{_identifier(run.name, set())}"
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, place).GetPrim())
    used: set[str] = set()
    for bone in run.bones:
        mesh = UsdGeom.Mesh.Define(stage, f"{place}/{_identifier(bone.name, used)}")
        _fill_bone(mesh, bone, codes)
        _paint(stage, mesh, bone, place)
    for muscle in run.muscles:
        mesh = UsdGeom.Mesh.Define(stage, f"{place}/{_identifier(muscle.name, used)}")
        _fill_muscle(mesh, muscle, codes, normals)
        _paint(stage, mesh, muscle, place)
    stage.GetRootLayer().Export(str(path))


def _fill_bone(mesh: Any, bone: MovingBone, codes: Floats) -> None:
    from pxr import Gf

    _set_topology(mesh, bone.faces, None)
    _set_points(mesh, bone.vertices, None)
    _set_normals(mesh, bone.vertices, bone.faces, None)
    place = mesh.AddTransformOp()
    if not bone.moves:
        place.Set(Gf.Matrix4d(bone.poses[0].T))
        return
    for code, pose in zip(codes, bone.poses):
        place.Set(Gf.Matrix4d(pose.T), float(code))


def _fill_muscle(mesh: Any, muscle: MovingMuscle, codes: Floats, normals: bool) -> None:
    from pxr import Sdf, UsdGeom, Vt

    if muscle.keeps_vertices:
        _set_topology(mesh, muscle.faces[0], None)
    primvars = UsdGeom.PrimvarsAPI(mesh)
    values = {
        key: primvars.CreatePrimvar(key, Sdf.ValueTypeNames.FloatArray, UsdGeom.Tokens.vertex)
        for key in muscle.values
    }
    for k, code in enumerate(map(float, codes)):
        if not muscle.keeps_vertices:
            _set_topology(mesh, muscle.faces[k], code)
        _set_points(mesh, muscle.vertices[k], code)
        if normals:
            _set_normals(mesh, muscle.vertices[k], muscle.faces[k], code)
        for key, primvar in values.items():
            numbers = np.ascontiguousarray(muscle.values[key][k], dtype=np.float32)
            primvar.Set(Vt.FloatArray.FromNumpy(numbers), code)


def _set_topology(mesh: Any, faces: Integers, code: float | None) -> None:
    from pxr import UsdGeom, Vt

    if code is None or not mesh.GetSubdivisionSchemeAttr().HasAuthoredValue():
        mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
        mesh.CreateOrientationAttr(UsdGeom.Tokens.rightHanded)
    numbers = np.ascontiguousarray(faces, dtype=np.int32).ravel()
    counts = np.full(len(faces), 3, dtype=np.int32)
    at = () if code is None else (code,)
    mesh.CreateFaceVertexCountsAttr().Set(Vt.IntArray.FromNumpy(counts), *at)
    mesh.CreateFaceVertexIndicesAttr().Set(Vt.IntArray.FromNumpy(numbers), *at)


def _set_points(mesh: Any, vertices: Floats, code: float | None) -> None:
    from pxr import Vt

    points = np.ascontiguousarray(vertices, dtype=np.float32)
    extent = np.stack([points.min(axis=0), points.max(axis=0)])
    at = () if code is None else (code,)
    mesh.CreatePointsAttr().Set(Vt.Vec3fArray.FromNumpy(points), *at)
    mesh.CreateExtentAttr().Set(Vt.Vec3fArray.FromNumpy(extent), *at)


def _set_normals(mesh: Any, vertices: Floats, faces: Integers, code: float | None) -> None:
    """Normals of the vertices: without them a surface that is no subdivision surface is drawn facet by facet."""
    from pxr import UsdGeom, Vt

    rows = np.ascontiguousarray(vertex_normals(vertices, faces), dtype=np.float32)
    mesh.CreateNormalsAttr().Set(Vt.Vec3fArray.FromNumpy(rows), *(() if code is None else (code,)))
    mesh.SetNormalsInterpolation(UsdGeom.Tokens.vertex)


def _paint(stage: Any, mesh: Any, item: MovingBone | MovingMuscle, place: str) -> None:
    """The colour of a mesh, for those who draw materials and for those who draw none."""
    from pxr import Gf, Sdf, UsdShade

    colour = Gf.Vec3f(*linear_rgb(item.colour).tolist())
    mesh.CreateDisplayColorAttr([colour])
    mesh.GetPrim().SetDisplayName(item.name)
    name = mesh.GetPrim().GetName()
    material = UsdShade.Material.Define(stage, f"{place}/materials/{name}")
    shader: Any = UsdShade.Shader.Define(stage, f"{place}/materials/{name}/surface")
    shader.CreateIdAttr("UsdPreviewSurface")
    shader.CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f).Set(colour)
    shader.CreateInput("roughness", Sdf.ValueTypeNames.Float).Set(0.6)
    output = shader.CreateOutput("surface", Sdf.ValueTypeNames.Token)
    material.CreateSurfaceOutput().ConnectToSource(output)
    UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim()).Bind(material)


def _identifier(name: str, used: set[str]) -> str:
    """A name as USD allows it, unlike those used before."""
    from pxr import Tf

    base = Tf.MakeValidIdentifier(name)
    found, count = base, 1
    while found in used or found == "materials":
        count += 1
        found = f"{base}_{count}"
    used.add(found)
    return found
