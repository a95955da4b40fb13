"""One episode: a policy acts in an environment, and what happened becomes columns."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from data_collection.policies import Policy
from data_collection.schema import COLUMNS, quantise_depth
from envs.errors import UsageError


def collect_episode(
    env: gymnasium.Env,
    policy: Policy,
    steps: int,
    seed: int,
    episode: int,
    ground_truth: bool = False,
    on_step: Callable[[], None] = lambda: None,
) -> tuple[dict[str, NDArray[Any]], bool]:
    """Roll out one episode; the same arguments give the same episode, whatever came before.

    Args:
        env: from `make_env`.
        policy: a fresh one.
        steps: actions to execute; fewer if the environment ends the episode.
        seed: of the run.
        episode: number of the episode in the run.
        ground_truth: also record segmentation and body poses.
        on_step: called before every step.

    Returns:
        the columns of the schema, (steps + 1, ...) each, and whether the episode ended in a terminal state.

    Raises:
        UsageError: the environment gave colours, ids or depth that a dataset does not store, or its `info` has
            something in some steps only.
    """
    env_seeds, policy_seeds = np.random.SeedSequence((seed, episode)).spawn(2)
    obs, info = env.reset(seed=int(env_seeds.generate_state(1)[0] >> 1))
    policy.reset(env, np.random.default_rng(policy_seeds))
    space = env.action_space
    assert isinstance(space, gymnasium.spaces.Box)
    camera = env.unwrapped.camera  # type: ignore[attr-defined]
    rows: dict[str, list[Any]] = defaultdict(list)
    _record(rows, env, obs, info, ground_truth)
    terminated = False
    for _ in range(steps):
        on_step()
        action = np.asarray(policy.act(obs), np.float32)
        if action.shape != space.shape or not np.isfinite(action).all():
            raise ValueError(f"the policy gave action {action}; it must be {space.shape} finite numbers")
        action = np.clip(action, space.low, space.high)
        obs, reward, terminated, truncated, info = env.step(action)
        rows["action"].append(action)
        rows["reward"].append(reward)
        if "joint_delta" in info:
            rows["joint_delta"].append(info["joint_delta"])
        _record(rows, env, obs, info, ground_truth)
        _check_infos(rows)
        if terminated or truncated:
            break
    rows["action"].append(np.zeros(space.shape))
    rows["reward"].append(0.0)
    if "joint_delta" in rows:
        rows["joint_delta"].append(np.zeros_like(rows["joint_delta"][-1]))
    rows["depth"] = [quantise_depth(frame, camera.near, camera.far) for frame in rows["depth"]]
    columns = {name: _stored(name, np.stack(rows[name])) for name in COLUMNS if name in rows}
    return columns, bool(terminated)


def _check_infos(rows: dict[str, list[Any]]) -> None:
    """Check, after a step, that what `info` has now it has had from the start."""
    frames = len(rows["rgb"])
    for name, wanted, where in (
        ("scene_obs", frames, "reset and every step"),
        ("joint_delta", frames - 1, "every step"),
    ):
        if name in rows and len(rows[name]) != wanted:
            raise UsageError(f"the environment's info has '{name}' now and then; give it in {where}, or never")


def _stored(name: str, values: NDArray[Any]) -> NDArray[Any]:
    """A column in the dtype of the schema; colours and ids that would wrap or be cut off are refused."""
    dtype = np.dtype(COLUMNS[name].dtype)
    if dtype.kind == "u" and values.dtype != dtype:
        low, high, most = values.min(), values.max(), np.iinfo(dtype).max
        if values.dtype.kind not in "iu" or low < 0 or high > most:
            raise UsageError(
                f"the environment gave '{name}' as {values.dtype} from {low} to {high}; "
                f"a dataset stores whole numbers from 0 to {most}"
            )
    return values.astype(dtype)


def _record(
    rows: dict[str, list[Any]], env: gymnasium.Env, obs: dict[str, Any], info: dict[str, Any], ground_truth: bool
) -> None:
    """Append one frame and the state of the world at it."""
    inner: Any = env.unwrapped
    for name in ("rgb", "depth", "proprio"):
        rows[name].append(np.array(obs[name]))
    rows["state"].append(inner.get_state())
    if "scene_obs" in info:
        rows["scene_obs"].append(np.array(info["scene_obs"]))
    if ground_truth:
        rows["segmentation"].append(inner.segmentation())
        rows["body_pose"].append(inner.body_poses())
