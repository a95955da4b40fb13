"""Uniformly random actions."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray


class RandomPolicy:
    """Every action number uniform over its range, independent from step to step."""

    def reset(self, env: gymnasium.Env, rng: np.random.Generator) -> None:
        space = env.action_space
        assert isinstance(space, gymnasium.spaces.Box)
        self._low, self._high, self._rng = space.low, space.high, rng

    def act(self, obs: dict[str, Any]) -> NDArray[Any]:
        return self._rng.uniform(self._low, self._high).astype(np.float32)
