"""Sampling-based predictive control on the simulator itself: the hand turns the cube towards its goal.

A beam search through what the hand could do. A stage is a fifth of a second, in which the joint targets go straight to
a random new place. From the best states that the last stage led to, many such moves are simulated, and again the best
are kept. The first move is carried out when the search is some stages ahead of it, and the search goes on from there.
The policy looks into the simulator; the data that it makes does not.
"""

from __future__ import annotations

import weakref
from dataclasses import dataclass, field
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from data_collection.policies.predictive_cost import Array, Weights, step_costs
from envs.dexhand import DexHandEnv
from envs.dexhand.goals import rotation_distance
from envs.dexhand.simulate import BatchSimulator
from envs.errors import UsageError


@dataclass(frozen=True)
class Settings:
    """How the predictive policy searches."""

    stage: int = 5
    """Control steps in a stage."""
    ahead: int = 3
    """Stages that the search is ahead when a move is carried out."""
    samples: int = 240
    """Moves simulated in a stage."""
    beam: int = 16
    """States kept after a stage."""
    crowd: int = 3
    """Of those, how many at most may be `alike`."""
    alike: float = 0.15
    """Rad, between the orientations of cubes that are alike."""
    spread: tuple[float, ...] = (0.1, 0.3, 0.6)
    """Standard deviations of moves, in halves of the joints' ranges; equally many moves of each."""
    share: float = 0.4
    """Of the joints that a move moves, in the mean."""
    way: float = 0.3
    """What the mean cost of a stage weighs in the end, where the cost of the last moment weighs 1."""
    weights: Weights = field(default_factory=Weights)

    def __post_init__(self) -> None:
        for name in ("stage", "ahead", "samples", "beam", "crowd"):
            if getattr(self, name) < 1:
                raise UsageError(f"{name} is {getattr(self, name)}; give a whole number of at least 1")


@dataclass(frozen=True, eq=False)
class Beam:
    """States that the search has come to; all are as many stages ahead."""

    physics: Array
    """(B, P)"""
    targets: Array
    """(B, 20) the actions that they end with."""
    moves: Array
    """(B, stages, stage, 20) the actions that lead there from where the hand is now."""
    way: Array
    """(B,) what the way there has cost."""


class PredictivePolicy:
    """Turns the cube of a dexterous hand towards its goal; privileged.

    Args:
        settings: how to search.
        threads: moves simulated in parallel.
    """

    def __init__(self, settings: Settings | None = None, threads: int = 1) -> None:
        self._settings, self._threads = settings or Settings(), threads

    def reset(self, env: gymnasium.Env, rng: np.random.Generator) -> None:
        """Start an episode.

        Raises:
            UsageError: not a dexterous hand.
        """
        if not isinstance(env.unwrapped, DexHandEnv):
            raise UsageError(f"policy 'predictive' cannot act in {type(env.unwrapped).__name__}; use --env dexhand")
        self._env, self._rng = env.unwrapped, rng
        self._simulator = BatchSimulator(self._env, self._threads)
        weakref.finalize(self, self._simulator.close)
        self._start()
        self._step = 0

    def act(self, obs: dict[str, Any]) -> NDArray[Any]:
        """The next action (20,) in [-1, 1]; `obs` is not looked at."""
        if self._step == 0:
            self._move = self._next_move()
        action = self._move[self._step]
        self._step = (self._step + 1) % self._settings.stage
        return action.astype(np.float32)

    def _start(self) -> None:
        """Search from here, and from nothing known."""
        physics, action = self._simulator.physics(self._env.get_state()), self._env.last_action
        moves = np.empty((1, 0, self._settings.stage, len(action)))
        self._beam = Beam(physics[None], action[None], moves, np.zeros(1))
        self._goal = self._env.goal

    def _next_move(self) -> Array:
        """The actions (stage, 20) of the first move on the best way found."""
        if not np.array_equal(self._goal, self._env.goal):
            self._start()
        for _ in range(self._settings.ahead - self._beam.moves.shape[1]):
            self._beam = self._expand(self._beam)
        beam = self._beam
        move = beam.moves[0, 0]  # the best comes first
        same = (beam.moves[:, 0] == move).all((1, 2))
        self._beam = Beam(beam.physics[same], beam.targets[same], beam.moves[same, 1:], beam.way[same])
        return move

    def _expand(self, beam: Beam) -> Beam:
        """The best states a stage further on, the best first."""
        settings = self._settings
        parents = np.arange(settings.samples) % len(beam.physics)
        start, end = beam.targets[parents], self._new_targets(beam.targets[parents])
        share = (np.arange(1, settings.stage + 1) / settings.stage)[:, None]
        actions = start[:, None] + share * (end - start)[:, None]
        paths = self._simulator.go_on(beam.physics[parents], None, actions)
        costs = step_costs(settings.weights, paths, actions, self._goal)
        way = beam.way[parents] + settings.way * costs.mean(axis=1)
        kept = self._select(way + costs[:, -1], paths.cube_pose[:, -1, 3:])
        moves = np.concatenate([beam.moves[parents[kept]], actions[kept, None]], axis=1)
        return Beam(paths.end[kept], end[kept], moves, way[kept])

    def _select(self, costs: Array, orientations: Array) -> list[int]:
        """The numbers of the states to keep, the best first, no crowd of any orientation (N, 4) among them.

        A cube lies on a face, and the way to a better face leads over an edge, where it is worse for a while.
        """
        settings = self._settings
        kept: list[int] = []
        for number in np.argsort(costs, kind="stable"):
            if np.sum(rotation_distance(orientations[kept], orientations[number]) < settings.alike) < settings.crowd:
                kept.append(int(number))
                if len(kept) == settings.beam:
                    break
        return kept

    def _new_targets(self, targets: Array) -> Array:
        """Where moves from these targets (N, 20) go, (N, 20): nowhere, or some joints somewhere else."""
        settings, rng = self._settings, self._rng
        spread = rng.choice(settings.spread, size=(len(targets), 1))
        touched = rng.random(targets.shape) < settings.share
        new = np.clip(targets + touched * spread * rng.normal(size=targets.shape), -1, 1)
        new[: len(self._beam.physics)] = targets[: len(self._beam.physics)]
        return new
