"""`python -m data_collection.goal_scores --out goals.jsonl`: how well policies bring the cube in the hand to a goal."""

from __future__ import annotations

import json
import multiprocessing
import os
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
FIELDS = {"policy", "episode", "steps", "goal_angle", "seed", "reached", "dropped", "seconds_a_step", "errors"}
"""What is recorded of an episode."""


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
    policies = tuple(policy_name(Path(name)) if name.endswith(SUFFIX) else name for name in config.policies)
    tasks = [{"policy": name, "episode": n, **common} for name in policies for n in range(config.episodes)]
    done = read_rows(config.out) if config.out.exists() else []
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
    print("\n".join(table(policies, asked)))


def read_rows(path: Path) -> list[dict[str, Any]]:
    """The episodes that are in a file; a last line that a killed process left unfinished is cut off.

    Raises:
        UsageError: a line is no episode of this program.
    """
    content = path.read_bytes()
    end = content.rfind(b"\n") + 1
    rows = []
    for number, line in enumerate(content[:end].splitlines(), 1):
        try:
            row = json.loads(line)
        except ValueError as error:
            raise UsageError(f"{path}, line {number} is no episode ({error}); remove that line") from error
        if not isinstance(row, dict) or not row.keys() >= FIELDS:
            raise UsageError(f"{path}, line {number} is no episode as it is recorded now; give another --out")
        rows.append(row)
    if end < len(content):
        os.truncate(path, end)
    return rows


def play(task: dict[str, Any]) -> dict[str, Any]:
    """One episode: the task, rotation errors (rad) before each step and at the end, whether a step reached the goal as
    the environment means it, by angle and place, and whether the cube was dropped.

    Args:
        task: policy (a name, or what `policy_name` gives), episode, steps, goal_angle, seed.
    """
    env = DexHandEnv(goal_angle=task["goal_angle"], images=False)
    starts, own = np.random.SeedSequence((task["seed"], task["episode"])).spawn(2)
    obs, info = env.reset(seed=int(starts.generate_state(1)[0] >> 1))
    policy = _policy(task["policy"])
    policy.reset(env, np.random.default_rng(own))
    errors, reached, seconds = [info["rotation_error"]], False, time.process_time()
    for _ in range(task["steps"]):
        obs, _, terminated, _, info = env.step(policy.act(obs))
        errors.append(info["rotation_error"])
        reached = reached or info["is_success"]
        if terminated:
            break
    seconds = (time.process_time() - seconds) / (len(errors) - 1)
    env.close()
    ended = {"reached": reached, "dropped": info["is_dropped"], "seconds_a_step": seconds}
    return {**task, **ended, "errors": [round(e, 4) for e in errors]}


def table(policies: tuple[str, ...], rows: list[dict[str, Any]]) -> Iterator[str]:
    """Markdown: medians over the episodes of each policy; the error of a dropped cube is that of its last moment."""
    yield f"| policy | episodes | at the start | after {EARLY} steps | at the end | reached | dropped | CPU ms a step |"
    yield "|---|---|---|---|---|---|---|---|"
    for name in policies:
        own = [row for row in rows if row["policy"] == name]
        steps = max(row["steps"] for row in own)
        errors = np.degrees([row["errors"] + row["errors"][-1:] * (steps + 1 - len(row["errors"])) for row in own])
        start, early, end = (np.median(errors[:, step]) for step in (0, min(EARLY, steps), steps))
        reached, dropped, seconds = (
            np.mean([row[key] for row in own]) for key in ("reached", "dropped", "seconds_a_step")
        )
        yield (
            f"| {name} | {len(own)} | {start:.0f} | {early:.0f} | {end:.0f} | {reached:.0%} | {dropped:.0%} | "
            f"{1000 * seconds:.0f} |"
        )


def _policy(name: str) -> Policy:
    return HoldPolicy() if name == HOLD else make_policy(name)


if __name__ == "__main__":
    run(Config, main)
