"""Goals: cube poses, how far one is from another, and what that is worth.

A pose is (..., 7): position, metres, and unit quaternion wxyz. Everything works over leading dimensions, as
hindsight relabelling needs it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from envs import rotations

Array = NDArray[np.float64]

HOME = np.array([1.0, 0.88, 0.16])  # m, where the cube lies in the hand; the position of every goal
ROTATION_REACHED, POSITION_REACHED = 0.2, 0.05  # rad, m
DROP_HEIGHT, DROP_RADIUS = 0.09, 0.13  # m, above the floor and, horizontally, from HOME
DROP_REWARD = -20.0  # of the step that drops the cube: as much as never reaching the goal, at a discount of 0.95
POSITION_WEIGHT = 10.0  # rad/m, in the dense reward; gymnasium-robotics'


def rotation_distance(one: ArrayLike, other: ArrayLike) -> Array:
    """The angle (...,) in [0, pi] between two orientations, unit quaternions (..., 4), exact also where it is small."""
    one, other = np.asarray(one, np.float64), np.asarray(other, np.float64)
    chord = np.minimum(np.linalg.norm(one - other, axis=-1), np.linalg.norm(one + other, axis=-1))
    return 4 * np.arcsin(np.minimum(chord / 2, np.sqrt(0.5)))


def distances(achieved: ArrayLike, desired: ArrayLike) -> tuple[Array, Array]:
    """Position (...,), metres, and rotation (...,), radians, between poses (..., 7)."""
    achieved, desired = np.asarray(achieved, np.float64), np.asarray(desired, np.float64)
    position = np.linalg.norm(achieved[..., :3] - desired[..., :3], axis=-1)
    return position, rotation_distance(achieved[..., 3:], desired[..., 3:])


def is_dropped(pose: ArrayLike) -> NDArray[np.bool_]:
    """Whether a cube at a pose (..., 7) has left the hand for good."""
    place = np.asarray(pose, np.float64)[..., :3]
    aside = np.linalg.norm(place[..., :2] - HOME[:2], axis=-1)
    return (place[..., 2] < DROP_HEIGHT) | (aside > DROP_RADIUS)


def is_reached(achieved: ArrayLike, desired: ArrayLike) -> NDArray[np.bool_]:
    """Whether the cube is as the goal asks: turned to within 0.2 rad, and in the hand, within 5 cm."""
    position, rotation = distances(achieved, desired)
    return (position < POSITION_REACHED) & (rotation < ROTATION_REACHED)


def reward(achieved: ArrayLike, desired: ArrayLike, dense: bool) -> NDArray[np.float32]:
    """What it is worth to have the cube at `achieved` when it shall be at `desired`.

    Args:
        achieved: (..., 7).
        desired: (..., 7).
        dense: less the rotation that is left, radians, and ten times the way that is left, metres; otherwise 0 where
            the goal is reached and -1 elsewhere.

    Returns:
        (...,) float32; `DROP_REWARD` where the cube is dropped.
    """
    position, rotation = distances(achieved, desired)
    value = -(POSITION_WEIGHT * position + rotation) if dense else is_reached(achieved, desired) - 1.0
    return np.where(is_dropped(achieved), DROP_REWARD, value).astype(np.float32)


def random_turn(max_angle: float, rng: np.random.Generator) -> Array:
    """A rotation, unit quaternion (4,), uniform over all those by at most `max_angle` radians."""
    angles = np.linspace(0, max_angle, 1000)  # in SO(3) the density of an angle a is proportional to 1 - cos a
    share = angles - np.sin(angles)
    angle = np.interp(rng.uniform(0, share[-1]), share, angles)
    axis = rng.normal(size=3)
    return np.append(np.cos(angle / 2), np.sin(angle / 2) * axis / np.linalg.norm(axis))


def draw_goal(cube_orientation: Array, max_angle: float, rng: np.random.Generator) -> Array:
    """A goal pose (7,): the cube's orientation (4,) turned by at most `max_angle` radians, and `HOME`."""
    orientation = rotations.multiply(random_turn(max_angle, rng), cube_orientation)
    return np.concatenate([HOME, orientation / np.linalg.norm(orientation)])
