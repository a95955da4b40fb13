"""`python -m envs.tabletop.pictures --out docs/pictures`: each scene as the robot and as a visitor sees it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import imageio.v3 as iio
import numpy as np

from envs import command
from envs.errors import UsageError
from envs.files import written_aside
from envs.tabletop.env import TabletopEnv
from envs.tabletop.layouts import LAYOUTS


@dataclass(frozen=True)
class Config:
    """Draw scenes A to D: the static camera beside the second view, one file for each scene."""

    out: Path
    """The folder for scene-a.png to scene-d.png."""
    size: int = 288
    """Height of the pictures, pixels."""
    seed: int = 26
    """Of the arrangement that is shown."""

    def __post_init__(self) -> None:
        if not 16 <= self.size <= 1024:
            raise UsageError(f"size is {self.size}; give 16 to 1024 pixels")


def main(config: Config) -> None:
    """Draw and write the pictures."""
    config.out.mkdir(parents=True, exist_ok=True)
    for scene in LAYOUTS:
        env = TabletopEnv(scene, images=False)
        env.reset(seed=config.seed, options={"arm": "rest"})
        picture = np.concatenate([env.view("static", config.size), env.view("side", config.size)], axis=1)
        env.close()
        path = config.out / f"scene-{scene.lower()}.png"
        with written_aside(path) as aside:
            iio.imwrite(aside, picture, extension=".png")
        print(path)


if __name__ == "__main__":
    command.run(Config, main)
