"""VTK and VTP files: read as VTK reads them where they are whole, refused in one line where they are not."""

import itertools
import zlib

import numpy as np
import pytest
import trimesh

from rbfmuscle.sim.formats.lz4 import unpack_lz4
from rbfmuscle.sim.formats.polydata import BrokenFileError, read_polydata, triangles_of
from rbfmuscle.sim.scene.meshes import read_mesh
from rbfmuscle.validation import MeshError

BALL = trimesh.creation.icosphere(subdivisions=2, radius=20.0)


def vtk_data():
    import pyvista

    data = pyvista.make_tri_mesh(BALL.vertices, BALL.faces)
    data.cell_data["number"] = np.arange(len(BALL.faces), dtype=float)
    return data


def write_vtp(path, mode="Appended", compressor="ZLib", header="UInt32", *, encode=True, order="Little"):
    from vtkmodules.vtkIOXML import vtkXMLPolyDataWriter

    writer = vtkXMLPolyDataWriter()
    writer.SetInputData(vtk_data())
    writer.SetFileName(str(path))
    getattr(writer, f"SetDataModeTo{mode}")()
    getattr(writer, f"SetCompressorTypeTo{compressor}")()
    getattr(writer, f"SetHeaderTypeTo{header}")()
    getattr(writer, f"SetByteOrderTo{order}Endian")()
    writer.SetEncodeAppendedData(encode)
    writer.SetBlockSize(4096)  # several blocks an array
    writer.Write()
    return path


def write_legacy(path, *, binary, version):
    from vtkmodules.vtkIOLegacy import vtkPolyDataWriter

    writer = vtkPolyDataWriter()
    writer.SetInputData(vtk_data())
    writer.SetFileName(str(path))
    writer.SetFileVersion(version)
    (writer.SetFileTypeToBinary if binary else writer.SetFileTypeToASCII)()
    writer.Write()
    return path


def assert_is_ball(path):
    data = read_polydata(path)
    np.testing.assert_array_equal(triangles_of(data), BALL.faces)
    np.testing.assert_allclose(data.points, BALL.vertices, atol=2e-6)  # float32


VTP_FORMS = [
    form
    for form in itertools.product(
        ("Ascii", "Binary", "Appended"), ("None", "ZLib", "LZMA", "LZ4"), ("UInt32", "UInt64"), (False, True)
    )
    if not (form[0] != "Appended" and form[3]) and not (form[0] == "Ascii" and form[1] != "None")
]


class TestWholeFiles:
    @pytest.mark.parametrize(("mode", "compressor", "header", "encode"), VTP_FORMS)
    def test_vtp_of_every_encoding_holds_what_vtk_wrote(self, tmp_path, mode, compressor, header, encode):
        for order in ("Little", "Big"):
            path = tmp_path / f"{order}.vtp"
            assert_is_ball(write_vtp(path, mode, compressor, header, encode=encode, order=order))

    @pytest.mark.parametrize("binary", [False, True])
    @pytest.mark.parametrize("version", [42, 51])
    def test_legacy_file_holds_what_vtk_wrote(self, tmp_path, binary, version):
        assert_is_ball(write_legacy(tmp_path / "ball.vtk", binary=binary, version=version))

    def test_values_of_cells_are_read_where_asked(self, tmp_path):
        path = write_vtp(tmp_path / "ball.vtp")
        assert read_polydata(path).values == {}
        np.testing.assert_array_equal(
            read_polydata(path, values=True).values["number"], np.arange(len(BALL.faces))
        )

    def test_quads_strips_and_concave_polygons_become_triangles(self, tmp_path):
        path = tmp_path / "mixed.vtk"
        # A unit cube: bottom and top as quads, sides as one strip; and an arrowhead, concave at its corner 10.
        points = "0 0 0 1 0 0 1 1 0 0 1 0 0 0 1 1 0 1 1 1 1 0 1 1  0 0 5 2 1 5 1.5 0 5 2 -1 5"
        path.write_text(
            f"# vtk DataFile Version 3.0\ncube\nASCII\nDATASET POLYDATA\nPOINTS 12 float\n{points}\n"
            "POLYGONS 3 15\n4 0 3 2 1\n4 4 5 6 7\n4 10 9 8 11\n"
            "TRIANGLE_STRIPS 1 11\n10 4 0 5 1 6 2 7 3 4 0\n"
        )
        data = read_polydata(path)
        faces = triangles_of(data)
        cube = trimesh.Trimesh(data.points, faces[(faces < 8).all(axis=1)], process=False)
        assert abs(cube.volume) == pytest.approx(1.0)
        arrow = data.points[faces[(faces >= 8).all(axis=1)]]
        normals = np.cross(arrow[:, 1] - arrow[:, 0], arrow[:, 2] - arrow[:, 0])
        assert (normals[:, 2] > 0).all() or (normals[:, 2] < 0).all()  # none folds over
        assert 0.5 * np.linalg.norm(normals, axis=1).sum() == pytest.approx(1.5)

    def test_pieces_are_joined(self, tmp_path):
        path = write_vtp(tmp_path / "one.vtp", "Ascii", "None")
        text = path.read_text()
        piece = text[text.index("<Piece") : text.index("</Piece>") + len("</Piece>")]
        (tmp_path / "two.vtp").write_text(text.replace(piece, piece + piece))
        data = read_polydata(tmp_path / "two.vtp")
        faces = triangles_of(data)
        np.testing.assert_array_equal(faces, np.vstack([BALL.faces, BALL.faces + len(BALL.vertices)]))

    def test_lz4_of_overlapping_matches_and_long_runs(self):
        # "ab" and a match of 300 that repeats it; then five literals.
        block = bytes([0x2F]) + b"ab" + bytes([2, 0, 255, 26]) + bytes([0x50]) + b"cdefg"
        assert unpack_lz4(block, 307) == b"ab" * 151 + b"cdefg"
        for size in (306, 308):
            with pytest.raises(BrokenFileError):
                unpack_lz4(block, size)


