"""What a world looks like and how it is acted on: where a model was made, and where it is to be used.

A model unprojects with its own camera, scales depth by its own range, and takes actions in its own units. Where these
are others it still predicts, and what it predicts means nothing.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

from data_collection.dataset import RGBDDataset
from envs.camera import CameraModel
from envs.errors import UsageError
from worldmodel.clips import action_units
from worldmodel.world_model import WorldModel

TOLERANCE = 1e-3
"""Relative, of what is measured rather than counted."""

Pair = tuple[str, Any, Any]
"""What is compared: its name, the given one and the wanted one."""


@dataclass(frozen=True)
class Interface:
    """Camera and actions of a dataset, of an environment, or of those that a model was trained on."""

    env_id: str
    camera: CameraModel
    action_aggregation: tuple[str, ...]
    """How each number of an action adds up over a frame gap."""
    action_scale: tuple[float, ...]
    """Metres or radians that 1 stands for in each number of an action."""
    control_rate: float
    """Control steps a second."""

    @classmethod
    def of_model(cls, model: WorldModel) -> Interface:
        """What a model was made for."""
        context = model.context
        return cls(context.env_id, model.camera, context.action_aggregation, context.action_scale, context.control_rate)

    @classmethod
    def of_data(cls, dataset: RGBDDataset, action_column: str = "action") -> Interface:
        """What a dataset has, with one of its columns for actions.

        Raises:
            UsageError: it has no such column.
        """
        attrs = dataset.attrs
        return cls(attrs["env_id"], dataset.camera, *action_units(dataset, action_column), float(attrs["control_rate"]))


def mismatch(given: Interface, wanted: Interface) -> str | None:
    """The first thing that keeps a model made for `wanted` from being used on `given`.

    Returns:
        As in "depth range (1.0, 4.0), not (1.0, 3.0)"; None if they agree. The camera's pose, the scene and the control
        rate may differ.
    """
    return camera_mismatch(given.camera, wanted.camera) or _difference(
        exact=(
            ("action size", len(given.action_scale), len(wanted.action_scale)),
            ("action aggregation", given.action_aggregation, wanted.action_aggregation),
        ),
        measured=(("action scale", given.action_scale, wanted.action_scale),),
    )


def camera_mismatch(given: CameraModel, wanted: CameraModel) -> str | None:
    """The first thing that keeps a model made for the camera `wanted` from being shown what `given` takes.

    Returns:
        As `mismatch` does.
    """
    return _difference(
        exact=(("image size", _size(given), _size(wanted)),),
        measured=(
            ("depth range", (given.near, given.far), (wanted.near, wanted.far)),
            ("intrinsics fx, fy, cx, cy", _intrinsics(given), _intrinsics(wanted)),
        ),
    )


def check_fits(name: str, model: WorldModel, dataset: RGBDDataset) -> list[str]:
    """See whether a model can predict a dataset.

    Args:
        name: of the model, for messages.
        model: what is to predict.
        dataset: what it is to predict.

    Returns:
        What differs and does not keep it from that, as sentences without a full stop.

    Raises:
        UsageError: the dataset has another camera or other actions than the model was trained on.
    """
    column, wanted = model.context.action_column, Interface.of_model(model)
    if column not in ("action", "joint_delta") and set(dataset.attrs["action_aggregation"]) != {"last"}:
        raise UsageError(
            f"{name} was trained on absolute actions ('{column}'), and {dataset.path} has others; give data of its kind"
        )
    given = Interface.of_data(dataset, column)
    difference = mismatch(given, wanted)
    if difference is not None:
        raise UsageError(f"{dataset.path} has {difference}, which {name} was trained on; give data of its kind")
    notes = []
    if given.control_rate != wanted.control_rate:
        notes.append(
            f"{dataset.path} has {given.control_rate:g} control steps a second, {name} was trained on "
            f"{wanted.control_rate:g}"
        )
    if _family(given.env_id) != _family(wanted.env_id):
        notes.append(f"{dataset.path} comes from {given.env_id}, {name} was trained on {wanted.env_id}")
    return notes


def _difference(exact: Iterable[Pair], measured: Iterable[Pair]) -> str | None:
    """The first pair that differs of what is counted, then of what is measured."""
    for what, given, wanted in exact:
        if given != wanted:
            return f"{what} {given}, not {wanted}"
    for what, given, wanted in measured:
        if not np.allclose(given, wanted, TOLERANCE, 0):
            return f"{what} {given}, not {wanted}"
    return None


def _size(camera: CameraModel) -> tuple[int, int]:
    return camera.height, camera.width


def _intrinsics(camera: CameraModel) -> tuple[float, ...]:
    return tuple(round(float(camera.K[place]), 3) for place in ((0, 0), (1, 1), (0, 2), (1, 2)))


def _family(env_id: str) -> str:
    """Whose environment it is: "t3vip" of "envs:t3vip/TabletopD-v0"."""
    return env_id.rpartition(":")[2].partition("/")[0]
