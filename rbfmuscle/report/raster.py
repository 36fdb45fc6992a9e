"""Triangles as a picture: a depth buffer in memory, so that drawing needs neither graphics nor a display."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from rbfmuscle.geometry.arrays import Floats, Integers
from rbfmuscle.geometry.surfaces import vertex_normals
from rbfmuscle.jit import compiled
from rbfmuscle.output.appearance import rgb

if TYPE_CHECKING:
    from PIL.Image import Image


# Each pixel is the mean of so many by so many.
_FINER = 2
_MARGIN = 0.05
# Height of a row of labels, and width of a colour before one [pixel].
_LINE, _CHIP = 22, 17


class Solid(NamedTuple):
    """What is drawn: vertices (n, 3), faces (m, 3), colour "#rrggbb", and opacity from 0 to 1."""

    vertices: Floats
    faces: Integers
    colour: str
    opacity: float = 1.0


class Camera(NamedTuple):
    """A parallel projection: ``axes`` (3, 3) are right, up and towards the camera; ``scale`` is pixels per unit."""

    axes: Floats
    centre: Floats
    scale: float
    size: tuple[int, int]

    def project(self, points: Floats) -> Floats:
        """Pixel to the right, pixel downwards and distance towards the camera of points (n, 3)."""
        found = (points - self.centre) @ self.axes.T
        found[:, 0] = 0.5 * self.size[0] + self.scale * found[:, 0]
        found[:, 1] = 0.5 * self.size[1] - self.scale * found[:, 1]
        return found


def aim(axes: Floats, points: Floats, size: tuple[int, int]) -> Camera:
    """A camera of these axes that sees all points (n, 3), as large as a picture of ``size`` holds them."""
    seen = points @ axes.T
    low, high = seen.min(axis=0), seen.max(axis=0)
    wide, tall, _ = np.maximum(high - low, 1e-9)
    scale = (1.0 - 2.0 * _MARGIN) * min(size[0] / wide, size[1] / tall)
    return Camera(axes, 0.5 * (low + high) @ axes, float(scale), size)


def fitted_size(axes: Floats, points: Floats, area: float) -> tuple[int, int]:
    """Width and height of so many pixels, in the proportions of what is seen; even numbers, as films ask for."""
    wide, tall, _ = np.maximum(np.ptp(points @ axes.T, axis=0), 1e-9)
    shape = float(np.clip(tall / wide, 0.6, 2.2))
    return 2 * round(0.5 * (area / shape) ** 0.5), 2 * round(0.5 * (area * shape) ** 0.5)


def draw_solids(solids: Sequence[Solid], camera: Camera) -> Integers:
    """Picture (h, w, 3) of uint8; what is not opaque is laid over all that is."""
    width, height = camera.size
    fine = camera._replace(scale=camera.scale * _FINER, size=(_FINER * width, _FINER * height))
    depth = np.full(fine.size[::-1], -np.inf, dtype=np.float32)
    image = np.ones((*depth.shape, 3), dtype=np.float32)
    for solid in sorted(solids, key=lambda solid: -solid.opacity):
        points, shades = fine.project(np.asarray(solid.vertices, dtype=float)), _shaded(solid, camera.axes)
        _raster_loop(points, np.asarray(solid.faces, dtype=np.int64), shades, solid.opacity, depth, image)
    mean = image.reshape(height, _FINER, width, _FINER, 3).mean(axis=(1, 3))
    return np.round(255.0 * np.clip(mean, 0.0, 1.0)).astype(np.uint8)


def _shaded(solid: Solid, axes: Floats) -> Floats:
    """Colours (n, 3) in the light of a lamp up and left of the camera."""
    normals = vertex_normals(solid.vertices, solid.faces)
    lamp = np.array([-0.35, 0.45, 1.0]) @ axes
    lamp /= np.linalg.norm(lamp)
    half = lamp + axes[2]
    facing = np.clip(normals @ lamp, 0.0, 1.0)[:, None]
    gloss = np.clip(normals @ (half / np.linalg.norm(half)), 0.0, 1.0)[:, None] ** 24
    return rgb(solid.colour) * (0.42 + 0.62 * facing) + 0.1 * gloss


def labelled(image: Integers, text: str, titles: Sequence[str], chips: Mapping[str, str]) -> Image:
    """Image (h, w, 3) with a strip above that has a title for each column, and one below: text and colours."""
    from PIL import Image, ImageDraw, ImageFont

    font = ImageFont.load_default(13)
    height, width = image.shape[:2]
    x, y, places = 8, height + _LINE + 5, []
    for name, colour in [*((part, "") for part in text.split(", ")), *chips.items()]:
        wide = int(font.getlength(name)) + (_CHIP if colour else 0)
        if places and x + wide > width:
            x, y = 8, y + _LINE
        places.append((x, y, name, colour))
        x += wide + 20
    sheet = Image.new("RGB", (width, y + _LINE + 3), "white")
    sheet.paste(Image.fromarray(image), (0, _LINE))
    pen = ImageDraw.Draw(sheet)
    for k, title in enumerate(titles):
        pen.text((k * width // len(titles) + 8, 4), title, fill="#5f646b", font=font)
    for x, y, name, colour in places:
        if colour:
            pen.rectangle((x, y + 2, x + 12, y + 14), fill=colour)
        pen.text((x + (_CHIP if colour else 0), y), name, fill="#26282b", font=font)
    return sheet


@compiled
def _raster_loop(points, faces, shades, opacity, depth, image):
    height, width = depth.shape
    for f in range(len(faces)):
        i, j, k = faces[f]
        a, b, c = points[i], points[j], points[k]
        area = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
        if area == 0.0:
            continue
        left, right = max(0.0, min(a[0], b[0], c[0])), min(width - 1.0, max(a[0], b[0], c[0]))
        top, bottom = max(0.0, min(a[1], b[1], c[1])), min(height - 1.0, max(a[1], b[1], c[1]))
        for y in range(int(np.ceil(top)), int(np.floor(bottom)) + 1):
            for x in range(int(np.ceil(left)), int(np.floor(right)) + 1):
                u = ((b[0] - x) * (c[1] - y) - (b[1] - y) * (c[0] - x)) / area
                v = ((c[0] - x) * (a[1] - y) - (c[1] - y) * (a[0] - x)) / area
                w = 1.0 - u - v
                z = u * a[2] + v * b[2] + w * c[2]
                if u < 0.0 or v < 0.0 or w < 0.0 or z <= depth[y, x]:
                    continue
                if opacity >= 1.0:
                    depth[y, x] = z
                for m in range(3):
                    shade = u * shades[i, m] + v * shades[j, m] + w * shades[k, m]
                    image[y, x, m] += opacity * (shade - image[y, x, m])
