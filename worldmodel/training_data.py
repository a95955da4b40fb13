"""What a run trains and validates on: one dataset or two, of one kind, and none that is for testing."""

from __future__ import annotations

from dataclasses import replace

from data_collection.dataset import RGBDDataset
from data_collection.overlap import shared_episodes
from envs.errors import UsageError
from envs.planar_push.objects import SPLITS, canonical
from worldmodel.clips import HELD, ClipSource, usual_column
from worldmodel.config import ModelContext
from worldmodel.held_out import ValidationSet
from worldmodel.interface import Interface, mismatch
from worldmodel.memory import available_memory
from worldmodel.options import TrainOptions
from worldmodel.ranks import processes_here

TEST_ONLY = "TabletopD-v0"
"""The unseen scene; training or tuning on it would make every figure about generalisation worthless."""
TEST_SPLITS = ("test", "all")
"""Of our planar pushes, the splits with objects that are for testing."""
HELD_OUT = 10
"""Without a validation set, one episode in so many is held out."""
FREE_SHARE = 0.5
"""Of the memory that is free, what datasets may take; training takes some, too."""


def settled(options: TrainOptions) -> TrainOptions:
    """The options with the action column that `auto` comes to for their data."""
    if options.action_column != "auto":
        return options
    column = usual_column(RGBDDataset(options.data))
    return replace(options, action_column=column)  # type: ignore[arg-type]


def open_data(options: TrainOptions) -> tuple[ClipSource, ValidationSet]:
    """Clips to train on, and those to validate on.

    Raises:
        UsageError: there is no such data, it is for testing only, or it is too short or too little for the options.
    """
    dataset = RGBDDataset(options.data)
    for opened in [dataset] + ([RGBDDataset(options.validation)] if options.validation else []):
        if str(opened.attrs["env_id"]).endswith(TEST_ONLY):
            raise UsageError(
                f"{opened.path} comes from {TEST_ONLY}, the test scene; train and validate on scene A, B or C"
            )
        if _is_for_testing(opened):
            raise UsageError(
                f"{opened.path} is for testing only; collect objects with --scene train and --scene validation, import "
                "another --split"
            )
    limit = _memory_limit(options)
    column = settled(options).action_column
    if options.validation is not None:
        held_out = RGBDDataset(options.validation)
        _same_world(dataset, held_out, column)
        check_apart(dataset, held_out)
        train = ClipSource(dataset, options.frame_gap, action_column=column, memory_limit=limit)
        limit -= dataset.size_of(HELD) if train.in_memory else 0
        other = ClipSource(held_out, options.frame_gap, action_column=column, memory_limit=limit)
    else:
        if dataset.episodes < 2:
            raise UsageError(
                f"{dataset.path} has {dataset.episodes} episode, none to hold out; collect more, or give --validation"
            )
        split = dataset.episodes - max(1, dataset.episodes // HELD_OUT)
        train = ClipSource(dataset, options.frame_gap, slice(0, split), action_column=column, memory_limit=limit)
        other = ClipSource(dataset, options.frame_gap, slice(split, None), share=train, action_column=column)
    frames = max(frames for _, frames in options.schedule.clip_lengths)
    for clips in (train, other):
        clips.starts(frames)  # now, not hours later, when the curriculum gets there
    return train, ValidationSet(other, options.validation_clips, frames, options.context, options.batch)


def check_apart(train: RGBDDataset, other: RGBDDataset) -> None:
    """See that a model is not judged by what it was trained on.

    Raises:
        UsageError: datasets share episodes.
    """
    if shared := shared_episodes(train, other):
        raise UsageError(
            f"{len(shared)} of the {other.episodes} episodes of {other.path} (the first is number {shared[0]}) are in "
            f"{train.path}, too, and say nothing about what a model has not seen; collect with another --seed"
        )


def _memory_limit(options: TrainOptions) -> float:
    """Bytes that the pictures of all datasets may take in this process."""
    if options.memory_limit is not None:
        return 1e9 * options.memory_limit
    return FREE_SHARE * available_memory() / processes_here()


def _is_for_testing(dataset: RGBDDataset) -> bool:
    kwargs = dataset.attrs["env_kwargs"]
    if "PlanarPush" not in str(dataset.attrs["env_id"]):  # imported: its split has the name that its folder had
        return kwargs.get("split") == "test"
    one = kwargs.get("object")
    return kwargs.get("split") in TEST_SPLITS or (one is not None and canonical(one) in SPLITS["test"])


def _same_world(train: RGBDDataset, other: RGBDDataset, action_column: str) -> None:
    difference = mismatch(Interface.of_data(other, action_column), Interface.of_data(train, action_column))
    if difference is not None:
        raise UsageError(f"{other.path} has {difference} as {train.path}; validate on data of one kind")


def model_context(train: ClipSource, options: TrainOptions) -> ModelContext:
    """What the model is made for, as the data says."""
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
