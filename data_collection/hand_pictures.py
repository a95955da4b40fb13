"""`python -m data_collection.hand_pictures --data DIR --out docs/pictures`: an episode of the hand: dexhand.png."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from data_collection.dataset import RGBDDataset
from data_collection.environments import KNOWN_ENVS, known_env
from data_collection.pictures import colour_depth
from data_collection.schema import quantise_depth
from envs.command import run
from envs.dexhand import DexHandEnv
from envs.errors import UsageError
from envs.files import written_aside

COLOURS = 256  # of the picture


@dataclass(frozen=True)
class Config:
    """Draw moments of an episode: what a model sees, its depth, and the view for people, with the goal."""

    data: Path
    """A dataset of the dexterous hand."""
    out: Path
    """The folder for dexhand.png."""
    episode: int = 0
    """Number of the episode."""
    moments: int = 6
    """Columns, evenly spread over the episode."""
    size: int = 132
    """Height of a picture, pixels."""

    def __post_init__(self) -> None:
        for name, least, most in (("episode", 0, 10**9), ("moments", 2, 20), ("size", 16, 1024)):
            if not least <= getattr(self, name) <= most:
                raise UsageError(f"--{name} is {getattr(self, name)}; give {least} to {most}")


def main(config: Config) -> None:
    """Restore the moments, draw them."""
    dataset = RGBDDataset(config.data)
    if known_env(str(dataset.attrs["env_id"])) is not KNOWN_ENVS["dexhand"]:
        raise UsageError(f"{config.data} is of {dataset.attrs['env_id']}; give a dataset of --env dexhand")
    if config.episode >= dataset.episodes:
        raise UsageError(f"--episode is {config.episode}; {config.data} has episodes 0 to {dataset.episodes - 1}")
    states = dataset.episode(config.episode)["state"]
    env = DexHandEnv(image_size=config.size, render_mode="rgbd_tuple", images=False)
    columns = []
    for moment in np.linspace(0, len(states) - 1, config.moments).round().astype(int):
        env.set_state(states[moment])
        columns.append(_column(env, config.size))
    env.close()
    config.out.mkdir(parents=True, exist_ok=True)
    path = config.out / "dexhand.png"
    with written_aside(path) as aside:
        picture = Image.fromarray(np.concatenate(columns, axis=1))
        picture.quantize(COLOURS, dither=Image.Dither.NONE).save(aside, "png", optimize=True)
    print(path)


def _column(env: DexHandEnv, size: int) -> NDArray[np.uint8]:
    """What there is to see, (3 * size, size, 3)."""
    rgb, depth = env.render()
    raw = quantise_depth(depth, env.camera.near, env.camera.far)
    return np.concatenate([rgb, colour_depth(raw, raw.min(), raw.max()), env.view("side", size)])


if __name__ == "__main__":
    run(Config, main)
