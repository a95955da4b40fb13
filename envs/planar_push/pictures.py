"""`python -m envs.planar_push.pictures --out docs/pictures`: some objects as the camera sees them, and a push."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import imageio.v3 as iio
import numpy as np
from numpy.typing import NDArray

from envs import command
from envs.errors import UsageError
from envs.files import written_aside
from envs.planar_push.control import ACTION_SCALE
from envs.planar_push.env import PlanarPushEnv

SHOWN = ("1111", "2222", "3333", "4444", "1342")
FRAMES, STEPS = 5, 12  # pictures of the push, control steps
PUSH_FROM, PUSH_TO = np.array([-0.14, -0.05]), np.array([0.04, 0.01])  # m
CROP = 0.6  # share of the picture's width and height that is shown


@dataclass(frozen=True)
class Config:
    """Draw objects (upper row) and a push of the last one (lower row), all cropped: planar-push.png."""

    out: Path
    """The folder for planar-push.png."""
    size: int = 144
    """Height of a picture, pixels."""

    def __post_init__(self) -> None:
        if not 16 <= self.size <= 1024:
            raise UsageError(f"size is {self.size}; give 16 to 1024 pixels")


def main(config: Config) -> None:
    """Draw and write the picture."""
    config.out.mkdir(parents=True, exist_ok=True)
    env = PlanarPushEnv("all", images=False)
    upper = []
    for name in SHOWN:
        env.reset(seed=0, options={"object": name, "pose": [0, 0, 0.3], "tip": [-0.12, -0.02]})
        upper.append(_cropped_view(env, config.size))
    lower = _push(env, config.size)
    env.close()
    picture = np.concatenate([np.concatenate(row, axis=1) for row in (upper, lower)])
    path = config.out / "planar-push.png"
    with written_aside(path) as aside:
        iio.imwrite(aside, picture, extension=".png")
    print(path)


def _push(env: PlanarPushEnv, size: int) -> list[NDArray[np.uint8]]:
    """FRAMES pictures of one push."""
    env.reset(seed=0, options={"object": SHOWN[-1], "pose": [-0.03, 0, 0.3], "tip": PUSH_FROM})
    move = (PUSH_TO - PUSH_FROM) / STEPS
    frames = []
    for step in range(STEPS + 1):
        if step in np.linspace(0, STEPS, FRAMES).round():
            frames.append(_cropped_view(env, size))
        env.step([*(move / ACTION_SCALE[:2]), np.arctan2(move[1], move[0]) / np.pi])
    return frames


def _cropped_view(env: PlanarPushEnv, size: int) -> NDArray[np.uint8]:
    large = round(size / CROP)
    edge = (large - size) // 2
    return env.view("static", large)[edge : edge + size, edge : edge + size]


if __name__ == "__main__":
    command.run(Config, main)
