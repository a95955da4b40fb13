"""A labelled figure of a clip: strips of pictures under each other as a PNG, or one frame after the other as an MP4."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import imageio.v3 as imageio
import numpy as np
from PIL import Image as Pillow
from PIL import ImageDraw

from data_collection.video import write_video
from envs.files import written_aside
from worldmodel.colours import Image
from worldmodel.legends import DARK, GREY, Scales, font, legend

TRUTH = "truth"
ROW_GAP, SECTION_GAP = 3, 12  # pixels
EDGE = (226, 226, 226)  # of every picture, so that white ones end somewhere
HOLD_S = 1.0  # the film's first and last frame stay for so long
LEAST_FPS = 10.0


@dataclass(frozen=True)
class Strip:
    """One row: a kind of picture from one source, over the frames of a clip."""

    section: str
    """What it shows; rows of one section stand together and share a legend."""
    source: str
    """The truth, or a model."""
    pictures: Sequence[Image | None]
    """One a frame; None where there is none."""


@dataclass(frozen=True)
class Storyboard:
    """All strips of a clip, and when its frames are."""

    strips: Sequence[Strip]
    """In the order of the figure."""
    scales: Scales
    """What the colours mean."""
    context: int
    """How many frames are seen; the last of them is time 0."""
    frame_seconds: float
    """From one frame to the next."""

    @property
    def frames(self) -> int:
        """Seen and predicted."""
        return len(self.strips[0].pictures)

    @property
    def sections(self) -> list[str]:
        """In order."""
        return list(dict.fromkeys(strip.section for strip in self.strips))

    @property
    def sources(self) -> list[str]:
        """In order, the truth first."""
        return list(dict.fromkeys(strip.source for strip in self.strips))

    @property
    def picture_size(self) -> tuple[int, int]:
        """Width and height of every picture."""
        height, width = next(p for strip in self.strips for p in strip.pictures if p is not None).shape[:2]
        return width, height

    def seconds(self, frame: int) -> str:
        """How far ahead of the last frame seen a frame is."""
        ahead = (frame - self.context + 1) * self.frame_seconds
        tenths = abs(10 * self.frame_seconds - round(10 * self.frame_seconds)) < 1e-6
        return f"{ahead:+.{1 if tenths else 2}f} s" if ahead else "0 s"


@dataclass(frozen=True)
class _Layout:
    """Sizes in pixels that follow from the size of a tile."""

    width: int
    height: int
    labels: int
    text: float

    @classmethod
    def of(cls, board: Storyboard, scale: int, words: Sequence[str]) -> _Layout:
        width, height = (scale * side for side in board.picture_size)
        text = min(20.0, max(9.0, height / 8))
        labels = max(font(text).getlength(word) for word in words) + 1.2 * text
        return cls(width, height, int(labels), text)


def sheet(board: Storyboard, columns: int, scale: int) -> Image:
    """The figure: a row for each strip, a column for the last frame seen and for some predicted ones.

    Args:
        board: what to show.
        columns: at most so many predicted frames, evenly spread up to the last.
        scale: how many times each picture is enlarged.
    """
    layout = _Layout.of(board, scale, board.sections + board.sources)
    shown = [board.context - 1, *_spread(board.context, board.frames, columns)]
    tops = _tops(board, layout)
    width = layout.labels + len(shown) * (layout.width + ROW_GAP) - ROW_GAP + 4
    page = Pillow.new("RGB", (width, tops[-1] + layout.height + 4), "white")
    draw = ImageDraw.Draw(page)
    for column, frame in enumerate(shown):
        x = layout.labels + column * (layout.width + ROW_GAP)
        _heading(draw, board, frame, x + layout.width / 2, layout)
        for strip, top in zip(board.strips, tops, strict=True):
            seen_by_all = column == 0 and strip.source != TRUTH
            _place(page, None if seen_by_all else strip.pictures[frame], (x, top), layout)
    explained: set[str] = set()
    for number, (strip, top) in enumerate(zip(board.strips, tops, strict=True)):
        if number == 0 or board.strips[number - 1].section != strip.section:
            draw.text((layout.text * 0.4, top), strip.section, DARK, font(layout.text), anchor="la")
        middle = (layout.labels - 0.5 * layout.text, top + layout.height / 2)
        draw.text(middle, strip.source, GREY, font(layout.text * 0.9), anchor="rm")
        room = strip.pictures[shown[0]] is None or strip.source != TRUTH
        if room and strip.section not in explained:
            explained.add(strip.section)
            key = legend(strip.section, board.scales, layout.width, layout.height)
            if key is not None:
                page.paste(key, (layout.labels, top))
    return np.asarray(page)


def film(board: Storyboard, scale: int) -> Iterator[Image]:
    """The same, a frame at a time: a row for each source, a column for each section, legends below."""
    layout = _Layout.of(board, scale, board.sources)
    sections, sources = board.sections, board.sources
    left = [layout.labels + column * (layout.width + SECTION_GAP) for column in range(len(sections))]
    first = int(2.2 * layout.text)
    tops = [first + row * (layout.height + ROW_GAP) for row in range(len(sources) + 1)]
    tops[-1] += SECTION_GAP
    keys = [legend(section, board.scales, layout.width, layout.height) for section in sections]
    bottom = tops[-1] + (layout.height if any(keys) else 0) + int(0.5 * layout.text)
    blank = Pillow.new("RGB", _even(left[-1] + layout.width + 8, bottom), "white")
    draw = ImageDraw.Draw(blank)
    for x, section, key in zip(left, sections, keys, strict=True):
        middle = (x + layout.width / 2, first - 0.5 * layout.text)
        draw.text(middle, section, DARK, font(layout.text), anchor="ms")
        if key is not None:
            blank.paste(key, (x, tops[-1]))
    for top, source in zip(tops, sources, strict=False):
        middle = (layout.labels - 0.6 * layout.text, top + layout.height / 2)
        draw.text(middle, source, DARK, font(layout.text), anchor="rm")
    truth = {strip.section: strip for strip in board.strips if strip.source == TRUTH}
    for frame in range(board.frames):
        page = blank.copy()
        for strip in board.strips:
            picture = strip.pictures[frame]
            if picture is None and strip.section in truth and frame < board.context:
                picture = truth[strip.section].pictures[frame]  # all sources start from what was seen
            place = left[sections.index(strip.section)], tops[sources.index(strip.source)]
            _place(page, picture, place, layout)
        _clock(page, board, frame, layout, tops[-1])
        yield np.asarray(page)


def write_sheet(board: Storyboard, path: Path, columns: int, scale: int) -> None:
    """Write `sheet` as a PNG."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with written_aside(path) as aside:
        imageio.imwrite(aside, sheet(board, columns, scale), extension=".png", optimize=True)


