"""VTK and VTP files: read as VTK reads them where they are whole, refused in one line where they
are not.
"""

import os
import re
import signal
import subprocess
import sys
import zlib
from functools import cache

import numpy as np
import pytest
import trimesh
from fuzz.meshes import FORMS, suffix_of, write_mesh

from rbfmuscle.scene.meshes import polydata
from rbfmuscle.scene.meshes.polydata import MOST_ARRAYS
from rbfmuscle.scene.meshes.read import read_mesh, read_part
from rbfmuscle.validation import MeshError

BALL = trimesh.creation.icosphere(subdivisions=2, radius=20.0)
ASCII, ENCODED = "vtp-Ascii-None", "vtp-Appended-LZMA-UInt32-encoded"


def assert_is_ball(path):
    _, points, triangles, *_ = read_part(path)
    np.testing.assert_array_equal(triangles, BALL.faces)
    np.testing.assert_allclose(points, BALL.vertices, atol=2e-6)  # float32


def assert_refused(path, capfd):
    """In one line that names the file, and with nothing printed by a library."""
    with pytest.raises(MeshError, match=re.escape(path.name)) as caught:
        read_mesh(path)
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 1000
    assert capfd.readouterr() == ("", "")


class TestWholeFiles:
    @pytest.mark.parametrize(
        "form", [*(f for f in FORMS if "vt" in f), "vtp-Binary-ZLib-UInt64", ENCODED]
    )
    def test_file_holds_what_vtk_wrote(self, tmp_path, form):
        assert_is_ball(write_mesh(tmp_path / f"ball{suffix_of(form)}", BALL, form))

    def test_quads_and_strips_become_triangles(self, tmp_path):
        path = tmp_path / "cube.vtk"
        points = "0 0 0 1 0 0 1 1 0 0 1 0 0 0 1 1 0 1 1 1 1 0 1 1"
        path.write_text(
            f"# vtk DataFile Version 3.0\ncube\nASCII\nDATASET POLYDATA\nPOINTS 8 float\n{points}\n"
            "POLYGONS 2 10\n4 0 3 2 1\n4 4 5 6 7\nTRIANGLE_STRIPS 1 11\n10 4 0 5 1 6 2 7 3 4 0\n"
        )
        cube = trimesh.Trimesh(*read_part(path)[1:3], process=False)
        assert abs(cube.volume) == pytest.approx(1.0) and len(cube.faces) == 12


class TestDamagedFiles:
    @pytest.mark.parametrize(
        "form", [ASCII, "vtp-Binary-ZLib", "vtp-Appended-LZ4", "vtk-text-51", "vtk-binary-51"]
    )
    def test_file_cut_anywhere_is_refused_in_one_line(self, tmp_path, form, capfd):
        whole = write_mesh(tmp_path / "whole", BALL, form).read_bytes()
        end = (
            0.9 * len(whole) if form[:3] == "vtp" else len(whole) - 6
        )  # within a text's last number
        path = tmp_path / f"cut{suffix_of(form)}"
        for cut in np.linspace(1, end, 25).astype(int):
            path.write_bytes(whole[:cut])
            assert_refused(path, capfd)

    @pytest.mark.parametrize(
        ("suffix", "old", "new"),
        [
            ("vtk", "POINTS 162", "POINTS 162000000000"),
            ("vtk", "POINTS 162", "POINTS 163"),
            ("vtk", "POLYGONS 320 1280", "POLYGONS 320 " + "9" * 5000),
            ("vtk", "DATASET POLYDATA", "DATASET UNSTRUCTURED_GRID"),
            ("vtk", "\n3 ", "\n3 99999 "),
            ("vtp", 'NumberOfPoints="162"', 'NumberOfPoints="99999999999999999999"'),
            ("vtp", 'NumberOfPolys="320"', 'NumberOfPolys="1000000"'),
            ("vtp", "vtkZLibDataCompressor", "vtkLZMADataCompressor"),
            ("vtp", 'offset="', 'offset="9999'),
        ],
    )
    def test_file_that_says_what_is_not_so(self, tmp_path, suffix, old, new, capfd):
        form = "vtk-text-42" if suffix == "vtk" else "vtp-Appended-ZLib"
        data = write_mesh(tmp_path / f"a.{suffix}", BALL, form).read_bytes()
        at = max(data.find(b"<Points>"), 0) if old == 'offset="' else 0
        assert old.encode() in data[at:]
        damaged = tmp_path / f"b.{suffix}"
        damaged.write_bytes(data[:at] + data[at:].replace(old.encode(), new.encode(), 1))
        assert_refused(damaged, capfd)


