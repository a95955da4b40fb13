"""What an environment must have so that its episodes can become a dataset."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np

from data_collection.schema import COLUMNS
from envs.camera import CameraModel
from envs.errors import UsageError

NEEDED = ("camera", "get_state", "ACTION_AGGREGATION", "ACTION_SCALE", "control_rate")
NEEDED_FOR_GROUND_TRUTH = ("segmentation", "body_poses", "body_names", "hand_body_ids")
WORKSPACE = (2, 3)
"""Shape of a workspace: its low and its high corner, m. Where the end-effector is in it, the first three numbers of
`proprio` say."""
MAX_BODIES = int(np.iinfo(COLUMNS["segmentation"].dtype).max) + 1


def check_env(env: gymnasium.Env, env_id: str, ground_truth: bool) -> None:
    """Check what an environment says about itself; what it then gives is checked by the rollout.

    Args:
        env: just made.
        env_id: its Gymnasium id.
        ground_truth: whether segmentation and body poses will be recorded.

    Raises:
        UsageError: it lacks something, or its observations are not what a dataset stores.
    """
    inner: Any = env.unwrapped
    for name in NEEDED + (NEEDED_FOR_GROUND_TRUTH if ground_truth else ()):
        if not hasattr(inner, name):
            raise UsageError(f"environment '{env_id}' has no attribute '{name}'; it cannot be collected from")
    if not isinstance(inner.camera, CameraModel):
        stranger = type(inner.camera).__name__
        raise UsageError(f"environment '{env_id}' has a {stranger} as camera; make it an envs.camera.CameraModel")
    size = (inner.camera.height, inner.camera.width)
    _check_space(env, env_id, "rgb", np.uint8, (*size, 3), f"uint8 {(*size, 3)}, as its camera says")
    _check_space(env, env_id, "depth", np.floating, size, f"metres, floating-point {size}, as its camera says")
    _check_space(env, env_id, "proprio", np.number, None, "a vector of numbers")
    action = env.action_space
    if not isinstance(action, gymnasium.spaces.Box) or len(action.shape) != 1:
        raise UsageError(f"environment '{env_id}' takes actions {action}; it must take a Box of shape (A,)")
    if not action.is_bounded():
        raise UsageError(f"environment '{env_id}' takes actions {action}, without bounds; give it a Box that has them")
    for name in ("ACTION_AGGREGATION", "ACTION_SCALE"):
        if np.shape(getattr(inner, name)) != action.shape:
            raise UsageError(
                f"environment '{env_id}' has {name} {getattr(inner, name)!r}; it must have one for each of the "
                f"{action.shape[0]} numbers of an action"
            )
    workspace = getattr(inner, "workspace", None)
    if workspace is not None and np.shape(workspace) != WORKSPACE:
        raise UsageError(
            f"environment '{env_id}' has a workspace of shape {np.shape(workspace)}; make it {WORKSPACE}, the low and "
            "high corner that the first three numbers of proprio go through, or leave it out"
        )
    if ground_truth and len(inner.body_names) > MAX_BODIES:
        raise UsageError(
            f"environment '{env_id}' has {len(inner.body_names)} bodies, and a dataset stores ids of {MAX_BODIES}; "
            "leave out --ground-truth"
        )


def _check_space(
    env: gymnasium.Env, env_id: str, key: str, dtype: Any, shape: tuple[int, ...] | None, wanted: str
) -> None:
    """Check the dtype and shape of an observation; any vector will do where `shape` is None."""
    space = getattr(env.observation_space, "spaces", {}).get(key)
    if space is None:
        raise UsageError(f"environment '{env_id}' does not observe '{key}'; it cannot be collected from")
    fits = len(space.shape or ()) == 1 if shape is None else space.shape == shape
    if not fits or not np.issubdtype(space.dtype, dtype):
        raise UsageError(
            f"environment '{env_id}' observes '{key}' as {space.dtype} {space.shape}; a dataset needs {wanted}"
        )
