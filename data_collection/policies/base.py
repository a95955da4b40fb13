"""What the collector asks of a policy."""

from __future__ import annotations

from typing import Any, Protocol

import gymnasium
import numpy as np
from numpy.typing import NDArray


class Policy(Protocol):
    """Chooses actions for one episode at a time; all its randomness comes from the generator of `reset`."""

    def reset(self, env: gymnasium.Env, rng: np.random.Generator) -> None:
        """Start an episode in `env`, which has just been reset; a privileged policy may look into `env.unwrapped`."""

    def act(self, obs: dict[str, Any]) -> NDArray[Any]:
        """The action (A,) to execute on this observation; the collector clips it to the action space."""
