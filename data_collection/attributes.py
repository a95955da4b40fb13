"""What a shard says about its columns: whether all is said, and whether it fits them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from data_collection.actions import aggregate_actions
from data_collection.schema import ATTRIBUTES, SCHEMA_VERSION
from envs.camera import CameraModel
from envs.errors import UsageError

FROM_CAMERA = ("K", "world_T_camera", "near", "far")
"""Attributes that repeat what the attribute `camera` says, for readers of HDF5 that know no `CameraModel`."""
IMAGES = {"rgb": (3,), "depth": (), "segmentation": ()}
"""Column of images -> shape of a pixel."""


def complete_attributes(attrs: Mapping[str, Any], columns: Mapping[str, tuple[int, ...]]) -> dict[str, Any]:
    """All attributes of a shard that is to be written: those given, the schema's version, and `FROM_CAMERA`.

    Args:
        attrs: as Python values; `camera` as `CameraModel.to_dict` gives it.
        columns: name -> shape of one row.

    Raises:
        UsageError: one is missing, or does not fit the columns or the camera.
    """
    missing = [name for name in ATTRIBUTES if name not in ("schema", *FROM_CAMERA, *attrs)]
    if missing:
        raise UsageError(f"a shard without attribute '{missing[0]}'; give all that docs/data.md lists")
    camera = CameraModel.from_dict(attrs["camera"])
    check_attributes(attrs, columns, camera, "the shard")
    derived = {name: getattr(camera, name) for name in FROM_CAMERA}
    for name, value in derived.items():
        if name in attrs and not np.array_equal(attrs[name], value):
            raise UsageError(f"attribute {name} is not what the camera has; leave it out, it follows from `camera`")
    return {"schema": SCHEMA_VERSION, **attrs, **derived}


def check_attributes(
    attrs: Mapping[str, Any], columns: Mapping[str, tuple[int, ...]], camera: CameraModel, where: str
) -> None:
    """Check that images are of the camera's size, and that each number of an action has its aggregation and scale.

    Args:
        attrs: of a shard.
        columns: those that there are, name -> shape of one row.
        camera: of the shard.
        where: what to call the shard.

    Raises:
        UsageError: they do not fit.
    """
    for name, pixel in IMAGES.items():
        wanted = (camera.height, camera.width, *pixel)
        if name in columns and columns[name] != wanted:
            raise UsageError(
                f"{where} has '{name}' of {columns[name]}, but its camera takes {wanted}; "
                "write it with the camera of these images"
            )
    if "action" not in columns:
        return
    (size,) = columns["action"]
    for name in ("action_aggregation", "action_scale"):
        if np.shape(attrs[name]) != (size,):
            raise UsageError(
                f"{where} has actions of {size} numbers, but {name} {attrs[name]!r}; write it with one for each"
            )
    try:
        aggregate_actions(np.zeros((1, size)), attrs["action_aggregation"])
    except ValueError as error:
        raise UsageError(f"{where} has an action_aggregation that means nothing: {error}") from error
