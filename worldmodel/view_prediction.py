"""Command `view-prediction`: a picture of what a model predicts for one clip, beside what happened."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from data_collection.dataset import RGBDDataset
from envs import command as command_line
from envs.errors import UsageError
from worldmodel.checkpoint import load_model
from worldmodel.clips import ClipSource
from worldmodel.pictures import picture_prediction
from worldmodel.world_model import WorldModel


@dataclass(frozen=True)
class ViewOptions:
    """Write a picture of a free-running prediction beside the truth.

    Rows: true and predicted RGB, true and predicted depth, masks, true (where the dataset knows it) and predicted scene
    flow, optical flow on the colour wheel, occlusion. Columns: the predicted steps.
    """

    data: Path
    """Dataset that the clip comes from."""
    out: Path
    """PNG to write."""
    model: str = "t3vip"
    """A training run, a folder with config.json and model.safetensors, or a shipped name."""
    episode: int = 0
    """Which episode of the dataset."""
    start: int | None = None
    """Control step of the clip's first frame; where most changes when not given."""
    context: int = 2
    """Frames that the model sees."""
    predicted: int = 10
    """Frames that it predicts from them."""
    scale: int = 2
    """How many times each picture is enlarged."""
    device: str = "cpu"
    """Where the model runs."""

    def __post_init__(self) -> None:
        for name, least in (("episode", 0), ("context", 1), ("predicted", 1), ("scale", 1)):
            if getattr(self, name) < least:
                raise UsageError(f"--{name} is {getattr(self, name)}; give a whole number of at least {least}")
        if self.start is not None and self.start < 0:
            raise UsageError(f"--start is {self.start}; give a control step from 0 on")
        if self.out.suffix.lower() != ".png":
            raise UsageError(f"--out is {self.out}; give a file that ends in .png")


def main(options: ViewOptions) -> None:
    """Predict, draw, and say where the picture is."""
    dataset, model = RGBDDataset(options.data), load_model(options.model, options.device)
    _check_fits(dataset, model, options)
    if options.episode >= dataset.episodes:
        raise UsageError(
            f"--episode is {options.episode}, {options.data} has {dataset.episodes}; give 0 to {dataset.episodes - 1}"
        )
    source = ClipSource(dataset, model.frame_gap, slice(options.episode, options.episode + 1))
    start = _start(source, options)
    frames = options.context + options.predicted
    truth = source.truth_at(start, frames) if dataset.has_ground_truth else None
    picture_prediction(model, source.at(start, frames), truth, options.context, options.out, options.scale)
    print(f"{options.predicted} predicted frames beside the truth: {options.out}")


def _start(source: ClipSource, options: ViewOptions) -> np.ndarray:
    """First row (1,) of the clip in the columns that the source holds."""
    frames = options.context + options.predicted
    starts = source.starts(frames)
    if options.start is not None:
        if options.start >= len(starts):
            raise UsageError(
                f"--start is {options.start}; in this episode a clip of {frames} frames starts at {len(starts) - 1} at"
                " the latest"
            )
        return starts[[options.start]]
    span = (frames - 1) * source.frame_gap
    rgb = source.dataset.episode(options.episode)["rgb"].astype(np.int16)
    first = source.dataset.episode_slices[options.episode, 0]
    changes = [np.abs(rgb[row + span] - rgb[row]).mean() for row in starts - first]
    return starts[[int(np.argmax(changes))]]


def _check_fits(dataset: RGBDDataset, model: WorldModel, options: ViewOptions) -> None:
    for name, ours, theirs in (
        ("action size", model.context.action_dim, dataset.action_dim),
        ("image size", (model.camera.height, model.camera.width), (dataset.camera.height, dataset.camera.width)),
        ("depth range", (model.camera.near, model.camera.far), (dataset.camera.near, dataset.camera.far)),
    ):
        if ours != theirs:
            raise UsageError(
                f"{options.data} has {name} {theirs}, the model {options.model} wants {ours}; give data of its kind"
            )


def command() -> None:
    """Entry point of `view-prediction`."""
    command_line.run(ViewOptions, main)
