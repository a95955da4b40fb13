"""Any policy that Stable-Baselines3 trained, from its zip file.

Such a file holds pickled Python objects: loading one runs what is in it, so load only what you trust.
"""

from __future__ import annotations

import functools
import hashlib
import importlib
import json
import zipfile
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from envs.errors import UsageError

SUFFIX = ".zip"
ALGORITHMS = {
    "stable_baselines3.sac.policies": ("stable_baselines3", "SAC"),
    "stable_baselines3.td3.policies": ("stable_baselines3", "TD3"),  # and DDPG's, which is TD3 without its additions
    "stable_baselines3.common.policies": ("stable_baselines3", "PPO"),  # and A2C's
    "sb3_contrib.tqc.policies": ("sb3_contrib", "TQC"),
}
"""The module of a policy's class -> where the algorithm is that can load it."""
NOT_NEEDED: dict[str, object] = {"replay_buffer_class": None, "replay_buffer_kwargs": {}, "buffer_size": 1}
"""What training had and acting has no use for; HER's buffer could not even be made without an environment."""


def policy_name(path: Path) -> str:
    """How a dataset names a policy file: its path, and a digest, so that nobody goes on with another by mistake.

    Raises:
        UsageError: there is no such file.
    """
    if not path.is_file():
        raise UsageError(f"there is no policy file {path}; make one with train-policy, or name a policy")
    return f"{path}#{_digest(path)}"


def without_folder(name: str) -> str:
    """A policy's name without the folder of its file: the same for the same file, wherever it is named from."""
    return Path(name).name if "#" in name else name


class StableBaselinesPolicy:
    """Acts as trained, without exploration.

    Args:
        name: from `policy_name`.

    Raises:
        UsageError: the file is not there, is another one by now, or is none of Stable-Baselines3's.
    """

    def __init__(self, name: str) -> None:
        self._path, self._model = _load_once(name)

    def reset(self, env: gymnasium.Env, rng: np.random.Generator) -> None:
        """Start an episode.

        Raises:
            UsageError: the policy was trained for other observations or actions.
        """
        wanted, action = self._model.observation_space, self._model.action_space
        offered = getattr(env.observation_space, "spaces", {})
        self._keys = tuple(getattr(wanted, "spaces", {}))
        missing = sorted(set(self._keys) - set(offered))
        if not self._keys or missing:
            raise UsageError(
                f"{self._path} observes {missing or wanted}, which this environment does not offer (it has "
                f"{', '.join(offered)}); train the policy in the environment that it shall act in"
            )
        for key in self._keys:
            if not _same_shape(wanted[key], offered[key]):
                raise UsageError(
                    f"{self._path} observes {key} of shape {wanted[key].shape}, this environment has "
                    f"{offered[key].shape}; give the environment that the policy was trained in (--image-size for rgb "
                    "and depth)"
                )
        if action.shape != env.action_space.shape:
            raise UsageError(
                f"{self._path} gives actions {action.shape}, the environment takes {env.action_space.shape}"
            )

    def act(self, obs: dict[str, Any]) -> NDArray[Any]:
        """The action that the policy thinks best."""
        return self._model.predict({key: obs[key] for key in self._keys}, deterministic=True)[0]


def _same_shape(wanted: gymnasium.Space, offered: gymnasium.Space) -> bool:
    """Whether they agree; Stable-Baselines3 trains on pictures with their channels first, and turns ours round."""
    shape = wanted.shape or ()
    return offered.shape in (shape, (*shape[1:], *shape[:1]))


@functools.lru_cache(maxsize=1)  # a worker makes a new policy for each episode
def _load_once(name: str) -> tuple[Path, Any]:
    path, _, digest = name.rpartition("#")
    if not Path(path).is_file() or _digest(Path(path)) != digest:
        raise UsageError(f"{path} is not the policy it was when this dataset was begun; choose another --out")
    return Path(path), load_model(Path(path))


def load_model(path: Path, device: str = "cpu", **changes: Any) -> Any:
    """The Stable-Baselines3 model of a zip file.

    Args:
        path: of the file.
        device: PyTorch's name of it, or "auto".
        changes: passed on to the algorithm's `load`; without any, what only training needs is left out.

    Raises:
        UsageError: it is none.
    """
    try:
        with zipfile.ZipFile(path) as file:
            policy = json.loads(file.read("data"))["policy_class"]
        if policy["__module__"] not in ALGORITHMS:
            raise ValueError(f"its policy is of the class {policy.get('__name__')} of {policy['__module__']}")
        package, algorithm = ALGORITHMS[policy["__module__"]]
        loader = getattr(importlib.import_module(package), algorithm)
        return loader.load(path, device=device, **(changes or {"custom_objects": NOT_NEEDED}))
    except (OSError, zipfile.BadZipFile, KeyError, TypeError, ValueError, ImportError, AttributeError) as error:
        known = ", ".join(name for _, name in ALGORITHMS.values())
        raise UsageError(
            f"{path} is no policy that can be loaded here ({_said(error)}); give a zip of {known}"
        ) from error


def _said(error: Exception) -> str:
    return str(error) if type(error) is ValueError else repr(error)


def _digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()[:12]
