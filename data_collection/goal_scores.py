"""`python -m data_collection.goal_scores --out goals.jsonl`: how well policies bring the cube in the hand to a goal."""

from __future__ import annotations

import json
import multiprocessing
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from data_collection.policies import POLICIES, Policy, make_policy
from data_collection.policies.stable_baselines import SUFFIX, policy_name
from envs.command import run
from envs.dexhand import DexHandEnv
from envs.errors import UsageError

EARLY = 25  # control steps, as long as a clip of the DexHand data
HOLD = "hold"


@dataclass(frozen=True)
class Config:
    """Let policies act in episodes of the dexterous hand; the same starts and goals for all. Same command: goes on."""

    out: Path
    """What happened, a line of JSON an episode."""
    policies: tuple[str, ...] = ("predictive", "random", HOLD)
    """Names as for collect-rollouts, files of Stable-Baselines3, and `hold`: stay as you are."""
    episodes: int = 40
    """Of each policy."""
    steps: int = 100
    """Control steps in an episode."""
    goal_angle: float = 90.0
    """Goals are no further than this from the cube at the start, degrees."""
    seed: int = 0
    """With the number of an episode it fixes the start and the goal."""
    workers: int = 2
    """Processes."""

    def __post_init__(self) -> None:
        for name, least in (("episodes", 1), ("steps", 1), ("workers", 1), ("seed", 0)):
            if getattr(self, name) < least:
                raise UsageError(f"--{name} is {getattr(self, name)}; give a whole number of at least {least}")
        for name in self.policies:
            if name not in (*POLICIES, HOLD) and not name.endswith(SUFFIX):
                raise UsageError(f"no policy named '{name}'; choose from {', '.join((*POLICIES, HOLD))}, or a {SUFFIX}")


class HoldPolicy:
    """Stays as it is."""

    def reset(self, env: gymnasium.Env, rng: np.random.Generator) -> None:
        self._env: Any = env.unwrapped

    def act(self, obs: dict[str, Any]) -> NDArray[Any]:
        return self._env.last_action.astype(np.float32)


def main(config: Config) -> None:
    """Run what is missing, then print a table."""
    common = {"steps": config.steps, "goal_angle": config.goal_angle, "seed": config.seed}
    tasks = [{"policy": name, "episode": n, **common} for name in config.policies for n in range(config.episodes)]
    done = [json.loads(line) for line in config.out.read_text().splitlines()] if config.out.exists() else []
    there = [{key: row[key] for key in ("policy", "episode", *common)} for row in done]
    missing = [task for task in tasks if task not in there]
    if missing:
        config.out.parent.mkdir(parents=True, exist_ok=True)
        with multiprocessing.get_context("spawn").Pool(config.workers) as pool, config.out.open("a") as file:
            for row in pool.imap(play, missing):
                file.write(json.dumps(row) + "\n")
                file.flush()
                done.append(row)
    asked = [row for row in done if {key: row[key] for key in ("policy", "episode", *common)} in tasks]
    print("\n".join(table(config.policies, asked)))


def play(task: dict[str, Any]) -> dict[str, Any]:
    """One episode: the task, and rotation errors (rad) before each step and at the end, and whether it was dropped.

    Args:
        task: policy, episode, steps, goal_angle, seed.
    """
    env = DexHandEnv(goal_angle=task["goal_angle"], images=False)
    starts, own = np.random.SeedSequence((task["seed"], task["episode"])).spawn(2)
    obs, info = env.reset(seed=int(starts.generate_state(1)[0] >> 1))
    policy = _policy(task["policy"])
    policy.reset(env, np.random.default_rng(own))
    errors, seconds = [info["rotation_error"]], time.process_time()
    for _ in range(task["steps"]):
        obs, _, terminated, _, info = env.step(policy.act(obs))
        errors.append(info["rotation_error"])
        if terminated:
            break
    seconds = (time.process_time() - seconds) / (len(errors) - 1)
    env.close()
    return {**task, "dropped": info["is_dropped"], "seconds_a_step": seconds, "errors": [round(e, 4) for e in errors]}


def table(policies: tuple[str, ...], rows: list[dict[str, Any]]) -> Iterator[str]:
    """Markdown: medians over the episodes of each policy; the error of a dropped cube is that of its last moment."""
    yield f"| policy | episodes | at the start | after {EARLY} steps | at the end | reached | dropped | CPU ms a step |"
    yield "|---|---|---|---|---|---|---|---|"
    for name in policies:
        own = [row for row in rows if row["policy"] == name]
        steps = max(row["steps"] for row in own)
        errors = np.degrees([row["errors"] + row["errors"][-1:] * (steps + 1 - len(row["errors"])) for row in own])
        start, early, end = (np.median(errors[:, step]) for step in (0, min(EARLY, steps), steps))
        reached = np.mean(errors.min(axis=1) < np.degrees(0.2))
        dropped, seconds = (np.mean([row[key] for row in own]) for key in ("dropped", "seconds_a_step"))
        yield (
            f"| {name} | {len(own)} | {start:.0f} | {early:.0f} | {end:.0f} | {reached:.0%} | {dropped:.0%} | "
            f"{1000 * seconds:.0f} |"
        )


def _policy(name: str) -> Policy:
    if name == HOLD:
        return HoldPolicy()
    return make_policy(policy_name(Path(name)) if name.endswith(SUFFIX) else name)


if __name__ == "__main__":
    run(Config, main)