class TestReader:
    """What a file can do to the process that reads it."""

    @pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP])
    def test_process_that_ends_or_hangs_costs_one_file(self, tmp_path, monkeypatch, capfd, number):
        path = write_mesh(tmp_path / "a.vtp", BALL, "vtp-Appended-ZLib")
        assert_is_ball(path)
        monkeypatch.setattr(polydata, "PATIENCE", 0.5)
        os.kill(polydata._child(os.getpid()).pid, number)
        assert_refused(path, capfd)
        monkeypatch.undo()
        assert_is_ball(path)

    @pytest.mark.parametrize("form", ["pickle", "array of objects", "size", "shape", "nothing"])
    def test_answer_of_a_process_that_was_taken_over_is_never_run(
        self, tmp_path, monkeypatch, capfd, form
    ):
        """The file that it would make is not there, and the next file is read."""
        victim = tmp_path / "victim"
        code = f"""
import io, numpy as np, os, pickle, sys
class Evil:
    def __reduce__(self):
        return os.mkdir, ({str(victim)!r},)
plain, objects, shape = io.BytesIO(), io.BytesIO(), io.BytesIO()
np.save(objects, np.array([Evil()], dtype=object), allow_pickle=True)
np.save(shape, np.zeros((3, 2)))
whole = lambda data: len(data).to_bytes(8, "little") + data
sys.stdout.buffer.write({{
    "pickle": pickle.dumps(Evil()), "array of objects": whole(objects.getvalue()),
    "size": (1 << 62).to_bytes(8, "little"), "shape": whole(2 * shape.getvalue()), "nothing": b"",
}}[{form!r}])
"""
        path = write_mesh(tmp_path / "a.vtp", BALL, "vtp-Appended-ZLib")
        polydata._child.cache_clear()
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
        with monkeypatch.context() as patch:
            child = cache(lambda _: subprocess.Popen([sys.executable, "-c", code], **pipes))
            patch.setattr(polydata, "_child", child)
            assert_refused(path, capfd)
        assert not victim.exists()
        assert_is_ball(path)

    def test_file_is_read_where_the_system_takes_no_limit_of_memory(self, tmp_path, monkeypatch):
        """As macOS, where a limit below what is mapped is a ValueError."""
        (tmp_path / "sitecustomize.py").write_text(
            "import resource\ndef refuse(*given):\n    raise ValueError('limit')\n"
            "resource.setrlimit = refuse\n"
        )
        monkeypatch.setenv("PYTHONPATH", str(tmp_path))
        path = write_mesh(tmp_path / "a.vtp", BALL, "vtp-Appended-ZLib")
        polydata._end(polydata._child(os.getpid()))
        assert_is_ball(path)
        polydata._end(polydata._child(os.getpid()))

    def test_file_of_more_arrays_than_are_read_in_seconds_is_refused(self, tmp_path, capfd):
        array = '<DataArray type="Float32" Name="a%d" format="ascii">0 0 0 0</DataArray>'
        arrays = {
            "a.vtp": '<VTKFile type="PolyData"><PolyData><Piece NumberOfPoints="4" '
            f'NumberOfPolys="0"><PointData>{"".join(array % k for k in range(MOST_ARRAYS))}'
            f"</PointData><Points>{array % 0}</Points></Piece></PolyData></VTKFile>",
            "a.vtk": "# vtk DataFile Version 3.0\na\nASCII\nDATASET POLYDATA\nPOINTS 1 float\n0 0 0"
            f"\nPOINT_DATA 1\nFIELD FieldData {MOST_ARRAYS + 1}\n",
        }
        for name, text in arrays.items():
            path = tmp_path / name
            path.write_text(text)
            with pytest.raises(MeshError, match="1001 arrays, at most 1000 are read"):
                read_mesh(path)
            assert_refused(path, capfd)

    def test_file_that_unpacks_without_end_is_refused(self, tmp_path, capfd):
        size = 24 * 10**9
        block = zlib.compress(bytes(10**6), 9)
        header = np.array(
            [size // 10**6, 10**6, 0, *[len(block)] * (size // 10**6)], dtype="<u4"
        ).tobytes()
        path = tmp_path / "bomb.vtp"
        path.write_bytes(
            b'<?xml version="1.0"?><VTKFile type="PolyData" byte_order="LittleEndian" '
            b'header_type="UInt32" '
            b'compressor="vtkZLibDataCompressor"><PolyData><Piece NumberOfPoints="%d" '
            b'NumberOfPolys="0">'
            b'<Points><DataArray type="Float64" NumberOfComponents="3" format="appended" '
            b'offset="0"/></Points>'
            b'</Piece></PolyData><AppendedData encoding="raw">_%s</AppendedData></VTKFile>'
            % (size // 24, header + block * (size // 10**6))
        )
        assert_refused(path, capfd)
