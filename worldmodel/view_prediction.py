"""Command `view-prediction`: what models predict for one clip beside what happened, as a figure, a film, or in 3D."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import tyro
from numpy.typing import NDArray

from data_collection.dataset import RGBDDataset
from envs import command as command_line
from envs.errors import UsageError
from worldmodel.checkpoint import PRETRAINED, find_model, load_model, shipped_models
from worldmodel.clips import ClipSource
from worldmodel.figure import TRUTH, Storyboard, write_film, write_sheet
from worldmodel.interface import check_fits
from worldmodel.pictures import predict, storyboard
from worldmodel.viewer3d import Scene, require_rerun, view_scene, write_scene
from worldmodel.world_model import WorldModel

Section = Literal["rgb", "depth", "masks", "scene-flow", "optical-flow", "occlusion"]
TILE = 128
"""Pixels: pictures are enlarged to at least this width."""
SUFFIXES = (".png", ".mp4", ".rrd")


@dataclass(frozen=True)
class ViewOptions:
    """Show free-running predictions of one clip beside the truth, as a figure (.png), a film (.mp4), or in 3D (.rrd).

    In each section the truth, where the dataset knows it, and each model: RGB, depth, masks, scene flow, optical flow
    on the colour wheel, occlusion. Models of pictures (sv2p, sna, cdna) have RGB and masks only. Latents are at 0.
    """

    data: Path
    """Dataset that the clip comes from."""
    models: Annotated[tuple[str, ...], tyro.conf.arg(aliases=("--model",))] = ("t3vip",)
    """Shipped names, training runs, or folders with config.json and model.safetensors; all of one frame gap."""
    out: tuple[Path, ...] = ()
    """What to write: any of x.png, x.mp4, x.rrd (a recording for the Rerun viewer)."""
    view: bool = False
    """Open the 3D view in the Rerun viewer, and wait until it is closed."""
    episode: int | None = None
    """Which episode of the dataset; the first when not given."""
    start: int | None = None
    """Control step of the clip's first frame; where most changes when not given."""
    seed: int | None = None
    """Draw what is not given of episode and start, and the samples' latents, from this seed."""
    context: int = 2
    """Frames that the models see."""
    predicted: int = 10
    """Frames that they predict from them."""
    samples: int = 0
    """Futures of each model with latents, drawn from the prior and shown under the one with latents at 0."""
    sections: tuple[Section, ...] = ()
    """Which kinds of picture the figure and the film show; all that there are when not given."""
    columns: int = 10
    """At most so many predicted frames in the figure, evenly spread; the film shows all of them."""
    scale: int | None = None
    """How many times each picture is enlarged; when not given, until it is 128 pixels wide."""
    speed: float = 0.5
    """Of the film; 1 is real time."""
    device: str = "auto"
    """Where the models run: cpu, cuda, or auto for a GPU where there is one."""

    def __post_init__(self) -> None:
        least = {
            "episode": 0,
            "start": 0,
            "seed": 0,
            "context": 1,
            "predicted": 1,
            "samples": 0,
            "columns": 1,
            "scale": 1,
        }
        for name, bound in least.items():
            value = getattr(self, name)
            if value is not None and value < bound:
                raise UsageError(f"--{name} is {value}; give a whole number of at least {bound}")
        if not 0.01 <= self.speed <= 100:
            raise UsageError(f"--speed is {self.speed}; give a number from 0.01 to 100, 1 for real time")
        if not self.models:
            raise UsageError("--models is empty; name at least one")
        for path in self.out:
            if path.suffix.lower() not in SUFFIXES:
                raise UsageError(f"--out is {path}; give files that end in {', '.join(SUFFIXES)}")
        if not self.out and not self.view:
            raise UsageError("nothing to show; give --out FILE.png, FILE.mp4 or FILE.rrd, or --view")


