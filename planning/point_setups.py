"""Setups whose point lies on a thing that has to be moved: what they share."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from planning.goals import Goal
from planning.marks import Mark
from planning.setups import Setup

TOLERANCES = (0.02, 0.01)  # metres from the goal; the first decides


@dataclass(frozen=True, eq=False)
class PointSetup(Setup):
    """A setup with a point on a thing.

    Attributes:
        mark: the designated point, for the judge and the oracle.
        part: which part of the setups it belongs to, a key of `planning.report.TITLES`.
    """

    mark: Mark
    part: str


def point_setup(
    env: gym.Env,
    index: int,
    env_seed: int,
    state: NDArray[np.float64],
    body: str,
    point: NDArray[np.float64],
    way: NDArray[np.float64],
    part: str,
) -> PointSetup:
    """The setup in which a point of a body is to go some way.

    Args:
        env: as it is at the start.
        index, env_seed, state: see `Setup`.
        body: its name.
        point: (3,) metres, world frame, where the camera sees it.
        way: (3,) metres, world frame.
        part: see `PointSetup`.
    """
    inner: Any = env.unwrapped
    camera = inner.camera
    start, end = camera.to_camera(point), camera.to_camera(point + way)
    pixel, distance = camera.project(end), float(np.linalg.norm(way))
    return PointSetup(
        index=index,
        env_seed=env_seed,
        state=state,
        goal=Goal(point + way, pixel, point),
        distance=distance,
        pixel_distance=float(np.linalg.norm(pixel - camera.project(start))),
        axis_share=float(abs(end[2] - start[2]) / distance),
        mark=Mark.at(env, body, point),
        part=part,
    )


def seen_on(
    env: gym.Env, body: str, depth: NDArray, rng: np.random.Generator, near: Callable[[NDArray], NDArray]
) -> NDArray[np.float64] | None:
    """A random point that the camera sees on a body, if possible none at its edge.

    Args:
        env: that renders.
        body: its name.
        depth: (H, W) metres, what is seen.
        rng: draws the pixel.
        near: says of what all pixels see, (H, W, 3) metres, world frame, which may be taken, (H, W) bool.

    Returns:
        (3,) metres, world frame; None where nothing such is seen.
    """
    inner: Any = env.unwrapped
    points = inner.camera.to_world(inner.camera.unproject(depth))
    shown = inner.segmentation() == inner.body_names.index(body)
    neighbours = [np.roll(shown, shift, axis) for axis in (0, 1) for shift in (1, -1)]
    usable = shown & near(points)
    within = usable & np.all(neighbours, axis=0)
    taken = np.argwhere(within if within.any() else usable)
    return points[tuple(taken[rng.integers(len(taken))])] if len(taken) else None
