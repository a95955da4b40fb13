"""`servo-eval`: how often controllers bring a point to where it shall be, on the same setups for all of them."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import gymnasium as gym
import numpy as np
import tyro
from tqdm import tqdm

import envs.command
from envs.errors import UsageError
from envs.files import locked, write_json
from planning.comparison import difference_table, differences, success_chart
from planning.controllers import CONTROLLERS, LEARNED, PIXEL_MODELS, Kit
from planning.episode import Record, mark_of, run_episode
from planning.film import Film, Studio, film_path, is_filmed
from planning.filmstrip import filmstrip
from planning.icem import ICEMConfig
from planning.records import EpisodeLog
from planning.report import summarise, table
from planning.setups import Setup
from planning.tasks import TASKS, Task
from worldmodel.memory import keep_freed_memory

EPISODES = 50  # per model, unless the command says otherwise
EPISODE_ENTROPY = 0xE9150DE  # sets the planners' randomness apart from the setups'


@dataclass(frozen=True)
class ServoConfig:
    """Let controllers servo a point to random goals in 3D and report how often it arrives.

    The point is the hand's, or lies on a thing that has to be pushed or pulled there. An episode succeeds if it is near
    its goal for at least 5 control steps: the hand within 10 % of its initial distance, a thing within 20 mm. The same
    command again goes on where a stopped run ended.
    """

    out: Path = Path("runs/servo")
    """folder for servo.json, episodes.jsonl, the charts and the videos"""
    env: Literal["tabletop", "planar-push"] = "tabletop"
    """environment; the shipped models are those that were trained for it"""
    point: Literal["hand", "drawer", "object"] = "hand"
    """whose point is to reach the goal: the hand or the drawer of the tabletop, the object of planar-push"""
    model: tuple[str, ...] = ("t3vip",)
    """controllers to compare: t3vip plans in 3D; sv2p, sna and cdna are given the goal's pixel only; oracle plans in
    the simulator; linear, proportional and random have no world model"""
    checkpoint: tuple[str, ...] = ()
    """weights to use instead of the shipped ones: a checkpoint folder, or MODEL=FOLDER for each of several models"""
    episodes: int | None = None
    """episodes per model, each in a setup of its own; 50 unless --setups says otherwise"""
    setups: int | None = None
    """distinct setups; with --repeats in place of --episodes"""
    repeats: int = 1
    """episodes per setup; --setups 10 --repeats 5 is the paper's protocol"""
    scene: str = TASKS["tabletop", "hand"].scenes[0]
    """tabletop: A, B, C or D; planar-push: objects of train, validation, test or all. No shipped model has seen D or
    test"""
    steps: int = TASKS["tabletop", "hand"].steps
    """budget of control steps per episode"""
    whole_episodes: bool = False
    """go on to the last step, to find out where the point stays. Otherwise an episode ends once the tightest limit is
    met, and the distance is one of that moment"""
    seed: int = 0
    """of the setups and the planners"""
    image_size: int = 64
    """pixels; what the world model was trained on"""
    hold: int = 3
    """control steps that a planned translation is held for where no world model's frame gap says so"""
    planner: Annotated[ICEMConfig, tyro.conf.arg(name="planner")] = field(
        default_factory=lambda: TASKS["tabletop", "hand"].planner
    )
    deadline: float | None = None
    """seconds after which a plan must be there"""
    video: int = 0
    """episodes per model to film, finished ones too; with t3vip and a pixel model also a film strip of both"""
    device: str = "cpu"
    """where world models run, e.g. cpu or cuda"""

    def __post_init__(self) -> None:
        if (self.env, self.point) not in TASKS:
            known = " or ".join(point for env, point in TASKS if env == self.env)
            raise UsageError(f"--point is {self.point}, but {self.env} has only {known}; choose one of its points")
        if self.scene not in self.task.scenes:
            raise UsageError(f"--scene is {self.scene}; {self.env} has {', '.join(sorted(self.task.scenes))}")
        for name in self.model:
            if name not in CONTROLLERS:
                raise UsageError(f"unknown model '{name}'; known are {', '.join(CONTROLLERS)}")
        if not self.model or len(set(self.model)) < len(self.model):
            raise UsageError(f"--model is {' '.join(self.model) or 'empty'}; name each model once")
        for option in ("episodes", "setups", "repeats", "steps", "image_size", "hold"):
            value = getattr(self, option)
            if value is not None and value < 1:
                raise UsageError(f"--{option.replace('_', '-')} is {value}; give at least 1")
        if self.episodes is not None and self.setups is not None:
            raise UsageError(
                f"--episodes is {self.episodes} and --setups is {self.setups}; give one of them, --repeats with either"
            )
        if self.seed < 0 or self.video < 0:
            raise UsageError(f"--seed is {self.seed}, --video is {self.video}; give 0 or more")
        if self.deadline is not None and not self.deadline > 0:
            raise UsageError(f"--deadline is {self.deadline}; give a positive number of seconds")
        self.checkpoints()

    @property
    def task(self) -> Task:
        """What is asked for."""
        return TASKS[self.env, self.point]

    def checkpoints(self) -> dict[str, str]:
        """World model -> its weights, as given.

        Raises:
            UsageError: weights for no model of this run, or for one model twice.
        """
        learned = [name for name in self.model if name in LEARNED]
        given: dict[str, str] = {}
        for entry in self.checkpoint:
            name, separator, path = entry.partition("=")
            if not separator:
                if len(learned) != 1:
                    raise UsageError(
                        f"--checkpoint {entry} fits {' or '.join(learned) or 'no model of this run'};"
                        " say MODEL=FOLDER for a model that learns"
                    )
                name, path = learned[0], entry
            if name not in learned:
                raise UsageError(f"--checkpoint {entry} is for '{name}'; learned models of this run: {learned}")
            if name in given:
                raise UsageError(f"--checkpoint {entry} is a second one for '{name}'; give one folder per model")
            given[name] = path
        return given

    def attempts(self) -> list[tuple[int, int]]:
        """(setup, repeat) of every episode of a model."""
        episodes = self.setups * self.repeats if self.setups is not None else self.episodes or EPISODES
        return [divmod(episode, self.repeats) for episode in range(episodes)]


