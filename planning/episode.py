"""One servo episode: a controller, a setup, a budget of steps, and how near it came."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from statistics import median
from typing import Any

import gymnasium as gym
import numpy as np

from planning.controllers.base import Controller
from planning.setups import Setup

THRESHOLDS = (0.1, 0.05, 0.025)  # shares of the initial distance; the first is the paper's
HITS = 5  # control steps that must be within a threshold
Watcher = Callable[[int], None]


@dataclass(frozen=True)
class Record:
    """What came of an episode; one line of `episodes.jsonl`. Distances in metres, those in the picture in pixels."""

    model: str
    setup: int
    repeat: int
    steps: int
    initial_distance: float
    initial_pixel_distance: float
    axis_share: float
    hits_3d: list[int]
    """control steps within each of THRESHOLDS of the initial distance"""
    hits_2d: list[int]
    final_distance: float
    final_pixel_distance: float
    least_distance: float
    plan_seconds: float
    """median wall time of a decision"""
    distances: list[float]
    """after every control step"""

    def success(self, threshold: float, space: str) -> bool:
        """Whether the goal counts as reached; `space` is "3d" or "2d"."""
        hits = self.hits_3d if space == "3d" else self.hits_2d
        return hits[THRESHOLDS.index(threshold)] >= HITS

    def to_dict(self) -> dict[str, Any]:
        """The record as JSON knows it."""
        return asdict(self)


def run_episode(
    env: gym.Env,
    setup: Setup,
    controller: Controller,
    steps: int,
    repeat: int = 0,
    watch: Watcher | None = None,
) -> Record:
    """Let a controller servo from a setup.

    The episode ends early only when nothing is left to be found out: when the tightest threshold has been met
    often enough, in 3D and in the picture.

    Args:
        env: where; its `tcp_position` is the judge, not shown to the controller.
        setup: where it starts and what the goal is.
        controller: sees observations and the goal.
        steps: budget of control steps.
        repeat: number of this attempt at the setup.
        watch: called with the control step at the start and after every step, to film.
    """
    tabletop: Any = env.unwrapped
    camera = tabletop.camera
    observation = setup.start(env)
    controller.reset(observation, setup.goal)
    if watch:
        watch(0)
    limits = np.array(THRESHOLDS)
    hits_3d, hits_2d = np.zeros(len(limits), int), np.zeros(len(limits), int)
    distances: list[float] = []
    pixel_distance = setup.pixel_distance
    for step in range(steps):
        observation, *_ = env.step(controller.act(observation))
        tcp = tabletop.tcp_position
        distances.append(float(np.linalg.norm(tcp - setup.goal.point_world)))
        pixel_distance = float(np.linalg.norm(camera.project(camera.to_camera(tcp)) - setup.goal.pixel))
        hits_3d += distances[-1] <= limits * setup.distance
        hits_2d += pixel_distance <= limits * setup.pixel_distance
        if watch:
            watch(step + 1)
        if min(hits_3d.min(), hits_2d.min()) >= HITS:
            break
    return Record(
        model=controller.name,
        setup=setup.index,
        repeat=repeat,
        steps=len(distances),
        initial_distance=setup.distance,
        initial_pixel_distance=setup.pixel_distance,
        axis_share=setup.axis_share,
        hits_3d=hits_3d.tolist(),
        hits_2d=hits_2d.tolist(),
        final_distance=distances[-1],
        final_pixel_distance=pixel_distance,
        least_distance=min(distances),
        plan_seconds=median(controller.plan_seconds),
        distances=[round(d, 5) for d in distances],
    )