class TestDamagedFiles:
    @pytest.mark.parametrize("form", [("Ascii", "None"), ("Binary", "ZLib"), ("Appended", "LZ4")], ids=str)
    def test_vtp_cut_anywhere_is_refused_in_one_line(self, tmp_path, form, capfd):
        whole = write_vtp(tmp_path / "whole.vtp", *form, encode=False).read_bytes()
        path = tmp_path / "cut.vtp"
        for cut in np.linspace(1, 0.9 * len(whole), 25).astype(int):
            path.write_bytes(whole[:cut])
            with pytest.raises(MeshError, match=r"cut\.vtp") as caught:
                read_mesh(path)
            assert "\n" not in str(caught.value) and len(str(caught.value)) < 1000
        assert capfd.readouterr() == ("", "")  # nor does a library print anything

    @pytest.mark.parametrize("binary", [False, True])
    def test_legacy_file_cut_anywhere_is_refused(self, tmp_path, binary, capfd):
        whole = write_legacy(tmp_path / "whole.vtk", binary=binary, version=51).read_bytes()
        end = whole.index(b"CELL_DATA") - 20
        path = tmp_path / "cut.vtk"
        for cut in np.linspace(1, end, 25).astype(int):
            path.write_bytes(whole[:cut])
            with pytest.raises(MeshError, match=r"cut\.vtk"):
                read_mesh(path)
        assert capfd.readouterr() == ("", "")

    @pytest.mark.parametrize(
        ("old", "new", "words"),
        [
            ("POINTS 162", "POINTS 162000000000", "more than the file can hold"),
            ("POINTS 162", "POINTS -1", "more than the file can hold"),
            ("POINTS 162", "POINTS 163", "promised"),
            ("double", "quaternion", "unknown number type"),
            ("POLYGONS 320 1280", "POLYGONS 320 " + "9" * 5000, "more than the file can hold"),
            ("POLYGONS 320 1280", "POLYGONS 321 1280", "does not fit"),
            ("DATASET POLYDATA", "DATASET UNSTRUCTURED_GRID", "not a VTK PolyData"),
            ("ASCII", "ENIGMA", "neither ASCII nor BINARY"),
            ("\n3 ", "\n3 99999 ", "not fit|promised|name point"),
            ("\n3 ", "\n-3 ", "does not fit"),
        ],
    )
    def test_false_counts_and_types(self, tmp_path, old, new, words):
        text = write_legacy(tmp_path / "a.vtk", binary=False, version=42).read_text()
        assert old in text
        (tmp_path / "b.vtk").write_text(text.replace(old, new, 1))
        with pytest.raises(MeshError, match=words):
            read_mesh(tmp_path / "b.vtk")

    @pytest.mark.parametrize(
        ("old", "new", "words"),
        [
            ('type="Float64"', 'type="Float99"', "unknown number type"),
            ('NumberOfPoints="162"', 'NumberOfPoints="99999999999999999999"', "not a number that the file"),
            ('NumberOfPolys="320"', 'NumberOfPolys="1000000"', "promised|not a number"),
            ('format="appended"', 'format="telepathy"', "unknown format"),
            ("vtkZLibDataCompressor", "vtkLZMADataCompressor", "cannot be unpacked"),
            ("vtkZLibDataCompressor", "vtkEvilCompressor", "unknown compressor"),
            ('offset="', 'offset="9999', "ends after|not a number"),
            ("LittleEndian", "MiddleEndian", "unknown byte_order"),
            ("<VTKFile", "<!DOCTYPE a [<!ENTITY b 'c'>]><VTKFile", "document type"),
            ('type="PolyData"', 'type="ImageData"', "not a VTK PolyData"),
        ],
    )
    def test_vtp_that_says_what_is_not_so(self, tmp_path, old, new, words):
        data = write_vtp(tmp_path / "a.vtp", encode=False).read_bytes()
        at = (
            max(data.find(b"<Points>"), 0)
            if old in ('type="Float64"', 'format="appended"', 'offset="')
            else 0
        )
        assert old.encode() in data[at:]
        (tmp_path / "b.vtp").write_bytes(data[:at] + data[at:].replace(old.encode(), new.encode(), 1))
        with pytest.raises(MeshError, match=words):
            read_mesh(tmp_path / "b.vtp")

    def test_flipped_bytes_of_compressed_data_never_pass_for_another_mesh(self, tmp_path):
        whole = write_vtp(tmp_path / "a.vtp", encode=False).read_bytes()
        start = whole.index(b"<AppendedData")
        rng = np.random.default_rng(3)
        path = tmp_path / "b.vtp"
        for _ in range(40):
            damaged = bytearray(whole)
            damaged[rng.integers(start + 40, len(whole) - 40)] ^= 1 << rng.integers(8)
            path.write_bytes(damaged)
            try:
                found = read_mesh(path).mesh
            except MeshError:
                continue
            assert found.volume == pytest.approx(BALL.volume, rel=1e-3)


