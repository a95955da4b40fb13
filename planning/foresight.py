"""`python -m planning.foresight`: what T3VIP foresees of plans, beside what the simulator makes of them.

To be looked at before a model is let plan. A model may predict the data well and yet believe that a thing goes along
wherever the end-effector goes, because in the data it did.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
import scipy  # its parts load when they are used
from numpy.typing import NDArray
from tqdm import tqdm

from envs import command
from envs.errors import UsageError
from envs.files import write_json
from planning.controllers.base import Observation
from planning.controllers.kit import Kit
from planning.controllers.oracle import OracleController
from planning.controllers.t3vip import T3VIPController
from planning.episode import mark_of
from planning.marks import point_position
from planning.tasks import TASKS
from worldmodel.tracking import Track

Array = NDArray[np.float64]
WAYS = ((0.0, 0.001), (0.001, 0.02), (0.02, 0.05), (0.05, np.inf))
"""Plans are told apart by how far they truly take the point, metres."""
LEAST_SPREAD = 0.001  # m, standard deviation of the costs of plans below which their order says nothing
PLAN_ENTROPY = 0xF05E516E  # sets the seeds of the plans apart from the planners'
BEND = 0.3  # how far a plan's direction strays from one move to the next


@dataclass(frozen=True)
class Config:
    """Compare what T3VIP foresees with what the simulator does, for random plans along the oracle's way to the goal."""

    env: Literal["tabletop", "planar-push"] = "planar-push"
    """environment"""
    point: Literal["hand", "drawer", "object"] = "object"
    """whose point"""
    checkpoint: str | None = None
    """weights; the shipped ones by default"""
    episodes: int = 5
    """setups in which the oracle servoes"""
    decisions: int = 10
    """of the oracle in each, at which plans are compared"""
    plans: int = 64
    """at each decision: of all directions and speeds, bending slowly"""
    seed: int = 1
    """of setups and plans"""
    out: Path | None = None
    """JSON file to write the table to"""

    def __post_init__(self) -> None:
        if (self.env, self.point) not in TASKS:
            known = ", ".join(f"--env {env} --point {point}" for env, point in TASKS)
            raise UsageError(f"nothing is known of --env {self.env} --point {self.point}; there is {known}")
        for name in ("episodes", "decisions", "plans"):
            if getattr(self, name) < 1:
                raise UsageError(f"--{name} is {getattr(self, name)}; give at least 1")
        if self.seed < 0:
            raise UsageError(f"--seed is {self.seed}; give 0 or more")


class Onlooker(T3VIPController):
    """Sees what another controller sees and is told what that one does.

    Attributes:
        told: action of the environment, to be set before each `act`.
        foresee: what it would foresee of plans from the last frame on; see `T3VIPController.foresight`.
    """

    told: NDArray[np.float32]
    foresee: Callable[[NDArray], list[Track]]

    def decide(self, observation: Observation) -> NDArray:
        self.watch(observation)
        self.foresee = self.foresight(observation)
        self.executed.append(self.held(self.told))
        return np.zeros(self.effector.axes)


@dataclass
class Comparison:
    """Ways (N, 3) that plans take the point, metres, and how well costs agree."""

    true: list[Array] = field(default_factory=list)
    foreseen: list[Array] = field(default_factory=list)
    rank_correlations: list[float] = field(default_factory=list)

    def add(self, true: Array, foreseen: Array, costs: tuple[Array, Array]) -> None:
        """Of one decision: ways (N, 3) of the point, and costs (N,), true and foreseen."""
        self.true.append(true)
        self.foreseen.append(foreseen)
        if min(cost.std() for cost in costs) > LEAST_SPREAD:
            self.rank_correlations.append(float(scipy.stats.spearmanr(*costs).statistic))

    def table(self) -> dict[str, Any]:
        """Means over plans, by how far they truly take the point."""
        true, foreseen = np.concatenate(self.true), np.concatenate(self.foreseen)
        length, seen = np.linalg.norm(true, axis=1), np.linalg.norm(foreseen, axis=1)
        error = np.linalg.norm(foreseen - true, axis=1)
        cosine = (true * foreseen).sum(1) / np.maximum(length * seen, 1e-9)
        rows = []
        for low, high in WAYS:
            some = (length >= low) & (length < high)
            if some.any():
                means = (float(values[some].mean()) for values in (length, seen, error, cosine))
                names = ("true_m", "foreseen_m", "error_m", "cosine")
                rows.append({"from_m": low, "to_m": high if np.isfinite(high) else None, "plans": int(some.sum())})
                rows[-1] |= dict(zip(names, means, strict=True))
        correlation = float(np.mean(self.rank_correlations)) if self.rank_correlations else None
        return {"ways": rows, "rank_correlation": correlation, "decisions": len(self.rank_correlations)}