def main(options: ViewOptions) -> None:
    """Predict, draw, and say where the pictures are."""
    if options.view or any(path.suffix.lower() == ".rrd" for path in options.out):
        require_rerun(options.view)
    dataset = RGBDDataset(options.data)
    models = {name: load_model(name, options.device) for name in options.models}
    for name, model in models.items():
        for note in check_fits(name, model, dataset):
            print(note)
    _check_together(models, options)
    gap = next(iter(models.values())).frame_gap
    episode, start = _choose(dataset, gap, options)
    source = ClipSource(dataset, gap, slice(episode, episode + 1), memory_limit=0)
    frames = options.context + options.predicted
    rows = np.array([dataset.episode_slices[episode, 0] + start])
    clips = source.at(rows, frames)
    truth = source.truth_at(rows, frames) if dataset.has_ground_truth else None
    names = labels(options.models)
    seed = options.seed or 0
    shown = [
        predict(
            names[name],
            model,
            source.with_actions(model.context.action_column).at(rows, frames),
            options.context,
            options.samples,
            seed,
        )
        for name, model in models.items()
    ]
    board = storyboard(clips, truth, options.context, shown, source.frame_seconds)
    scene = Scene(dataset.camera, clips, truth, options.context, source.frame_seconds, shown)
    if options.sections:
        board = _only(board, options.sections)
    scale = options.scale or -(-TILE // dataset.camera.width)
    for path in options.out:
        if path.suffix.lower() == ".png":
            write_sheet(board, path, options.columns, scale)
        elif path.suffix.lower() == ".mp4":
            write_film(board, path, scale, options.speed)
        else:
            write_scene(scene, path)
    print(
        f"{', '.join(names.values())}: {options.predicted} predicted frames beside the truth, episode {episode} from "
        f"step {start}{': ' if options.out else ''}{', '.join(map(str, options.out))}"
    )
    if options.view:
        view_scene(scene)


def _only(board: Storyboard, sections: Sequence[Section]) -> Storyboard:
    """Some sections of a figure."""
    kept = [strip for strip in board.strips if strip.section.lower().replace(" ", "-") in sections]
    if not kept:
        raise UsageError(
            f"--sections is {' '.join(sections)}; these models and this data have "
            f"{', '.join(board.sections)}; choose of them"
        )
    return replace(board, strips=kept)


def labels(models: Sequence[str]) -> dict[str, str]:
    """How each model is called in the figure: shipped names in capitals, runs by their folder, if that tells them
    apart; none as the truth is."""
    short = {}
    for name in dict.fromkeys(models):
        folder = Path(name)
        if name in shipped_models() and find_model(name).is_relative_to(PRETRAINED):
            short[name] = folder.name.upper()
        else:
            folder = folder.resolve()
            short[name] = folder.parent.name if folder.name == "model" else folder.name
    if len(set(short.values())) < len(short):
        short = {name: name for name in short}
    return {name: f"model {label}" if label == TRUTH else label for name, label in short.items()}


def _choose(dataset: RGBDDataset, gap: int, options: ViewOptions) -> tuple[int, int]:
    """Episode and control step of the clip's first frame."""
    span = (options.context + options.predicted - 1) * gap + 1
    lengths = dataset.episode_lengths
    rng = None if options.seed is None else np.random.default_rng(options.seed)
    episode = options.episode
    if episode is None:
        long_enough = np.flatnonzero(lengths >= span + (options.start or 0))
        episode = 0 if rng is None or not len(long_enough) else int(rng.choice(long_enough))
    if episode >= dataset.episodes:
        raise UsageError(
            f"--episode is {episode}, {options.data} has {dataset.episodes}; give 0 to {dataset.episodes - 1}"
        )
    latest = int(lengths[episode]) - span
    if latest < 0:
        raise UsageError(
            f"no clip fits: episode {episode} has {lengths[episode]} frames, {options.context} seen and "
            f"{options.predicted} predicted ones at gap {gap} need {span}; give a smaller --predicted"
        )
    if options.start is None:
        rgb = dataset.episode(episode)["rgb"]
        return episode, _liveliest(rgb, span) if rng is None else int(rng.integers(latest + 1))
    if options.start > latest:
        raise UsageError(
            f"--start is {options.start}; in episode {episode} a clip of {span} control steps starts at {latest} at "
            "the latest"
        )
    return episode, options.start


def _liveliest(rgb: NDArray[np.uint8], span: int) -> int:
    """Where the picture differs most from the one a clip later."""
    values = rgb.astype(np.int16)
    return int(
        np.argmax([np.abs(after - before).mean() for before, after in zip(values, values[span - 1 :], strict=False)])
    )


def _check_together(models: dict[str, WorldModel], options: ViewOptions) -> None:
    gaps = {name: model.frame_gap for name, model in models.items()}
    if len(set(gaps.values())) > 1:
        listed = ", ".join(f"{name} {gap}" for name, gap in gaps.items())
        raise UsageError(f"the models have different frame gaps ({listed}); show models of one gap in one figure")
    if options.samples and not any(model.latent_shape[0] for model in models.values()):
        raise UsageError(f"--samples is {options.samples}, but {', '.join(models)} have no latents; leave it out")


def command() -> None:
    """Entry point of `view-prediction`."""
    command_line.run(ViewOptions, main)
