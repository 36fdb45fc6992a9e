"""The small scene that is damaged: two bones, a joint, one muscle, as tables and as mesh files of every form."""

from pathlib import Path

import numpy as np
import trimesh

# Every form in which a mesh is written: suffix and how.
FORMS = (
    "stl", "stl-text", "obj", "ply", "ply-text", "vtk-text-42", "vtk-binary-42", "vtk-text-51", "vtk-binary-51",
    "vtp-Ascii-None", "vtp-Binary-None", "vtp-Binary-ZLib", "vtp-Appended-None", "vtp-Appended-ZLib",
    "vtp-Appended-LZ4", "vtp-Appended-LZMA",
)  # fmt: skip


def muscle_mesh() -> trimesh.Trimesh:
    """An ellipsoid of 320 triangles beside the joint [mm]."""
    mesh = trimesh.creation.icosphere(subdivisions=2, radius=1.0)
    mesh.apply_scale([14.0, 12.0, 55.0])
    return mesh.apply_translation([34.0, 0.0, -10.0])


def bone_meshes() -> dict[str, trimesh.Trimesh]:
    """A ball above the joint and a rod below it [mm]."""
    upper = trimesh.creation.icosphere(subdivisions=2, radius=18.0).apply_translation([0.0, 0.0, 30.0])
    lower = trimesh.creation.capsule(height=80.0, radius=10.0, count=[10, 10])
    return {"upper": upper, "lower": lower.apply_translation([0.0, 0.0, -95.0])}


def suffix_of(form: str) -> str:
    """Suffix of a file of a form."""
    return "." + form.split("-")[0]


def write_mesh(path: Path, mesh: trimesh.Trimesh, form: str) -> Path:
    """Write a mesh in one of ``FORMS``."""
    kind, *how = form.split("-")
    if kind == "stl":
        path.write_bytes(mesh.export(file_type="stl_ascii").encode() if how else mesh.export(file_type="stl"))
    elif kind == "ply":
        path.write_bytes(mesh.export(file_type="ply", encoding="ascii" if how else "binary"))
    elif kind == "obj":
        path.write_text(mesh.export(file_type="obj", include_normals=False))
    elif kind == "vtk":
        _write_legacy(path, mesh, *how)
    else:
        _write_vtp(path, mesh, *how)
    return path


def _poly_data(mesh):
    import pyvista

    return pyvista.make_tri_mesh(np.asarray(mesh.vertices), np.asarray(mesh.faces))


def _write_legacy(path, mesh, how, version):
    from vtkmodules.vtkIOLegacy import vtkPolyDataWriter

    writer = vtkPolyDataWriter()
    writer.SetInputData(_poly_data(mesh))
    writer.SetFileName(str(path))
    writer.SetFileVersion(int(version))
    (writer.SetFileTypeToBinary if how == "binary" else writer.SetFileTypeToASCII)()
    writer.Write()


def _write_vtp(path, mesh, mode, compressor, header="UInt32", encoded=""):
    from vtkmodules.vtkIOXML import vtkXMLPolyDataWriter

    writer = vtkXMLPolyDataWriter()
    writer.SetInputData(_poly_data(mesh))
    writer.SetFileName(str(path))
    getattr(writer, f"SetDataModeTo{mode}")()
    getattr(writer, f"SetCompressorTypeTo{compressor}")()
    getattr(writer, f"SetHeaderTypeTo{header}")()
    writer.SetEncodeAppendedData(bool(encoded))
    writer.SetBlockSize(4096)  # several blocks an array
    writer.Write()


def write_base(folder: Path) -> dict[str, bytes]:
    """Write the scene's files once; the muscle's bytes by form."""
    for name, mesh in bone_meshes().items():
        write_mesh(folder / f"{name}.ply", mesh, "ply")
    z = np.asarray(muscle_mesh().vertices)[:, 2]
    np.savetxt(folder / "upper.txt", np.flatnonzero(z > 25), fmt="%d")
    np.savetxt(folder / "lower.txt", np.flatnonzero(z < -45), fmt="%d")
    lines = [[[34.0, 0.0, 30.0], [34.0, 0.0, -10.0], [34.0, 0.0, -50.0]]]
    (folder / "fibres.json").write_text(f'{{"polylines": {lines}}}')
    rows = "\n".join(f"{k}\t{3 * k}" for k in range(4))
    (folder / "flex.mot").write_text(f"flex\nversion=1\ninDegrees=yes\nendheader\ntime\tflexion\n{rows}\n")
    forms = {}
    for form in FORMS:
        path = write_mesh(folder / f"muscle-{form}{suffix_of(form)}", muscle_mesh(), form)
        forms[form] = path.read_bytes()
    return forms


def base_scene() -> dict:
    """The tables of the scene file, with a value for every key that a small scene can have."""
    axes = {"flexion": [0.0, 1.0, 0.0], "turn": [0.0, 0.0, 1.0]}
    model = {"name": "rbf", "centres": 60, "samples": 200, "resolution": 16, "iterations": 4}
    attach = [{"bone": bone, "vertices": f"{bone}.txt"} for bone in ("upper", "lower")]
    return {
        "scene": {"format": 1, "name": "small", "units": "mm"},
        "defaults": {"model": "rbf"},
        "bone": [
            {"name": "upper", "mesh": "upper.ply"},
            {"name": "lower", "mesh": "lower.ply", "scale": 1.0},
        ],
        "joint": [
            {"name": "hip", "parent": "upper", "child": "lower", "centre": [0.0, 0.0, 0.0], "axes": axes}
        ],
        "motion": {"ramp": {"hip.flexion": {"from": 0.0, "to": 6.0, "step": 3.0}}},
        "muscle": [{"name": "muscle", "mesh": "muscle-ply.ply", "model": model, "attach": attach}],
        "contact": {"initial": "resolve", "substep_angle": 3.0},
        "detect": {"tunnelling": {"angle": 135.0, "action": "substep"}},
        "output": {"report": False},
    }
