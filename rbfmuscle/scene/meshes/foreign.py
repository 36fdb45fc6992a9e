"""What a file is whose content is not what its suffix says."""

import re
import struct

# First bytes of what is saved under a wrong name, and what to do about it.
_NO_MESH = (
    (rb"version https://git-lfs", "a pointer of Git LFS: fetch the file itself (git lfs pull)"),
    (rb"\s*<(!doctype\s+html|html)", "a web page: download the file itself"),
    (rb"\x1f\x8b", "compressed: unpack it (gzip -d)"),
    (rb"PK\x03\x04", "a zip archive: unpack it"),
    (rb"\xff\xfe|\xfe\xff", "text in UTF-16: save it as UTF-8"),
)
# Mesh formats by their first bytes. A binary STL may begin with any of these, but not be so long.
_MESHES = (
    (rb"ply\s", ".ply"),
    (rb"# vtk DataFile", ".vtk"),
    (rb"(<\?xml[^>]*>\s*)?<VTKFile", ".vtp"),
    (rb"solid\b[^\r\n]*\s+facet\s", ".stl"),
    (rb"(#[^\n]*\n|\s)*(mtllib|o|g|v|vn|vt)[ \t]+\S", ".obj"),
)


def foreign_content(content: bytes, suffix: str) -> str:
    """What content is and what to do, where it is not of its file's ``suffix``; empty where it may
    be.
    """
    binary_stl = (
        len(content) > 84 and len(content) == 84 + 50 * struct.unpack_from("<I", content, 80)[0]
    )
    if binary_stl:
        return "" if suffix == ".stl" else "a .stl file: rename it"
    start = content[:1000].removeprefix(b"\xef\xbb\xbf")
    for pattern, said in _NO_MESH:
        if re.match(pattern, start, re.IGNORECASE):
            return said
    for pattern, kind in _MESHES:
        if re.match(pattern, start) and (kind != ".obj" or b"\0" not in start):
            return "" if kind == suffix else f"a {kind} file: rename it"
    return ""
