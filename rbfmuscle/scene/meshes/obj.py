"""OBJ files: polygons, their objects and groups, and the line that is wrong."""

import numpy as np

from rbfmuscle.geometry.arrays import Floats, Integers
from rbfmuscle.scene.meshes.input_mesh import NO_CORNERS, Corners
from rbfmuscle.scene.meshes.polygons import cut_polygons

# Elements that are no faces.
_OTHER = (b"l", b"p", b"curv", b"curv2", b"surf")


class ObjFile:
    """What the lines of an OBJ file say.

    ``numbers`` are the vertices of all polygons, those of polygon k ``numbers[ends[k] : ends[k +
    1]]``; ``textures`` and ``normals`` the numbers of these there, -1 for none. ``objects`` and
    ``groups`` name the parts, ``labels`` (k, 2) give the places of the polygon's object and group
    in them.
    """

    def __init__(self, content: bytes) -> None:
        self.points: list[tuple[float, float, float]] = []
        self.corners: list[tuple[int, int, int]] = []
        self.uv: list[tuple[float, ...]] = []
        self.vn: list[tuple[float, ...]] = []
        self.ends = [0]
        self.lines: list[int] = []  # of each polygon in the file
        self.objects, self.groups = [""], [""]
        self.labels: list[tuple[int, int]] = []
        self.other = 0
        for number, line in _joined_lines(content.removeprefix(b"\xef\xbb\xbf")):
            key, *words = line.partition(b"#")[0].split() or [b""]
            try:
                self._take(key, words, number)
            except (ValueError, OverflowError) as error:
                said = line.decode("utf-8", "replace").strip()[:60]
                raise ValueError(f"line {number}, {said!r}: {error}") from None
        self.vertices: Floats = np.array(self.points, dtype=np.float64).reshape(-1, 3)
        corners = np.array(self.corners, dtype=np.int64).reshape(-1, 3)
        self.numbers: Integers = np.ascontiguousarray(corners[:, 0])
        self.textures, self.normals = corners[:, 1], corners[:, 2]
        if len(self.numbers) and self.numbers.max() >= len(self.vertices):
            wrong = int(np.argmax(self.numbers >= len(self.vertices)))
            line = self.lines[int(np.searchsorted(self.ends, wrong, side="right")) - 1]
            raise ValueError(
                f"line {line}: a face names vertex {self.numbers[wrong] + 1}, there are "
                f"{len(self.vertices)}"
            )

    def _take(self, key: bytes, words: list[bytes], line: int) -> None:
        if key == b"v":
            if len(words) < 3:
                raise ValueError(f"{len(words)} coordinates, a vertex has three")
            self.points.append((float(words[0]), float(words[1]), float(words[2])))
        elif key == b"f":
            self.corners += [self._corner(word) for word in words]
            self.ends.append(len(self.corners))
            self.lines.append(line)
            self.labels.append((len(self.objects) - 1, len(self.groups) - 1))
        elif key == b"vt":
            self.uv.append(_floats(words, 2))
        elif key == b"vn":
            self.vn.append(_floats(words, 3))
        elif key in (b"o", b"g"):
            name = b" ".join(words).decode("utf-8", "replace")
            (self.objects if key == b"o" else self.groups).append(name)
        elif key in _OTHER:
            self.other += 1

    def _corner(self, word: bytes) -> tuple[int, int, int]:
        """Vertex, texture coordinates and normal from 0 on of a face's corner, as ``a/b/c`` names
        them; -1 for what is not named.
        """
        first, _, more = word.partition(b"/")
        texture, _, normal = more.partition(b"/")
        return (
            self._number(first),
            _place(texture, len(self.uv)),
            _place(normal, len(self.vn)),
        )

    def _number(self, word: bytes) -> int:
        """Vertex from 0 on."""
        number = int(word)
        if number == 0 or number < -len(self.points):
            raise ValueError(
                f"vertex {number}; numbers begin at 1, or count back from -1 to {-len(self.points)}"
            )
        return number - 1 if number > 0 else len(self.points) + number

    def parts(self) -> list[tuple[str, Integers]]:
        """Names of the meshes in the file and their polygons; one without a name where it is one.

        Those are its objects, or groups that have no vertex in common.
        """
        labels = np.array(self.labels, dtype=np.int64).reshape(-1, 2)
        by_name = np.array([self.objects.index(self.objects[k]) for k in labels[:, 0]], dtype=int)
        groups = np.array([self.groups.index(self.groups[k]) for k in labels[:, 1]], dtype=int)
        for names, label, apart in (
            (self.objects, labels[:, 0], True),
            (self.objects, by_name, False),
            (self.groups, groups, True),
        ):
            found = [(names[k], np.flatnonzero(label == k)) for k in np.unique(label)]
            if len(found) > 1 and (not apart or self._are_apart([part for _, part in found])):
                return found
        return [("", np.arange(len(labels)))]

    def _are_apart(self, parts: list[Integers]) -> bool:
        """Whether no vertex belongs to two parts."""
        used = [np.unique(self.numbers[self.corners_of(part)[1]]) for part in parts]
        return len(np.unique(np.concatenate(used))) == sum(map(len, used))

    def corners_of(self, polygons: Integers) -> tuple[Integers, Integers]:
        """Ends of some polygons, and the places of their corners among all."""
        starts = np.array(self.ends)[polygons]
        sizes = np.diff(self.ends)[polygons]
        ends = np.concatenate([[0], np.cumsum(sizes)])
        return ends, np.arange(ends[-1]) + np.repeat(starts - ends[:-1], sizes)

    def look_of(self, corners: Integers) -> tuple[Corners, list[str]]:
        """Texture coordinates and normals of triangles, by the places (m, 3) of their corners, and
        notes of what was left out: that which some corners lack.
        """
        found, notes = NO_CORNERS, []
        for kind, given, numbers, width in (
            ("texture", self.uv, self.textures[corners], 2),
            ("normal", self.vn, self.normals[corners], 3),
        ):
            values = np.array(given, dtype=np.float64).reshape(-1, width)
            if not len(corners) or (numbers < 0).all():
                continue
            used, own = np.unique(numbers, return_inverse=True)
            whole = used[0] >= 0 and used[-1] < len(values) and np.isfinite(values[used]).all()
            if not whole:
                notes.append(f"{kind} coordinates left out, as some corners have none")
                continue
            own = own.reshape(-1, 3)
            if kind == "texture":
                found = found._replace(texture=values[used], texture_faces=own)
            else:
                found = found._replace(normals=values[used], normal_faces=own)
        return found, notes

    def empty_objects(self) -> list[str]:
        """Names of objects without a face."""
        full = {self.objects[k] for k, _ in self.labels}
        return [name for name in self.objects[1:] if name not in full]


