"""What is written beside a picture: the frame, where its joints are, what colours mean."""

from __future__ import annotations

from typing import Any

from rbfmuscle.geometry.arrays import Integers
from rbfmuscle.report.appearance import BACKGROUND

_STRIP = 30
# Coordinates that a caption names at most.
MOST_SHOWN = 4


def caption(saved: Any, frame: int) -> Any:
    """Frame number and joint angles, as text."""
    entry = next(entry for entry in saved.info["frames"] if entry["frame"] == frame)
    clock = [f"{entry['time']:.4g} s"] if "time" in entry else []
    return ", ".join([f"frame {frame}", *clock, *coordinate_texts(saved.info, entry)])


def coordinate_texts(info: dict[str, Any], entry: dict[str, Any]) -> Any:
    """A frame's coordinates as text, each with its unit; of many, those that the motion moves most.

    Parameters
    ----------
    info : dict
        What ``run.json`` holds.
    entry : dict
        Of its ``frames``.
    """
    values = entry["coordinates"]
    if len(values) > MOST_SHOWN:
        tracks = {n: [row["coordinates"].get(n, 0.0) for row in info["frames"]] for n in values}
        spans = {n: max(track) - min(track) for n, track in tracks.items()}
        values = {n: values[n] for n in sorted(values, key=lambda n: -spans[n])[:MOST_SHOWN]}
    units = info["scene"].get("coordinate_units", {})
    return [f"{name} {value:.4g}{units.get(name, '°')}" for name, value in values.items()]


def labelled(image: Integers, text: str, titles: list[Any], chips: dict[str, Any]) -> Any:
    """Image with a title above each column, and below a strip with a caption and what colours mean.

    Parameters
    ----------
    image : (h, w, 3) ndarray of uint8
    text : str
    titles : list of str
    chips : dict of str to colour
    """
    from PIL import Image, ImageDraw, ImageFont

    font = ImageFont.load_default(13)
    height, width = image.shape[:2]
    pen = ImageDraw.Draw(Image.new("RGB", (1, 1)))
    # Where each word begins: side by side, and in another line where there is no room.
    x, y, places = 8, height + 7, []
    parts = [text] if pen.textlength(text, font=font) <= width - 16 else text.split(", ")
    for name in [*parts, *chips]:
        wide = int(pen.textlength(name, font=font)) + (17 if len(places) >= len(parts) else 0)
        if places and x + wide > width:
            x, y = 8, y + _STRIP - 8
        places.append((x, y))
        x += wide + 20
    sheet = Image.new("RGB", (width, y - 7 + _STRIP), BACKGROUND)
    sheet.paste(Image.fromarray(image), (0, 0))
    pen = ImageDraw.Draw(sheet)
    for k, title in enumerate(titles):
        pen.text((k * width // len(titles) + 8, 6), title, fill="#8a8a8a", font=font)
    for place, part in zip(places, parts):
        pen.text(place, part, fill="#333333", font=font)
    for (x, y), (name, colour) in zip(places[len(parts) :], chips.items()):
        pen.rectangle((x, y + 2, x + 12, y + 14), fill=colour)
        pen.text((x + 17, y), name, fill="#333333", font=font)
    return sheet
