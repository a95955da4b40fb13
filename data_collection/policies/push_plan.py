"""How the push policy decides: where the next push starts and ends, and how the tip gets there around the object."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from envs.planar_push import PlanarPushEnv
from envs.planar_push.pieces import HALF_WIDTH, REACH, clearance
from envs.planar_push.scene import TIP_RADIUS

Array = NDArray[np.float64]

LENGTH = (0.05, 0.09)  # m, that the tip goes in a push; the object goes some of it
RUN_UP = (0.004, 0.012)  # m, free space before the contact
OFFSET = 0.016  # m, standard deviation of how far a push's line is from the middle of the object
MAX_OFFSET = 0.028  # m; every object is wider
ZONE = 0.09  # m, from the middle of the table: where pushes shall leave the object
CANDIDATES, CHOICES = 40, 3  # directions tried; of so many good ones the nearest is taken
AROUND = float(np.hypot(HALF_WIDTH + REACH, HALF_WIDTH)) + TIP_RADIUS + 0.012  # m, radius of the way round the object
SEARCH = np.arange(AROUND, 0.0, -0.0005)  # m, before the middle of the object: where the contact may be


@dataclass(frozen=True, eq=False)
class Push:
    """A straight push."""

    start: Array
    """(2,) of the tip, beside the object, metres."""
    end: Array
    """(2,) metres."""

    @property
    def direction(self) -> Array:
        """(2,) of length 1."""
        return (self.end - self.start) / np.linalg.norm(self.end - self.start)


def choose_push(env: PlanarPushEnv, rng: np.random.Generator) -> Push:
    """A push in a random direction, through a point near the middle of the object, that leaves it in view.

    Of a few that would do, the one whose start is nearest to the tip.
    """
    pose, (low, high) = env.object_pose, env.tip_workspace
    good: list[Push] = []
    for _ in range(CANDIDATES):
        push = _draw_push(env.object_name, pose, rng)
        inside = all((point > low).all() and (point < high).all() for point in (push.start, push.end))
        if inside and _keeps_in_view(pose[:2], push.direction):
            good.append(push)
            if len(good) == CHOICES:
                break
    if not good:  # at the edge: straight to the middle, as far as the workspace goes
        push = _push_along(env.object_name, pose, -pose[:2] / max(float(np.linalg.norm(pose[:2])), 1e-9), 0.0, rng)
        return Push(np.clip(push.start, low, high), np.clip(push.end, low, high))
    return min(good, key=lambda push: float(np.linalg.norm(push.start - env.tip_target)))


def way_round(env: PlanarPushEnv, push: Push, last_direction: Array | None, stride: float) -> Array:
    """Waypoints (N, 2) from the tip to the start of a push: back off, around the object on a spiral, and in again."""
    middle = env.object_pose[:2]
    corners = [env.tip_target]
    if last_direction is not None:
        corners.append(_leave(corners[0], -last_direction, middle))
    entry = _leave(push.start, -push.direction, middle)
    away, towards = corners[-1] - middle, entry - middle
    bearing, radius = np.arctan2(*away[::-1]), max(float(np.linalg.norm(away)), AROUND)
    turn = (np.arctan2(*towards[::-1]) - bearing + np.pi) % (2 * np.pi) - np.pi
    share = np.linspace(0, 1, 2 + int(abs(turn) / 0.1))
    angles, radii = bearing + turn * share, radius + (np.linalg.norm(towards) - radius) * share
    spiral = middle + radii[:, None] * np.column_stack([np.cos(angles), np.sin(angles)])
    return _resample(np.clip([*corners, *spiral, push.start], *env.tip_workspace), stride)


def _draw_push(name: str, pose: Array, rng: np.random.Generator) -> Push:
    heading = rng.uniform(-np.pi, np.pi)
    offset = np.clip(rng.normal(0, OFFSET), -MAX_OFFSET, MAX_OFFSET)
    return _push_along(name, pose, np.array([np.cos(heading), np.sin(heading)]), offset, rng)


def _push_along(name: str, pose: Array, direction: Array, offset: float, rng: np.random.Generator) -> Push:
    """The push along a line at this offset from the middle of the object; the tip starts just before the contact."""
    line = pose[:2] + offset * np.array([-direction[1], direction[0]])
    places = line - SEARCH[:, None] * direction
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    touching = clearance(name, (places - pose[:2]) @ np.array([[cos, -sin], [sin, cos]])) < TIP_RADIUS
    contact = places[np.argmax(touching)]
    start = contact - rng.uniform(*RUN_UP) * direction
    return Push(start, start + rng.uniform(*LENGTH) * direction)


def _keeps_in_view(middle: Array, direction: Array) -> bool:
    after = middle + np.mean(LENGTH) * direction
    return bool(after @ after < ZONE**2 or direction @ middle < -0.7 * np.linalg.norm(middle))


def _leave(point: Array, direction: Array, middle: Array) -> Array:
    """Where a ray (2,) from a point (2,) leaves the circle around the object; the point itself if it is outside."""
    offset = point - middle
    inside = AROUND**2 - offset @ offset
    if inside <= 0:
        return point
    along = offset @ direction
    return point + (np.sqrt(along**2 + inside) - along) * direction


def _resample(corners: Array, stride: float) -> Array:
    """Points (N, 2) on a line of corners (M, 2), `stride` metres apart, the last corner included, the first not."""
    lengths = np.linalg.norm(np.diff(corners, axis=0), axis=1)
    along = np.concatenate([[0.0], np.cumsum(lengths)])
    stops = np.linspace(0, along[-1], max(1, int(np.ceil(along[-1] / stride))) + 1)[1:]
    return np.column_stack([np.interp(stops, along, corners[:, axis]) for axis in range(2)])
