"""Which environments the collector knows, and what a dataset says about the one that made it."""

from __future__ import annotations

import hashlib
import importlib.metadata
import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

import data_collection
import envs  # registers the environments
from data_collection.requirements import check_env
from envs.base import RGBDEnv
from envs.errors import UsageError
from envs.gl import gl_renderer

PACKAGES = (
    "t3vip",
    "mujoco",
    "robosuite",
    "gymnasium",
    "gymnasium-robotics",
    "dm_control",
    "fast-simplification",
    "numpy",
    "scipy",
    "h5py",
)
"""Distributions that an episode depends on: physics, scenes and meshes, arithmetic, and the file."""


@dataclass(frozen=True)
class KnownEnv:
    """An environment by its short name."""

    env_id: str
    """Gymnasium id; `{scene}` stands for the scene's letter."""
    policy: str = "play"
    """Who acts unless told otherwise."""
    scenes: tuple[str, ...] = ()
    """The first is taken unless told otherwise."""
    scene_keyword: str = ""
    """Keyword argument that a scene goes to; "" if it is part of the id."""
    kwargs: dict[str, Any] = field(default_factory=dict)
    steps: int = 240
    """Actions in an episode unless told otherwise."""

    @property
    def ids(self) -> tuple[str, ...]:
        """The Gymnasium ids of all its scenes."""
        return tuple(self.env_id.replace("{scene}", scene) for scene in self.scenes or ("",))


KNOWN_ENVS: dict[str, KnownEnv] = {
    "tabletop": KnownEnv("t3vip/Tabletop{scene}-v0", scenes=("C", "A", "B", "D")),
    "planar-push": KnownEnv("t3vip/PlanarPush-v0", "push", ("train", "validation", "test", "all"), "split"),
    "dexhand": KnownEnv("t3vip/DexHand-v0", "predictive", kwargs={"new_goals": True}, steps=100),
}


def resolve_env(name: str, scene: str | None) -> tuple[str, dict[str, Any]]:
    """Short name, or any Gymnasium id (such as "module:Name-v0") -> (Gymnasium id, keyword arguments).

    Args:
        name: the short name or the id.
        scene: one of the environment's scenes; None for its usual one.

    Raises:
        UsageError: unknown name or scene.
    """
    if not (name in KNOWN_ENVS or name in gymnasium.registry or "/" in name or ":" in name):
        raise UsageError(
            f"no environment named '{name}'; choose one of {', '.join(KNOWN_ENVS)}, or give a Gymnasium id, as "
            "module:Name-v0, which imports the module first"
        )
    ours = known_env(name)
    known = KNOWN_ENVS.get(name) or KnownEnv(name, kwargs=ours.kwargs if ours else {})
    if scene is None:
        scene = known.scenes[0] if known.scenes else ""
    elif not known.scenes:
        raise UsageError(f"{name} has no scenes to choose from, but --scene is '{scene}'; leave it out")
    elif scene not in known.scenes:
        raise UsageError(f"{name} has no scene '{scene}'; choose one of {', '.join(sorted(known.scenes))}")
    chosen = {known.scene_keyword: scene} if known.scene_keyword else {}
    return known.env_id.replace("{scene}", scene), {**known.kwargs, **chosen}


def usual_steps(name: str) -> int:
    """Actions in an episode of an environment, by its short name or Gymnasium id, unless told otherwise."""
    return (known_env(name) or KnownEnv(name)).steps


def usual_policy(name: str) -> str:
    """Who acts in an environment, by its short name or Gymnasium id, unless told otherwise; noise in unknown ones."""
    known = known_env(name)
    return known.policy if known else "noise"


def known_env(name: str) -> KnownEnv | None:
    """The environment of this project that a short name or Gymnasium id means; None if it is another's.

    Args:
        name: the short name, or the whole id, which may begin with the module to import, as in "envs:t3vip/DexHand-v0".
    """
    env_id = name.rpartition(":")[2]
    return KNOWN_ENVS.get(name) or next((known for known in KNOWN_ENVS.values() if env_id in known.ids), None)