def write_film(board: Storyboard, path: Path, scale: int, speed: float) -> None:
    """Write `film` as an MP4; speed 1 is real time. First and last frame stay for a while."""
    path.parent.mkdir(parents=True, exist_ok=True)
    rate = speed / board.frame_seconds
    repeats = int(np.ceil(LEAST_FPS / rate))  # players do not like few frames a second
    pictures = list(film(board, scale))
    hold = [round(HOLD_S * rate) if frame in (0, len(pictures) - 1) else 0 for frame in range(len(pictures))]
    times = [repeats * (1 + extra) for extra in hold]
    shown = (picture for picture, count in zip(pictures, times, strict=True) for _ in range(count))
    write_video(path, shown, rate * repeats, quality=8)


def _spread(first: int, stop: int, count: int) -> list[int]:
    """At most `count` whole numbers from `first` up to and with `stop - 1`."""
    count = min(count, stop - first)
    return [first + round((k + 1) * (stop - first) / count) - 1 for k in range(count)]


def _tops(board: Storyboard, layout: _Layout) -> list[int]:
    tops = [int(2.9 * layout.text)]
    for before, strip in zip(board.strips, board.strips[1:], strict=False):
        gap = ROW_GAP if before.section == strip.section else SECTION_GAP
        tops.append(tops[-1] + layout.height + gap)
    return tops


def _heading(draw: ImageDraw.ImageDraw, board: Storyboard, frame: int, middle: float, layout: _Layout) -> None:
    step = frame - board.context + 1
    words = ("seen" if step == 0 else f"step {step}", board.seconds(frame))
    draw.text((middle, 1.2 * layout.text), words[0], DARK, font(layout.text), anchor="ms")
    draw.text((middle, 2.4 * layout.text), words[1], GREY, font(layout.text * 0.9), anchor="ms")


def _clock(page: Pillow.Image, board: Storyboard, frame: int, layout: _Layout, top: int) -> None:
    """The time in the corner below the sources."""
    step = frame - board.context + 1
    right = layout.labels - 0.6 * layout.text
    draw = ImageDraw.Draw(page)
    word = "seen" if step <= 0 else f"step {step}"
    draw.text((right, top + 1.2 * layout.text), word, GREY, font(layout.text), anchor="rs")
    draw.text((right, top + 2.6 * layout.text), board.seconds(frame), DARK, font(layout.text), anchor="rs")


def _place(page: Pillow.Image, picture: Image | None, place: tuple[int, int], layout: _Layout) -> None:
    if picture is None:
        return
    large = Pillow.fromarray(picture).resize((layout.width, layout.height), Pillow.Resampling.NEAREST)
    page.paste(large, place)
    x, y = place
    ImageDraw.Draw(page).rectangle((x - 1, y - 1, x + layout.width, y + layout.height), outline=EDGE)


def _even(width: int, height: int) -> tuple[int, int]:
    """Video encoders want even numbers."""
    return width + width % 2, height + height % 2
