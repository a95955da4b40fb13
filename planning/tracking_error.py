"""`python -m planning.tracking_error`: how far the point tracker is off while things are moved, by the simulator."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from data_collection.policies.push import PushPolicy
from envs import command
from envs.errors import UsageError
from planning.costs import env_action
from planning.drawer_setups import gap
from planning.episode import mark_of
from planning.followers import SurfaceFollower
from planning.tasks import TASKS

Act = Callable[[dict[str, Any]], NDArray]


@dataclass(frozen=True)
class Config:
    """Follow designated points while a scripted mover, who sees everything, pushes or pulls the things they are on."""

    episodes: int = 20
    """setups of each kind"""
    steps: int = 100
    """control steps in each"""
    seed: int = 1
    """of the setups"""

    def __post_init__(self) -> None:
        for name in ("episodes", "steps"):
            if getattr(self, name) < 1:
                raise UsageError(f"--{name} is {getattr(self, name)}; give at least 1")
        if self.seed < 0:
            raise UsageError(f"--seed is {self.seed}; give 0 or more")


def main(config: Config) -> None:
    """Measure and print, a line for each kind of point."""
    movers = {("planar-push", "object"): pusher, ("tabletop", "drawer"): slider}
    print("env point episodes way-mm mean-mm 95%-mm worst-mm")
    for (env_name, point), mover in movers.items():
        task = TASKS[env_name, point]
        env = task.make_env(task.scenes[0], 64)
        errors, ways = [], []
        for index in range(config.episodes):
            setup = task.make_setup(env, index, config.seed)
            observation = setup.start(env)
            mark, act = mark_of(setup), mover(env, np.random.default_rng((config.seed, index)))
            start = setup.goal.designated
            assert mark is not None and start is not None and task.surface is not None  # points on things
            follower = SurfaceFollower(env.unwrapped.camera, task.surface)  # type: ignore[attr-defined]
            follower.reset(observation, setup.goal)
            for _ in range(config.steps):
                observation, *_ = env.step(act(observation))
                follower.observe(observation)
                errors.append(1e3 * np.linalg.norm(follower.point - mark.position(env)))
                ways.append(1e3 * np.linalg.norm(mark.position(env) - start))
        env.close()
        numbers = [np.max(ways), np.mean(errors), np.quantile(errors, 0.95), np.max(errors)]
        print(env_name, point, config.episodes, *(f"{number:.1f}" for number in numbers))


def pusher(env: gym.Env, rng: np.random.Generator) -> Act:
    """Pushes the object about, as the data was made."""
    policy = PushPolicy()
    policy.reset(env, rng)
    return policy.act


def slider(env: gym.Env, rng: np.random.Generator) -> Act:
    """Lowers the hand into the gap behind the handle, then slides the drawer to and fro."""
    inner: Any = env.unwrapped
    period, phase = rng.uniform(30, 60), rng.uniform(-np.pi, np.pi)
    step = 0

    def act(observation: dict[str, Any]) -> NDArray:
        nonlocal step
        above = (inner.tcp_position - gap(inner))[2]
        step += above < 0.01
        slide = 0.7 * np.sin(2 * np.pi * step / period + phase) if step else 0.0
        return env_action(np.array([0.0, slide, np.clip(-above / 0.02, -1, 1)]), -1.0)

    return act


if __name__ == "__main__":
    command.run(Config, main)