def main(config: ServoConfig) -> None:
    """Run what is missing, then report on everything."""
    keep_freed_memory()
    task = config.task
    env = task.make_env(config.scene, config.image_size)
    studio = Studio(env, task.zoom)
    kit = Kit(
        env,
        config.planner,
        config.hold,
        config.checkpoints(),
        config.device,
        config.deadline,
        body=task.body,
        surface=task.surface,
        reach=task.reach,
    )
    try:
        learned = {name: kit.model(name) for name in config.model if name in LEARNED}
        kit.hold = common_gap(learned) or config.hold
        config.out.mkdir(parents=True, exist_ok=True)
        with locked(config.out):
            log = EpisodeLog(config.out, settings(config, kit.hold, learned))
            for record in run_missing(config, env, studio, kit, log):
                log.append(record)
            report(config, log)
    finally:
        kit.close()
        studio.close()
        env.close()


def common_gap(learned: dict[str, Any]) -> int | None:
    """The frame gap of the world models, None without any.

    Raises:
        UsageError: they differ. Then one would decide more often than another, and look less far ahead.
    """
    gaps = {name: model.frame_gap for name, model in learned.items()}
    if len(set(gaps.values())) > 1:
        listed = ", ".join(f"{name} {gap}" for name, gap in gaps.items())
        raise UsageError(f"the models' frame gaps differ ({listed}); give checkpoints of one frame gap")
    return next(iter(gaps.values()), None)


def settings(config: ServoConfig, hold: int, learned: dict[str, Any]) -> dict[str, Any]:
    """What an episode's outcome depends on, apart from its model, setup and repeat."""
    kept = {name: getattr(config, name) for name in ("scene", "steps", "seed", "image_size", "deadline")}
    if config.task.surface is not None:  # the hand's folders are older and do not say
        kept |= {
            "env": config.env,
            "point": config.point,
            "reach": asdict(config.task.reach) if config.task.reach else None,
        }
    kept |= {"whole_episodes": True} if config.whole_episodes else {}  # older folders do not say, either
    weights = {name: weights_hash(model) for name, model in learned.items()}
    return {**kept, "hold": hold, "planner": asdict(config.planner), "checkpoints": weights}


