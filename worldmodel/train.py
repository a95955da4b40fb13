"""Command `train-worldmodel`."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, replace
from typing import Any

import torch

from data_collection.dataset import RGBDDataset
from data_collection.files import write_json
from envs import command as command_line
from envs.errors import UsageError
from worldmodel.budget import Cost, measure_cost
from worldmodel.clips import ClipSource
from worldmodel.config import ModelContext
from worldmodel.memory import keep_freed_memory
from worldmodel.models import make_model, named_config
from worldmodel.options import PRESETS, TrainOptions
from worldmodel.ranks import Ranks, join_ranks
from worldmodel.trainer import Trainer
from worldmodel.validation import ValidationSet

TEST_ONLY = "TabletopD-v0"
"""The unseen scene; training or tuning on it would make every figure about generalisation worthless."""
TEST_SPLITS = ("test", "all")
"""Of environments whose objects are split, the splits with objects that are for testing."""
HELD_OUT = 10
"""Without a validation set, one episode in so many is held out."""


def main(options: TrainOptions) -> None:
    """Train, with all processes that torchrun started."""
    keep_freed_memory()
    with join_ranks(options.device) as ranks:
        _train(options, ranks)


def _train(options: TrainOptions, ranks: Ranks) -> None:
    ranks.share(options.batch)  # refuse an odd one before the data is read
    train, validation = _open(options)
    context = _context(train, options)
    kind, architecture = named_config(options.model, options.architecture)
    hashes = {"train": train.dataset.content_hash, "validation": validation.source.dataset.content_hash}

    def make_trainer(options: TrainOptions) -> Trainer:
        torch.manual_seed(options.seed)
        model = make_model(kind, architecture, context).to(ranks.device).to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        origin = {"options": _document(options), "data": hashes, "versions": {"torch": torch.__version__}}
        return Trainer(model, options, train, validation, origin, ranks)

    chosen = ranks.decide(lambda: existing_run(options))
    if chosen is None:
        cost = None if options.minutes is None else measure_cost(make_trainer, options)  # all train, all measure
        chosen = ranks.decide(lambda: _claim(_filling(options, cost)))
    make_trainer(chosen).run()


def _filling(options: TrainOptions, cost: Cost | None) -> TrainOptions:
    """The options with the number of steps that fill the given minutes, if minutes are given."""
    if options.minutes is None or cost is None:
        return options
    options = replace(options, steps=cost.steps_in(60 * options.minutes, options))
    print(
        f"{options.minutes:g} minutes are {options.steps} steps here: {cost.step:.3f} s a step over the run, "
        f"{cost.validation:.1f} s a validation, {cost.checkpoint:.1f} s a checkpoint",
        flush=True,
    )
    return options


def _open(options: TrainOptions) -> tuple[ClipSource, ValidationSet]:
    dataset = RGBDDataset(options.data)
    for opened in [dataset] + ([RGBDDataset(options.validation)] if options.validation else []):
        if str(opened.attrs["env_id"]).endswith(TEST_ONLY):
            raise UsageError(
                f"{opened.path} comes from {TEST_ONLY}, the test scene; train and validate on scene A, B or C"
            )
        if opened.attrs["env_kwargs"].get("split") in TEST_SPLITS:
            raise UsageError(
                f"{opened.path} holds objects for testing only; collect with --scene train and --scene validation"
            )
    if options.validation is not None:
        held_out = RGBDDataset(options.validation)
        _same_world(dataset, held_out)
        train, other = (
            ClipSource(opened, options.frame_gap, action_column=options.action_column) for opened in (dataset, held_out)
        )
    else:
        if dataset.episodes < 2:
            raise UsageError(
                f"{dataset.path} has {dataset.episodes} episode, none to hold out; collect more, or give --validation"
            )
        split = dataset.episodes - max(1, dataset.episodes // HELD_OUT)
        train = ClipSource(dataset, options.frame_gap, slice(0, split), action_column=options.action_column)
        other = ClipSource(
            dataset, options.frame_gap, slice(split, None), share=train, action_column=options.action_column
        )
    frames = max(frames for _, frames in options.schedule.clip_lengths)
    for clips in (train, other):
        clips.starts(frames)  # now, not hours later, when the curriculum gets there
    return train, ValidationSet(other, options.validation_clips, frames, options.context, options.batch)


def _same_world(train: RGBDDataset, other: RGBDDataset) -> None:
    for name, ours, theirs in (
        ("action size", train.action_dim, other.action_dim),
        ("image size", (train.camera.height, train.camera.width), (other.camera.height, other.camera.width)),
        ("depth range", (train.camera.near, train.camera.far), (other.camera.near, other.camera.far)),
    ):
        if ours != theirs:
            raise UsageError(f"{other.path} has {name} {theirs}, {train.path} has {ours}; validate on data of one kind")


def _context(train: ClipSource, options: TrainOptions) -> ModelContext:
    attrs = train.dataset.attrs
    mean, std = train.action_statistics()
    return ModelContext(
        env_id=attrs["env_id"],
        camera=train.dataset.camera.to_json(),
        action_dim=train.action_dim,
        frame_gap=options.frame_gap,
        control_rate=float(attrs["control_rate"]),
        action_aggregation=train.action_aggregation,
        action_scale=train.action_scale,
        action_mean=tuple(float(x) for x in mean),
        action_std=tuple(float(x) for x in std),
        action_column=train.action_column,
    )


def parse_options(arguments: Sequence[str]) -> TrainOptions:
    """The options that `train-worldmodel` makes of these arguments.

    Raises:
        UsageError: they do not parse, or cannot be.
    """
    return command_line.parse(TrainOptions, arguments, _preset)


def existing_run(options: TrainOptions) -> TrainOptions | None:
    """The options of the run that `options.out` holds; None where there is none yet.

    Raises:
        UsageError: it is a run with other options, or damaged.
    """
    path = options.out / "config.json"
    if not path.exists():
        return None
    try:
        before = {"action_column": "action", **json.loads(path.read_text())}  # older runs do not say
        if options.minutes is not None:  # then the number of steps is the run's own
            options = replace(options, steps=int(before["steps"]))
    except (ValueError, TypeError, KeyError) as error:
        raise UsageError(f"{path} is damaged ({error}); restore it, or give another --out") from error
    document = _document(options)
    for name in document:
        if name != "device" and before.get(name) != document[name]:
            raise UsageError(
                f"{options.out} holds a run with {name} = {before.get(name)}, not {document[name]}; give the same "
                "options to go on with it, or another --out"
            )
    return options


def _claim(options: TrainOptions) -> TrainOptions:
    """Write the options beside the run; returns them."""
    options.out.mkdir(parents=True, exist_ok=True)
    write_json(options.out / "config.json", _document(options))
    return options


def _document(options: TrainOptions) -> dict[str, Any]:
    _, architecture = named_config(options.model, options.architecture)
    document: dict[str, Any] = json.loads(json.dumps(asdict(replace(options, architecture=architecture)), default=str))
    document.pop("out")
    return document


def _preset(arguments: Sequence[str]) -> TrainOptions:
    """The preset that the command line names, whose values are the defaults of the rest."""
    name = "cpu"
    for here, following in zip(arguments, [*arguments[1:], ""], strict=True):
        if here == "--preset":
            name = following
        elif here.startswith("--preset="):
            name = here.split("=", 1)[1]
    if name not in PRESETS:
        raise UsageError(f"no preset '{name}'; there are {', '.join(PRESETS)}")
    return PRESETS[name]


def command() -> None:
    """Entry point of `train-worldmodel`."""
    command_line.run(TrainOptions, main, default=_preset)


if __name__ == "__main__":  # torchrun -m worldmodel.train
    command()
