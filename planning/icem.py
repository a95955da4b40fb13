"""iCEM: a cross-entropy method for real-time planning (Pinneri et al., CoRL 2020)."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from data_collection.policies.coloured_noise import coloured_noise
from envs.errors import UsageError

CostFunction = Callable[[NDArray[np.float64]], NDArray]
"""Action sequences (N, horizon, action_dim) -> costs (N,); one batched rollout of the model."""


@dataclass(frozen=True)
class ICEMConfig:
    """How iCEM searches; symbols are the paper's."""

    horizon: int = 2
    """actions planned ahead (h)"""
    population: int = 40
    """sequences sampled in the first iteration (N)"""
    iterations: int = 3
    """rounds of sampling and fitting"""
    elites: int = 10
    """sequences that the distribution is fitted to (K)"""
    decay: float = 1.25
    """the population shrinks by this factor from iteration to iteration (gamma), down to twice the elites"""
    momentum: float = 0.1
    """share of the old mean and deviation that stays (alpha)"""
    init_std: float = 0.5
    """deviation at the start of every plan, in halves of the action range (sigma_init). A wide search finds what a
    narrow one does not reach; a narrow one finds the small moves that are best near a goal"""
    noise_beta: float = 3.0
    """exponent of the coloured noise (beta); high is smooth"""
    keep_fraction: float = 0.3
    """share of the elites that compete again in the next iteration (xi)"""
    shift_fraction: float = 0.3
    """share of the elites that, shifted by one action, start the next plan (xi)"""

    def __post_init__(self) -> None:
        for name, least in (("horizon", 1), ("population", 4), ("iterations", 1), ("elites", 2)):
            if getattr(self, name) < least:
                raise UsageError(f"{name} is {getattr(self, name)}; give at least {least}")
        if not self.decay >= 1:
            raise UsageError(f"decay is {self.decay}; give 1 (constant population) or more")
        if not 0 < self.init_std < np.inf:
            raise UsageError(f"init_std is {self.init_std}; give a positive number of half action ranges")
        if not np.isfinite(self.noise_beta) or self.noise_beta < 0:
            raise UsageError(f"noise_beta is {self.noise_beta}; give 0 (white) or more")
        if not 0 <= self.momentum < 1:
            raise UsageError(f"momentum is {self.momentum}; give a number from 0 to below 1")
        for name in ("keep_fraction", "shift_fraction"):
            if not 0 <= getattr(self, name) <= 1:
                raise UsageError(f"{name} is {getattr(self, name)}; give a share from 0 to 1")

    @property
    def elite_count(self) -> int:
        """The elites there can be: at most half of the population, at least two."""
        return max(2, min(self.elites, self.population // 2))

    def populations(self) -> list[int]:
        """Freshly sampled sequences per iteration, e.g. 40, 32, 25."""
        sizes = [self.population]
        while len(sizes) < self.iterations:
            sizes.append(max(2 * self.elite_count, int(sizes[-1] / self.decay)))
        return sizes


@dataclass(frozen=True, eq=False)
class Plan:
    """What one search found.

    Attributes:
        actions: best sequence (horizon, action_dim), in the units of the bounds; the first one is to be executed.
        cost: its cost; infinite if every sequence of the search had a non-finite cost.
        rollouts: sequences that were simulated.
        complete: False if the deadline cut the search short.
    """

    actions: NDArray[np.float64]
    cost: float
    rollouts: int
    complete: bool


class ICEM:
    """Searches action sequences of least cost, warm-started from its previous plan.

    Args:
        config: the search.
        low, high: bounds of an action, (action_dim,), each low below its high.
        rng: where the samples come from.
        deadline: seconds after which `plan` returns the best so far; checked before each iteration but the first,
            against the time that the iteration is likely to take. None: no deadline.

    Raises:
        UsageError: the bounds leave nothing to search.
    """

    def __init__(
        self,
        config: ICEMConfig,
        low: NDArray,
        high: NDArray,
        rng: np.random.Generator,
        deadline: float | None = None,
    ) -> None:
        self.config = config
        self.low = np.asarray(low, np.float64)
        self.high = np.asarray(high, np.float64)
        self.rng = rng
        self.deadline = deadline
        self._check_bounds()
        self.reset()

    def reset(self) -> None:
        """Forget the previous plan."""
        centre = (self.low + self.high) / 2
        self.mean = np.tile(centre, (self.config.horizon, 1))  # (h, D)
        self._elites: NDArray[np.float64] | None = None  # of the previous plan, best first
        self._reset_std()

    def plan(self, cost_fn: CostFunction) -> Plan:
        """Search from the mean of the previous plan, shifted by one action.

        Args:
            cost_fn: called once per iteration with all sequences (N, horizon, action_dim) float64, within the bounds;
                returns costs (N,). A non-finite cost counts as infinite, and its sequence never becomes an elite.

        Returns:
            The best sequence of the last iteration's pool.
        """
        start, rollouts, populations = time.monotonic(), 0, self.config.populations()
        elites = np.empty((0, *self.mean.shape))
        elite_costs = np.empty(0)
        best, best_cost = self.mean.copy(), np.inf
        complete, lap = True, 0.0
        for iteration, population in enumerate(populations):
            began = time.monotonic()
            if iteration > 0 and self.deadline is not None and began - start + lap > self.deadline:
                complete = False
                break
            # Sample, with the last plan's elites in the first iteration and the mean in the last.
            samples = self._sample(population)
            if iteration == 0:
                samples = np.concatenate([samples, self._shifted_elites()])
            if iteration == len(populations) - 1:
                samples[0] = self.mean
            # Simulate everything in one call; what was simulated before keeps its cost.
            costs = self._evaluate(cost_fn, samples)
            rollouts += len(samples)
            kept = int(self.config.keep_fraction * len(elites))
            pool = np.concatenate([samples, elites[:kept]])
            costs = np.concatenate([costs, elite_costs[:kept]])
            # Select and fit.
            order = np.argsort(costs, kind="stable")[: self.config.elite_count]
            order = order[np.isfinite(costs[order])]
            if len(order) > 0:
                elites, elite_costs = pool[order], costs[order]
                best, best_cost = elites[0], float(elite_costs[0])
                self._fit(elites)
            lap = time.monotonic() - began
        self._elites = elites
        self.mean = np.concatenate([self.mean[1:], self.mean[-1:]])
        self._reset_std()
        return Plan(best.copy(), best_cost, rollouts, complete)

    def _check_bounds(self) -> None:
        same = self.low.ndim == 1 and self.low.shape == self.high.shape
        if not (same and np.all((self.low < self.high) & np.isfinite(self.high - self.low))):
            raise UsageError(
                f"low is {self.low.tolist()}, high is {self.high.tolist()}; give two lists of as many finite numbers,"
                " each low below its high"
            )

    def _reset_std(self) -> None:
        self.std = np.tile(self.config.init_std * (self.high - self.low) / 2, (self.config.horizon, 1))

    def _sample(self, count: int) -> NDArray[np.float64]:
        noise = coloured_noise(self.config.noise_beta, (count, len(self.low), self.config.horizon), self.rng)
        return np.clip(self.mean + self.std * noise.transpose(0, 2, 1), self.low, self.high)  # (N, h, D)

    def _shifted_elites(self) -> NDArray[np.float64]:
        """The previous plan's best, less the executed action, with a sampled last one."""
        if self._elites is None:
            return np.empty((0, *self.mean.shape))
        reused = self._elites[: int(self.config.shift_fraction * len(self._elites))]
        return np.concatenate([reused[:, 1:], self._sample(len(reused))[:, -1:]], axis=1)

    def _evaluate(self, cost_fn: CostFunction, samples: NDArray[np.float64]) -> NDArray[np.float64]:
        costs = np.asarray(cost_fn(samples), np.float64)
        if costs.shape != (len(samples),):
            raise ValueError(f"the cost function gave shape {costs.shape} for {len(samples)} sequences")
        return np.where(np.isfinite(costs), costs, np.inf)

    def _fit(self, elites: NDArray[np.float64]) -> None:
        alpha = self.config.momentum
        self.mean = (1 - alpha) * elites.mean(axis=0) + alpha * self.mean
        self.std = (1 - alpha) * elites.std(axis=0) + alpha * self.std
