"""What is written beside a picture: titles, the frame with where its joints are, what colours mean."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from rbfmuscle.geometry.arrays import Integers
from rbfmuscle.output.appearance import BACKGROUND

if TYPE_CHECKING:
    from PIL.Image import Image


_LINE, _CHIP = 22, 17


def labelled(image: Integers, text: str, titles: Sequence[str], chips: Mapping[str, str]) -> Image:
    """Image with a strip above that has a title for each column, and one below with text and what colours mean.

    Parameters
    ----------
    image : (h, w, 3) ndarray of uint8
    text : str
    titles : sequence of str
    chips : dict of str to colour
    """
    from PIL import Image, ImageDraw, ImageFont

    font = ImageFont.load_default(13)
    height, width = image.shape[:2]
    pen = ImageDraw.Draw(Image.new("RGB", (1, 1)))
    x, y, places = 8, height + _LINE + 5, []
    parts = [text] if pen.textlength(text, font=font) <= width - 16 else text.split(", ")
    for name in [*parts, *chips]:
        wide = int(pen.textlength(name, font=font)) + (_CHIP if len(places) >= len(parts) else 0)
        if places and x + wide > width:
            x, y = 8, y + _LINE
        places.append((x, y))
        x += wide + 20
    sheet = Image.new("RGB", (width, y + _LINE + 3), BACKGROUND)
    sheet.paste(Image.fromarray(image), (0, _LINE))
    pen = ImageDraw.Draw(sheet)
    for k, title in enumerate(titles):
        pen.text((k * width // len(titles) + 8, 4), title, fill="#5f646b", font=font)
    for place, part in zip(places, parts):
        pen.text(place, part, fill="#26282b", font=font)
    for (x, y), (name, colour) in zip(places[len(parts) :], chips.items()):
        pen.rectangle((x, y + 2, x + 12, y + 14), fill=colour)
        pen.text((x + _CHIP, y), name, fill="#26282b", font=font)
    return sheet
