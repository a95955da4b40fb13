"""Pushes, and what is none: moves that miss the object, graze it, end before it or come from afar; and waiting.

In pushes alone the tip hardly ever moves along its heading without the object going before it. A model that has seen
nothing else takes the heading for the cause and foresees pushes where nothing touches; a planner then believes it.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from data_collection.policies.push import PushPolicy
from data_collection.policies.push_plan import ZONE, Array

SHARES = {"push": 0.3, "poke": 0.45, "wander": 0.18, "wait": 0.07}
ASIDE = 0.06  # m, standard deviation of how far a poke's line is from the middle of the object; half of them miss it
LENGTH = (0.04, 0.28)  # m, of a poke
SPEED = (0.003, 0.014)  # m a control step
AREA = 0.17  # m, half the side of the square that the tip wanders in
WAIT = (2, 7)  # control steps
ANY_HEADING = 0.5  # share of the moves, other than pushes, whose heading is not their direction but a random one
TRIES = 20


class PokePolicy(PushPolicy):
    """Mixes the pushes of `PushPolicy` with moves that may or may not touch the object; privileged."""

    NAME = "poke"

    def _next_push(self) -> Iterator[NDArray[np.float32]]:
        kind = self._rng.choice(list(SHARES), p=list(SHARES.values()))
        if kind == "push":
            yield from super()._next_push()
            return
        self._last_direction = None  # there is nothing to back off from
        start = self._env.tip_target
        if kind == "wait":
            heading = self._rng.uniform(-np.pi, np.pi)
            for _ in range(self._rng.integers(*WAIT, endpoint=True)):
                yield self._move(start, heading)
            return
        end = self._poke(start) if kind == "poke" else self._rng.uniform(-AREA, AREA, 2)
        way = end - start
        steps = max(1, round(float(np.linalg.norm(way)) / self._rng.uniform(*SPEED)))
        random = self._rng.random() < ANY_HEADING
        heading = self._rng.uniform(-np.pi, np.pi) if random else float(np.arctan2(way[1], way[0]))
        for share in np.arange(1, steps + 1) / steps:
            yield self._move(start + share * way, heading)

    def _poke(self, start: Array) -> Array:
        """Where a straight move from here ends that goes by the object or into it, and leaves it in view."""
        low, high = self._env.tip_workspace
        middle = self._env.object_pose[:2]
        for _ in range(TRIES):
            towards = middle + self._rng.normal(0, ASIDE, 2) - start
            direction = towards / max(float(np.linalg.norm(towards)), 1e-9)
            end = start + self._rng.uniform(*LENGTH) * direction
            beyond = max(float((end - middle) @ direction), 0.0)  # how far the object may be taken along
            carried = middle + (beyond + 0.05) * direction
            if (end > low).all() and (end < high).all() and np.linalg.norm(carried) < ZONE + 0.03:
                return end
        return np.clip(self._rng.uniform(-AREA, AREA, 2), low, high)