def weights_hash(model: Any) -> str:
    """Names a model by its weights."""
    digest = hashlib.sha256()
    for name, tensor in sorted(model.state_dict().items()):
        digest.update(name.encode())
        digest.update(tensor.detach().cpu().float().numpy().tobytes())
    return digest.hexdigest()[:16]


def run_missing(config: ServoConfig, env: gym.Env, studio: Studio, kit: Kit, log: EpisodeLog) -> Iterator[Record]:
    """The episodes that the log does not hold yet, setup by setup, all models on the same one.

    Those that it holds without the film that is asked for are run again for it, and are not given.
    """
    todo = [
        (setup, repeat, name)
        for setup, repeat in config.attempts()
        for name in config.model
        if (name, setup, repeat) not in log.records or lacks_film(config, log.records[name, setup, repeat])
    ]
    done = len(config.model) * len(config.attempts()) - len(todo)
    setup: Setup | None = None
    with tqdm(todo, total=done + len(todo), initial=done, unit="episode", desc="servo") as progress:
        for index, repeat, name in progress:
            if setup is None or setup.index != index:
                setup = config.task.make_setup(env, index, config.seed)
            entropy = (EPISODE_ENTROPY, config.seed, index, repeat)
            kit.begin(mark_of(setup), np.random.default_rng(np.random.SeedSequence(entropy)))
            film = Film(studio, setup, name) if wants_film(config, index, repeat) else None
            watch = film.watch if film is not None else None
            controller, whole = CONTROLLERS[name](kit), config.whole_episodes
            record = run_episode(env, setup, name, controller, config.steps, repeat, watch, whole)
            if film is not None:
                film.save(film_path(config.out / "videos", record))
            progress.set_postfix_str(f"{name}: {100 * record.final_distance:.1f} cm left")
            if (name, index, repeat) not in log.records:
                yield record


def wants_film(config: ServoConfig, setup: int, repeat: int) -> bool:
    """Whether an episode is one of the first that are to be filmed."""
    return setup * config.repeats + repeat < config.video


def lacks_film(config: ServoConfig, record: Record) -> bool:
    """Whether a finished episode is to be filmed and is not."""
    return wants_film(config, record.setup, record.repeat) and not is_filmed(film_path(config.out / "videos", record))


def report(config: ServoConfig, log: EpisodeLog) -> None:
    """Write servo.json and the chart; print the table. Only the episodes that this command asks for count."""
    attempts = config.attempts()
    records = {name: [log.records[name, setup, repeat] for setup, repeat in attempts] for name in config.model}
    models = {name: summarise(of_model, config.whole_episodes) for name, of_model in records.items()}
    paired = differences(records)
    title = f"{config.task.where.replace('{scene}', config.scene)}, {len(attempts)} episodes each"
    asked = {name: getattr(config, name) for name in ("env", "point", "scene", "seed")}
    document = {**asked, "models": models, "t3vip_less": paired}
    write_json(config.out / "servo.json", document)
    written = ["servo.json", "episodes.jsonl", "success.png"]
    success_chart(models, config.out / "success.png", title)
    print(table(models))
    if paired:
        print(f"\n{difference_table(paired)}\n")
    rivals = [name for name in config.model if name in PIXEL_MODELS]
    if "t3vip" in records and rivals and config.video:
        filmed = {name: records[name][: config.video] for name in ("t3vip", rivals[0])}
        if filmstrip(config.out / "videos", filmed, config.out / "filmstrip.png"):
            written.append("filmstrip.png")
    print(f"written to {config.out}: {', '.join(written)}")


def usual_options(arguments: Sequence[str]) -> ServoConfig:
    """The options that hold for the environment and the point that a command line names.

    Raises:
        UsageError: there is no such task.
    """
    env = envs.command.given(arguments, "--env") or "tabletop"
    points = [point for known, point in TASKS if known == env]
    point = envs.command.given(arguments, "--point") or (points[0] if points else "")
    if point not in points:
        known = ", ".join(f"--env {env} --point {point}" for env, point in TASKS)
        raise UsageError(f"nothing is known of --env {env} --point {point or 'object'}; there is {known}")
    task = TASKS[env, point]
    return ServoConfig(env=env, point=point, scene=task.scenes[0], steps=task.steps, planner=task.planner)  # type: ignore[arg-type]


def command() -> None:
    """Console script."""
    envs.command.run(ServoConfig, main, default=usual_options)


if __name__ == "__main__":
    command()
