"""One servo episode: a controller, a setup, a budget of steps, and how near it came."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from statistics import median
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from envs.camera import CameraModel
from planning.controllers.base import Controller
from planning.marks import Mark, point_position
from planning.point_setups import TOLERANCES, PointSetup
from planning.setups import Setup

THRESHOLDS = (0.1, 0.05, 0.025)  # shares of the initial distance; the first is the paper's
HITS = 5  # control steps that must be within a threshold
LAST_STEPS = 20  # by which it is told how far off a point stays once it is there
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
    """control steps within each of the limits"""
    hits_2d: list[int]
    final_distance: float
    final_pixel_distance: float
    least_distance: float
    plan_seconds: float
    """median wall time of a decision; 0 where none was taken down"""
    distances: list[float]
    """after every control step"""
    limits: list[float] = field(default_factory=lambda: list(THRESHOLDS))
    """what counts as near: shares of the initial distance, or, where the setup has a part, metres"""
    part: str = ""
    """the part of the setups that this one belongs to, where it is not the way's direction that parts them"""

    def success(self, limit: float, space: str) -> bool:
        """Whether the goal counts as reached, by one of the limits; `space` is "3d" or "2d"."""
        hits = self.hits_3d if space == "3d" else self.hits_2d
        return hits[self.limits.index(limit)] >= HITS

    def reached(self, space: str) -> bool:
        """Whether the goal counts as reached by the limit that decides."""
        return self.success(self.limits[0], space)

    @property
    def stay(self) -> float:
        """Mean distance over the last control steps, metres. It says where the point stays if the episode was whole."""
        return float(np.mean(self.distances[-LAST_STEPS:]))

    def to_dict(self) -> dict[str, Any]:
        """The record as JSON knows it."""
        return asdict(self)


def run_episode(
    env: gym.Env,
    setup: Setup,
    name: str,
    controller: Controller,
    steps: int,
    repeat: int = 0,
    watch: Watcher | None = None,
    whole: bool = False,
) -> Record:
    """Let a controller servo from a setup.

    Unless it is to be whole, the episode ends early when nothing is left to be found out about success: when the
    tightest limit has been met often enough, in 3D and in the picture.

    Args:
        env: where; the simulator is the judge, not shown to the controller.
        setup: where it starts and what the goal is.
        name: what the record calls the controller.
        controller: sees observations and the goal.
        steps: budget of control steps.
        repeat: number of this attempt at the setup.
        watch: called with the control step at the start and after every step, to film.
        whole: go on to the last step.
    """
    inner: Any = env.unwrapped
    camera = inner.camera
    observation = setup.start(env)
    controller.reset(observation, setup.goal)
    if watch:
        watch(0)
    limits, limits_3d, limits_2d = limits_of(setup, camera)
    mark = mark_of(setup)
    hits_3d, hits_2d = np.zeros(len(limits), int), np.zeros(len(limits), int)
    distances: list[float] = []
    pixel_distance = setup.pixel_distance
    for step in range(steps):
        observation, *_ = env.step(controller.act(observation))
        point = point_position(env, mark)
        distances.append(float(np.linalg.norm(point - setup.goal.point_world)))
        pixel_distance = float(np.linalg.norm(camera.project(camera.to_camera(point)) - setup.goal.pixel))
        hits_3d += distances[-1] <= limits_3d
        hits_2d += pixel_distance <= limits_2d
        if watch:
            watch(step + 1)
        if not whole and min(hits_3d.min(), hits_2d.min()) >= HITS:
            break
    return Record(
        model=name,
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
        plan_seconds=median(controller.plan_seconds or [0.0]),
        distances=[round(d, 5) for d in distances],
        limits=list(limits),
        part=setup.part if isinstance(setup, PointSetup) else "",
    )


def mark_of(setup: Setup) -> Mark | None:
    """Where a setup's point truly is; None for the end-effector's."""
    return setup.mark if isinstance(setup, PointSetup) else None


def limits_of(setup: Setup, camera: CameraModel) -> tuple[tuple[float, ...], NDArray, NDArray]:
    """What counts as near: as it is said, in metres, and in pixels.

    A point on a thing is to come within a distance in metres; in the picture, within what that is at the goal.
    """
    if not isinstance(setup, PointSetup):
        shares = np.array(THRESHOLDS)
        return THRESHOLDS, shares * setup.distance, shares * setup.pixel_distance
    metres = np.array(TOLERANCES)
    return TOLERANCES, metres, metres * camera.K[0, 0] / camera.to_camera(setup.goal.point_world)[2]
