"""What is searched: the learning rate, L1 or L2, and the weights of the objective (paper, III-G), in their ranges."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from worldmodel.models import named_config
from worldmodel.options import TrainOptions

Point = dict[str, float]
"""A configuration by the names of its axes."""
POWER = "power"
POWERS = (1, 2)
"""alpha: absolute or squared reconstruction errors."""


@dataclass(frozen=True)
class Axis:
    """A quantity that is searched on a logarithmic scale."""

    name: str
    low: float
    high: float


LEARNING_RATE = Axis("learning_rate", 3e-5, 1e-3)
WEIGHTS = tuple(
    Axis(name, 1e-3, 1.0) for name in ("rgb", "depth", "knn", "scene_smoothness", "optical_smoothness", "kl")
)
"""lambda_1 to lambda_6."""


def axes_of(training: TrainOptions, around: float | None = None) -> tuple[Axis, ...]:
    """The logarithmic axes that matter for a model: a model of pictures has no depth, a deterministic one no KL.

    A term of the objective that is off, with a weight of 0, stays off.

    Args:
        training: the options that the search begins with.
        around: search from each of their values divided by this to the value times this; without it the paper's ranges.
    """
    kind, architecture = named_config(training.model, training.architecture)
    weights = {axis.name for axis in WEIGHTS} if kind == "t3vip" else {"rgb", "kl"}
    if architecture.latents == "none":
        weights -= {"kl"}
    axes = (LEARNING_RATE, *(axis for axis in WEIGHTS if axis.name in weights))
    values = point_of(training, axes)
    axes = tuple(axis for axis in axes if values[axis.name] != 0)
    if around is None:
        return axes
    return tuple(Axis(axis.name, values[axis.name] / around, values[axis.name] * around) for axis in axes)


def draw(axes: tuple[Axis, ...], rng: np.random.Generator) -> Point:
    """A configuration: every axis log-uniform, the power a coin."""
    point: Point = {axis.name: float(np.exp(rng.uniform(np.log(axis.low), np.log(axis.high)))) for axis in axes}
    return point | {POWER: int(rng.choice(POWERS))}


def point_of(training: TrainOptions, axes: tuple[Axis, ...]) -> Point:
    """The configuration that some options have already; it may lie outside of the ranges."""
    values = {**asdict(training.losses), LEARNING_RATE.name: training.learning_rate}
    return {name: values[name] for name in (*(axis.name for axis in axes), POWER)}


def at_point(training: TrainOptions, point: Point) -> TrainOptions:
    """The options with a configuration's values in their places."""
    document = as_options(point)
    losses = replace(training.losses, **document["losses"])
    return replace(training, learning_rate=document["learning_rate"], losses=losses)


def as_options(point: Point) -> dict[str, Any]:
    """A configuration as `train-worldmodel --config` reads it."""
    losses = {name: float(value) for name, value in point.items() if name not in (LEARNING_RATE.name, POWER)}
    return {"learning_rate": float(point[LEARNING_RATE.name]), "losses": losses | {POWER: int(point[POWER])}}
