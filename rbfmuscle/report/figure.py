"""A small picture of bones and muscles with a caption, as a notebook shows it."""

from __future__ import annotations

import base64
import io
from collections.abc import Mapping
from html import escape

import numpy as np

from rbfmuscle.geometry.arrays import Floats, Integers
from rbfmuscle.output.appearance import BACKGROUND, BONE_COLOUR, muscle_colours, rgb, view_axes
from rbfmuscle.report.raster import Solid, aim, draw_solids

SIZE = (300, 340)
DIRECTION = (1.4, -1.6, 0.5)

Meshes = Mapping[str, tuple[Floats, Integers]]


def figure_html(bones: Meshes, muscles: Meshes, caption: str, body: Floats) -> str:
    """HTML of a picture.

    Parameters
    ----------
    bones, muscles : mapping of str to (vertices, faces)
        Where they are drawn.
    caption : str
    body : (3, 3) ndarray
        Left, posterior and superior.
    """
    from PIL import Image

    colours = muscle_colours(list(muscles))
    solids = [Solid(np.asarray(v), np.asarray(f), rgb(BONE_COLOUR)) for v, f in bones.values()]
    solids += [Solid(np.asarray(v), np.asarray(f), rgb(colours[name])) for name, (v, f) in muscles.items()]
    picture = ""
    if solids:
        camera = aim(view_axes(DIRECTION, body), np.concatenate([s.vertices for s in solids]), SIZE)
        file = io.BytesIO()
        Image.fromarray(draw_solids(solids, camera, rgb(BACKGROUND))).save(file, format="PNG")
        source = base64.b64encode(file.getvalue()).decode()
        picture = f'<img src="data:image/png;base64,{source}" width="{SIZE[0]}" height="{SIZE[1]}" alt="">'
    return f"<figure>{picture}<figcaption>{escape(caption)}</figcaption></figure>"
