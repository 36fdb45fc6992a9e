"""A moving run as VTKHDF files, one a muscle or bone, each with all its times."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from rbfmuscle.geometry.arrays import Floats
from rbfmuscle.study.animation.moving import MovingRun
from rbfmuscle.validation import MissingPartError, SolveError

COMPRESSION = 2


def write_vtkhdf(folder: Path, run: MovingRun) -> list[Path]:
    """Write a run as VTKHDF, the file format of VTK that holds time.

    Parameters
    ----------
    folder : pathlib.Path
        Takes ``NAME.vtkhdf`` for each muscle (double precision) and bone (single).
    run : MovingRun

    Returns
    -------
    list of pathlib.Path

    Raises
    ------
    MissingPartError
        Where VTK is older than 9.4, which does not write the format.
    """
    written = []
    for muscle in run.muscles:
        meshes = [
            _polydata(vertices, faces, {key: found[k] for key, found in muscle.values.items()})
            for k, (vertices, faces) in enumerate(zip(muscle.vertices, muscle.faces))
        ]
        written.append(_write(folder / f"{muscle.name}.vtkhdf", meshes, run.times))
    for bone in run.bones:
        poses, times = (bone.poses, run.times) if bone.moves else (bone.poses[:1], run.times[:1])
        posed = [(bone.vertices @ pose[:3, :3].T + pose[:3, 3]).astype(np.float32) for pose in poses]
        written.append(
            _write(folder / f"{bone.name}.vtkhdf", [_polydata(p, bone.faces, {}) for p in posed], times)
        )
    return written


def _polydata(vertices, faces, values):
    from vtkmodules.util.numpy_support import numpy_to_vtk, numpy_to_vtkIdTypeArray
    from vtkmodules.vtkCommonCore import vtkPoints
    from vtkmodules.vtkCommonDataModel import vtkCellArray, vtkPolyData

    mesh, points, cells = vtkPolyData(), vtkPoints(), vtkCellArray()
    points.SetData(numpy_to_vtk(np.ascontiguousarray(vertices), deep=True))
    ends = np.arange(0, 3 * len(faces) + 1, 3, dtype=np.int64)
    numbers = np.ascontiguousarray(faces, dtype=np.int64).ravel()
    cells.SetData(numpy_to_vtkIdTypeArray(ends, deep=True), numpy_to_vtkIdTypeArray(numbers, deep=True))
    mesh.SetPoints(points)
    mesh.SetPolys(cells)
    for key, value in values.items():
        array = numpy_to_vtk(np.ascontiguousarray(value, dtype=np.float64), deep=True)
        array.SetName(key)
        mesh.GetPointData().AddArray(array)
    return mesh


def _write(path: Path, meshes: list[Any], times: Floats) -> Path:
    try:
        from vtkmodules.vtkIOHDF import vtkHDFWriter
    except ImportError:
        raise MissingPartError(
            "export to vtkhdf needs VTK 9.4 or newer: pip install --upgrade vtk pyvista"
        ) from None
    writer, source = vtkHDFWriter(), _source(meshes, [float(t) for t in times])
    writer.SetInputConnection(source.GetOutputPort())
    writer.SetFileName(str(path))
    writer.SetWriteAllTimeSteps(True)
    writer.SetCompressionLevel(COMPRESSION)
    if not writer.Write():
        raise SolveError(f"cannot write {path}")
    return path


def _source(meshes, times):
    """A VTK source of one mesh a time."""
    from vtkmodules.util.vtkAlgorithm import VTKPythonAlgorithmBase
    from vtkmodules.vtkCommonDataModel import vtkPolyData
    from vtkmodules.vtkCommonExecutionModel import vtkStreamingDemandDrivenPipeline as Pipeline

    class Source(VTKPythonAlgorithmBase):
        def __init__(self):
            super().__init__(nInputPorts=0, nOutputPorts=1, outputType="vtkPolyData")

        def RequestInformation(self, _request, _inputs, outputs):
            info = outputs.GetInformationObject(0)
            info.Set(Pipeline.TIME_STEPS(), times, len(times))
            info.Set(Pipeline.TIME_RANGE(), [times[0], times[-1]], 2)
            return 1

        def RequestData(self, _request, _inputs, outputs):
            info, wanted = outputs.GetInformationObject(0), times[0]
            if info.Has(Pipeline.UPDATE_TIME_STEP()):
                wanted = info.Get(Pipeline.UPDATE_TIME_STEP())
            vtkPolyData.GetData(outputs).ShallowCopy(meshes[int(np.argmin(np.abs(np.array(times) - wanted)))])
            return 1

    return Source()
