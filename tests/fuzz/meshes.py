"""The small scene that is damaged, its mesh files of every form, and damaged meshes: bytes, numbers
and shapes.
"""

import re
from pathlib import Path

import numpy as np
import trimesh

# Every form in which a mesh is written: suffix and how.
FORMS = (
    "stl",
    "stl-text",
    "obj",
    "ply",
    "ply-text",
    "vtk-text-42",
    "vtk-binary-42",
    "vtk-text-51",
    "vtk-binary-51",
    "vtp-Ascii-None",
    "vtp-Binary-None",
    "vtp-Binary-ZLib",
    "vtp-Appended-None",
    "vtp-Appended-ZLib",
    "vtp-Appended-LZ4",
    "vtp-Appended-LZMA",
)


def muscle_mesh() -> trimesh.Trimesh:
    """An ellipsoid of 320 triangles beside the joint [mm]."""
    mesh = trimesh.creation.icosphere(subdivisions=2, radius=1.0)
    mesh.apply_scale([14.0, 12.0, 55.0])
    return mesh.apply_translation([34.0, 0.0, -10.0])


def bone_meshes() -> dict[str, trimesh.Trimesh]:
    """A ball above the joint and a rod below it [mm]."""
    upper = trimesh.creation.icosphere(subdivisions=2, radius=18.0).apply_translation(
        [0.0, 0.0, 30.0]
    )
    lower = trimesh.creation.capsule(height=80.0, radius=10.0, count=[10, 10])
    return {"upper": upper, "lower": lower.apply_translation([0.0, 0.0, -95.0])}


def suffix_of(form: str) -> str:
    """Suffix of a file of a form."""
    return "." + form.split("-")[0]


def write_mesh(path: Path, mesh: trimesh.Trimesh, form: str) -> Path:
    """Write a mesh in one of ``FORMS``."""
    kind, *how = form.split("-")
    if kind == "stl":
        path.write_bytes(
            mesh.export(file_type="stl_ascii").encode() if how else mesh.export(file_type="stl")
        )
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
    (folder / "flex.mot").write_text(
        f"flex\nversion=1\ninDegrees=yes\nendheader\ntime\tflexion\n{rows}\n"
    )
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
    bones = (("upper", {}), ("lower", {"scale": 1.0}))
    return {
        "scene": {"format": 2, "name": "small", "units": "mm"},
        "classes": {"main": {"model": "rbf"}},
        "bone": [{"name": name, "mesh": f"{name}.ply"} | scale for name, scale in bones],
        "joint": [
            {"name": "hip", "parent": "upper", "child": "lower", "centre": [0.0] * 3, "axes": axes}
        ],
        "motion": {"ramp": {"hip.flexion": {"from": 0.0, "to": 6.0, "step": 3.0}}},
        "muscle": [{"name": "muscle", "mesh": "muscle-ply.ply", "model": model, "attach": attach}],
        "contact": {"initial": "keep", "substep_angle": 3.0},
        "detect": {"tunnelling": {"angle": 135.0, "action": "substep"}},
        "output": {"report": False},
    }


def pick(rng, options):
    """One of the options, as it is."""
    return options[int(rng.integers(len(options)))]


NUMBERS = (
    b"0",
    b"-1",
    b"1",
    b"3",
    b"163",
    b"99999",
    b"4294967295",
    b"4294967296",
    b"9223372036854775807",
    b"9" * 30,
    b"9" * 5000,
    b"nan",
    b"inf",
    b"1e308",
    b"-1e300",
    b"1e400",
    b"1.5",
    b"abc",
    b"",
    b"0x10",
)


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
    """The muscle's mesh with vertices moved, joined or lost, or with triangles lost, turned or
    repeated.
    """
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
        # A bow tie about its waist.
        vertices[upper, :2] = 2.0 * vertices[:, :2].mean(axis=0) - vertices[upper, :2]
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
        faces = (
            faces[few[:1]] if rng.random() < 0.3 else rng.permutation(faces.ravel()).reshape(-1, 3)
        )
    return trimesh.Trimesh(vertices, faces, process=False)
