"""What the colours of each kind of picture mean, drawn in the room of one picture."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from PIL import Image as Pillow
from PIL import ImageDraw, ImageFont

from worldmodel.colours import Image, depth_colours, scene_flow_colours, wheel_legend

RGB, DEPTH, MASKS = "RGB", "depth", "masks"
SCENE_FLOW, OPTICAL_FLOW, OCCLUSION = "scene flow", "optical flow", "occlusion"
GREY = (120, 120, 120)
DARK = (40, 40, 40)


@dataclass(frozen=True)
class Scales:
    """What the ends of the colours stand for; one for all models in a figure."""

    near: float
    """Metres; depth that is brightest."""
    far: float
    """Metres; depth that is darkest."""
    scene_flow: float
    """Metres of full colour."""
    optical_flow: float
    """Pixels of full colour."""


def font(size: float) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    """The font of all labels."""
    return ImageFont.load_default(size=size)


def legend(section: str, scales: Scales, width: int, height: int) -> Pillow.Image | None:
    """The legend of a section in a picture of this size, or None for what needs none."""
    draw_it = _LEGENDS.get(section)
    if draw_it is None:
        return None
    page = Pillow.new("RGB", (width, height), "white")
    draw_it(page, ImageDraw.Draw(page), scales)
    return page


def _small(page: Pillow.Image) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    return font(max(7.0, page.height / 10.5))


def _depth(page: Pillow.Image, draw: ImageDraw.ImageDraw, scales: Scales) -> None:
    width, height = page.size
    left, top, right, bottom = width // 4, height // 8, width // 4 + width // 9, height - height // 8
    steps = torch.linspace(scales.near, scales.far, bottom - top).view(1, -1, 1).expand(1, -1, right - left)
    _paste(page, depth_colours(steps, scales.near, scales.far), (left, top))
    for y, metres, anchor in ((top, scales.near, "la"), (bottom, scales.far, "ld")):
        draw.text((right + width // 16, y), f"{metres:.2f} m", GREY, _small(page), anchor=anchor)


def _masks(page: Pillow.Image, draw: ImageDraw.ImageDraw, scales: Scales) -> None:
    _lines(page, draw, "one colour\neach;\nwhite: stays")


def _scene_flow(page: Pillow.Image, draw: ImageDraw.ImageDraw, scales: Scales) -> None:
    width, height = page.size
    bar_width, bar_height, left = int(0.80 * width), max(2, height // 14), int(0.10 * width)
    full = scales.scene_flow
    for axis, words in enumerate((("left", "right"), ("up", "down"), ("closer", "away"))):
        flow = torch.zeros(3, bar_height, bar_width)
        flow[axis] = torch.linspace(-full, full, bar_width)
        top = int((0.05 + 0.27 * axis) * height)
        _paste(page, scene_flow_colours(flow, full), (left, top))
        y = top + bar_height + 1
        draw.text((left, y), words[0], GREY, _small(page), anchor="la")
        draw.text((left + bar_width, y), words[1], GREY, _small(page), anchor="ra")
    draw.text((width / 2, 0.99 * height), f"full at {_metric(full)}", GREY, _small(page), anchor="md")


def _optical_flow(page: Pillow.Image, draw: ImageDraw.ImageDraw, scales: Scales) -> None:
    width, height = page.size
    size = int(min(width, height) * 0.78)
    fine = Pillow.fromarray(wheel_legend(4 * size)).resize((size, size), Pillow.Resampling.LANCZOS)
    left, top = (width - size) // 2, int(0.02 * height)
    page.paste(fine, (left, top))
    draw.ellipse((left, top, left + size - 1, top + size - 1), outline=(225, 225, 225))
    draw.text((width / 2, 0.99 * height), f"rim: {scales.optical_flow:g} px", GREY, _small(page), anchor="md")


def _occlusion(page: Pillow.Image, draw: ImageDraw.ImageDraw, scales: Scales) -> None:
    _lines(page, draw, "dark: hidden\nbefore,\nno point lands")


def _lines(page: Pillow.Image, draw: ImageDraw.ImageDraw, text: str) -> None:
    middle = (page.width / 2, page.height / 2)
    draw.multiline_text(middle, text, GREY, _small(page), anchor="mm", align="center", spacing=page.height // 32)


def _paste(page: Pillow.Image, picture: Image, place: tuple[int, int]) -> None:
    page.paste(Pillow.fromarray(np.ascontiguousarray(picture)), place)


def _metric(metres: float) -> str:
    return f"{100 * metres:g} cm" if metres >= 0.01 else f"{1000 * metres:g} mm"


_LEGENDS: dict[str, Callable[[Pillow.Image, ImageDraw.ImageDraw, Scales], None]] = {
    DEPTH: _depth,
    MASKS: _masks,
    SCENE_FLOW: _scene_flow,
    OPTICAL_FLOW: _optical_flow,
    OCCLUSION: _occlusion,
}
