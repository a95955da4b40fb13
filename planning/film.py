"""Episodes to look at: the robot's view beside a second one, the goal drawn in afterwards.

The goal is drawn on the finished pictures of the film. It is no object of the scene and in no observation.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import gymnasium as gym
import imageio.v3 as iio
import numpy as np
from numpy.typing import NDArray

from data_collection.files import written_aside
from envs.camera import CameraModel
from envs.rendering import StaticCamera
from planning.setups import Setup

SIZE = 256  # pixels of each view
VIEWS = ("static", "side")
STRIP_FRAMES = 6
STEPS_PER_FRAME, FPS = 2, 15  # real time, at 30 control steps a second
GOAL_COLOUR, TCP_COLOUR = (230, 30, 30), (40, 200, 255)


class Studio:
    """The cameras that films are taken with; made once, for people only.

    Args:
        env: the tabletop environment; it is only looked at.
    """

    def __init__(self, env: gym.Env) -> None:
        tabletop: Any = env.unwrapped
        self.tabletop = tabletop
        model, near, far = tabletop.mj_model, tabletop.camera.near, tabletop.camera.far
        self.cameras = [StaticCamera(model, view, SIZE, SIZE, near, far) for view in VIEWS]

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
        """Note where the TCP is, and take a picture every other control step."""
        self._path.append(np.array(self._studio.tabletop.tcp_position))
        if step % STEPS_PER_FRAME:
            return
        views = [self._view(camera) for camera in self._studio.cameras]
        frame = np.concatenate(views, axis=1)
        left = np.linalg.norm(self._path[-1] - self._setup.goal.point_world)
        _write(frame, f"{self._caption}  step {step}  {100 * left:.1f} cm", (6, 14))
        self.frames.append(frame)

    def _view(self, camera: StaticCamera) -> NDArray[np.uint8]:
        image = np.ascontiguousarray(camera.render(self._studio.tabletop.mj_data)[0])
        way = _pixels(camera.geometry, np.array(self._path))
        cv2.polylines(image, [way[:, None]], False, TCP_COLOUR, 1, cv2.LINE_AA, shift=4)
        goal = _pixels(camera.geometry, self._setup.goal.point_world[None])[0] >> 4
        cv2.drawMarker(image, goal.tolist(), GOAL_COLOUR, cv2.MARKER_CROSS, 13, 2, cv2.LINE_AA)
        return image

    def save(self, path: Path) -> None:
        """Write `path`.mp4 and `path`.png (a strip of some frames)."""
        path.parent.mkdir(parents=True, exist_ok=True)
        with written_aside(path.with_suffix(".mp4")) as aside:
            iio.imwrite(aside, np.stack(self.frames), extension=".mp4", fps=FPS, output_params=["-f", "mp4"])
        chosen = np.unique(np.linspace(0, len(self.frames) - 1, STRIP_FRAMES).round().astype(int))
        rows = [np.concatenate(np.split(self.frames[i], len(VIEWS), axis=1), axis=0) for i in chosen]
        with written_aside(path.with_suffix(".png")) as aside:
            iio.imwrite(aside, np.concatenate(rows, axis=1), extension=".png")


def _pixels(camera: CameraModel, points: NDArray) -> NDArray[np.int32]:
    """World points (N, 3) as pixels in sixteenths, kept near the picture."""
    pixels = np.nan_to_num(camera.project(camera.to_camera(points)))
    return np.rint(16 * np.clip(pixels, -SIZE, 2 * SIZE)).astype(np.int32)


def _write(frame: NDArray[np.uint8], text: str, place: tuple[int, int]) -> None:
    for colour, thickness in (((0, 0, 0), 3), ((255, 255, 255), 1)):
        cv2.putText(frame, text, place, cv2.FONT_HERSHEY_SIMPLEX, 0.4, colour, thickness, cv2.LINE_AA)