class TestMemory:
    def bomb(self, path, size):
        """A file whose points unpack to ``size`` bytes of nothing, as it says itself."""
        block = zlib.compress(bytes(size), 9)
        header = np.array([1, size, 0, len(block)], dtype="<u4").tobytes()
        path.write_bytes(
            b'<?xml version="1.0"?><VTKFile type="PolyData" byte_order="LittleEndian" header_type="UInt32" '
            b'compressor="vtkZLibDataCompressor"><PolyData><Piece NumberOfPoints="%d" NumberOfPolys="0">'
            b'<Points><DataArray type="Float64" NumberOfComponents="3" format="appended" offset="0"/></Points>'
            b'</Piece></PolyData><AppendedData encoding="raw">_%s</AppendedData></VTKFile>'
            % (size // 24, header + block)
        )
        return path

    def test_file_that_unpacks_without_end_is_refused_before_it_does(self, tmp_path, monkeypatch):
        path = self.bomb(tmp_path / "bomb.vtp", 24 * 1_000_000)
        unpacked = []
        real = zlib.decompressobj
        monkeypatch.setattr(zlib, "decompressobj", lambda: unpacked.append(1) or real())
        with pytest.raises(
            MeshError, match=r"bomb\.vtp.*times the file.*RBFMUSCLE_MESH_EXPANSION|not a number"
        ):
            read_mesh(path)
        assert not unpacked

    def test_limit_can_be_raised(self, tmp_path, monkeypatch):
        path = self.bomb(tmp_path / "bomb.vtp", 24 * 100_000)
        with pytest.raises(MeshError, match="RBFMUSCLE_MESH_EXPANSION"):
            read_polydata(path)
        monkeypatch.setenv("RBFMUSCLE_MESH_EXPANSION", "5000")
        assert len(read_polydata(path).points) == 100_000
        monkeypatch.setenv("RBFMUSCLE_MESH_EXPANSION", "much")
        with pytest.raises(MeshError, match="must be a positive number"):
            read_polydata(path)
