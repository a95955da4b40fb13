"""How the play policy moves: waypoints, and a hand that follows them the way a person's does.

A damped second-order follower turns a waypoint into velocities: it accelerates, cruises at the waypoint's speed, slows
down when it comes near, and rounds the corner when the next waypoint takes over. Coloured noise is added to the
velocity, so that the hand wanders smoothly instead of trembling; it fades where a skill needs precision.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from data_collection.policies.coloured_noise import coloured_noise
from envs import rotations

Array = NDArray[np.float64]

GAIN = 0.25  # wanted velocity per unit of error, per control step
AGILITY = 0.5  # share of the way to the wanted velocity that is made in one control step
BRAKING = 0.2  # deceleration that the follower plans for, share of the action range per control step
NOISE_BETA = 1.5  # between pink and red
NOISE_SHARES = np.array([1.0, 1.0, 1.0, 0.5, 0.5, 0.5])  # less in the rotations
NOISE_PERIOD = 512  # control steps after which the noise repeats
POINTING_DOWN = np.array([0.0, 0.5**0.5, 0.5**0.5, 0.0])  # wxyz; the fingers open along x


@dataclass
class Waypoint:
    """Where the hand should be, and how it should get there.

    Attributes:
        position: (3,) TCP position in the world, metres.
        yaw: rotation of the fingers about the vertical, radians; None keeps the orientation as it is.
        tilt: (2,) further rotation about the world's x and y, radians.
        gripper: 1 opens, -1 closes.
        speed: largest velocity along an axis, as a share of the action range; above 1 several axes are at their limit.
        tolerance: distance at which the waypoint counts as reached, metres.
        turn_tolerance: angle at which it does, radians.
        dwell: control steps to stay after reaching it.
        noise: standard deviation of the velocity noise, as a share of the action range.
        patience: control steps beyond the expected duration after which it counts as missed.
        required: a skill that misses this waypoint is abandoned; otherwise it goes on with the next one.
    """

    position: Array
    yaw: float | None = None
    tilt: Sequence[float] | Array = (0.0, 0.0)
    gripper: float = 1.0
    speed: float = 0.6
    tolerance: float = 0.02
    turn_tolerance: float = np.inf
    dwell: int = 0
    noise: float = 0.15
    patience: int = 15
    required: bool = False


@dataclass
class Follower:
    """Smooth relative actions that take the target pose of the hand to a waypoint.

    Args:
        scale: (6,) metres and radians that an action of 1 moves the target pose by.
        rng: source of the noise.
    """

    scale: Array
    rng: np.random.Generator
    _velocity: Array = field(default_factory=lambda: np.zeros(6))
    _step: int = 0

    def __post_init__(self) -> None:
        self._noise = coloured_noise(NOISE_BETA, (6, NOISE_PERIOD), self.rng).T.copy()  # (NOISE_PERIOD, 6)

    def act(self, error: Array, speed: float, noise: float) -> Array:
        """One action.

        Args:
            error: (6,) from the target pose to the waypoint: metres, then rotation vector in the world, radians.
            speed: largest velocity along an axis, share of the action range; above 1 it saturates.
            noise: standard deviation of the noise on the velocity, share of the action range.

        Returns:
            (6,) in [-1, 1].
        """
        wanted = GAIN * error / self.scale
        for part in (slice(0, 3), slice(3, 6)):
            largest = np.abs(wanted[part]).max()
            # The speed from which a constant deceleration stops at the waypoint bounds the one on the way to it.
            limit = min(speed, (2.0 * BRAKING * largest / GAIN) ** 0.5)
            if largest > limit:
                wanted[part] *= limit / largest
        self._velocity += AGILITY * (wanted - self._velocity)
        action = self._velocity + noise * NOISE_SHARES * self._noise[self._step % NOISE_PERIOD]
        self._step += 1
        return np.clip(action, -1.0, 1.0)


def expected_steps(error: Array, scale: Array, speed: float) -> int:
    """Control steps that a follower of this scale (6,) takes over an error (6,) at this speed."""
    return int(np.abs(error / scale).max() / min(speed, 1.0)) + 8


def rotation_between(start: Array, end: Array) -> Array:
    """World-frame rotation vector (3,), radians, that turns the quaternion `start` into `end`, both (4,) wxyz."""
    return rotations.to_rotvec(rotations.multiply(end, rotations.conjugate(start)))


def hand_orientation(yaw: float, tilt: Sequence[float] | Array) -> Array:
    """Orientation (4,) wxyz of the hand; without yaw and tilt it points down and its fingers open along x."""
    about_z, about_xy = rotations.from_euler(np.array([[0.0, 0.0, yaw], [*tilt, 0.0]]))
    return rotations.multiply(about_xy, rotations.multiply(about_z, POINTING_DOWN))
