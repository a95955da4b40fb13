"""Where an episode starts: which object, how it is inside, where it lies, and where the tip is."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from envs.errors import UsageError
from envs.planar_push import objects, pieces
from envs.planar_push.control import WORKSPACE_HIGH, WORKSPACE_LOW
from envs.planar_push.hidden import NUMBERS, Hidden
from envs.planar_push.scene import TIP_RADIUS
from envs.reset_options import option_numbers

OBJECT_AREA = 0.07  # m, half the side of the square that the object's middle starts in
TIP_DISTANCE = (0.10, 0.16)  # m, from the middle of the object
BEARINGS = 2  # a stream of its own, beside those of the environment's noise
TRIES = 200


@dataclass(frozen=True, eq=False)
class Start:
    """The start of an episode."""

    object_name: str
    hidden: Hidden
    pose: NDArray[np.float64]
    """x, y, yaw of the object (3,), m and rad."""
    tip: NDArray[np.float64]
    """(2,) m"""
    noise_seed: int

    def with_options(self, options: Mapping[str, Any]) -> Start:
        """With what the options of `PlanarPushEnv.reset` say instead of what was drawn.

        Raises:
            UsageError: a value that does not fit, or the tip is inside of the object, or has no place beside it.
        """
        changes: dict[str, Any] = {}
        if "object" in options:
            changes["object_name"] = objects.canonical(options["object"])
        if "hidden" in options:
            given = options["hidden"]
            if not isinstance(given, Hidden):
                given = Hidden.from_vector(option_numbers("hidden", given, NUMBERS))
            changes["hidden"] = given
        if "pose" in options:
            changes["pose"] = option_numbers("pose", options["pose"], 3)
            changes["tip"] = self.tip + changes["pose"][:2] - self.pose[:2]
        if "tip" in options:
            changes["tip"] = option_numbers("tip", options["tip"], 2)
        start = dataclasses.replace(self, **changes)
        if "pose" in options and "tip" not in options:
            return start._with_tip_beside()
        if (start.tip < WORKSPACE_LOW).any() or (start.tip > WORKSPACE_HIGH).any():
            low, high = WORKSPACE_LOW.tolist(), WORKSPACE_HIGH.tolist()
            raise UsageError(f"the tip would start at {start.tip.tolist()}; choose tip between {low} and {high}")
        if start.clearance() < 0:
            raise UsageError(f"tip {start.tip.tolist()} is inside of the object; choose a place beside it")
        return start

    def _with_tip_beside(self) -> Start:
        """With the tip elsewhere around the object, as far from it, if it does not fit where it is."""
        middle = self.pose[:2]
        distance = np.linalg.norm(self.tip - middle)
        bearings = np.random.default_rng((self.noise_seed, 0, BEARINGS)).uniform(-np.pi, np.pi, TRIES)
        around = middle + distance * np.stack([np.cos(bearings), np.sin(bearings)], axis=1)
        for tip in (self.tip, *around):
            start = dataclasses.replace(self, tip=tip)
            if (tip >= WORKSPACE_LOW).all() and (tip <= WORKSPACE_HIGH).all() and start.clearance() >= 0:
                return start
        raise UsageError(f"pose {self.pose.tolist()} leaves the tip no place beside the object; choose one nearer to 0")

    def clearance(self) -> float:
        """Free space between tip and object, metres."""
        x, y, yaw = self.pose
        cos, sin = np.cos(yaw), np.sin(yaw)
        in_object = np.array([[cos, sin], [-sin, cos]]) @ (self.tip - [x, y])
        return float(pieces.clearance(self.object_name, in_object)) - TIP_RADIUS


def draw(names: Sequence[str], rng: np.random.Generator) -> Start:
    """A random start with one of these objects."""
    name, hidden = names[rng.integers(len(names))], Hidden.draw(rng)
    place, yaw = rng.uniform(-OBJECT_AREA, OBJECT_AREA, 2), rng.uniform(-np.pi, np.pi)
    bearing, distance = rng.uniform(-np.pi, np.pi), rng.uniform(*TIP_DISTANCE)
    tip = place + distance * np.array([np.cos(bearing), np.sin(bearing)])
    return Start(name, hidden, np.append(place, yaw), tip, int(rng.integers(2**53)))
