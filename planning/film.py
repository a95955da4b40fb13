"""Episodes to look at: the robot's view beside a second one, the goal drawn in afterwards.

The goal is drawn on the finished pictures of the film. It is no object of the scene and in no observation.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium as gym
import imageio.v3 as iio
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from data_collection.video import write_video
from envs.camera import CameraModel
from envs.files import written_aside
from envs.rendering import StaticCamera
from planning.episode import Record, mark_of
from planning.marks import point_position
from planning.setups import Setup

SIZE = 256  # pixels of each view
VIEWS = ("static", "side")
STRIP_FRAMES = 6
MOST_FPS = 15  # pictures a second, in real time
GOAL_COLOUR, POINT_COLOUR = (230, 30, 30), (40, 200, 255)
FINE = 4  # lines are drawn this many times larger, then shrunk: smooth edges


def film_path(folder: Path, record: Record) -> Path:
    """Where the film of an episode is, without the ending."""
    return folder / f"{record.model}-setup{record.setup:02d}-{record.repeat}"


def is_filmed(path: Path) -> bool:
    """Whether `Film.save` has written both of its files there."""
    return all(path.with_suffix(suffix).exists() for suffix in (".mp4", ".png"))


class Studio:
    """The cameras that films are taken with; made once, for people only.

    Args:
        env: the environment; it is only looked at.
        zoom: how many times as large things are shown, around the middle of the picture.
    """

    def __init__(self, env: gym.Env, zoom: float = 1.0) -> None:
        inner: Any = env.unwrapped
        self.env, self.inner = env, inner
        self.steps_per_frame = -(-int(inner.control_rate) // MOST_FPS)
        model, near, far = inner.mj_model, inner.camera.near, inner.camera.far
        large = 2 * round(zoom * SIZE / 2)
        self.cameras = [StaticCamera(model, view, large, large, near, far) for view in VIEWS]

    def close(self) -> None:
        """Free the cameras."""
        for camera in self.cameras:
            camera.close()


class Film:
    """Takes pictures of an episode, and writes them as a video and as a strip.

    Args:
        studio: where.
        setup: whose goal is drawn.
        caption: text in the corner.
    """

    def __init__(self, studio: Studio, setup: Setup, caption: str) -> None:
        self._studio, self._setup, self._caption = studio, setup, caption
        self._path: list[NDArray] = []
        self.frames: list[NDArray[np.uint8]] = []

    def watch(self, step: int) -> None:
        """Note where the point is, and take a picture now and then."""
        self._path.append(point_position(self._studio.env, mark_of(self._setup)))
        if step % self._studio.steps_per_frame:
            return
        views = [self._view(camera) for camera in self._studio.cameras]
        left = np.linalg.norm(self._path[-1] - self._setup.goal.point_world)
        camera = self._studio.inner.camera  # what the model sees by, so in its pixels
        seen = camera.project(camera.to_camera(self._path[-1])) - self._setup.goal.pixel
        text = f"{self._caption}  step {step}  {100 * left:.1f} cm  {np.linalg.norm(seen):.1f} px"
        self.frames.append(_captioned(np.concatenate(views, axis=1), text))

    def _view(self, camera: StaticCamera) -> NDArray[np.uint8]:
        margin = _margin(camera.geometry)
        shown = slice(margin, margin + SIZE)
        picture = Image.fromarray(camera.render(self._studio.inner.mj_data)[0][shown, shown])
        way = _pixels(camera.geometry, np.array(self._path))
        u, v = _pixels(camera.geometry, self._setup.goal.point_world[None])[0]
        _draw_lines(picture, [way], POINT_COLOUR, 1)
        _draw_dot(picture, way[-1], POINT_COLOUR)
        _draw_lines(picture, [[(u - 6, v), (u + 6, v)], [(u, v - 6), (u, v + 6)]], GOAL_COLOUR, 2)
        return np.asarray(picture)

    def save(self, path: Path) -> None:
        """Write `path`.mp4 and `path`.png (a strip of some frames)."""
        path.parent.mkdir(parents=True, exist_ok=True)
        fps = int(self._studio.inner.control_rate) / self._studio.steps_per_frame
        write_video(path.with_suffix(".mp4"), self.frames, fps)
        chosen = np.unique(np.linspace(0, len(self.frames) - 1, STRIP_FRAMES).round().astype(int))
        rows = [np.concatenate(np.split(self.frames[i], len(VIEWS), axis=1), axis=0) for i in chosen]
        with written_aside(path.with_suffix(".png")) as aside:
            iio.imwrite(aside, np.concatenate(rows, axis=1), extension=".png")


def _margin(camera: CameraModel) -> int:
    """Pixels on each side that are not shown."""
    return (camera.width - SIZE) // 2


def _pixels(camera: CameraModel, points: NDArray) -> list[tuple[float, float]]:
    """World points (N, 3) as pixels of what is shown, kept near it."""
    pixels = np.nan_to_num(camera.project(camera.to_camera(points))) - _margin(camera)
    return [(float(u), float(v)) for u, v in np.clip(pixels, -SIZE, 2 * SIZE)]


def _draw_lines(
    picture: Image.Image, lines: list[list[tuple[float, float]]], colour: tuple[int, int, int], width: int
) -> None:
    """Draw polylines of pixels (u, v), whose centres are integers."""
    stencil = Image.new("L", (FINE * picture.width, FINE * picture.height))
    draw = ImageDraw.Draw(stencil)
    for line in lines:
        draw.line([(FINE * (u + 0.5), FINE * (v + 0.5)) for u, v in line], 255, FINE * width, joint="curve")
    picture.paste(colour, mask=stencil.resize(picture.size, Image.Resampling.BOX))


def _draw_dot(picture: Image.Image, pixel: tuple[float, float], colour: tuple[int, int, int]) -> None:
    """Draw a dot with a dark rim at a pixel (u, v)."""
    u, v = (FINE * (place + 0.5) for place in pixel)
    for radius, fill in ((4.0, (0, 0, 0)), (3.0, colour)):
        stencil = Image.new("L", (FINE * picture.width, FINE * picture.height))
        reach = FINE * radius
        ImageDraw.Draw(stencil).ellipse((u - reach, v - reach, u + reach, v + reach), 255)
        picture.paste(fill, mask=stencil.resize(picture.size, Image.Resampling.BOX))


def _captioned(frame: NDArray[np.uint8], text: str) -> NDArray[np.uint8]:
    picture = Image.fromarray(frame)
    font = ImageFont.load_default(size=12)
    ImageDraw.Draw(picture).text((6, 4), text, "white", font, stroke_width=1, stroke_fill="black")
    return np.asarray(picture)
