"""VTK files written directly: PolyData (.vtp) and collections over time (.pvd), without loading VTK."""

import base64
import zlib
from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np

_BLOCK = 1 << 20
_TYPES = {"f8": "Float64", "f4": "Float32", "i4": "Int32", "i8": "Int64"}


def write_vtp(path, vertices, faces, *, ascii=False, single=False):
    """Write a triangle mesh as VTK XML PolyData.

    Parameters
    ----------
    path : path
    vertices : (n, 3) array_like
    faces : (m, 3) array_like of int
    ascii : bool
        Plain numbers, as OpenSim reads them; else compressed base64, for which no reader needs a setting.
    single : bool
        Positions in single precision.
    """
    vertices = np.ascontiguousarray(vertices, dtype=np.float32 if single else np.float64)
    faces = np.ascontiguousarray(faces, dtype=np.int32)
    ends = np.arange(3, 3 * len(faces) + 1, 3, dtype=np.int32)
    compressor = "" if ascii else ' compressor="vtkZLibDataCompressor"'
    parts = [
        '<?xml version="1.0"?>\n',
        '<VTKFile type="PolyData" version="1.0" byte_order="LittleEndian" header_type="UInt32"',
        f'{compressor}>\n<PolyData>\n<Piece NumberOfPoints="{len(vertices)}" NumberOfVerts="0" ',
        f'NumberOfLines="0" NumberOfStrips="0" NumberOfPolys="{len(faces)}">\n<Points>\n',
        _array(vertices, "Points", ascii, components=3),
        "</Points>\n<Polys>\n",
        _array(faces.ravel(), "connectivity", ascii),
        _array(ends, "offsets", ascii),
        "</Polys>\n</Piece>\n</PolyData>\n</VTKFile>\n",
    ]
    Path(path).write_text("".join(parts), encoding="ascii")


def _array(values, name, ascii, *, components=1):
    kind = _TYPES[values.dtype.str[1:]]
    many = f' NumberOfComponents="{components}"' if components > 1 else ""
    head = f'<DataArray type="{kind}" Name="{name}"{many} format="{"ascii" if ascii else "binary"}">\n'
    if ascii:
        rows = values.reshape(-1, 3) if values.size % 3 == 0 else values.reshape(-1, 1)
        text = "\n".join(" ".join(map(repr, row)) for row in rows.tolist())
    else:
        text = _compressed(values.astype(values.dtype.newbyteorder("<"), copy=False).tobytes())
    return f"{head}{text}\n</DataArray>\n"


def _compressed(data):
    """VTK's inline form: a header of block sizes, then the zlib blocks, each part in base64."""
    blocks = [zlib.compress(data[start : start + _BLOCK], 1) for start in range(0, len(data), _BLOCK)]
    last = len(data) % _BLOCK
    header = np.array([len(blocks), _BLOCK, last, *map(len, blocks)], dtype="<u4")
    return (base64.b64encode(header.tobytes()) + base64.b64encode(b"".join(blocks))).decode("ascii")


class Collection:
    """A .pvd file that is complete after every frame, so that an interrupted run can be opened.

    Parameters
    ----------
    path : path
        The files that it names are relative to its folder.
    """

    _HEAD = '<?xml version="1.0"?>\n<VTKFile type="Collection" version="0.1">\n<Collection>\n'
    _TAIL = "</Collection>\n</VTKFile>\n"

    def __init__(self, path):
        self._file = open(path, "w", encoding="utf-8", newline="\n")  # noqa: SIM115
        self._file.write(self._HEAD)
        self._end = self._file.tell()
        self._close_tags()

    def add(self, time, entries):
        """Add one time step.

        Parameters
        ----------
        time : float
        entries : list of (name, file)
        """
        self._file.seek(self._end)
        for part, (name, file) in enumerate(entries):
            what = f'group="" part="{part}" name={quoteattr(name)} file={quoteattr(file)}'
            self._file.write(f'<DataSet timestep="{time}" {what}/>\n')
        self._end = self._file.tell()
        self._close_tags()

    def close(self):
        self._file.close()

    def _close_tags(self):
        self._file.write(self._TAIL)
        self._file.flush()
