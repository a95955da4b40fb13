"""What the pictures do not show: how heavy an object is, where its weights are, and how rough everything is."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from envs.errors import UsageError

MASS = (0.3, 0.7)  # kg, without the weights
WEIGHT = (0.05, 0.25)  # kg
WEIGHT_SHARE = 0.5  # of the sides that carry one
TABLE_FRICTION = (0.15, 0.6)
TIP_FRICTION = (0.05, 0.6)

NUMBERS = 7


@dataclass(frozen=True)
class Hidden:
    """The hidden variables of an episode."""

    mass: float
    """Of the object without its weights, kg."""
    weights: tuple[float, float, float, float]
    """In the middle of each side, kg; 0 where there is none. They move the centre of mass by up to 2 cm."""
    table_friction: float
    """Coulomb coefficient between object and table."""
    tip_friction: float
    """Coulomb coefficient between object and tip."""

    def __post_init__(self) -> None:
        values = np.array([self.mass, *self.weights, self.table_friction, self.tip_friction], np.float64)
        if values.shape != (NUMBERS,) or not np.isfinite(values).all() or (values < 0).any() or self.mass <= 0:
            raise UsageError(f"hidden variables are {values.tolist()}; give a mass above 0 and nothing below 0")

    @classmethod
    def draw(cls, rng: np.random.Generator) -> Hidden:
        """Those of a new episode."""
        carried = rng.random(4) < WEIGHT_SHARE
        weights = np.where(carried, rng.uniform(*WEIGHT, 4), 0.0)
        return cls.from_vector([rng.uniform(*MASS), *weights, rng.uniform(*TABLE_FRICTION), rng.uniform(*TIP_FRICTION)])

    @classmethod
    def from_vector(cls, vector: ArrayLike) -> Hidden:
        """What `vector` gave.

        Raises:
            UsageError: not 7 fitting numbers.
        """
        values = np.asarray(vector, np.float64)
        if values.shape != (NUMBERS,):
            raise UsageError(f"hidden variables have shape {values.shape}; give {NUMBERS} numbers")
        mass, *weights, table_friction, tip_friction = values.tolist()
        return cls(mass, tuple(weights), table_friction, tip_friction)

    def vector(self) -> NDArray[np.float64]:
        """(7,): mass, four weights (kg), friction with the table, friction with the tip."""
        return np.array([self.mass, *self.weights, self.table_friction, self.tip_friction])
