"""`train-policy`: train a policy with Stable-Baselines3 and hindsight relabelling, for `collect-rollouts --policy`."""

from __future__ import annotations

import dataclasses
import json
import math
import shlex
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import gymnasium
import numpy as np
from tqdm import tqdm

from data_collection.environments import KNOWN_ENVS, known_env, resolve_env
from data_collection.policies.stable_baselines import SUFFIX, load_model
from envs.command import run
from envs.errors import UsageError
from envs.files import write_json, written_aside

DISCOUNT, POLYAK, GOALS_A_STEP = 0.98, 0.05, 4  # Plappert et al. (2018), but for the discount of a shorter episode
LEARNING_STARTS = 1000  # steps before the first update
NOISE = 0.1  # standard deviation of DDPG's and TD3's exploration
NETWORK = [256, 256, 256]
MAY_CHANGE = ("out", "steps", "save_every", "trials")
"""Options that a run may go on with others of; those that it must keep are in a .json beside the policy."""


@dataclass(frozen=True)
class Config:
    """Train a goal-conditioned policy from the simulator's state, without pictures. Same command: goes on."""

    out: Path
    """The policy, a .zip file; written every `--save-every` steps and at the end. A .json beside it has the options."""
    env: str = "dexhand"
    """Environment with goals: a short name (dexhand), or a Gymnasium id."""
    algorithm: Literal["sac", "td3", "ddpg"] = "sac"
    """All learn from a replay buffer with hindsight experience replay (HER)."""
    steps: int = 1_000_000
    """Control steps, over all parts of a run that was interrupted."""
    goal_angle: float = 180.0
    """Goals are no further than this from the cube at the start, degrees (dexhand)."""
    reward: Literal["sparse", "dense"] = "sparse"
    """0 or -1, or the distance to the goal (dexhand)."""
    learning_rate: float = 1e-3
    """Adam's."""
    batch: int = 256
    """Transitions an update."""
    updates_every: int = 1
    """Steps from one update to the next."""
    buffer: int = 500_000
    """Transitions that are kept; a run that goes on begins with none."""
    save_every: int = 10_000
    """Steps from one save to the next."""
    trials: int = 20
    """Episodes to try the policy in at the end; 0 for none."""
    seed: int = 0
    """Decides goals, starts, weights and exploration; a part of a run that goes on has its own."""

    def __post_init__(self) -> None:
        for name in ("steps", "batch", "updates_every", "buffer", "save_every"):
            if getattr(self, name) < 1:
                raise UsageError(f"--{name.replace('_', '-')} is {getattr(self, name)}; give at least 1")
        for name in ("trials", "seed"):
            if getattr(self, name) < 0:
                raise UsageError(f"--{name} is {getattr(self, name)}; give 0 or more")
        if self.out.suffix != SUFFIX:
            raise UsageError(f"--out is {self.out}; give a file that ends in {SUFFIX}")
        if not 0 < self.learning_rate < math.inf:
            raise UsageError(f"--learning-rate is {self.learning_rate}; give a positive number such as 1e-3")
        for name in ("goal_angle", "reward"):
            value = getattr(self, name)
            if not _is_hand(self.env) and value != getattr(Config, name):
                raise UsageError(f"--{name.replace('_', '-')} is {value}, which is for dexhand only; leave it out")

    @property
    def options_file(self) -> Path:
        """Where the options are that a run must keep."""
        return self.out.with_suffix(".json")

    def kept_options(self) -> dict[str, Any]:
        """The options that a run must keep."""
        return {name: value for name, value in dataclasses.asdict(self).items() if name not in MAY_CHANGE}


def main(config: Config) -> None:
    """Train, save, try."""
    check_continues(config)
    env = _make_env(config)
    model = _model(config, env)
    model.set_logger(_silent())
    config.out.parent.mkdir(parents=True, exist_ok=True)
    write_json(config.options_file, config.kept_options())
    missing = config.steps - model.num_timesteps
    with tqdm(total=config.steps, initial=model.num_timesteps, unit="step", dynamic_ncols=True) as bar:
        if missing > 0:
            model.learn(missing, callback=_callback(config, bar.update), reset_num_timesteps=False)
    save(model, config.out)
    print(f"{config.out}: {model.num_timesteps} steps; use it with: {collecting(config)}")
    if config.trials:
        print(_trial(config, env, model))


def check_continues(config: Config) -> None:
    """Check that the policy and the options that are there, if any, are those that these options made.

    Raises:
        UsageError: nothing says how the policy was trained, or it was trained with other options (names the first); or
            what lies in the options' place is something else.
    """
    path, options = config.options_file, config.kept_options()
    if not path.exists():
        if config.out.exists():
            raise UsageError(
                f"{config.out} has no {path.name} beside it, so it is no run to go on with; choose another --out"
            )
        return
    try:
        before = dict(json.loads(path.read_text()))
    except (ValueError, TypeError):
        before = {}
    if before.keys() != options.keys():
        raise UsageError(f"{path} is there and does not hold the options of a policy's run; choose another --out")
    for name, asked in options.items():
        if config.out.exists() and before[name] != asked:
            raise UsageError(
                f"{config.out} was trained with {name} = {before[name]!r}, not {asked!r}; "
                "run with the same options to go on with it, or choose another --out"
            )