def random_plans(rng: np.random.Generator, count: int, horizon: int, axes: int, limit: float) -> Array:
    """Plans (count, horizon, axes) of one speed each, in random directions that bend a little."""
    direction = rng.normal(size=(count, axes))
    moves = []
    for _ in range(horizon):
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        moves.append(direction)
        direction = direction + BEND * rng.normal(size=direction.shape)
    return np.stack(moves, axis=1) * rng.uniform(0.2, 1.0, (count, 1, 1)) * limit


def compare(config: Config) -> dict[str, Any]:
    """The table of `Comparison`."""
    task = TASKS[config.env, config.point]
    env = task.make_env(task.scenes[0], 64)
    given = {} if config.checkpoint is None else {"t3vip": config.checkpoint}
    kit = Kit(env, task.planner, checkpoints=given, body=task.body, surface=task.surface, reach=task.reach)
    found, rng = Comparison(), np.random.default_rng(np.random.SeedSequence((PLAN_ENTROPY, config.seed)))
    try:
        model = kit.model("t3vip")
        hold = model.frame_gap
        for index in tqdm(range(config.episodes), desc="foresight", unit="episode"):
            setup = task.make_setup(env, index, config.seed)
            kit.begin(mark_of(setup), np.random.default_rng((config.seed, index)))
            oracle = OracleController(kit.simulator, kit.mark, hold=hold, **kit.planning_parts())
            onlooker = Onlooker(model, kit.camera, **kit.planning_parts())
            observation, goal = setup.start(env), setup.goal.point_world
            oracle.reset(observation, setup.goal)
            onlooker.reset(observation, setup.goal)
            for step in range(config.decisions * hold):
                onlooker.told = action = oracle.act(observation)
                onlooker.act(observation)
                if step % hold == 0:
                    plans = random_plans(rng, config.plans, task.planner.horizon, task.body.axes, task.body.limit)
                    held = np.repeat(oracle.effector.action(plans), hold, axis=1)
                    true = kit.simulator.paths(kit.simulator.state(), held, kit.mark).point[:, hold - 1 :: hold]
                    tracks, towards = onlooker.foresee(plans), onlooker.in_camera(goal)
                    end = kit.camera.to_world(tracks[-1].expected_position().cpu().numpy().astype(float))
                    distances = [track.expected_distance(towards).cpu().numpy() for track in tracks]
                    costs = np.linalg.norm(true - goal, axis=-1).mean(axis=1), np.mean(distances, axis=0)
                    found.add(true[:, -1] - point_position(env, kit.mark), end - onlooker.follower.point, costs)
                observation, *_ = env.step(action)
    finally:
        kit.close()
        env.close()
    return found.table()


def main(config: Config) -> None:
    """Compare, print, and write if asked to."""
    found = compare(config)
    print("true way, mm | plans | truly mm | foreseen mm | error mm | cosine")
    for row in found["ways"]:
        upto = "" if row["to_m"] is None else f"{1e3 * row['to_m']:.0f}"
        way, seen, error = (1e3 * row[name] for name in ("true_m", "foreseen_m", "error_m"))
        label = f"{1e3 * row['from_m']:.0f} to {upto}"
        print(f"{label:>12} | {row['plans']:5} | {way:8.1f} | {seen:11.1f} | {error:8.1f} | {row['cosine']:.2f}")
    if found["rank_correlation"] is not None:
        print(f"rank correlation of costs: {found['rank_correlation']:.2f}, over {found['decisions']} decisions")
    if config.out:
        config.out.parent.mkdir(parents=True, exist_ok=True)
        write_json(config.out, {"checkpoint": config.checkpoint, **found})


if __name__ == "__main__":
    command.run(Config, main)