def read_obj(content: bytes) -> list[tuple[str, Floats, Integers, list[str], Corners]]:
    """Name, vertices, triangles, notes and `Corners` of each mesh of an OBJ file; ValueError where
    a line is wrong.

    Numbers of textures and normals do not split vertices. Where there are several meshes, the
    vertices of each are its own, in the order of the file.
    """
    file = ObjFile(content)
    parts, empty = file.parts(), file.empty_objects()
    left = [f"{file.other} lines, points and curves left out"] if file.other else []
    if empty:
        left.append(f"{len(empty)} objects without faces ({', '.join(empty[:8])})")
    found = []
    for name, polygons in parts:
        ends, corners = file.corners_of(polygons)
        places, notes = cut_polygons(file.vertices, ends, file.numbers[corners])
        look, lacking = file.look_of(corners[places])
        vertices, faces = file.vertices, file.numbers[corners[places]]
        if len(parts) > 1:
            own, faces = np.unique(faces, return_inverse=True)
            vertices, faces = vertices[own], faces.reshape(-1, 3)
        found.append((name, vertices, faces, notes + lacking + left, look))
    return found


def _floats(words: list[bytes], count: int) -> tuple[float, ...]:
    """That many numbers; NaN for all where there are fewer, or one is none."""
    try:
        return tuple(float(words[k]) for k in range(count))
    except (ValueError, IndexError):
        return (np.nan,) * count


def _place(text: bytes, count: int) -> int:
    """A number from 1 on, or back from -1, as a place; -1 where it is none."""
    try:
        number = int(text or 0)
    except ValueError:
        return -1
    return number - 1 if number > 0 else max(count + number, -1) if number < 0 else -1


def _joined_lines(content):
    """Number and text of each line, those that a backslash continues as one."""
    lines = content.splitlines()
    number = 0
    while number < len(lines):
        first, line = number + 1, lines[number]
        while line.endswith(b"\\") and number + 1 < len(lines):
            number += 1
            line = line[:-1] + b" " + lines[number]
        number += 1
        yield first, line