def extra_kwargs(name: str, text: str) -> dict[str, Any]:
    """Keyword arguments that somebody gives an environment, by its short name or Gymnasium id, as JSON.

    Raises:
        UsageError: no JSON object of finite numbers, or a keyword that other options choose.
    """

    def refuse(constant: str) -> None:
        raise ValueError(f"{constant} is no number")

    try:
        kwargs = json.loads(text, parse_constant=refuse)
        if not isinstance(kwargs, dict):
            raise ValueError(f"it is a {type(kwargs).__name__}")
    except ValueError as error:
        example = """'{"depth_noise": 0.002}'"""
        raise UsageError(f"--env-kwargs is '{text}' ({error}); give a JSON object, as {example}") from error
    chosen = {"image_size": "--image-size"} | ({"scene": "--env and --scene"} if known_env(name) else {})
    if name in KNOWN_ENVS:
        chosen[KNOWN_ENVS[name].scene_keyword] = "--scene"
    for keyword in kwargs:
        if keyword in chosen:
            raise UsageError(f"--env-kwargs has '{keyword}', which is for {chosen[keyword]} to say; leave it out")
    return kwargs


def make_env(env_id: str, env_kwargs: dict[str, Any], ground_truth: bool) -> gymnasium.Env:
    """Make an environment to collect from: no time limit, checked for what a dataset needs.

    Raises:
        UsageError: it cannot be made, lacks something, or observes what a dataset does not store.
    """
    try:
        env = gymnasium.make(env_id, max_episode_steps=-1, disable_env_checker=True, **env_kwargs)
    except (gymnasium.error.Error, ModuleNotFoundError, TypeError) as error:
        raise UsageError(
            f"cannot make environment '{env_id}' with {env_kwargs}: {error}; check --env and --env-kwargs"
        ) from error
    check_env(env, env_id, ground_truth)
    return env


def describe_env(env: gymnasium.Env, env_id: str, env_kwargs: dict[str, Any]) -> dict[str, Any]:
    """The attributes of a shard that follow from the environment.

    Raises:
        UsageError: no OpenGL works, for an environment that draws with it.
    """
    inner: Any = env.unwrapped
    drawn_here = isinstance(inner, RGBDEnv)  # what draws another's pictures, only that one knows
    attrs = {
        "env_id": env_id,
        "env_kwargs": env_kwargs,
        "control_rate": float(inner.control_rate),
        "camera": inner.camera.to_dict(),
        "action_aggregation": list(inner.ACTION_AGGREGATION),
        "action_scale": [float(unit) for unit in inner.ACTION_SCALE],
        "body_names": list(getattr(inner, "body_names", [])),
        "hand_body_ids": [int(body) for body in getattr(inner, "hand_body_ids", ())],
        "versions": versions(),
        "gl_renderer": gl_renderer() if drawn_here else str(getattr(inner, "gl_renderer", "unknown")),
    }
    if getattr(inner, "workspace", None) is not None:
        attrs["workspace"] = [np.asarray(corner, float).tolist() for corner in inner.workspace]
    space = env.action_space
    if isinstance(space, gymnasium.spaces.Box) and space.is_bounded():  # JSON has no infinity
        attrs["action_bounds"] = [space.low.tolist(), space.high.tolist()]
    return attrs


def versions() -> dict[str, str | None]:
    """What an episode depends on beside its options: package versions, and `source`, a hash of this project's code."""
    digest = hashlib.sha256()
    for package in (envs, data_collection):
        for path in sorted(Path(package.__path__[0]).rglob("*.py")):
            digest.update(path.read_bytes())
    return {**{package: _version(package) for package in PACKAGES}, "source": digest.hexdigest()[:12]}


def _version(package: str) -> str | None:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None