def collecting(config: Config) -> str:
    """The command that collects episodes with the policy, of goals like those that it was trained with."""
    words = ["collect-rollouts", "--env", config.env, "--policy", str(config.out), "--out", "DIR"]
    if config.goal_angle < Config.goal_angle:
        words += ["--env-kwargs", json.dumps({"goal_angle": config.goal_angle})]
    return shlex.join(words)


def save(model: Any, path: Path) -> None:
    """Write a model, whole or not at all."""
    with written_aside(path) as aside, aside.open("wb") as file:
        model.save(file)


def _is_hand(env: str) -> bool:
    return known_env(env) is KNOWN_ENVS["dexhand"]


def _make_env(config: Config) -> gymnasium.Env:
    env_id, env_kwargs = resolve_env(config.env, None)
    if known_env(env_id) is not None:  # another's may always be without pictures, or not know the word
        env_kwargs = {**env_kwargs, "images": False}
    if _is_hand(env_id):
        env_kwargs = {**env_kwargs, "goal_angle": config.goal_angle, "reward_type": config.reward, "new_goals": False}
    try:
        env = gymnasium.make(env_id, disable_env_checker=True, **env_kwargs)
    except (gymnasium.error.Error, ModuleNotFoundError, TypeError) as error:
        raise UsageError(f"cannot make environment '{env_id}': {error}; check --env") from error
    if not hasattr(env.unwrapped, "compute_reward"):
        raise UsageError(f"environment '{env_id}' has no goals (no compute_reward); choose one that has, as dexhand")
    assert env.spec is not None
    steps = env.spec.max_episode_steps or 0
    if config.buffer < 2 * steps:  # relabelling needs a whole episode beside the one under way
        raise UsageError(f"--buffer is {config.buffer}; give at least {2 * steps}, two episodes of '{env_id}'")
    return env


def _model(config: Config, env: gymnasium.Env) -> Any:
    """A new model, or the one that an interrupted run left."""
    import stable_baselines3 as sb3

    assert env.spec is not None
    # relabelling needs a whole episode, and the buffer starts empty also where a run goes on
    first = max(min(LEARNING_STARTS, config.steps // 2), (env.spec.max_episode_steps or 0) + 1)
    if config.out.exists():
        model = load_model(config.out, device="auto", env=env)
        model.learning_starts = model.num_timesteps + first
        # loading seeds as at the start: without others, each part of a run would begin with the same episodes
        seeds = np.random.SeedSequence((config.seed, model.num_timesteps))
        model.set_random_seed(int(seeds.generate_state(1)[0] >> 1))
        return model
    algorithm = {"sac": sb3.SAC, "td3": sb3.TD3, "ddpg": sb3.DDPG}[config.algorithm]
    assert env.action_space.shape is not None
    size = env.action_space.shape[0]
    explore: dict[str, Any] = {}
    if config.algorithm != "sac":
        from stable_baselines3.common.noise import NormalActionNoise

        explore["action_noise"] = NormalActionNoise(np.zeros(size), np.full(size, NOISE))
    return algorithm(
        "MultiInputPolicy",
        env,
        replay_buffer_class=sb3.HerReplayBuffer,
        replay_buffer_kwargs={"n_sampled_goal": GOALS_A_STEP, "goal_selection_strategy": "future"},
        learning_rate=config.learning_rate,
        batch_size=config.batch,
        train_freq=config.updates_every,
        buffer_size=config.buffer,
        learning_starts=first,
        gamma=DISCOUNT,
        tau=POLYAK,
        policy_kwargs={"net_arch": NETWORK},
        seed=config.seed,
        device="auto",
        **explore,
    )


def _silent() -> Any:
    """A logger for nobody: the usual one would write nothing either, but leaves an empty folder in /tmp each time."""
    from stable_baselines3.common.logger import Logger

    return Logger(None, [])


def _callback(config: Config, update: Callable[[int], Any]) -> Any:
    from stable_baselines3.common.callbacks import BaseCallback

    class Progress(BaseCallback):
        """Says how far it is, saves now and then."""

        def _on_step(self) -> bool:
            update(1)
            if self.num_timesteps % config.save_every == 0:
                save(self.model, config.out)
            return True

    return Progress()


def _trial(config: Config, env: gymnasium.Env, model: Any) -> str:
    """What the policy achieves, in words."""
    reached, first, last, dropped = 0, [], [], 0
    for number in range(config.trials):
        obs, info = env.reset(seed=config.seed + 10_000 + number)
        first.append(info.get("rotation_error", np.nan))
        over = False
        while not over:
            obs, _, terminated, truncated, info = env.step(model.predict(obs, deterministic=True)[0])
            over = terminated or truncated
        reached += bool(info.get("is_success", False))
        dropped += bool(info.get("is_dropped", False))
        last.append(info.get("rotation_error", np.nan))
    said = f"in {config.trials} episodes: goal reached at the end of {reached}"
    if not _is_hand(config.env):
        return said
    start, end = np.degrees(np.median(first)), np.degrees(np.median(last))
    return f"{said}, dropped in {dropped}; median rotation error {start:.0f} degrees at the start, {end:.0f} at the end"


def command() -> None:
    """Entry point of `train-policy`."""
    run(Config, main)
